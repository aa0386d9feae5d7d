"""One method at every true object and frame: what each frame's own estimate is worth.

A true object that nothing matches, or whose match is absent in the frame, has infinite error. So has, in all that
compares meshes, a match of the wrong class (its pose is in another mesh's frame), while its translation, between the
boxes' centres, stays finite. A median is infinite where half of the object-frames are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.evaluation import detection, pose
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames
from ctmap_gtsam.evaluation.pose import Shape
from ctmap_gtsam.evaluation.statistics import log_score, mean, median
from ctmap_gtsam.evaluation.vsd import SHARES, Scene, vsd_recall
from sequences.camera import Camera
from sequences.types import Run

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
    "pose_2cm_10deg",
    "pose_5cm_15deg",
    "add_auc",
    "adds_auc",
    "mssd_recall",
    "mspd_recall",
    "vsd_recall",
    "bop_recall",
    "mssd_mm_early",
    "mssd_mm_occlusion",
    "mssd_mm_reentry",
    "mssd_mm_steady",
)
"""Metrics that need poses. posed_share: how many object-frames have a pose of the true class. pose_*: how many are
within both thresholds. *_auc: area under the curve of accuracy over the threshold, up to AUC_M (Xiang et al., PoseCNN,
RSS 2018). *_recall: BOP's average recalls (Hodan et al., BOP Challenge 2020, ECCV Workshops 2020), and their mean.
mssd_mm_<situation>: median of the object-frames in a situation that have a pose of the true class, see SITUATIONS"""

SITUATIONS = ("early", "occlusion", "reentry", "steady")
"""Where hindsight may help: an object's first FRESH frames in which it is visible, the first in each later visit, the
first after it was out of sight for at least HIDDEN frames of a visit; and all others"""

FRESH = 5
HIDDEN = 3

AUC_M = 0.1
"""Where PoseCNN's curves end"""

THRESHOLDS = {"2cm_10deg": (0.02, np.deg2rad(10.0)), "5cm_15deg": (0.05, np.deg2rad(15.0))}
"""The named points of the curves of pose accuracy, metres and rad"""

CLASSES = (
    "class_accuracy",
    "class_accuracy_last_half",
    "class_log_score",
    "class_brier_score",
    "class_log_score_confusable",
    "class_brier_score_confusable",
)
"""Metrics that need none. class_accuracy_last_half: over the second half of each run's frames. The scores are of the
belief over the classes and "nothing there", as logarithm (Good, Rational decisions, 1952) and square (Brier, 1950):
lower is better. *_confusable: at the objects whose class looks like another one of the catalogue (`alike`)"""


@dataclass(frozen=True)
class FrameErrors:
    """One method at object-frames; inf where it has no answer, NaN where nothing is asked.

    In a comparison (N, F) true objects and frames, in a record (n,) those that count.
    """

    late: Bools
    """in the second half of the run's frames"""
    situation: Ints
    """position in SITUATIONS"""
    confusable: Bools
    """whether the true class looks like another one of the catalogue"""
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
    mssd_recall: Array
    """share of BOP's ten thresholds, 5 to 50 % of the diameter, that MSSD is below"""
    mspd_recall: Array
    """the same of MSPD, 5 to 50 pixels of an image 640 pixels wide"""
    vsd_recall: Array
    """share of BOP's hundred pairs of tolerance and threshold that VSD passes; NaN in frames where it isn't asked"""

    def at(self, where: Bools) -> FrameErrors:
        """Those of some object-frames (N, F), in one row."""
        return FrameErrors(**{f.name: getattr(self, f.name)[where] for f in fields(self)})


def frame_errors(
    run: Run,
    method: MethodMap,
    truth: ObjectFrames,
    matching: Matching,
    shapes: dict[int, Shape],
    measured: Mapping[int, Scene],
    confusable: Collection[int],
) -> FrameErrors:
    """(N, F) how a method fares at the true objects, by `matching`.

    VSD in the frames of `measured` (`vsd.scenes`); `confusable` are the classes of which `alike.confusable` tells.
    """
    said = detection.matched_class(method.objects, matching)
    translation, rotation, mssd, add, adds, mspd = (np.where(truth.visible, np.inf, np.nan) for _ in range(6))
    diameters, widths = np.ones(truth.visible.shape), np.array([frame.camera.width for frame in run.frames])
    cameras = [frame.camera for frame in run.frames]
    for n, row in enumerate(matching.row):
        for true_id, said_id in np.unique(np.stack([truth.class_id[n], said[n]], axis=1), axis=0):
            f = truth.visible[n] & (truth.class_id[n] == true_id) & (said[n] == said_id)
            if said_id < 0 or not f.any():
                continue
            true, other = shapes[int(true_id)], shapes[int(said_id)]
            T_true, T = truth.T_camera_object[n, f], method.objects.T_camera_object[row, f]
            translation[n, f] = pose.translation_error(other, T, true, T_true)
            if said_id == true_id:
                diameters[n, f] = true.of.diameter_m
                rotation[n, f] = pose.rotation_error(true, T, T_true)
                mssd[n, f], add[n, f], adds[n, f] = (e(true, T, T_true) for e in (pose.mssd, pose.add, pose.adds))
                mspd[n, f] = _mspd(true, T, T_true, [cameras[k] for k in np.flatnonzero(f)])
    beliefs = [detection.belief(method, int(row), truth.class_id[n]) for n, row in enumerate(matching.row)]
    return FrameErrors(
        **_kinds(run, truth, confusable),
        class_id=said,
        class_correct=detection.class_correct(truth, method.objects, matching),
        class_probability=np.array([b.probability for b in beliefs]).reshape(truth.visible.shape),
        class_square=np.array([b.square for b in beliefs]).reshape(truth.visible.shape),
        translation_m=translation,
        rotation_rad=rotation,
        mssd_m=mssd,
        add_m=add,
        adds_m=adds,
        mssd_recall=_recall(mssd / diameters),
        mspd_recall=_recall(mspd / widths * (640.0 / 100.0)),  # 5 px of 640 is the least threshold, as 5 % is
        vsd_recall=vsd_recall(run.catalogue, measured, truth, method.objects, matching),
    )


def _kinds(run: Run, truth: ObjectFrames, confusable: Collection[int]) -> dict[str, Any]:
    """What kind of object-frames these are, whatever a method says of them: (N, F) each."""
    return {
        "late": _late(truth),
        "situation": situations(truth.visible, np.array([frame.visit for frame in run.frames])),
        "confusable": np.isin(truth.class_id, list(confusable)),
    }


def _mspd(shape: Shape, T: Array, T_true: Array, cameras: Sequence[Camera]) -> Array:
    """(n,) of poses (n, 4, 4) in n images."""
    out = np.empty(len(cameras))
    for camera in dict.fromkeys(cameras):
        k = np.array([one == camera for one in cameras])
        out[k] = pose.mspd(shape, T[k], T_true[k], camera)
    return out


def _recall(error: Array) -> Array:
    """Share of the thresholds that errors (...) are below; NaN where they are."""
    return np.where(np.isnan(error), np.nan, (error[..., None] < SHARES).mean(axis=-1))


def detector_errors(
    run: Run, score: detection.DetectorScore, truth: ObjectFrames, confusable: Collection[int]
) -> FrameErrors:
    """(N, F) the same of the detector's boxes, which have classes and no poses."""
    nothing = np.where(truth.visible, np.inf, np.nan)
    return FrameErrors(
        **_kinds(run, truth, confusable),
        class_id=score.class_id,
        class_correct=(score.class_id == truth.class_id) & truth.present,
        class_probability=score.class_probability,
        class_square=score.class_square,
        translation_m=nothing,
        rotation_rad=nothing,
        mssd_m=nothing,
        add_m=nothing,
        adds_m=nothing,
        mssd_recall=nothing,
        mspd_recall=nothing,
        vsd_recall=nothing,
    )


def pose_metrics(errors: FrameErrors) -> dict[str, float | None]:
    """POSES over the object-frames (n,) given; vsd_recall over those that it was measured in."""
    recalls = {
        "mssd_recall": mean(errors.mssd_recall),
        "mspd_recall": mean(errors.mspd_recall),
        "vsd_recall": mean(errors.vsd_recall[np.isfinite(errors.vsd_recall)]),
    }
    return {
        "mssd_mm_median": median(1e3 * errors.mssd_m),
        "adds_mm_median": median(1e3 * errors.adds_m),
        "add_mm_median": median(1e3 * errors.add_m),
        "translation_mm_median": median(1e3 * errors.translation_m),
        "rotation_deg_median": median(np.rad2deg(errors.rotation_rad)),
        "posed_share": mean(np.isfinite(errors.mssd_m)),
        **named_accuracies("pose", errors.translation_m, errors.rotation_rad),
        "add_auc": area_under_curve(errors.add_m),
        "adds_auc": area_under_curve(errors.adds_m),
        **recalls,
        "bop_recall": None if None in recalls.values() else float(np.mean([*recalls.values()])),
        **{f"mssd_mm_{name}": _posed_mssd(errors, k) for k, name in enumerate(SITUATIONS)},
    }


def situations(visible: Bools, visit: Ints) -> Ints:
    """Which of SITUATIONS each object-frame is in.

    Args:
        visible: (N, F) true objects in frames.
        visit: (F,) of each frame, ascending.

    Returns:
        (N, F); that of object-frames which aren't visible means nothing.
    """
    early, occlusion, reentry, steady = range(len(SITUATIONS))
    out = np.full(visible.shape, steady, dtype=np.int64)
    for n, seen in enumerate(visible):
        since, situation, last = FRESH, early, -1
        for f in np.flatnonzero(seen):
            if last < 0:
                since = 0
            elif visit[f] != visit[last]:
                since, situation = 0, reentry
            elif f - last > HIDDEN:
                since, situation = 0, occlusion
            if since < FRESH:
                out[n, f] = situation
            since, last = since + 1, int(f)
    return out


def _posed_mssd(errors: FrameErrors, situation: int) -> float | None:
    """Median, millimetres; of what has no pose the other metrics tell."""
    asked = errors.mssd_m[errors.situation == situation]
    return median(1e3 * asked[np.isfinite(asked)])


def accuracy(translation_m: Array, rotation_rad: Array, within_m: Array, within_rad: Array) -> Array:
    """The paper's accuracy (section V-B): the share N_correct / N_total within both thresholds.

    Errors (n,) each, and thresholds that broadcast against each other (...) -> (...); NaN where there are no errors.
    """
    within_m, within_rad = np.broadcast_arrays(within_m, within_rad)
    if len(translation_m) == 0:
        return np.full(within_m.shape, np.nan)
    near = translation_m <= within_m[..., None]
    return (near & (rotation_rad <= within_rad[..., None])).mean(axis=-1)


def named_accuracies(name: str, translation_m: Array, rotation_rad: Array) -> dict[str, float | None]:
    """`accuracy` at THRESHOLDS, as <name>_2cm_10deg and so on."""
    return {
        f"{name}_{point}": mean((translation_m <= metres) & (rotation_rad <= rad))
        for point, (metres, rad) in THRESHOLDS.items()
    }


def area_under_curve(errors_m: Array) -> float | None:
    """The area under accuracy over threshold from 0 to AUC_M, as a share of the largest: errors (n,) -> 0 to 1.

    The accuracy is a staircase, and this its exact integral.
    """
    return mean(np.maximum(0.0, 1.0 - errors_m / AUC_M))


def class_metrics(errors: FrameErrors) -> dict[str, float | None]:
    """CLASSES over the object-frames (n,) given."""
    return {
        "class_accuracy": mean(errors.class_correct),
        "class_accuracy_last_half": mean(errors.class_correct[errors.late]),
        "class_log_score": log_score(errors.class_probability),
        "class_brier_score": mean(errors.class_square),
        "class_log_score_confusable": log_score(errors.class_probability[errors.confusable]),
        "class_brier_score_confusable": mean(errors.class_square[errors.confusable]),
    }


def _late(truth: ObjectFrames) -> Bools:
    frames = truth.visible.shape[1]
    return np.broadcast_to(np.arange(frames) >= frames // 2, truth.visible.shape)
