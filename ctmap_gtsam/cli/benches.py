"""Commands that measure: speed on this machine, and what the estimators reach on simulated places."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ctmap_gtsam.cli.options import Assignments, ConfigFile, JsonFile, Out, Seed, settings, writable

EXIT_FAILED = 1

bench_app = typer.Typer(no_args_is_help=True, help="Measure speed, and what the estimators reach.")


@bench_app.command()
def render(
    json_file: JsonFile = None, config_file: ConfigFile = None, assignments: Assignments = None, seed: Seed = None
) -> None:
    """Hypotheses rendered and scored a second on this machine, beside Open3D and pyrender.

    Example: `ctmap bench render --json render.json`
    """
    _figures("render", json_file, config_file, assignments, seed)


@bench_app.command()
def solver(
    json_file: JsonFile = None, config_file: ConfigFile = None, assignments: Assignments = None, seed: Seed = None
) -> None:
    """Seconds to solve the smoother's graph, beside GTSAM's own optimiser on the same and on C++ factors.

    Example: `ctmap bench solver --json solver.json`
    """
    _figures("solver", json_file, config_file, assignments, seed)


@bench_app.command()
def paper(
    out: Out,
    seeds: Annotated[
        str, typer.Option("--seeds", metavar="SET", help="Places: tuning, reported, or seeds such as 0-4,7.")
    ] = "reported",
    quick: Annotated[bool, typer.Option("--quick", help="Short for the first three of the tuning seeds.")] = False,
    passes: Annotated[
        str,
        typer.Option(
            "--pass", metavar="A,B,...", help="main, wrong-x4, wrong-/4, shuffled, an ablation, passes, ablations."
        ),
    ] = "main",
    methods: Annotated[
        str | None, typer.Option("--methods", metavar="A,B,...", help="Only these methods.", show_default="all")
    ] = None,
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="Run each method with so many seeds.")] = 1,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes.", show_default="one a core")
    ] = None,
    keep_runs: Annotated[bool, typer.Option("--keep-runs", help="Keep the simulated runs, some 60 MB each.")] = False,
    freeze: Annotated[
        bool, typer.Option("--freeze", help="Only simulate the reported places and write their hashes: a new set.")
    ] = False,
    json_file: JsonFile = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """The paper's Table I and pose accuracy on simulated places (synthetic), beside the paper's figures.

    Writes DIR/paper.json, DIR/paper.md and plots. What is in DIR already, of the same settings and code, is not done
    again, so it may be stopped at any time; the passes add to what is there. The settings are the benchmark's own,
    unless --config gives others.

    Example: `ctmap bench paper --quick --out paper-quick`
    """
    from ctmap_gtsam.bench import paper as bench
    from ctmap_gtsam.runtime.progress import RichProgress
    from sequences.atomic import write_json

    config = settings(config_file or bench.SETTINGS, assignments, seed)
    protocol = bench.load_protocol()
    task = bench.Task(
        seeds=protocol.seeds("quick" if quick else seeds),
        passes=protocol.choose(passes),
        methods=None if methods is None else tuple(name.strip() for name in methods.split(",")),
        repeats=repeats,
    )
    with RichProgress() as progress:
        workshop = bench.Workshop(
            workers=workers, keep_runs=keep_runs, progress=progress, say=lambda line: typer.echo(line, err=True)
        )
        if freeze:
            failures = bench.freeze(writable(out), config, protocol, workshop)
        else:
            outcome = bench.run_paper(writable(out), config, task, workshop)
            failures = outcome.failures
            typer.echo(outcome.tables)
            if json_file is not None:
                write_json(json_file, outcome.result)
    if failures:
        raise typer.Exit(EXIT_FAILED)


@bench_app.command()
def realism(
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="DIR", envvar="CTMAP_DATA", help="Folder of the real recordings."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for plots and pictures.")] = None,
    json_file: JsonFile = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """Depth about the true surface: real recordings beside their synthetic twins and simulated places.

    Spread, tails, correlation over pixels, holes and bias. `over_real` above 1: simulated depth is the harder.

    Example: `ctmap bench realism --data recordings --out realism --json realism.json`
    """
    folder = None if out is None else writable(out)
    _figures("realism", json_file, config_file, assignments, seed, data=data, out=folder)


@bench_app.command()
def detector(
    seeds: Annotated[
        str, typer.Option("--seeds", metavar="SET", help="Places: tuning, reported, or seeds such as 0-4,7.")
    ] = "tuning",
    json_file: JsonFile = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """The simulated detector's mAP against its knob on the paper's benchmark, and the knob for the paper's mAP.

    Only what shows is drawn, so twenty places take minutes. The settings are the benchmark's, unless --config gives
    others; the knob goes into [simulation.detector] of what is to use it.

    Example: `ctmap bench detector --seeds 0-4`
    """
    from ctmap_gtsam.bench.paper import SETTINGS, load_protocol

    chosen = load_protocol().seeds(seeds)
    _figures("detector", json_file, config_file or SETTINGS, assignments, seed, seeds=chosen)


@bench_app.command()
def highlight(
    out: Out,
    json_file: JsonFile = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """The paper's highlight figure on simulated cases (synthetic): what a map corrects of the detector's errors.

    Loofah to bowl by depth, milk to shampoo by context, a table that is missed under its cloth. Writes
    DIR/highlight.png; the figures say what each method makes of the thing in question.

    Example: `ctmap bench highlight --out highlight`
    """
    _figures("highlight", json_file, config_file, assignments, seed, out=writable(out))


Quick = Annotated[bool, typer.Option("--quick", help="Few objects and keyframes, to try it out.")]
Keep = Annotated[
    Path | None,
    typer.Option("--keep", metavar="DIR", help="Keep what each run took, and go on from there if it is stopped."),
]


@bench_app.command(name="filter")
def filter_(
    quick: Quick = False,
    keep: Keep = None,
    json_file: JsonFile = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """The filter's keyframes a second against objects, particles and the length of the run, and its memory (synthetic).

    A camera goes round a table, 640 x 480; 5 to 40 things are in view all the time. The whole takes most of an hour;
    --keep holds what was measured; what another version took is measured again. Seconds are CPU seconds.

    Example: `ctmap bench filter --quick --json filter.json`
    """
    folder = None if keep is None else writable(keep)
    _figures("filter", json_file, config_file, assignments, seed, sizes=_sizes(quick), keep=folder)


@bench_app.command()
def smooth(
    quick: Quick = False,
    keep: Keep = None,
    json_file: JsonFile = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """The smoother's time beside the filter's, against objects and the length of the run, and its memory (synthetic).

    The runs are those of `ctmap bench filter`, which aren't measured again where it has kept them.

    Example: `ctmap bench smooth --quick --json smooth.json`
    """
    folder = None if keep is None else writable(keep)
    _figures("smooth", json_file, config_file, assignments, seed, sizes=_sizes(quick), keep=folder)


def _sizes(quick: bool) -> Any:
    from ctmap_gtsam.bench.scaling.sizes import FULL, QUICK

    return QUICK if quick else FULL


@bench_app.command()
def spread(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Recordings that have a truth.", show_default=False)
    ],
    methods: Annotated[
        str, typer.Option("--methods", metavar="A,B,...", help="Methods of `ctmap compare`.")
    ] = "filter-ct,smooth-ct",
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Run each method with so many seeds.")] = 10,
    disturb: Annotated[
        bool, typer.Option("--disturb", help="Give the recorded cameras an error of 2 cm and 2 degrees.")
    ] = False,
    json_file: JsonFile = None,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """Every metric on recordings over several seeds: median and extremes, so that chance isn't taken for progress.

    Example: `ctmap bench spread recordings/desk --seeds 10 --disturb --json spread.json`
    """
    names = tuple(name.strip() for name in methods.split(","))
    options = {"runs": tuple(runs), "methods": names, "seeds": seeds, "disturb": disturb}
    _figures("spread", json_file, config_file, assignments, seed, **options)


def _figures(
    name: str,
    json_file: Path | None,
    config_file: Path | None,
    assignments: list[str] | None,
    seed: int | None,
    **options: Any,
) -> None:
    """Measure, print the figures and write them."""
    from ctmap_gtsam.bench import run_bench
    from ctmap_gtsam.runtime.progress import RichProgress
    from sequences.atomic import write_json

    with RichProgress() as progress:
        result = run_bench(name, settings(config_file, assignments, seed), progress, **options)
    for figure, value in result["figures"].items():
        typer.echo(f"{figure} {value:.6g}" if isinstance(value, float) else f"{figure} {value}")
    if json_file is not None:
        write_json(json_file, result)
