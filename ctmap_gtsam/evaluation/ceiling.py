"""The truth's own map, judged like any other: what a perfect method would reach, which need not be perfect scores."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate, Ledger, Modes, Moves
from ctmap_gtsam.evaluation.matching import from_truth, shapes_of
from ctmap_gtsam.evaluation.moves import Period, true_periods
from sequences.types import VISIBLE_FRACTION, Run, TrueObject, Truth

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NAME = "truth"
"""Of the method"""

_UNKNOWN = -(1 << 31)  # a support that isn't said, as estimators write it
_SIGMA = 1e-6  # rad and metres: a covariance has to have an inverse


def truth_estimate(run: Run, truth: Truth) -> Estimate:
    """The true map as an Estimate: every frame a keyframe, poses and classes certain, cameras the true ones."""
    frames = np.arange(len(run.frames), dtype=np.int64)
    class_ids = np.array(run.catalogue.obj_ids, dtype=np.int64)
    shape = (len(truth.objects), len(frames))
    exists, in_view = np.zeros(shape), np.zeros(shape, dtype=np.bool_)
    probability = np.zeros((*shape, len(class_ids)))
    for n, thing in enumerate(truth.objects):
        exists[n, thing.frames] = 1.0
        in_view[n, thing.frames] = thing.visible_fraction >= VISIBLE_FRACTION
        probability[n, :, run.catalogue.index(thing.obj_id)] = 1.0
    none = np.zeros(0, dtype=np.int64)
    moved = [p for p in true_periods(run, truth, from_truth(run, truth), shapes_of(run.catalogue)) if p.moved]
    return Estimate(
        object_id=np.array([thing.inst_id for thing in truth.objects], dtype=np.int64),
        class_ids=class_ids,
        class_probability=probability,
        existence=exists,
        in_view=in_view,
        keyframe_frame=frames,
        keyframe_time_ns=np.array([frame.time_ns for frame in run.frames], dtype=np.int64),
        keyframe_visit=np.array([frame.visit for frame in run.frames], dtype=np.int64),
        T_world_camera=truth.T_world_camera,
        camera_covariance=np.tile(_SIGMA**2 * np.eye(6), (len(frames), 1, 1)),
        modes=_modes(truth.objects),
        moves=_moves(moved),
        ledger=Ledger(none, none, none, none, np.zeros(0)),
        meta={
            "method": NAME,
            "fingerprint": run.fingerprint,
            "run": run.name,
            "recorded_T_world_camera": [frame.T_world_camera.tolist() for frame in run.frames],
        },
    )


def _moves(moved: list[Period]) -> Moves:
    """One gap a period with a move, at its time where that is known."""
    interval = [(min(p.moved_ns), max(p.moved_ns)) if p.moved_ns else p.times_ns for p in moved]
    unknown = np.full(len(moved), _UNKNOWN, dtype=np.int64)
    return Moves(
        object=np.array([p.object for p in moved], dtype=np.int64),
        gap=np.array([p.frames for p in moved], dtype=np.int64).reshape(-1, 2),
        probability=np.ones(len(moved)),
        interval_ns=np.array(interval, dtype=np.int64).reshape(-1, 2),
        from_support=unknown,
        to_support=unknown,
    )


def _modes(objects: tuple[TrueObject, ...]) -> Modes:
    counts = [len(thing.frames) for thing in objects]
    m = sum(counts)
    return Modes(
        object=np.repeat(np.arange(len(objects), dtype=np.int64), counts),
        keyframe=np.concatenate([np.zeros(0, dtype=np.int64), *(thing.frames for thing in objects)]),
        class_id=np.repeat(np.array([thing.obj_id for thing in objects], dtype=np.int64), counts),
        log_weight=np.zeros(m),
        T_world_object=np.concatenate([np.zeros((0, 4, 4)), *(thing.T_world_object for thing in objects)]),
        covariance=np.tile(_SIGMA**2 * np.eye(6), (m, 1, 1)),
        free_axes=np.zeros((m, 6, 3)),
    )
