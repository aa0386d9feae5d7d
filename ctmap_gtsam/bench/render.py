"""Hypotheses rendered and scored a second: the fused kernel beside Open3D and pyrender, on the same poses and tile.

All three end in the same number, a hypothesis's log-likelihood ratio on a depth tile, so the figures of the references
hold the scoring of their tiles too. They are measured in turn, several times, and a figure is the median: what else the
machine does then falls on all of them. A ratio is the median of the ratios within a turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numba
import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.frontend.scoring import Tile, score_depth
from factors.measurement import DepthModel, depth_log_ratio
from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.meshes import simplify
from sequences.progress import SILENT, Progress
from sequences.rendering import RENDERERS, DepthRenderer
from sequences.rendering.rasteriser import Rasteriser
from sequences.seeds import generator
from sequences.simulation.shapes import mug

Array = NDArray[np.float64]

TURNS = 7
HYPOTHESES = 1000
LEAST_SECONDS = 0.2  # a method is called again and again for so long in each turn
TILE = 40  # samples a side
DISTANCE_M = 0.8
PLANE_M = 0.86  # the depth of what is behind


@dataclass(frozen=True)
class Task:
    """What all renderers get."""

    mesh: Mesh
    tile: Tile
    T_camera_object: Array
    """(K, 4, 4)"""
    model: DepthModel
    margin_m: float


def run(config: Config, progress: Progress = SILENT) -> dict[str, float | str | None]:
    """Measure.

    Returns:
        `fused.hypotheses_per_s`, the same for `fused_open` (the mesh with a hole, so that no back face may be left
        out) and for each of the references that can render here, `fused.over_<reference>`, and how far a reference
        is from the rasteriser: `<reference>.agreement_mm_p99` over samples that both cover,
        `<reference>.silhouette_share` of covered samples that one of them doesn't, `<reference>.score_nats_p50`. A
        reference that can't render here has null figures and `<reference>.skipped`, the reason.
    """
    task = make_task(config)
    opened = replace(task, mesh=Mesh(task.mesh.vertices, task.mesh.faces[1:], task.mesh.colours))
    references = {name: kind() for name, kind in RENDERERS.items() if name != Rasteriser.name}
    reasons = {name: renderer.available() for name, renderer in references.items()}
    usable = {name: renderer for name, renderer in references.items() if reasons[name] is None}
    methods: dict[str, Callable[[], Array]] = {"fused": partial(fused, task), "fused_open": partial(fused, opened)}
    methods |= {name: partial(rendered, task, renderer) for name, renderer in usable.items()}
    seconds = measure(methods, progress)
    covered = Rasteriser().render(task.mesh, task.tile.camera, task.T_camera_object) > 0
    figures: dict[str, float | str | None] = {
        "task.faces": len(task.mesh.faces),
        "task.covered_samples": float(covered.sum(axis=(1, 2)).mean()),
        "task.threads": numba.get_num_threads(),
    }
    for name in methods:
        figures[f"{name}.hypotheses_per_s"] = float(np.median(HYPOTHESES / seconds[name]))
    for name, renderer in usable.items():
        figures[f"fused.over_{name}"] = float(np.median(seconds[name] / seconds["fused"]))
        figures |= {f"{name}.{figure}": value for figure, value in agreement(task, renderer).items()}
    for name in references.keys() - usable.keys():
        figures |= {f"{name}.hypotheses_per_s": None, f"fused.over_{name}": None, f"{name}.skipped": reasons[name]}
    return figures


def make_task(config: Config) -> Task:
    """A mug before a wall, seen with the sensor's noise; half of the hypotheses are turned anyhow, half are near."""
    rng = generator(config.seed, "bench.render")
    sensor = config.sensor
    model = DepthModel(
        sensor.sigma_m,
        sensor.sigma_quadratic_per_m,
        sensor.outlier_weight,
        sensor.range_m,
        sensor.occluder_weight,
        sensor.background_sigma_m,
    )
    whole = mug()
    centre = (whole.vertices.min(axis=0) + whole.vertices.max(axis=0)) / 2.0
    coarse = simplify(Mesh(whole.vertices - centre, whole.faces, whole.colours), config.frontend.mesh_faces)
    truth = se3.make(se3.so3_exp(np.array([1.9, 0.5, 0.3])), np.array([0.0, 0.0, DISTANCE_M]))
    half = TILE // 2
    step = max(1, round(config.frontend.angular_step_rad * 525.0))
    image = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
    x, y = 320 - half * step, 240 - half * step
    camera = image.window(x, y, TILE, TILE, step)
    depth = Rasteriser().render(coarse, camera, truth[None])[0]
    background = np.full_like(depth, PLANE_M)
    depth = np.where(depth > 0, depth, background)
    depth += (rng.normal(size=depth.shape) * model.sigma(depth)).astype(np.float32)
    anyhow = se3.make(
        se3.rotation_from_quaternion(rng.normal(size=(HYPOTHESES // 2, 4))),
        truth[:3, 3] + rng.normal(scale=0.02, size=(HYPOTHESES // 2, 3)),
    )
    nearly = se3.retract(truth, rng.normal(size=(HYPOTHESES - len(anyhow), 6)) * np.repeat([0.1, 0.005], 3))
    poses = np.concatenate([anyhow, nearly])
    return Task(coarse, Tile(camera, depth, background, x, y, step), poses, model, sensor.occlusion_margin_m)


def fused(task: Task) -> Array:
    """(K,) log-likelihood ratios by the fused kernel, nats."""
    return score_depth(task.mesh, task.tile, task.T_camera_object, task.model.parameters(), task.margin_m).log_ratio


def rendered(task: Task, renderer: DepthRenderer) -> Array:
    """(K,) the same from a reference's depth tiles."""
    depth = renderer.render(task.mesh, task.tile.camera, task.T_camera_object)
    return depth_log_ratio(task.tile.depth, depth, task.tile.background, task.model).sum(axis=(1, 2))


def agreement(task: Task, renderer: DepthRenderer) -> dict[str, float]:
    """How far a reference is from the rasteriser, and its scores from the fused kernel's."""
    ours = Rasteriser().render(task.mesh, task.tile.camera, task.T_camera_object)
    theirs = renderer.render(task.mesh, task.tile.camera, task.T_camera_object)
    both = (ours > 0) & (theirs > 0)
    scores = depth_log_ratio(task.tile.depth, theirs, task.tile.background, task.model).sum(axis=(1, 2))
    return {
        "agreement_mm_p99": float(1e3 * np.quantile(np.abs(ours[both].astype(np.float64) - theirs[both]), 0.99)),
        "silhouette_share": float(((ours > 0) != (theirs > 0)).sum() / both.sum()),
        "score_nats_p50": float(np.median(np.abs(scores - fused(task)))),
    }


def measure(methods: dict[str, Callable[[], Array]], progress: Progress = SILENT) -> dict[str, Array]:
    """Seconds a call (TURNS,) of each method, in turn; the first call of each, which may compile, isn't measured."""
    seconds = {name: np.zeros(TURNS) for name in methods}
    with progress.stage("render", total=(TURNS + 1) * len(methods)) as stage:
        for method in methods.values():
            method()
            stage.advance()
        for turn in range(TURNS):
            for name, method in methods.items():
                seconds[name][turn] = _seconds(method)
                stage.advance()
    return seconds


def _seconds(method: Callable[[], Array]) -> float:
    calls, began = 0, time.perf_counter()
    while (passed := time.perf_counter() - began) < LEAST_SECONDS or calls == 0:
        method()
        calls += 1
    return passed / calls
