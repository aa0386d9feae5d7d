"""The simulated detector before a recording that exists: any run with truth, real or simulated."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sequences import layout, se3
from sequences.atomic import json_bytes, write_together
from sequences.bop import load_run
from sequences.detections import detection_json, sources
from sequences.errors import InputError
from sequences.progress import SILENT, Progress, Stage
from sequences.rendering.scene import render_scene
from sequences.simulation.config import DetectorConfig
from sequences.simulation.detections import Detector, Surroundings
from sequences.simulation.visibility import Thing, Visible, look
from sequences.truth import load_truth
from sequences.types import Frame, Run, Truth, Visit

SOURCE = "simulation"
NEARER_M, NEARER_PER_M2 = 0.015, 0.015
"""Measured depth that is nearer than a thing's surface by this and this times z^2 is of something else, which hides it:
five sigmas of the sensors that `ctmap bench realism` holds against each other"""


def simulate_detections(
    path: Path,
    config: DetectorConfig,
    seed: int,
    *,
    scene: int | None = None,
    force: bool = False,
    progress: Progress = SILENT,
) -> int:
    """Replace a run's scene_detections.json by what the simulated detector makes of it; nothing else is touched.

    Things are drawn where the truth has them. They hide each other, and whatever the recorded depth has before them
    hides them too. All visits are written, or none.

    Args:
        path: the run's folder.
        config: settings of the detector.
        seed: every draw comes from it.
        scene: the BOP scene, where the run's visits are not listed.
        force: replace detections that no simulation made, too.
        progress: is told of each frame.

    Returns:
        How many detections were written.

    Raises:
        InputError: the run can't be read or has no truth, or there are detections of another source.
    """
    run = load_run(path, scene=scene)
    files = [_file(visit) for visit in run.visits]
    if not force:
        _check_replaceable(files)
    truth = load_truth(run)
    if truth is None:
        raise InputError(
            "the run has no truth", file=path, field=layout.SCENE_GT, remedy=f"add {layout.SCENE_GT} to each scene"
        )
    with progress.stage("detect", total=len(run.frames)) as stage:
        found = [_detect(run, truth, v, config, seed, stage) for v in range(len(run.visits))]
    write_together({file: json_bytes(said) for file, said in zip(files, found, strict=True)})
    return sum(len(said) for said in found)


def _file(visit: Visit) -> Path:
    return visit.frames[0].depth_path.parent.parent / layout.SCENE_DETECTIONS


def _check_replaceable(files: Iterable[Path]) -> None:
    for file in files:
        others = sources(file) - {SOURCE}
        if others:
            who = ", ".join(sorted(f"{name!r}" for name in others if name is not None)) or "somebody who doesn't say"
            raise InputError(
                f"holds detections of {who}, which can't be made again here",
                file=file,
                field="source",
                remedy="move them away, or give --force to replace them",
            )


def _detect(run: Run, truth: Truth, v: int, config: DetectorConfig, seed: int, stage: Stage) -> list[dict[str, Any]]:
    """All detections of a visit as scene_detections.json has them."""
    visit = run.visits[v]
    camera = visit.frames[0].camera
    things = {o.inst_id: o.obj_id for o in truth.objects}
    size, n = (camera.width, camera.height), len(visit.frames)
    detector = Detector(run.catalogue, size, config, seed, v, things, n)
    out = []
    for k, frame in enumerate(visit.frames):
        found = detector.detect(k, *_shown(run, truth, frame))
        out += [detection_json(d, visit.scene_id, frame.im_id, run.catalogue.obj_ids, SOURCE) for d in found]
        stage.advance()
    return out


def _shown(run: Run, truth: Truth, frame: Frame) -> tuple[list[Visible], Surroundings]:
    """What shows of each thing in a frame, and the rest of the image."""
    T_world_camera = truth.T_world_camera[frame.index]
    T_camera_world = se3.inverse(T_world_camera)
    things = []
    for o in truth.objects:
        at = np.flatnonzero(o.frames == frame.index)
        if at.size:
            T_camera_object = T_camera_world @ o.T_world_object[at[0]]
            things.append(Thing(o.inst_id, o.obj_id, run.catalogue[o.obj_id].mesh, T_camera_object))
    images = render_scene([(thing.mesh, thing.T_camera_object) for thing in things], frame.camera)
    measured, drawn = frame.read_depth(), images.depth
    hidden = (measured > 0) & (measured < drawn - NEARER_M - NEARER_PER_M2 * drawn**2)
    item = np.where(hidden, -1, images.item).astype(np.int32)
    around = Surroundings(frame.camera, T_world_camera, measured, item < 0)
    return look(things, item, frame.camera), around
