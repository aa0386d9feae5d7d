"""Whether the objects that are there are called what they are.

Class accuracy is the share of visible true object-frames whose matched estimate exists and has the true class as its
most probable one. The detector, which has boxes and no objects, is asked the same: its box must overlap the true
object's by IoU >= 0.5 (PASCAL VOC; Everingham et al., IJCV 2010) and its best class be the true one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames
from ctmap_gtsam.evaluation.silhouettes import silhouettes
from sequences.camera import Camera
from sequences.catalogue import Catalogue
from sequences.types import Detection, Run

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

IOU = 0.5
"""Two boxes are of one thing from this overlap on"""


class DetectorScore(NamedTuple):
    """How the detector's own boxes fare against the boxes of the true objects."""

    class_correct: Bools
    """(N, F) true objects that have a box, called what they are"""
    class_probability: Array
    """(N, F) the box's score of the true class, background left out; 0 without a box"""
    false_boxes: int
    """boxes that belong to no visible true object"""


def class_correct(truth: ObjectFrames, estimate: ObjectFrames, matching: Matching) -> Bools:
    """(N, F) whether each true object's match exists in the frame and has its class."""
    return (matched_class(estimate, matching) == truth.class_id) & truth.present


def matched_class(estimate: ObjectFrames, matching: Matching) -> NDArray[np.int64]:
    """(N, F) obj_id of each true object's match, -1 where it has none or that is absent."""
    out = np.full((len(matching.row), estimate.class_id.shape[1]), -1, dtype=np.int64)
    matched = matching.row >= 0
    out[matched] = estimate.class_id[matching.row[matched]]
    return out


def class_probability(method: MethodMap, row: int, class_id: NDArray[np.int64]) -> Array:
    """(F,) P(exists) P(class) of a method's object `row` for classes (F,); 0 where either is -1, for none."""
    out = np.zeros(len(class_id))
    if row < 0:
        return out
    column = {int(c): k for k, c in enumerate(method.estimate.class_ids)}
    columns = np.array([column.get(int(c), -1) for c in class_id], dtype=np.int64)
    known = columns >= 0
    k = method.held[known]
    out[known] = method.estimate.existence[row, k] * method.estimate.class_probability[row, k, columns[known]]
    return out


def score_detections(run: Run, truth: ObjectFrames) -> DetectorScore:
    """Match the run's recorded detections to the boxes of the visible true objects, frame by frame."""
    correct = np.zeros(truth.visible.shape, dtype=np.bool_)
    probability = np.zeros(truth.visible.shape)
    false_boxes = 0
    obj_ids = np.array(run.catalogue.obj_ids)
    for f, frame in enumerate(run.frames):
        rows, boxes = _true_boxes(run.catalogue, truth, f, frame.camera)
        pairs = match_boxes(boxes, _boxes(frame.detections))
        false_boxes += len(frame.detections) - len(pairs)
        for b, d in pairs:
            n, scores = rows[b], frame.detections[d].class_scores[1:]
            true_class = truth.class_id[n, f]
            correct[n, f] = obj_ids[np.argmax(scores)] == true_class
            probability[n, f] = scores[run.catalogue.index(int(true_class))] / max(scores.sum(), 1e-12)
    return DetectorScore(correct, probability, false_boxes)


def match_boxes(ours: Array, theirs: Array) -> list[tuple[int, int]]:
    """The one-to-one pairs of boxes (n, 4) and (m, 4), x y width height, of largest total IoU, each at least IOU."""
    overlap = iou(ours, theirs)
    worth = np.where(overlap >= IOU, overlap, 0.0)
    rows, columns = linear_sum_assignment(worth, maximize=True)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if worth[i, j] > 0]


def iou(ours: Array, theirs: Array) -> Array:
    """Intersection over union of boxes (n, 4) and (m, 4), x y width height: (n, m)."""
    low = np.maximum(ours[:, None, :2], theirs[None, :, :2])
    high = np.minimum(ours[:, None, :2] + ours[:, None, 2:], theirs[None, :, :2] + theirs[None, :, 2:])
    shared = np.clip(high - low, 0.0, None).prod(axis=-1)
    union = ours[:, None, 2:].prod(axis=-1) + theirs[None, :, 2:].prod(axis=-1) - shared
    return shared / np.where(union > 0, union, 1.0)


def _true_boxes(catalogue: Catalogue, truth: ObjectFrames, f: int, camera: Camera) -> tuple[NDArray[np.int64], Array]:
    """Rows of the true objects that count in frame f, and the boxes (n, 4) of their visible pixels."""
    present = np.flatnonzero(truth.present[:, f])
    drawn = silhouettes(catalogue, truth.class_id[present, f], truth.T_camera_object[present, f], camera)
    boxes = [(n, s.visible_box) for n, s in zip(present, drawn, strict=True) if truth.visible[n, f] and s.visible_box]
    return np.array([n for n, _ in boxes], dtype=np.int64), np.array([b for _, b in boxes]).reshape(-1, 4)


def _boxes(detections: tuple[Detection, ...]) -> Array:
    return np.array([d.box for d in detections], dtype=np.float64).reshape(-1, 4)
