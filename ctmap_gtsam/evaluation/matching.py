"""The one matching of estimated objects to true ones (or to another method's), which every metric rests on.

Both sides become `ObjectFrames`: where each object is in each frame's own camera. Poses are compared there, as BOP
does: ``inv(T_world_camera) T_world_object`` with each side's own camera, so a localisation error that object and camera
share costs nothing, and one that moves the object in the picture does.

There is one assignment a place (Kuhn, 1955; scipy's linear_sum_assignment), over all visits at once. It is blind to the
class, so that a wrong class at the right place is a wrong class and not a miss. The cost of a pair is the distance of
the bounding boxes' centres over the reach, at most 1, summed over the frames where the reference object is visible;
being absent costs 1. Two objects that are never within reach of each other are no pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.estimate import EXISTS, Estimate, Snapshot
from ctmap_gtsam.evaluation.pose import Shape
from sequences import se3
from sequences.catalogue import Catalogue
from sequences.types import VISIBLE_FRACTION, Frame, Run, Truth

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

REACH_M = 0.05
"""Centres further apart than this, or than half the smaller object's diameter where that is more, don't match. The
smaller one's: a mug somewhere on a table isn't the table"""

HIDDEN_WEIGHT = 1e-6
"""Weight of frames where the reference object is hidden: it decides nothing but ties, and lets an estimate of an object
that is never visible match it instead of counting as false"""


@dataclass(frozen=True)
class ObjectFrames:
    """Objects (N) over the frames of a run (F), each in the frame's own camera."""

    name: Ints
    """(N,) inst_id of the truth, object_id of an estimate"""
    class_id: Ints
    """(N, F) obj_id, -1 where the object is absent"""
    T_camera_object: Array
    """(N, F, 4, 4) metres, NaN where absent"""
    visible: NDArray[np.bool_]
    """(N, F) whether the object-frame counts"""

    @property
    def present(self) -> NDArray[np.bool_]:
        """(N, F) where the object is in the map, visible or not."""
        return self.class_id >= 0


class MethodMap(NamedTuple):
    """A method's answer, seen from every frame of the run."""

    name: str
    estimate: Estimate
    objects: ObjectFrames
    held: Ints
    """(F,) the keyframe whose map each frame shows"""
    T_world_camera: Array
    """(F, 4, 4) the method's own cameras"""


class Matching(NamedTuple):
    """Rows of the candidates for the rows of the reference."""

    row: Ints
    """(N,) the candidate's row for each reference object, -1 where nothing matches"""
    unmatched: Ints
    """rows of candidates that are in the map in some frame and match nothing"""


def shapes_of(catalogue: Catalogue) -> dict[int, Shape]:
    """What the errors need of each class, by obj_id."""
    return {c.obj_id: Shape(c) for c in catalogue.classes}


def snapshots(frames: Sequence[Frame], estimate: Estimate, least: float = EXISTS) -> list[Snapshot]:
    """The map at every frame: held between keyframes, the camera carried by the recorded motion (see `Estimate.at`)."""
    return [estimate.at(frame.time_ns, frame.T_world_camera, least) for frame in frames]


def from_truth(run: Run, truth: Truth) -> ObjectFrames:
    """The truth in the true cameras; visible where at least VISIBLE_FRACTION is."""
    shape = (len(truth.objects), len(run.frames))
    class_id, visible = np.full(shape, -1, dtype=np.int64), np.zeros(shape, dtype=np.bool_)
    poses = np.full((*shape, 4, 4), np.nan)
    for row, thing in enumerate(truth.objects):
        class_id[row, thing.frames] = thing.obj_id
        poses[row, thing.frames] = se3.inverse(truth.T_world_camera[thing.frames]) @ thing.T_world_object
        visible[row, thing.frames] = thing.visible_fraction >= VISIBLE_FRACTION
    return ObjectFrames(np.array([t.inst_id for t in truth.objects], dtype=np.int64), class_id, poses, visible)


def from_estimate(run: Run, name: str, estimate: Estimate) -> MethodMap:
    """What a method says, in its own cameras; visible where the object exists and is in view at the held keyframe."""
    shape = (len(estimate.object_id), len(run.frames))
    class_id, visible = np.full(shape, -1, dtype=np.int64), np.zeros(shape, dtype=np.bool_)
    poses, held = np.full((*shape, 4, 4), np.nan), np.zeros(shape[1], dtype=np.int64)
    cameras = np.zeros((shape[1], 4, 4))
    for f, snapshot in enumerate(snapshots(run.frames, estimate)):
        rows = snapshot.objects
        held[f], cameras[f] = snapshot.keyframe, snapshot.T_world_camera
        class_id[rows, f] = snapshot.class_id
        poses[rows, f] = se3.inverse(snapshot.T_world_camera) @ snapshot.T_world_object
        visible[rows, f] = estimate.in_view[rows, snapshot.keyframe]
    return MethodMap(name, estimate, ObjectFrames(estimate.object_id, class_id, poses, visible), held, cameras)


def centres(objects: ObjectFrames, shapes: dict[int, Shape]) -> Array:
    """(N, F, 3) centres of the bounding boxes in the camera frame, metres; NaN where absent."""
    out = np.full((*objects.class_id.shape, 3), np.nan)
    for obj_id in np.unique(objects.class_id[objects.present]):
        where = objects.class_id == obj_id
        out[where] = se3.transform(objects.T_camera_object[where], shapes[int(obj_id)].centre[None])[:, 0]
    return out


def match(reference: ObjectFrames, candidates: ObjectFrames, shapes: dict[int, Shape]) -> Matching:
    """Match a method's objects to the true ones, or to another method's.

    Args:
        reference: N objects over F frames. Its visible object-frames are those that count.
        candidates: M objects over the same F frames.
        shapes: by obj_id, see `shapes_of`.

    Returns:
        The assignment of least total cost. Listing either side in another order gives the same pairs.
    """
    closeness = _closeness(reference, candidates, shapes)
    rows, columns = linear_sum_assignment(closeness, maximize=True)
    pairs = closeness[rows, columns] > 0.0
    row = np.full(len(reference.name), -1, dtype=np.int64)
    row[rows[pairs]] = columns[pairs]
    somewhere = np.flatnonzero(candidates.present.any(axis=1))
    return Matching(row, np.setdiff1d(somewhere, row))


def _closeness(reference: ObjectFrames, candidates: ObjectFrames, shapes: dict[int, Shape]) -> Array:
    """(N, M) sum over frames of 1 - min(distance / reach, 1): least cost, seen from the other side."""
    weight = np.where(reference.visible, 1.0, HIDDEN_WEIGHT)
    reach, their_reach = reach_of(reference, shapes), reach_of(candidates, shapes)
    ours, theirs = centres(reference, shapes), centres(candidates, shapes)
    out = np.zeros((len(reference.name), len(candidates.name)))
    for n in range(len(out)):
        distance = np.linalg.norm(theirs - ours[n], axis=-1)  # (M, F)
        share = 1.0 - np.minimum(np.nan_to_num(distance, nan=np.inf) / np.minimum(reach[n], their_reach), 1.0)
        out[n] = share @ weight[n]
    return out


def reach_of(objects: ObjectFrames, shapes: dict[int, Shape]) -> Array:
    """(N, F) how near something has to be to be each object, by its own size, metres."""
    out = np.full(objects.class_id.shape, REACH_M)
    for obj_id in np.unique(objects.class_id[objects.present]):
        out[objects.class_id == obj_id] = max(REACH_M, 0.5 * shapes[int(obj_id)].of.diameter_m)
    return out
