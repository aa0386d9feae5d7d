"""Commands about runs: what is in one, and new ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctmap_gtsam.cli.guard import EXIT_INPUT
from ctmap_gtsam.cli.options import Assignments, ConfigFile, JsonFile, RunFolder, Scene, Seed, settings

if TYPE_CHECKING:
    from ctmap_gtsam.config import Config

simulate_app = typer.Typer(no_args_is_help=True, help="Make runs of which everything is known.")


def inspect(run: RunFolder, json_file: JsonFile = None, scene: Scene = None) -> None:
    """Say what a run holds, and everything that is wrong with it.

    Exits with 2 where a problem keeps the run from being used.

    Example: `ctmap inspect recordings/kitchen`
    """
    from ctmap_gtsam.cli.show import show_inspection
    from sequences.atomic import write_json
    from sequences.validation import inspect_run

    inspection = inspect_run(run, scene)
    show_inspection(inspection)
    if json_file is not None:
        write_json(json_file, inspection.to_json())
    if inspection.errors:
        raise typer.Exit(EXIT_INPUT)


@simulate_app.command()
def place(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder to write the run to.", show_default=False)],
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
    catalogue: Annotated[
        Path | None,
        typer.Option(
            "--catalogue",
            metavar="DIR",
            help="Folder with models/ as BOP keeps them, and perhaps catalogue.json: these things instead of ours.",
        ),
    ] = None,
) -> None:
    """Simulate visits to a place with household objects, as a camera would have recorded them.

    Example: `ctmap simulate place runs/simulated --seed 1`
    """
    simulate_into(run, settings(config_file, assignments, seed), catalogue)
    typer.echo(run)


def simulate_into(run: Path, config: Config, catalogue: Path | None = None) -> None:
    """Write a simulated run, with the things of a catalogue if one is given, showing progress."""
    from ctmap_gtsam.runtime.progress import RichProgress
    from sequences.simulation import simulate_place
    from sequences.simulation.models import load_shapes

    shapes = None if catalogue is None else load_shapes(catalogue)
    with RichProgress() as progress:
        simulate_place(run, config.simulation, config.seed, progress, shapes)


@simulate_app.command()
def detections(
    run: RunFolder,
    force: Annotated[bool, typer.Option("--force", help="Replace detections that no simulation made, too.")] = False,
    config_file: ConfigFile = None,
    assignments: Assignments = None,
    seed: Seed = None,
    scene: Scene = None,
) -> None:
    """Put a simulated detector before a run with truth: writes its scene_detections.json anew, nothing else.

    What shows is drawn from the truth and the run's meshes, and hidden by whatever the recorded depth has before it.

    Example: `ctmap simulate detections runs/simulated --set simulation.detector.noise=0.5 --seed 3`
    """
    from ctmap_gtsam.runtime.progress import RichProgress
    from sequences.simulation.redetection import simulate_detections

    config = settings(config_file, assignments, seed)
    with RichProgress() as progress:
        found = simulate_detections(
            run, config.simulation.detector, config.seed, scene=scene, force=force, progress=progress
        )
    typer.echo(f"{found} detections")
