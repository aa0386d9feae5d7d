"""report.html: one file that needs no network and says in a minute what was compared and what came out."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ctmap_gtsam.evaluation.agreement import Agreement
from ctmap_gtsam.evaluation.comparison import REFERENCE, Comparison
from ctmap_gtsam.evaluation.outcome import Outcome
from ctmap_gtsam.reporting import plot, tables
from ctmap_gtsam.reporting.colours import class_colours, css
from sequences.types import Run

PICTURES = 3
"""Frames shown as overlays"""

FILTER = "filter-ct"
"""The method that the reference is shown beside"""


@dataclass(frozen=True)
class Picture:
    """One frame with each shown method's map over it."""

    title: str
    images: Sequence[tuple[str, str]]
    """method, JPEG as a data: address"""


def render(
    run: Run,
    comparison: Comparison,
    outcomes: Mapping[str, Outcome],
    *,
    seed: int,
    versions: Mapping[str, str],
) -> str:
    """The whole page as text.

    Args:
        run: its images are read for the overlays.
        comparison: from `compare`, of the estimates in `outcomes`.
        outcomes: by name of method, in the order of the tables.
        seed: of the configuration.
        versions: of what ran, by package.
    """
    shown = shown_methods(outcomes)
    agreement = comparison.agreement.get(shown[0]) if len(shown) > 1 else None
    columns, more = (tables.known_columns(comparison, some) for some in (tables.COLUMNS, tables.MORE_COLUMNS))
    environment = Environment(
        loader=PackageLoader("ctmap_gtsam.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html").render(
        run=run,
        facts=_facts(run, seed),
        headline=headline(comparison, shown),
        has_truth=comparison.truth is not None,
        columns=columns,
        method_rows=tables.method_rows(comparison, outcomes, columns),
        more_columns=more,
        more_rows=tables.more_rows(comparison, outcomes, more) if more else [],
        oracles=[name for name, outcome in outcomes.items() if outcome.reads_truth and outcome.status == "ok"],
        shown=shown,
        pictures=_pictures(run, outcomes, shown, telling_frames(comparison, agreement)),
        legend=_legend(run, outcomes, shown),
        error_plot=_figure(plot.error_over_time(comparison, shown)) if _drawable(comparison, shown) else None,
        belief_plot=_figure(plot.belief_over_time(comparison, shown)) if _drawable(comparison, shown) else None,
        object_columns=tables.OBJECT_COLUMNS,
        object_rows=tables.object_rows(comparison, [name for name in shown if name in comparison.methods]),
        agreement=agreement,
        changes=tables.changes(comparison, agreement) if agreement else [],
        agreement_columns=tables.AGREEMENT_COLUMNS,
        agreement_rows=tables.agreement_rows(comparison),
        reference=comparison.reference,
        filtered=_filtered(outcomes, shown),
        stages=tables.stage_rows(outcomes),
        notes=notes(run, outcomes),
        versions=versions,
    )


def shown_methods(outcomes: Mapping[str, Outcome]) -> list[str]:
    """The filter and the smoother: the two (or the one, or none) whose maps are drawn side by side."""
    posed = [name for name, outcome in outcomes.items() if outcome.estimate is not None]
    chosen = []
    for preferred, family in ((FILTER, "filter"), (REFERENCE, "smooth")):
        named = [name for name in posed if name == preferred] or [name for name in posed if name.startswith(family)]
        chosen += named[:1]
    return chosen or posed[:2]


def headline(comparison: Comparison, shown: Sequence[str]) -> str:
    """The outcome in a sentence or two."""
    if comparison.truth is None:
        return "The truth about this run is not known, so methods are held to each other, not judged."
    if not shown:
        return "No method with poses ran."
    first, *rest = [_verdict(name, comparison.methods[name].metrics) for name in reversed(shown)]
    return ". ".join([first, *(f"Beside it, {sentence}" for sentence in rest)]) + "."


def _verdict(name: str, metrics: Mapping[str, Any]) -> str:
    accuracy, error = metrics["class_accuracy"], metrics["mssd_mm_median"]
    if accuracy is None:
        return f"{name} had no visible object to find"
    far = (
        "half of them have no pose"
        if error is None
        else f"surfaces are {error:.1f} mm off where they are furthest (median)"
    )
    mistakes = [
        f"{metrics[key]} {word}"
        for key, word in (("missed_objects", "missed"), ("false_positive_objects", "false"))
        if metrics[key]
    ]
    end = f"objects: {' and '.join(mistakes)}" if mistakes else "nothing is missed, nothing invented"
    return f"{name} calls objects what they are in {100 * accuracy:.0f} % of the views; {far}; {end}"


def telling_frames(comparison: Comparison, agreement: Agreement | None) -> list[int]:
    """A few frames worth looking at: early, where the two maps differ most, and the last."""
    n = len(comparison.time_s)
    if n == 0:
        return []
    differs = np.zeros(n)
    for thing in agreement.objects if agreement else ():
        far = np.minimum(np.nan_to_num(thing.distance_m, nan=0.0, posinf=1.0) / 0.05, 1.0)
        differs += np.where(thing.visible, far + (thing.reference_class != thing.other_class), 0.0)
    middle = int(np.argmax(differs)) if differs.max() > 0.1 else n // 2
    chosen: list[int] = []
    for frame in (middle, n - 1, n // 8, n // 2, 3 * n // 4):
        if len(chosen) < PICTURES and all(abs(frame - other) >= max(1, n // 5) for other in chosen):
            chosen.append(frame)
    return sorted(chosen)


def notes(run: Run, outcomes: Mapping[str, Outcome]) -> list[str]:
    """What the reader should know of the data and of what methods said about themselves."""
    said = [
        f"{name}: {note}"
        for name, outcome in outcomes.items()
        if outcome.estimate is not None
        for note in outcome.estimate.meta.get("notes", ())
    ]
    return [*run.notes, *said]


def _facts(run: Run, seed: int) -> list[tuple[str, str]]:
    frames = run.frames
    seconds = sum((v.frames[-1].time_ns - v.frames[0].time_ns) * 1e-9 for v in run.visits if v.frames)
    visits = f"{len(run.visits)} visit{'s' if len(run.visits) != 1 else ''}"
    size = f"{frames[0].camera.width} × {frames[0].camera.height}" if frames else "no frames"
    return [
        ("recorded", f"{visits}, {len(frames)} frames, {seconds:.1f} s, {size}"),
        ("catalogue", f"{len(run.catalogue)} classes"),
        ("seed", str(seed)),
        ("fingerprint", run.fingerprint[:12]),
    ]


def _pictures(run: Run, outcomes: Mapping[str, Outcome], shown: Sequence[str], frames: Iterable[int]) -> list[Picture]:
    out = []
    for f in frames:
        frame = run.frames[f]
        images = []
        for name in shown:
            estimate = outcomes[name].estimate
            assert estimate is not None
            image = plot.overlay(run, frame, estimate.at(frame.time_ns, frame.T_world_camera))
            images.append((name, "data:image/jpeg;base64," + base64.b64encode(plot.jpeg(image)).decode()))
        seconds = (frame.time_ns - run.visits[frame.visit].frames[0].time_ns) * 1e-9
        visit = f", {seconds:.2f} s into visit {frame.visit + 1}" if len(run.visits) > 1 else f", {seconds:.2f} s"
        out.append(Picture(f"Frame {f} of {len(run.frames)}{visit}", images))
    return out


def _legend(run: Run, outcomes: Mapping[str, Outcome], shown: Sequence[str]) -> list[tuple[str, str]]:
    """Name and colour of the classes that any shown map holds."""
    held: set[int] = set()
    for name in shown:
        estimate = outcomes[name].estimate
        assert estimate is not None
        held |= {int(c) for c in np.unique(estimate.best_class[estimate.exists])}
    colours = class_colours(run.catalogue)
    return [(run.catalogue[c].name.replace("_", " "), css(colours[c])) for c in sorted(held)]


def _filtered(outcomes: Mapping[str, Outcome], shown: Sequence[str]) -> tuple[str, Markup] | None:
    """The first shown method that says how its particles did, and the plot of that."""
    for name in shown:
        estimate = outcomes[name].estimate
        figure = None if estimate is None else plot.filter_over_time(estimate)
        if figure is not None:
            return name, _figure(figure)
    return None


def _drawable(comparison: Comparison, shown: Sequence[str]) -> bool:
    if comparison.truth is not None:
        return bool(comparison.labels) and bool(shown)
    return any(comparison.agreement[name].objects for name in shown if name in comparison.agreement)


def _figure(figure: Any) -> Markup:
    return Markup(plot.svg(figure))
