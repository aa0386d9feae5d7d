"""Results as tables on stdout."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from ctmap_gtsam.config import Config
    from ctmap_gtsam.estimate import Estimate
    from ctmap_gtsam.learning.calibration import Calibration, Fitted
    from ctmap_gtsam.learning.context import Learned
    from ctmap_gtsam.learning.persistence import Persistence
    from ctmap_gtsam.parameters import Smoother
    from sequences.catalogue import Catalogue
    from sequences.validation import Facts, Inspection


def show_inspection(inspection: Inspection) -> None:
    """What is there, then every problem."""
    if inspection.facts is not None:
        _show_facts(inspection.facts)
    for problem in inspection.problems:
        typer.echo(str(problem))
    warnings = len(inspection.problems) - len(inspection.errors)
    typer.echo(f"{len(inspection.errors)} errors, {warnings} warnings")


def _show_facts(facts: Facts) -> None:
    truth = f"known, {facts.true_objects} objects, {facts.true_moves} moves" if facts.has_truth else "not known"
    up = "not given" if facts.up_world is None else " ".join(f"{x:.3f}" for x in facts.up_world)
    noise = ", ".join(f"{name} {value:g}" for name, value in facts.localisation.items())
    typer.echo(f"{facts.name}: {facts.frames} frames in {facts.duration_s:.1f} s; truth {truth}")
    typer.echo(f"up in the world: {up}; localisation noise: {noise}; fingerprint {facts.fingerprint[:12]}\n")
    _show_table(
        ("scene", "frames", "seconds", "size", "colour", "detections"),
        (
            (v.scene_id, v.frames, f"{v.duration_s:.1f}", f"{v.width}x{v.height}", _yes(v.colour), v.detections)
            for v in facts.visits
        ),
    )
    _show_table(
        ("obj_id", "class", "category", "persistence s", "diameter mm", "faces", "symmetries"),
        (
            (c.obj_id, c.name, c.category, f"{c.persistence_s:g}", f"{c.diameter_m * 1e3:.0f}", c.faces, c.symmetries)
            for c in facts.classes
        ),
    )
    for note in facts.derived:
        typer.echo(f"taken for granted: {note}")


def show_persistence(learned: Sequence[Persistence], catalogue: Catalogue) -> None:
    """mu of each group of classes, and how well it is known."""
    _show_table(
        ("classes", "mu s", "from", "to", "gaps", "moves"),
        (
            (
                ", ".join(catalogue[i].name for i in one.obj_ids),
                f"{one.mu_s:.4g}",
                *(f"{end:.3g}" for end in one.interval_s),
                one.gaps,
                f"{one.moves:.1f}",
            )
            for one in learned
        ),
    )


def show_context(learned: Sequence[Learned]) -> None:
    """Each relation, and how well it is known."""
    _show_table(
        ("pairs of", "strength", "from", "to", "distance m", "sigma m", "area m2", "pairs", "independent", "places"),
        (
            (
                "one category" if one.names is None else " and ".join(one.names),
                *(f"{x:.2f}" for x in (one.relation.strength, *one.strength)),
                *(f"{x:.3g}" for x in (one.relation.distance_m, one.relation.sigma_m, one.relation.area_m2 or 0.0)),
                one.pairs,
                f"{one.independent:.1f}",
                one.places,
            )
            for one in learned
        ),
    )


def show_calibration(calibration: Calibration, config: Config) -> None:
    """Each setting as it was and as each length of run has it; then where these disagree, on stderr."""
    from ctmap_gtsam.learning.calibration import ALL

    _show_table(
        ("setting", "was", *(f"{name} (95 %)" for name in calibration.lengths), "object-visits"),
        (
            (
                f"{one.section}.{one.name}",
                f"{getattr(getattr(config, one.section), one.name):g}",
                *(_with_interval({**calibration.beside(one), ALL: one}.get(name)) for name in calibration.lengths),
                one.visits,
            )
            for one in calibration.fitted
        ),
    )
    for one, length, other in calibration.disagreeing():
        setting = f"{one.section}.{one.name}"
        message = f"{setting} hangs on the run's length: {_with_interval(one)}, {length} {_with_interval(other)}"
        typer.echo(f"warning: {message}", err=True)


def _with_interval(one: Fitted | None) -> str:
    """Nothing where a run of that length says nothing of it."""
    return "" if one is None else f"{one.value:.3g} ({one.interval[0]:.3g} to {one.interval[1]:.3g})"


def show_estimate(estimate: Estimate, catalogue: Catalogue) -> None:
    """The map at the last keyframe."""
    k = len(estimate.keyframe_frame) - 1
    snapshot = estimate.at_keyframe(k)
    _show_table(
        ("object", "class", "P", "x m", "y m", "z m"),
        (
            (estimate.object_id[row], catalogue[int(obj_id)].name, f"{score:.3f}", *(f"{x:.3f}" for x in T[:3, 3]))
            for row, obj_id, score, T in zip(
                snapshot.objects, snapshot.class_id, snapshot.score, snapshot.T_world_object, strict=True
            )
        ),
    )


def show_solver(estimate: Estimate, settings: Smoother) -> None:
    """On stderr, where a smoother's solver ended in another way than at a minimum."""
    told = estimate.meta.get("diagnostics", {}).get("solver")
    if told is None or told["end"] == "converged":
        return
    trace = told["trace"]
    if told["end"] == "cap":
        fell = trace[-2] - trace[-1]
        typer.echo(
            f"the solver hasn't converged: the last of smoother.max_iterations = {settings.max_iterations} steps still "
            f"lowered the energy by {fell:.3g} of {trace[-1]:.6g} nats (smoother.tolerance = {settings.tolerance:g})",
            err=True,
        )
    else:
        typer.echo(
            f"the solver has stalled after {len(trace) - 1} steps at {trace[-1]:.6g} nats: no step lowers the energy, "
            "though the factors' derivatives say that one should",
            err=True,
        )


def show_summary(path: Path) -> None:
    """The methods side by side, as a comparison's summary.json has them."""
    from ctmap_gtsam.reporting.tables import COLUMNS

    methods = json.loads(path.read_text())["methods"]
    done = {name: method for name, method in methods.items() if method["status"] == "ok"}
    _show_table(
        ("method", *(f"{c.title} {c.unit}".rstrip() for c in COLUMNS), "seconds"),
        (
            (name, *(c.text(method["metrics"].get(c.key)) for c in COLUMNS), f"{method['seconds']:.1f}")
            for name, method in done.items()
        ),
    )
    for name, method in methods.items():
        if method["status"] == "skipped":
            typer.echo(f"{name} skipped: {method['reason']} {method['remedy']}".rstrip())
        elif method["reads_truth"]:
            typer.echo(f"{name} reads the truth")


def _show_table(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    cells = [list(columns), *(list(map(str, row)) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    typer.echo()


def _yes(value: bool) -> str:
    return "yes" if value else "no"
