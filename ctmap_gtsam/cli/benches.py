"""Commands that measure: speed on this machine, and what the estimators reach on simulated places."""

from __future__ import annotations

from pathlib import Path

import typer

from ctmap_gtsam.cli.options import Assignments, ConfigFile, JsonFile, Seed, settings

bench_app = typer.Typer(no_args_is_help=True, help="Measure speed, and what the estimators reach.")


@bench_app.command()
def render(
    json_file: JsonFile = None, config_file: ConfigFile = None, assignments: Assignments = None, seed: Seed = None
) -> None:
    """Hypotheses rendered and scored a second on this machine, beside Open3D and pyrender.

    Example: `ctmap bench render --json render.json`
    """
    _figures("render", json_file, config_file, assignments, seed)


def _figures(
    name: str, json_file: Path | None, config_file: Path | None, assignments: list[str] | None, seed: int | None
) -> None:
    """Measure, print the figures and write them."""
    from ctmap_gtsam.bench import run_bench
    from ctmap_gtsam.runtime.progress import RichProgress
    from sequences.atomic import write_json

    with RichProgress() as progress:
        result = run_bench(name, settings(config_file, assignments, seed), progress)
    for figure, value in result["figures"].items():
        typer.echo(f"{figure} {value:.6g}" if isinstance(value, float) else f"{figure} {value}")
    if json_file is not None:
        write_json(json_file, result)
