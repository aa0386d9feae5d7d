"""Estimates made from the truth, right or wrong by known amounts, for the tests of metrics, exports and reports."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ctmap_gtsam.estimate import Estimate, Ledger, Modes, Moves
from sequences import se3
from sequences.types import Run, Truth

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
