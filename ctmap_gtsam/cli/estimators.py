"""Commands that estimate, and that compare and report estimates."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctmap_gtsam.cli.options import Assignments, ConfigFile, Out, RunFolder, Scene, Seed, settings, writable
from sequences.errors import InputError

if TYPE_CHECKING:
    from ctmap_gtsam.config import Config
    from ctmap_gtsam.methods import Method
    from ctmap_gtsam.smoothing.graph import Smoothed, SmootherGraph

NoContext = Annotated[bool, typer.Option("--no-context", help="Leave the context between objects out.")]
AsInPaper = Annotated[bool, typer.Option("--paper", help="Algorithm 1 and the potentials to the letter of the paper.")]


Lag = Annotated[
    int | None,
    typer.Option(
        "--lag",
        metavar="L",
        min=0,
        help="Estimate keyframe t from those up to t + L.",
        show_default="the whole run",
    ),
]


def filter(
    run: RunFolder,
    out: Out,
    no_context: NoContext = False,
    paper: AsInPaper = False,
    scene: Scene = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """Filter a run: each frame's map knows the past alone.

    Writes DIR/filter-ct.npz (filter-t without context, paper-ct and paper-t with --paper).

    Example: `ctmap filter recordings/kitchen --out results --set keyframes.every=2`
    """
    method = f"{'paper' if paper else 'filter'}-{'t' if no_context else 'ct'}"
    _estimate(method, run, scene, out, settings(config_file, assignments, seed))


def smooth(
    run: RunFolder,
    out: Out,
    no_context: NoContext = False,
    lag: Lag = None,
    graph: Annotated[
        Path | None, typer.Option("--graph", metavar="DIR", help="Folder for the factor graph, to look into.")
    ] = None,
    scene: Scene = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """Smooth a run: each frame's map knows the whole run, or with --lag the next L keyframes.

    Writes DIR/smooth-ct.npz (smooth-t without context, lag-ct with a lag, lag0-ct with a lag of 0). The whole run
    is smoothed in rounds after a filter's pass; what is there of them is kept in DIR/.METHOD until the end, and a
    command that was stopped goes on from it.

    With --graph also the last round's factors with their errors (factors.csv), the graph for Graphviz (graph.dot) and
    g2o (graph.g2o), and a picture (graph.png).

    Example: `ctmap smooth recordings/kitchen --out results --graph results/graph`
    """
    method = "smooth-t" if no_context else "smooth-ct"
    if lag is not None:
        for unfit, name in ((no_context, "--no-context"), (graph is not None, "--graph")):
            if unfit:
                raise InputError(f"a fixed lag can't be had with {name}", field="--lag", remedy=f"leave {name} out")
        method = "lag-ct" if lag else "lag0-ct"
        assignments = [*(assignments or []), f"smoother.lag={lag}"]
    folder = None if graph is None else writable(graph)
    _estimate(method, run, scene, out, settings(config_file, assignments, seed), folder)


def compare(
    run: RunFolder,
    out: Out,
    methods: Annotated[
        str | None, typer.Option("--methods", metavar="A,B,...", help="Only these methods.", show_default="all")
    ] = None,
    scene: Scene = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """Run all methods on a run and hold them against the truth and each other.

    Writes DIR/summary.json, DIR/report.html, DIR/estimates/ and each method's results. Methods that ran before
    with the same settings on the same run are not run again. Without --methods all run, the baselines among them, which
    take a fifth of the time; those named -oracle read the truth, as the paper's baselines do.

    Example: `ctmap compare recordings/kitchen --out results --methods filter-ct,smooth-ct --seed 1`
    """
    config = settings(config_file, assignments, seed)
    names = None if methods is None else [name.strip() for name in methods.split(",")]
    compare_and_show(run, writable(out), config, names, scene)


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where `ctmap compare` wrote.", show_default=False)],
) -> None:
    """Write DIR/report.html again, from the estimates that `ctmap compare` left there.

    Example: `ctmap report results`
    """
    from ctmap_gtsam.comparing import report as write_report

    typer.echo(write_report(folder))


def compare_and_show(run: Path, out: Path, config: Config, methods: list[str] | None, scene: int | None) -> None:
    """Compare, showing progress and then the table and where the report is."""
    from ctmap_gtsam.cli.show import show_summary
    from ctmap_gtsam.comparing import REPORT, SUMMARY, compare_run
    from ctmap_gtsam.runtime.progress import RichProgress

    with RichProgress() as progress:
        compare_run(run, out, config, methods, scene, progress)
    show_summary(out / SUMMARY)
    typer.echo(out / REPORT)


def _estimate(
    method: str, run_path: Path, scene: int | None, out: Path, config: Config, graph: Path | None = None
) -> None:
    from ctmap_gtsam.cli.show import show_estimate, show_solver
    from ctmap_gtsam.comparing import run_methods
    from ctmap_gtsam.runtime.progress import RichProgress
    from sequences.bop import load_run

    path, work = writable(out) / f"{method}.npz", out / f".{method}"
    run = load_run(run_path, scene=scene)
    with RichProgress() as progress:
        registry = None if graph is None else _looking(method, graph)
        store = work if graph is None else None  # the graph is of a solution that is not kept
        outcome = run_methods(run, [method], config, store, progress, registry)[method]
    if outcome.estimate is None:
        raise InputError(f"{method} can't run: {outcome.reason}", file=run_path, remedy=outcome.remedy)
    outcome.estimate.save(path)
    shutil.rmtree(work, ignore_errors=True)
    show_estimate(outcome.estimate, run.catalogue)
    show_solver(outcome.estimate, config.smoother)
    typer.echo(path)
    if graph is not None:
        typer.echo(graph)


def _looking(method: str, folder: Path) -> dict[str, Method]:
    """The methods, of which one, a smoother, writes its graph into a folder."""
    from ctmap_gtsam.export.graph import write_graph
    from ctmap_gtsam.methods import METHODS

    def look(graph: SmootherGraph, smoothed: Smoothed) -> None:
        write_graph(folder, graph, smoothed.solution.values)

    known = METHODS[method]
    assert known.run is not None
    return {**METHODS, method: replace(known, run=partial(known.run, look=look))}
