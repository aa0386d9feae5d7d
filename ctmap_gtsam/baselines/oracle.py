"""ICP and FPFH by the paper's protocol, which reads the truth: true boxes and classes, where each was last seen.

The paper takes the frame of each sequence in which an object is last seen, crops the point cloud by the true box and
registers the object's mesh to it. Here that is done for each true object in each visit, with the box of its visible
pixels, and the pose is held over all of the visit. Beside these `cameras` alone reads the truth, and no method that
does may be held against one that doesn't but in the way of the paper.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.baselines.placing import Placement, certainly, estimate_of
from ctmap_gtsam.baselines.registration import Kind, Registrar
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.shapes import build_shapes
from sequences import se3
from sequences.catalogue import Catalogue
from sequences.progress import SILENT, Progress
from sequences.rendering.scene import render_scene
from sequences.truth import load_truth
from sequences.types import VISIBLE_FRACTION, Frame, Run, TrueObject, Truth

Array = NDArray[np.float64]


def obstacle(run: Run) -> str | None:
    """None where the run has truth, else why not, with the remedy."""
    if load_truth(run) is not None:
        return None
    return "needs truth, and the run has none: add scene_gt.json to its scenes"


def register_truth(run: Run, config: Config, progress: Progress = SILENT, *, kind: Kind) -> Estimate:
    """Place each true object once a visit, in the frame in which it is last seen.

    Args:
        run: the recording, with truth beside it.
        config: settings.
        progress: who is told how far it is.
        kind: how: "icp" or "fpfh". Open3D is needed, see `registration.obstacle`.

    Returns:
        The estimate, of the method "<kind>-oracle". An object that a visit doesn't see, or that doesn't fit anything
        there, doesn't exist in it.
    """
    truth = load_truth(run)
    assert truth is not None, "a run without truth: see obstacle"
    method = f"{kind}-oracle"
    registrar = Registrar(kind, run.catalogue, config)
    placed: dict[tuple[int, int], Placement] = {}
    sightings = _last_sightings(run, truth)
    with progress.stage(method, total=len(sightings)) as stage:
        for f, things in sightings.items():
            frame, depth = run.frames[f], run.frames[f].read_depth()
            for thing, box in true_boxes(run.catalogue, truth, frame, things):
                found = registrar.register(thing.obj_id, frame, depth, box, thing.inst_id)
                if found is not None:
                    probability = certainly(run.catalogue.index(thing.obj_id), len(run.catalogue))
                    pose = frame.T_world_camera @ found.T_camera_object
                    placed[thing.inst_id, frame.visit] = Placement(probability, pose, found.covariance)
            stage.advance()
    keyframes = select_keyframes(run, config.keyframes)
    held = {
        thing.inst_id: [placed.get((thing.inst_id, run.frames[int(f)].visit)) for f in keyframes]
        for thing in truth.objects
    }
    shapes = build_shapes(run.catalogue, config.frontend.mesh_faces)
    return estimate_of(run, config, method, keyframes, held, shapes, {"reads_truth": True})


def _last_sightings(run: Run, truth: Truth) -> dict[int, list[TrueObject]]:
    """Frame -> the true objects that count in it and in no later one of its visit, by ascending frame."""
    visit = np.array([frame.visit for frame in run.frames], dtype=np.int64)
    found: dict[int, list[TrueObject]] = defaultdict(list)
    for thing in truth.objects:
        seen = thing.frames[thing.visible_fraction >= VISIBLE_FRACTION]
        for v in np.unique(visit[seen]):
            found[int(seen[visit[seen] == v].max())].append(thing)
    return dict(sorted(found.items()))


def true_boxes(
    catalogue: Catalogue, truth: Truth, frame: Frame, things: list[TrueObject]
) -> list[tuple[TrueObject, Array]]:
    """Boxes (4,) of the visible pixels: the truth's own, else drawn; true objects alone hide each other then."""
    own = {thing.inst_id: thing.visible_box[thing.frames == frame.index][0] for thing in things}
    if all(np.isfinite(box).all() for box in own.values()):
        return [(thing, own[thing.inst_id]) for thing in things]
    present = [thing for thing in truth.objects if frame.index in thing.frames]
    T_camera_world = se3.inverse(truth.T_world_camera[frame.index])
    poses = [T_camera_world @ thing.T_world_object[thing.frames == frame.index][0] for thing in present]
    meshes = [catalogue[thing.obj_id].mesh for thing in present]
    item = render_scene(list(zip(meshes, poses, strict=True)), frame.camera).item
    boxes = []
    for thing in things:
        rows, columns = np.nonzero(item == [one.inst_id for one in present].index(thing.inst_id))
        if len(rows):
            low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
            drawn = np.concatenate([low, high - low + 1]).astype(np.float64)
            boxes.append((thing, own[thing.inst_id] if np.isfinite(own[thing.inst_id]).all() else drawn))
    return boxes
