"""Seconds to solve the smoother's graph: our loop, and GTSAM's own on the same Python factors and on C++ factors alone.

A camera goes round four things and sees each in every keyframe; GTSAM's C++ factors can say the same where the things
have no symmetry, the error of a visit is held at next to nothing and localisation errs afresh in each keyframe:

    ours              `smoothing.solver.optimise` on the graph that the smoother builds
    gtsam_lm_custom   GTSAM's LevenbergMarquardtOptimizer on the same graph
    gtsam_lm_cpp      the same optimiser on PriorFactorPose3 and BetweenFactorPose3 alone, which say the same in fewer
                      variables
    smoother          ours once more, with the configured error of a visit and localisation that drifts

They are measured in turn; a figure is the median over turns, a ratio the median of the ratios within a turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.graph import Camera, Measured, SmootherGraph, build, camera_key, object_key
from ctmap_gtsam.smoothing.solver import optimise
from sequences import se3
from sequences.progress import SILENT, Progress
from sequences.seeds import generator
from sequences.simulation.shapes import catalogue, household
from sequences.types import LocalisationNoise

Array = NDArray[np.float64]

POSES = 2000
SIZES = (500, 1000, 2000, 4000, 8000)
TURNS = 3
THINGS = 4
VISIT = 40  # keyframes
STEP_S = 0.2
NEXT_TO_NOTHING = 1e-6  # rad, metres
MODE_SIGMAS = np.repeat([0.02, 0.004], 3)  # rad, metres
CAMERA_SIGMAS = np.repeat([0.004, 0.005], 3)
DRIFT_S = 10.0


@dataclass(frozen=True)
class Task:
    """A run's recorded cameras and measured modes."""

    model: Model
    cameras: tuple[Camera, ...]
    noise: LocalisationNoise
    objects: Mapping[int, tuple[Shape, Sequence[Measured]]]

    def graph(self) -> SmootherGraph:
        """As the smoother builds it."""
        return build(self.model, self.cameras, self.noise, self.objects)


def run(config: Config, progress: Progress = SILENT) -> dict[str, float | str | None]:
    """Measure.

    Returns:
        `<method>.s` at POSES poses, `ours.over_gtsam_lm_cpp` and `smoother.over_gtsam_lm_cpp` (smaller is better),
        `gtsam_lm_custom.over_ours`, how far our answer is from that of the C++ factors (`ours.apart_mm`,
        `ours.apart_mrad`, the largest over all poses), `ours.s_<n>` and `smoother.s_<n>` at each of SIZES, and
        `<method>.growth`: seconds a pose at the largest of them over those at the smallest.
    """
    task = make_task(config, POSES)
    built, drifting, cpp = task.graph(), make_task(config, POSES, drifting=True).graph(), cpp_graph(task)
    methods: dict[str, Callable[[], Any]] = {
        "ours": partial(ours, built, config),
        "smoother": partial(ours, drifting, config),
        "gtsam_lm_cpp": partial(gtsam_lm, *cpp, config),
        "gtsam_lm_custom": partial(gtsam_lm, built.to_gtsam(), built.initial, config),
    }
    seconds = measure("methods", methods, progress)
    figures: dict[str, float | str | None] = {"task.poses": POSES, "task.factors": len(built.labels)}
    figures |= {f"{name}.s": float(np.median(each)) for name, each in seconds.items()}
    for name in ("ours", "smoother"):
        figures[f"{name}.over_gtsam_lm_cpp"] = float(np.median(seconds[name] / seconds["gtsam_lm_cpp"]))
    figures["gtsam_lm_custom.over_ours"] = float(np.median(seconds["gtsam_lm_custom"] / seconds["ours"]))
    turned, moved = apart(ours(built, config), gtsam_lm(*cpp, config))
    figures |= {"ours.apart_mrad": 1e3 * turned, "ours.apart_mm": 1e3 * moved}
    return figures | _growth(config, progress)


def _growth(config: Config, progress: Progress) -> dict[str, float]:
    """Seconds of our loop by the number of poses."""
    methods = {
        f"{name}.s_{n}": partial(ours, make_task(config, n, drifting=drifting).graph(), config)
        for name, drifting in (("ours", False), ("smoother", True))
        for n in SIZES
    }
    seconds = measure("sizes", methods, progress)
    figures = {figure: float(np.median(each)) for figure, each in seconds.items()}
    small, large = SIZES[0], SIZES[-1]
    for name in ("ours", "smoother"):
        growth = seconds[f"{name}.s_{large}"] / seconds[f"{name}.s_{small}"]
        figures[f"{name}.growth"] = float(np.median(growth)) * small / large
    return figures


def measure(name: str, methods: Mapping[str, Callable[[], Any]], progress: Progress = SILENT) -> dict[str, Array]:
    """Seconds (TURNS,) of each method, in turn."""
    seconds = {method: np.zeros(TURNS) for method in methods}
    with progress.stage(name, total=TURNS * len(methods)) as stage:
        for turn in range(TURNS):
            for method, call in methods.items():
                began = time.perf_counter()
                call()
                seconds[method][turn] = time.perf_counter() - began
                stage.advance()
    return seconds


def make_task(config: Config, poses: int, *, drifting: bool = False) -> Task:
    """Keyframes and measurements of so many camera and object poses together.

    Args:
        config: settings; of the sensor's bias where it drifts.
        poses: a multiple of THINGS + 1.
        drifting: whether localisation errs from keyframe to keyframe and visits share an error, which no C++ factor
            can say.
    """
    rng = generator(config.seed, "bench.solver")
    if not drifting:
        still = dict.fromkeys(
            ("bias_rotation_rad", "bias_translation_m", "bias_surface_m", "bias_size"), NEXT_TO_NOTHING
        )
        config = replace(config, sensor=replace(config.sensor, **still))
    model = Model(catalogue(tuple(s for s in household() if s.object_class.name == "mug")), config, context=False)
    noise = LocalisationNoise(CAMERA_SIGMAS[0], CAMERA_SIGMAS[3], DRIFT_S if drifting else 1e-3 * STEP_S)
    n = poses // (THINGS + 1)
    turn = 0.1 * np.arange(n)
    recorded = se3.exp(np.stack([np.zeros(n), np.zeros(n), turn, np.cos(turn), np.sin(turn), np.zeros(n)], axis=-1))
    cameras = tuple(Camera(recorded[k], k * STEP_S, k // VISIT) for k in range(n))
    true_cameras = se3.retract(recorded, rng.normal(size=(n, 6)) * CAMERA_SIGMAS)
    things = se3.exp(rng.normal(size=(THINGS, 6)) * np.repeat([1.0, 0.3], 3))
    seen = se3.inverse(true_cameras) @ things[:, None]
    seen = se3.retract(seen, rng.normal(size=(THINGS, n, 6)) * MODE_SIGMAS)
    covariance = np.diag(MODE_SIGMAS**2)
    objects = {
        i: (
            model.shapes[0],
            [Measured(k, c.time_s, c.visit, seen[i, k], covariance, stays=k > 0) for k, c in enumerate(cameras)],
        )
        for i in range(THINGS)
    }
    return Task(model, cameras, noise, objects)


def cpp_graph(task: Task) -> tuple[Any, Any]:
    """gtsam.NonlinearFactorGraph of GTSAM's own factors alone, and gtsam.Values, of a task that doesn't drift."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    located = gtsam.noiseModel.Diagonal.Sigmas(CAMERA_SIGMAS)
    for k, camera in enumerate(task.cameras):
        pose = gtsam.Pose3(camera.T_world_camera)
        graph.add(gtsam.PriorFactorPose3(camera_key(k), pose, located))
        values.insert(camera_key(k), pose)
    for i, (_, measured) in task.objects.items():
        for before, m in zip([None, *measured], measured, strict=False):
            key, mode = object_key(i, m.keyframe), gtsam.Pose3(m.T_camera_centre)
            noise = gtsam.noiseModel.Gaussian.Covariance(m.covariance)
            graph.add(gtsam.BetweenFactorPose3(camera_key(m.keyframe), key, mode, noise))
            values.insert(key, gtsam.Pose3(task.cameras[m.keyframe].T_world_camera).compose(mode))
            if before is not None:
                sigma = task.model.prediction_covariance(m.time_s - before.time_s)
                noise = gtsam.noiseModel.Gaussian.Covariance(sigma)
                previous = object_key(i, before.keyframe)
                graph.add(gtsam.BetweenFactorPose3(previous, key, gtsam.Pose3(), noise))
    return graph, values


def ours(built: SmootherGraph, config: Config) -> Any:
    """gtsam.Values at the end of our loop."""
    smoother = config.smoother
    return optimise(
        built.problem(), built.initial, max_iterations=smoother.max_iterations, tolerance=smoother.tolerance
    ).values


def gtsam_lm(graph: Any, values: Any, config: Config) -> Any:
    """gtsam.Values at the end of GTSAM's, asked for the same tolerance."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.smoother.max_iterations)
    parameters.setRelativeErrorTol(config.smoother.tolerance)
    parameters.setAbsoluteErrorTol(config.smoother.tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def apart(values: Any, others: Any) -> tuple[float, float]:
    """The largest turn in rad and shift in metres between the poses of the same keys."""
    keys = list(gtsam.utilities.allPose3s(values).keys())
    A, B = (np.stack([v.atPose3(key).matrix() for key in keys]) for v in (values, others))
    r = se3.local(A, B)
    return float(np.linalg.norm(r[:, :3], axis=-1).max()), float(np.linalg.norm(r[:, 3:], axis=-1).max())
