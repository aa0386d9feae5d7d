"""Which detection is which object's, with the whole map in view: an assignment a keyframe, made anew each round.

A tracker knows the boxes before; the smoother knows where every object is, what stands before it and what it is called.
So tracks that change over from one thing to another, break off or start twice are mended by asking again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.frontend.association import class_shares
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.modes import Recording
from factors.measurement import box_iou
from sequences.types import Detection, Frame

Array = NDArray[np.float64]

_WITHIN = 0.7  # share of a box that lies in where an object would appear: a part of it shows
_CALLED = 0.5  # least P(box and object are of one class) for a part


@dataclass(frozen=True)
class Expected:
    """What the map says of one object at one keyframe."""

    shape: int
    """class index"""
    T_world_centre: Array
    """(4, 4)"""
    class_probability: Array
    """(C,)"""
    existence: float
    """P(it is there)"""


def associate(
    recording: Recording, model: Model, objects: Iterable[int], expected: Callable[[int, int], Expected | None]
) -> dict[int, dict[int, Detection]]:
    """Object -> keyframe -> its detection, by a global assignment a keyframe.

    Args:
        recording: the run.
        model: shapes and thresholds.
        objects: their ids.
        expected: (object, keyframe) -> what the map says of it there; None where it says nothing.
    """
    ids = sorted(objects)
    out: dict[int, dict[int, Detection]] = {i: {} for i in ids}
    for k, frame_index in enumerate(recording.keyframes):
        there = {i: e for i in ids if (e := expected(i, k)) is not None}
        frame = recording.run.frames[int(frame_index)]
        for i, detection in assign(frame, recording.box_depths[k], model, there).items():
            out[i][k] = detection
    return out


def assign(frame: Frame, box_depths: Array, model: Model, there: Mapping[int, Expected]) -> dict[int, Detection]:
    """Object -> its detection in one keyframe.

    Args:
        frame: the keyframe.
        box_depths: (D,) in the middle of each detection, metres; 0 where nothing was measured.
        model: shapes and thresholds.
        there: object -> what the map says of it, in ascending order.
    """
    if not frame.detections or not there:
        return {}
    ids = list(there)
    affinity = np.stack([_affinity(frame, box_depths, model, e) for e in there.values()])
    pairs = zip(*linear_sum_assignment(-affinity), strict=True)
    return {ids[row]: frame.detections[column] for row, column in pairs if affinity[row, column] > 0.0}


def _affinity(frame: Frame, z: Array, model: Model, expected: Expected) -> Array:
    """(D,) of an object to a keyframe's detections: overlap, by half what both are called and whether it exists."""
    shape = model.shapes[expected.shape]
    T = frame.T_camera_world @ expected.T_world_centre
    seen = outlook(shape, T, frame.camera)
    if seen.share <= 0.0:
        return np.zeros(len(frame.detections))
    boxes = np.array([d.box for d in frame.detections])
    overlap = box_iou(seen.box[None], boxes)
    called = np.stack([class_shares(d) for d in frame.detections])
    same = called @ expected.class_probability
    least = 0.5 * model.config.frontend.association_iou
    part = (_inside(boxes, seen.box) >= _WITHIN) & (same >= _CALLED)
    near = np.where(overlap >= least, overlap, np.where(part, least, 0.0))
    # what stands before an object isn't it; what is seen behind may be, past its rim or through its handle
    before = (z > 0.0) & (z < T[2, 3] - shape.reach_m - model.config.sensor.occlusion_margin_m)
    return np.where(before, 0.0, near * (0.5 + 0.5 * same) * (0.5 + 0.5 * expected.existence))


def _inside(boxes: Array, of: Array) -> Array:
    """(D,) share of each box (D, 4) that lies in another (4,), all x, y, w, h."""
    low = np.maximum(boxes[:, :2], of[:2])
    high = np.minimum(boxes[:, :2] + boxes[:, 2:], of[:2] + of[2:])
    return np.asarray(np.maximum(high - low, 0.0).prod(axis=-1) / np.maximum(boxes[:, 2:].prod(axis=-1), 1e-9))
