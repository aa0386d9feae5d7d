"""Commands that learn what the model takes for given."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ctmap_gtsam.cli.options import Assignments, ConfigFile, Seed, settings, writable
from ctmap_gtsam.cli.show import show_calibration, show_context, show_persistence

train_app = typer.Typer(no_args_is_help=True)

Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs.", show_default=False)]
Estimates = Annotated[
    list[Path] | None,
    typer.Option(
        "--estimate",
        metavar="NPZ",
        help="An estimate of one of the runs, used in place of its truth; repeatable.",
    ),
]
Settings = Annotated[
    Path, typer.Option("--out", metavar="FILE", help="A new TOML file of settings, for --config.", show_default=False)
]


@train_app.callback()
def train() -> None:
    """Learn what the model takes for given, from runs."""


@train_app.command()
def persistence(
    runs: Runs,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="A new catalogue.json.", show_default=False)],
    estimates: Estimates = None,
    by: Annotated[
        Literal["category", "class"], typer.Option("--by", help="Whose classes share their mu.")
    ] = "category",
) -> None:
    """Learn how long things stay where they were put (mu of Equation 3), from gaps between visits.

    Moves come from the truth of a run, or from an estimate of it, whose own prior is taken out first. Writes a
    catalogue.json of all the runs' classes, with what was learned and how well it is known (95 % of the posterior).

    Example: `ctmap train persistence recordings/kitchen --estimate results/smooth-ct.npz --out catalogue.json`
    """
    from ctmap_gtsam.learning.persistence import described, learn_from
    from sequences.atomic import write_json

    writable(out.parent)
    catalogue, learned = learn_from(runs, estimates or [], by=by)
    write_json(out, described(catalogue, learned))
    show_persistence(learned, catalogue)
    typer.echo(out)


@train_app.command()
def context(runs: Runs, out: Settings, estimates: Estimates = None) -> None:
    """Learn what stands beside what (the category level of Equation 5), from many places.

    Each run is a place. Pairs of one category, of two categories and of two classes are held to how things of other
    categories stand in the same places; few places teach no relation. Poses come from the truth of a run, or from an
    estimate of it. Writes settings, [context.relations], with the 95 % interval of each as a comment.

    Example: `ctmap train context places/* --out context.toml`, then `ctmap smooth RUN --config context.toml --out DIR`
    """
    from ctmap_gtsam.learning.context import described, learn_from
    from sequences.atomic import write_text

    writable(out.parent)
    learned = learn_from(runs, estimates or [])
    write_text(out, described(learned))
    show_context(learned)
    typer.echo(out)


@train_app.command()
def calibration(
    runs: Runs,
    out: Settings,
    every: Annotated[int, typer.Option("--every", metavar="N", min=2, help="The shorter runs: 1 frame in N.")] = 3,
    config: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """Fit the depth's noise, kappa and bias, and the detector's errors, to runs with truth.

    Everything is fitted to all frames, to one in --every, and to the first half of each visit: where the answers are
    apart by more than their 95 % intervals the model counts something twice, which is said on stderr. Writes settings,
    [sensor] and [detector], fitted to all frames. Estimators never read the truth; this does.

    Example: `ctmap train calibration places/* --out fit.toml`, then `ctmap compare RUN --out DIR --config fit.toml`
    """
    from ctmap_gtsam.learning.calibration import calibrate, described
    from ctmap_gtsam.runtime.progress import RichProgress
    from sequences.atomic import write_text

    writable(out.parent)
    with RichProgress() as progress:
        fitted = calibrate(runs, settings(config, assignments, seed), every, progress)
    write_text(out, described(fitted))
    show_calibration(fitted, settings(config, assignments, seed))
    typer.echo(out)
