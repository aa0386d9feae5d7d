"""Commands around the estimators: the demo, the settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctmap_gtsam.cli.estimators import compare_and_show
from ctmap_gtsam.cli.options import Assignments, ConfigFile, Seed, settings, writable
from ctmap_gtsam.cli.runs import simulate_into

DEMO_SETTINGS = Path(__file__).parent / "demo.toml"
DEMO_METHODS = ["detector", "filter-ct", "smooth-ct"]


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the run and the results.")] = Path(
        "ctmap-demo"
    ),
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
) -> None:
    """Simulate a small run, filter it, smooth it, compare the two and write a report.

    The settings are the demo's own, unless --config gives others.

    Example: `ctmap demo --out ctmap-demo`
    """
    chosen = settings(config_file or DEMO_SETTINGS, assignments, seed)
    run = writable(out) / "run"
    simulate_into(run, chosen)
    compare_and_show(run, out, chosen, DEMO_METHODS, scene=None)


def config(config_file: ConfigFile = None, assignments: Assignments = None, seed: Seed = None) -> None:
    """Print all settings as commented TOML, ready for --config.

    Example: `ctmap config --set keyframes.every=2 > settings.toml`
    """
    from ctmap_gtsam.runtime.settings import to_toml

    typer.echo(to_toml(settings(config_file, assignments, seed)), nl=False)
