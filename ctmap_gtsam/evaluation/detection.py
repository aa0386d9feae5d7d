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

from ctmap_gtsam.evaluation.boxes import IOU, TrueBoxes
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames
from ctmap_gtsam.evaluation.silhouettes import Box
from sequences.types import Run

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


class DetectorScore(NamedTuple):
    """How the detector's own boxes fare against the boxes of the true objects."""

    class_id: NDArray[np.int64]
    """(N, F) obj_id of the best class of each true object's box, -1 without a box"""
    class_probability: Array
    """(N, F) the box's score of the true class; 0 without a box"""
    class_square: Array
    """(N, F) squared distance of its scores, background taken for "nothing there", from the truth (Brier)"""
    false_boxes: int
    """boxes that belong to no visible true object"""


class Belief(NamedTuple):
    """What a method believes of one true object in each frame (F)."""

    probability: Array
    """(F,) P(exists) P(true class); 0 where either is missing"""
    square: Array
    """(F,) squared distance of P(exists) P(class) and P(not there) from 1 for the truth and 0 for the rest (Brier)"""


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


def belief(method: MethodMap, row: int, class_id: NDArray[np.int64]) -> Belief:
    """What a method's object `row`, -1 for none, says of a true object of classes (F,)."""
    probability = class_probability(method, row, class_id)
    squares = np.ones(len(class_id))
    if row >= 0:
        exists = method.estimate.existence[row, method.held]
        each = exists[:, None] * method.estimate.class_probability[row, method.held]
        squares = (each**2).sum(axis=-1) + (1.0 - exists) ** 2
    return Belief(probability, squares - 2.0 * probability + 1.0)


def score_detections(run: Run, truth: ObjectFrames, boxes: TrueBoxes) -> DetectorScore:
    """Match the run's recorded detections to the boxes of the visible true objects, frame by frame."""
    class_id = np.full(truth.visible.shape, -1, dtype=np.int64)
    probability, square = np.zeros(truth.visible.shape), np.full(truth.visible.shape, 2.0)
    false_boxes = 0
    obj_ids = np.array(run.catalogue.obj_ids)
    for f, frame in enumerate(run.frames):
        rows, true = boxes.counting(f)
        pairs = match_boxes(true, np.array([d.box for d in frame.detections], dtype=np.float64).reshape(-1, 4))
        false_boxes += len(frame.detections) - len(pairs)
        for b, d in pairs:
            n, scores = rows[b], frame.detections[d].class_scores
            class_id[n, f] = obj_ids[np.argmax(scores[1:])]
            probability[n, f] = scores[1 + run.catalogue.index(int(truth.class_id[n, f]))]
            square[n, f] = (scores**2).sum() - 2.0 * probability[n, f] + 1.0
    return DetectorScore(class_id, probability, square, false_boxes)


def best_classes(run: Run) -> list[list[tuple[int, float, Box]]]:
    """For each frame obj_id, score and box of each detection: its best class, and that class's score."""
    out = []
    for frame in run.frames:
        best = [int(np.argmax(d.class_scores[1:])) for d in frame.detections]
        found = zip(best, frame.detections, strict=True)
        out.append([(run.catalogue.obj_ids[c], float(d.class_scores[1 + c]), d.box) for c, d in found])
    return out


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
