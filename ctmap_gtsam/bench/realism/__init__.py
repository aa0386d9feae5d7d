"""Whether simulated depth is as hard as real depth: both held to the true surface, side by side.

Three kinds of recording are measured in the same way: real ones with truth (`ycb_desk`, an Asus Xtion, and `visp_rbt`,
a RealSense D435), the synthetic twin of each (the same scene before the simulator's sensor), and simulated places.
Planes, which need no truth, compare the noise further away, with a Kinect too (`tum_cabinet`).
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctmap_gtsam.bench.realism import planes
from ctmap_gtsam.bench.realism.planes import Patches
from ctmap_gtsam.bench.realism.residuals import Glance, Items, Picture, figures, glances, picture
from ctmap_gtsam.bench.realism.twin import Twin
from ctmap_gtsam.config import Config
from sequences.bop import load_run, load_truth
from sequences.camera import Camera
from sequences.errors import InputError
from sequences.images import read_depth
from sequences.progress import SILENT, Progress, Stage
from sequences.rendering.scene import SceneImages
from sequences.simulation import SimulationConfig, simulate_place
from sequences.types import Depth, Frame, Run, Truth

RECORDINGS = {"ycb_desk": 2, "visp_rbt": 6}
"""name -> every so-many-th frame is measured"""
KINECT = "tum_cabinet"
KINECT_CAMERA = Camera(535.4, 539.2, 320.1, 247.6, width=640, height=480)
KINECT_M = 1.0 / 5000.0  # metres a count of its depth images
KINECT_EVERY = 6
TWIN_SEEDS = 3
PLACE_SEEDS = (0, 1)  # of those that tuning may see
PLACE_FRAMES = 10
PLACES, TWIN = "places", "_twin"
NOT_EASIER = (
    "spread_mm",
    "beyond_3_sigma",
    "beyond_5_mm",
    "kurtosis",
    *(f"correlation_{lag}" for lag in (1, 2, 4, 8, 16)),
    "holes_interior",
    "holes_edge",
    "bias_mm",
    "lasting_mm",
)
"""What a twin is compared in, all of them the worse the larger"""


@dataclass(frozen=True)
class Measured:
    """One recording, or all simulated places."""

    name: str
    glances: tuple[Glance, ...] = ()
    patches: Patches | None = None
    picture: Picture | None = None


def run(
    config: Config, progress: Progress = SILENT, data: Path | None = None, out: Path | None = None
) -> dict[str, float | str | None]:
    """Measure.

    Args:
        config: its `simulation` is what is compared.
        progress: is told of each recording.
        data: folder of the real recordings; only places are measured where not given.
        out: folder for the plots; none are made where not given.

    Returns:
        `<recording>.<figure>` for each recording, `<recording>_twin.<figure>`, `places.<figure>`, and
        `<recording>_twin.over_real.<figure>`: above 1, simulated depth is the harder. docs/benchmarks.md says what the
        figures are. `<recording>.skipped` is the reason where a real recording isn't there.
    """
    results: dict[str, float | str | None] = {}
    measured: list[Measured] = []
    with progress.stage("realism", total=2 * len(RECORDINGS) + 2) as stage:
        for name in RECORDINGS:
            measured += _recording(name, data, config, results, stage)
        measured += _kinect(data, results)
        stage.advance()
        measured.append(_places(config))
        stage.advance()
    for one in measured:
        results |= {f"{one.name}.{figure}": _number(value) for figure, value in _figures(one).items()}
    for name in RECORDINGS:
        results |= _over_real(name, results)
    if out is not None:
        from ctmap_gtsam.bench.realism.plots import plot

        plot(measured, out)
    return results


def _recording(name: str, folder: Path | None, config: Config, results: dict[str, Any], stage: Stage) -> list[Measured]:
    """A real recording and its twin; nothing, with the reason, where it isn't there."""
    loaded = _load(name, folder, results)
    if loaded is None:
        return []
    recording, truth = loaded
    every = RECORDINGS[name]
    real = Measured(
        name,
        tuple(glances(recording, truth, every, _as_recorded)),
        Patches((frame.read_depth(), frame.camera) for frame in recording.frames[::every]),
        picture(recording, truth, _as_recorded),
    )
    stage.advance()
    sensors = [Twin(recording, truth, config.simulation.sensor, seed).measure for seed in range(TWIN_SEEDS)]
    twin = Measured(
        name + TWIN,
        tuple(_told_apart(g, k) for k, sensor in enumerate(sensors) for g in glances(recording, truth, every, sensor)),
        picture=picture(recording, truth, sensors[0]),
    )
    stage.advance()
    return [real, twin]


def _load(name: str, folder: Path | None, results: dict[str, Any]) -> tuple[Run, Truth] | None:
    if folder is None or not (folder / name).is_dir():
        results[f"{name}.skipped"] = _missing(name, folder)
        return None
    recording = load_run(folder / name)
    return recording, _truth(recording)


def _missing(name: str, folder: Path | None) -> str:
    where = "no folder of recordings is given" if folder is None else f"{folder} has no {name}"
    return f"{where}: give theirs with --data, or as CTMAP_DATA"


def _told_apart(glance: Glance, seed: int) -> Glance:
    """The same thing measured with another seed is another thing: its error is drawn anew."""
    visit, inst_id = glance.thing
    return replace(glance, thing=(visit + 1000 * seed, inst_id))


def _kinect(folder: Path | None, results: dict[str, Any]) -> list[Measured]:
    if folder is None or not (folder / KINECT / "depth").is_dir():
        results[f"{KINECT}.skipped"] = _missing(KINECT, folder)
        return []
    size = (KINECT_CAMERA.width, KINECT_CAMERA.height)
    files = sorted((folder / KINECT / "depth").glob("*.png"))[::KINECT_EVERY]
    return [Measured(KINECT, patches=Patches((read_depth(file, KINECT_M, size), KINECT_CAMERA) for file in files))]


def _places(config: Config) -> Measured:
    """A few places of the settings, simulated for this and thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        places = [_place(Path(folder) / str(seed), _short(config.simulation), seed) for seed in PLACE_SEEDS]
        seen = (_told_apart(g, k) for k, place in enumerate(places) for g in glances(*place, 1, _as_recorded))
        images = ((frame.read_depth(), frame.camera) for place, _ in places for frame in place.frames)
        return Measured(PLACES, tuple(seen), Patches(images), picture(*places[0], _as_recorded))


def _place(folder: Path, simulation: SimulationConfig, seed: int) -> tuple[Run, Truth]:
    simulate_place(folder, simulation, seed)
    place = load_run(folder)
    return place, _truth(place)


def _truth(run: Run) -> Truth:
    truth = load_truth(run)
    if truth is None:
        raise InputError("has no truth", file=run.path, remedy="add scene_gt.json to each scene")
    return truth


def _short(simulation: SimulationConfig) -> SimulationConfig:
    """One visit of a few frames, its colours drawn fast."""
    return replace(
        simulation,
        motion=replace(simulation.motion, visits=1),
        trajectory=replace(simulation.trajectory, frames=PLACE_FRAMES),
        sensor=replace(simulation.sensor, antialias=1),
    )


def _as_recorded(frame: Frame, items: Items, images: SceneImages) -> Depth:
    return frame.read_depth()


def _figures(one: Measured) -> dict[str, float]:
    out = figures(one.glances) if one.glances else {}
    return out | (planes.figures(one.patches) if one.patches is not None else {})


def _over_real(name: str, results: dict[str, Any]) -> dict[str, float | None]:
    """How much worse the twin is than the recording, figure by figure."""
    return {
        f"{name}{TWIN}.over_real.{figure}": _ratio(results[f"{name}{TWIN}.{figure}"], results[f"{name}.{figure}"])
        for figure in NOT_EASIER
        if f"{name}.{figure}" in results
    }


def _ratio(simulated: float | None, real: float | None) -> float | None:
    return None if simulated is None or not real else simulated / real


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
