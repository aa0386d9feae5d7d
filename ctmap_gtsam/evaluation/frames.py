"""One method at every true object and frame: what each frame's own estimate is worth.

A true object that nothing matches, or whose match is absent in the frame, has infinite error. So has, in all that
compares meshes, a match of the wrong class (its pose is in another mesh's frame), while its translation, between the
boxes' centres, stays finite. A median is infinite where half of the object-frames are.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.evaluation import detection, pose
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames
from ctmap_gtsam.evaluation.pose import Shape
from ctmap_gtsam.evaluation.statistics import log_score, mean, median

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

POSES = (
    "mssd_mm_median",
    "adds_mm_median",
    "add_mm_median",
    "translation_mm_median",
    "rotation_deg_median",
    "posed_share",
)
"""Metrics that need poses. posed_share: how many object-frames have a pose of the true class"""

CLASSES = ("class_accuracy", "class_accuracy_last_half", "class_log_score", "class_brier_score")
"""Metrics that need none. class_accuracy_last_half: over the second half of each run's frames. The scores are of the
belief over the classes and "nothing there", as logarithm (Good, Rational decisions, 1952) and square (Brier, 1950):
lower is better"""


@dataclass(frozen=True)
class FrameErrors:
    """One method at object-frames; inf where it has no answer, NaN where nothing is asked.

    In a comparison (N, F) true objects and frames, in a record (n,) those that count.
    """

    late: Bools
    """in the second half of the run's frames"""
    class_id: Ints
    """what the method says, -1 where it says nothing"""
    class_correct: Bools
    class_probability: Array
    """P(exists) P(true class)"""
    class_square: Array
    """squared distance of the belief over the classes and "nothing there" from the truth (Brier): 0 to 2"""
    translation_m: Array
    """between the bounding boxes' centres"""
    rotation_rad: Array
    """symmetry-aware"""
    mssd_m: Array
    add_m: Array
    adds_m: Array

    def at(self, where: Bools) -> FrameErrors:
        """Those of some object-frames (N, F), in one row."""
        return FrameErrors(**{f.name: getattr(self, f.name)[where] for f in fields(self)})


def frame_errors(method: MethodMap, truth: ObjectFrames, matching: Matching, shapes: dict[int, Shape]) -> FrameErrors:
    """(N, F) how a method fares at the true objects, by `matching`."""
    said = detection.matched_class(method.objects, matching)
    translation, rotation, mssd, add, adds = (np.where(truth.visible, np.inf, np.nan) for _ in range(5))
    for n, row in enumerate(matching.row):
        for true_id, said_id in np.unique(np.stack([truth.class_id[n], said[n]], axis=1), axis=0):
            f = truth.visible[n] & (truth.class_id[n] == true_id) & (said[n] == said_id)
            if said_id < 0 or not f.any():
                continue
            true, other = shapes[int(true_id)], shapes[int(said_id)]
            T_true, T = truth.T_camera_object[n, f], method.objects.T_camera_object[row, f]
            translation[n, f] = pose.translation_error(other, T, true, T_true)
            if said_id == true_id:
                rotation[n, f] = pose.rotation_error(true, T, T_true)
                mssd[n, f], add[n, f], adds[n, f] = (e(true, T, T_true) for e in (pose.mssd, pose.add, pose.adds))
    beliefs = [detection.belief(method, int(row), truth.class_id[n]) for n, row in enumerate(matching.row)]
    return FrameErrors(
        late=_late(truth),
        class_id=said,
        class_correct=detection.class_correct(truth, method.objects, matching),
        class_probability=np.array([b.probability for b in beliefs]).reshape(truth.visible.shape),
        class_square=np.array([b.square for b in beliefs]).reshape(truth.visible.shape),
        translation_m=translation,
        rotation_rad=rotation,
        mssd_m=mssd,
        add_m=add,
        adds_m=adds,
    )


def detector_errors(score: detection.DetectorScore, truth: ObjectFrames) -> FrameErrors:
    """(N, F) the same of the detector's boxes, which have classes and no poses."""
    nothing = np.where(truth.visible, np.inf, np.nan)
    return FrameErrors(
        late=_late(truth),
        class_id=score.class_id,
        class_correct=(score.class_id == truth.class_id) & truth.present,
        class_probability=score.class_probability,
        class_square=score.class_square,
        translation_m=nothing,
        rotation_rad=nothing,
        mssd_m=nothing,
        add_m=nothing,
        adds_m=nothing,
    )


def pose_metrics(errors: FrameErrors) -> dict[str, float | None]:
    """POSES over the object-frames (n,) given."""
    return {
        "mssd_mm_median": median(1e3 * errors.mssd_m),
        "adds_mm_median": median(1e3 * errors.adds_m),
        "add_mm_median": median(1e3 * errors.add_m),
        "translation_mm_median": median(1e3 * errors.translation_m),
        "rotation_deg_median": median(np.rad2deg(errors.rotation_rad)),
        "posed_share": mean(np.isfinite(errors.mssd_m)),
    }


def class_metrics(errors: FrameErrors) -> dict[str, float | None]:
    """CLASSES over the object-frames (n,) given."""
    return {
        "class_accuracy": mean(errors.class_correct),
        "class_accuracy_last_half": mean(errors.class_correct[errors.late]),
        "class_log_score": log_score(errors.class_probability),
        "class_brier_score": mean(errors.class_square),
    }


def _late(truth: ObjectFrames) -> Bools:
    frames = truth.visible.shape[1]
    return np.broadcast_to(np.arange(frames) >= frames // 2, truth.visible.shape)
