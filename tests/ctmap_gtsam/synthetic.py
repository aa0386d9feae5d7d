"""A small run, and estimates made from its truth, right or wrong by known amounts, to test all that is reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ctmap_gtsam.estimate import Estimate, Ledger, Modes, Moves
from ctmap_gtsam.evaluation.silhouettes import silhouettes
from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue, Mesh, ObjectClass
from sequences.rendering.scene import render_scene, shade
from sequences.types import Detection, Run, Truth
from sequences.writing import FrameTruth, RunWriter, Sighting, VisitWriter

RIGHT = 0.9
"""P(class) of the class that an estimate made here says"""


def estimate_of(
    run: Run,
    truth: Truth,
    *,
    disturb: Callable[[int, int, np.ndarray], np.ndarray] = lambda n, f, T: T,
    class_of: Callable[[int, int], int | None] = lambda n, f: None,
    existence: Callable[[int, int], float] = lambda n, f: 1.0,
    order: Sequence[int] | None = None,
    keyframes: Sequence[int] | None = None,
    cameras: np.ndarray | None = None,
    meta: dict | None = None,
) -> Estimate:
    """The true map as an Estimate.

    Args:
        run: its frames.
        truth: its objects.
        disturb: (object, frame, T_world_object) -> what the estimate says instead.
        class_of: (object, frame) -> obj_id that it says instead, None for the true one.
        existence: (object, frame) -> P(exists).
        order: the true objects in the order in which the estimate lists them.
        keyframes: frames that are keyframes, all where not given.
        cameras: (F, 4, 4) T_world_camera of the estimate, the true ones where not given.
        meta: more of it.
    """
    order = range(len(truth.objects)) if order is None else order
    frames = np.arange(len(run.frames)) if keyframes is None else np.array(keyframes)
    class_ids = np.array(run.catalogue.obj_ids)
    n, k = len(order), len(frames)
    probability = np.full((n, k, len(class_ids)), (1 - RIGHT) / (len(class_ids) - 1))
    exists, rows = np.zeros((n, k)), []
    for row, o in enumerate(order):
        thing = truth.objects[o]
        for column, f in enumerate(frames):
            obj_id = class_of(o, int(f)) or thing.obj_id
            probability[row, column, run.catalogue.index(obj_id)] = RIGHT
            exists[row, column] = existence(o, int(f))
            nearest = int(np.argmin(np.abs(thing.frames - f)))
            rows.append((row, column, obj_id, disturb(o, int(f), thing.T_world_object[nearest])))
    m = len(rows)
    used = truth.T_world_camera if cameras is None else cameras
    none = np.zeros(0, dtype=np.int64)
    return Estimate(
        object_id=np.arange(1, n + 1),
        class_ids=class_ids,
        class_probability=probability,
        existence=exists,
        in_view=np.ones((n, k), dtype=bool),
        keyframe_frame=frames,
        keyframe_time_ns=np.array([run.frames[f].time_ns for f in frames]),
        keyframe_visit=np.array([run.frames[f].visit for f in frames]),
        T_world_camera=used[frames],
        camera_covariance=np.tile(1e-8 * np.eye(6), (k, 1, 1)),
        modes=Modes(
            object=np.array([r[0] for r in rows], dtype=np.int64),
            keyframe=np.array([r[1] for r in rows], dtype=np.int64),
            class_id=np.array([r[2] for r in rows], dtype=np.int64),
            log_weight=np.zeros(m),
            T_world_object=np.array([r[3] for r in rows]).reshape(-1, 4, 4),
            covariance=np.tile(1e-6 * np.eye(6), (m, 1, 1)),
            free_axes=np.zeros((m, 6, 3)),
        ),
        moves=Moves(none, none.reshape(0, 2), np.zeros(0), none.reshape(0, 2), none, none),
        ledger=Ledger(none, none, none, none, np.zeros(0)),
        meta={
            "recorded_T_world_camera": [run.frames[f].T_world_camera.tolist() for f in frames],
            "diagnostics": {"hypotheses_scored": 1000 * n * k},
            **(meta or {}),
        },
    )


def shifted(metres: float, direction: Sequence[float] = (1.0, 0.0, 0.0)) -> Callable:
    """A disturbance that moves every object along a direction of the world."""
    offset = se3.make(np.eye(3), metres * np.asarray(direction) / np.linalg.norm(direction))
    return lambda n, f, T: offset @ T


def unplaced(estimate: Estimate, rows: Sequence[int]) -> Estimate:
    """The estimate without the objects of some rows."""
    keep = np.setdiff1d(np.arange(len(estimate.object_id)), rows)
    new_row = np.full(len(estimate.object_id), -1)
    new_row[keep] = np.arange(len(keep))
    kept = np.isin(estimate.modes.object, keep)
    modes = Modes(**{name: value[kept] for name, value in vars(estimate.modes).items()})
    return Estimate(
        **{
            **{k: v for k, v in vars(estimate).items() if k in Estimate.__dataclass_fields__},
            "object_id": estimate.object_id[keep],
            "class_probability": estimate.class_probability[keep],
            "existence": estimate.existence[keep],
            "in_view": estimate.in_view[keep],
            "modes": Modes(**{**vars(modes), "object": new_row[modes.object]}),
        }
    )


def solid(size: Sequence[float]) -> Mesh:
    """A box about the origin."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=np.int32)
    return Mesh(corners * np.asarray(size), faces, np.full((8, 3), 150, dtype=np.uint8))


def catalogue() -> Catalogue:
    """A carton without symmetry, a brick with half-turns about z, a crate like the carton."""
    half = se3.make(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    parts = (
        (3, "carton", (0.08, 0.06, 0.12), np.eye(4)[None]),
        (5, "clay_brick", (0.10, 0.05, 0.06), np.stack([np.eye(4), half])),
        (9, "crate", (0.09, 0.07, 0.11), np.eye(4)[None]),
    )
    return Catalogue(
        tuple(
            ObjectClass(obj_id, name, "box", 3600.0, False, True, solid(s), float(np.linalg.norm(s)), symmetries, ())
            for obj_id, name, s, symmetries in parts
        )
    )


OBJECTS = (  # inst_id, obj_id, position in the world, metres
    (1, 3, (-0.15, 0.0, 0.06)),
    (2, 5, (0.0, 0.03, 0.03)),
    (3, 3, (0.16, -0.02, 0.06)),
)
CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)


def write_run(path: Path, frames: int = 8, visits: int = 1) -> Path:
    """Two cartons and a brick with their truth, seen by a moving camera; the detector takes carton 1 for a crate."""
    classes = catalogue()
    R = np.array([[1.0, 0.0, 0.0], [0.0, -0.6, -0.8], [0.0, 0.8, -0.6]]).T
    with RunWriter(path, classes, source="tests", up_world=np.array([0.0, 0.0, 1.0])) as writer:
        for v in range(visits):
            visit = writer.add_visit(v + 1)
            for f in range(frames):
                T_world_camera = se3.make(R, np.array([0.01 * (f - 4), -0.56, 0.48]))
                _write_frame(visit, classes, f, 10**9 * 3600 * v + f * 10**8, T_world_camera)
    return path


def _write_frame(visit: VisitWriter, classes: Catalogue, f: int, time_ns: int, T_world_camera: np.ndarray) -> None:
    placed = [
        (inst, obj_id, se3.make(se3.so3_exp(np.array([0, 0, 0.3 * inst])), np.array(t))) for inst, obj_id, t in OBJECTS
    ]
    T_camera_world = se3.inverse(T_world_camera)
    items = [(classes[obj_id].mesh, T_camera_world @ T) for _, obj_id, T in placed]
    images = render_scene(items, CAMERA)
    drawn = silhouettes(classes, [o for _, o, _ in placed], np.stack([T for _, T in items]), CAMERA)
    detections = []
    for (inst, obj_id, _), seen in zip(placed, drawn, strict=True):
        scores = np.full(1 + len(classes), 0.1)
        scores[1 + classes.index(9 if inst == 1 else obj_id)] = 0.7
        detections.append(Detection(seen.visible_box, scores))
    visit.add_frame(
        im_id=f,
        time_ns=time_ns,
        camera=CAMERA,
        T_world_camera=T_world_camera,
        depth=images.depth,
        colour=shade(items, CAMERA, images, background=(120, 110, 100)),
        detections=detections,
        truth=FrameTruth(
            T_world_camera,
            tuple(Sighting(i, o, T, s.visible_fraction) for (i, o, T), s in zip(placed, drawn, strict=True)),
        ),
    )
