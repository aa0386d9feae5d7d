"""Methods side by side on one run: every metric of every method, from their estimates alone.

A method is judged by each frame's own estimate, over all visible true object-frames. A true object that nothing
matches, or whose match is absent in the frame, has infinite error. So has, in all that compares meshes, a match of the
wrong class (its pose is in another mesh's frame), while its translation, between the boxes' centres, stays finite.
A median is infinite where half of the object-frames are; in JSON, which knows no infinity, that is null.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation import detection, pose
from ctmap_gtsam.evaluation.agreement import Agreement, agree
from ctmap_gtsam.evaluation.matching import (
    Matching,
    MethodMap,
    ObjectFrames,
    from_estimate,
    from_truth,
    match,
    shapes_of,
)
from ctmap_gtsam.evaluation.pose import Shape
from sequences.catalogue import Catalogue
from sequences.truth import load_truth
from sequences.types import Run

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

DETECTOR = "detector"
"""Name of the row that judges the recorded boxes, which have no poses"""

REFERENCE = "smooth-ct"
"""The method that the others are held to where they are compared with each other"""

METRICS = (
    "mssd_mm_median",
    "adds_mm_median",
    "add_mm_median",
    "translation_mm_median",
    "rotation_deg_median",
    "posed_share",
    "class_accuracy",
    "class_accuracy_last_half",
)
"""Taken over the visible true object-frames, of all objects and of each. posed_share: how many of them have a pose of
the true class. class_accuracy_last_half: over the second half of the run's frames"""

COUNTS = ("missed_objects", "false_positive_objects")
"""True objects, visible somewhere, that nothing matches; estimated objects, existing somewhere, that match nothing"""


@dataclass(frozen=True)
class FrameErrors:
    """One method at every true object (N) and frame (F): inf where it has no answer, NaN where nothing is asked."""

    class_id: Ints
    """(N, F) what the method says, -1 where it says nothing"""
    class_correct: Bools
    """(N, F)"""
    class_probability: Array
    """(N, F) P(exists) P(true class)"""
    translation_m: Array
    """(N, F) between the bounding boxes' centres"""
    rotation_rad: Array
    """(N, F) symmetry-aware"""
    mssd_m: Array
    """(N, F)"""
    add_m: Array
    """(N, F)"""
    adds_m: Array
    """(N, F)"""


@dataclass(frozen=True)
class MethodScore:
    """All figures of one method."""

    metrics: Mapping[str, Any]
    """name -> number, or None where there is none (no truth, no poses, an infinite median); `objects` -> a mapping of
    the same for each true object"""
    errors: FrameErrors | None
    """None without truth, and for the detector"""
    matching: Matching | None
    """rows of the estimate for the true objects; None without truth, and for the detector"""


@dataclass(frozen=True)
class Comparison:
    """What `compare` found: M methods, N true objects (none without truth), F frames."""

    run: str
    """name of the run"""
    time_s: Array
    """(F,) since the first frame"""
    visit: Ints
    """(F,) row of Run.visits"""
    labels: tuple[str, ...]
    """(N,) the true objects' names: their class, and #inst_id where there are several"""
    class_names: Mapping[int, str]
    """obj_id -> name"""
    truth: ObjectFrames | None
    methods: Mapping[str, MethodScore]
    reference: str | None
    """the method that the others with poses are held to: REFERENCE where it ran, else the last; None without any"""
    agreement: Mapping[str, Agreement]
    """each other method with poses held to the reference method"""

    def table(self) -> pd.DataFrame:
        """One row a method, one column a metric."""
        flat = {name: {k: v for k, v in s.metrics.items() if k != "objects"} for name, s in self.methods.items()}
        return pd.DataFrame.from_dict(flat, orient="index")

    def object_table(self) -> pd.DataFrame:
        """One row a method and true object, one column a metric."""
        rows = {
            (name, label): values for name, s in self.methods.items() for label, values in s.metrics["objects"].items()
        }
        index = pd.MultiIndex.from_tuples(rows, names=["method", "object"]) if rows else None
        return pd.DataFrame(list(rows.values()), index=index)

    def frame_table(self) -> pd.DataFrame:
        """One row a method, visible true object and frame: time_s, class and errors (inf = no answer)."""
        parts = [
            self._frame_rows(name, score.errors) for name, score in self.methods.items() if score.errors is not None
        ]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()

    def _frame_rows(self, name: str, errors: FrameErrors) -> pd.DataFrame:
        assert self.truth is not None
        n, f = np.nonzero(self.truth.visible)
        columns = {field.name: getattr(errors, field.name)[n, f] for field in fields(errors)}
        labels = np.array(self.labels, dtype=object)[n]
        return pd.DataFrame({"method": name, "object": labels, "frame": f, "time_s": self.time_s[f], **columns})


def compare(run: Run, estimates: Mapping[str, Estimate], detector: bool = True) -> Comparison:
    """Score methods against the run's truth, and against each other. Reads the truth; runs no method, writes nothing.

    Args:
        run: the recording.
        estimates: by name of method.
        detector: also judge the recorded boxes, as the method "detector".

    Returns:
        The comparison; without truth the metrics that need it are None.
    """
    shapes = shapes_of(run.catalogue)
    truth = load_truth(run)
    true_objects = None if truth is None else from_truth(run, truth)
    labels = () if true_objects is None else object_labels(run.catalogue, true_objects)
    maps = {name: from_estimate(run, name, estimate) for name, estimate in estimates.items()}
    methods = {DETECTOR: _score_detector(run, true_objects, labels)} if detector else {}
    methods |= {name: _score(one, true_objects, labels, shapes) for name, one in maps.items()}
    reference = REFERENCE if REFERENCE in maps else next(reversed(maps), None)
    times = np.array([frame.time_ns for frame in run.frames], dtype=np.int64)
    return Comparison(
        run=run.name,
        time_s=np.asarray((times - times[:1]) * 1e-9, dtype=np.float64),
        visit=np.array([frame.visit for frame in run.frames], dtype=np.int64),
        labels=labels,
        class_names={c.obj_id: c.name for c in run.catalogue.classes},
        truth=true_objects,
        methods=methods,
        reference=reference,
        agreement={name: agree(maps[reference], other, shapes) for name, other in maps.items() if name != reference}
        if reference is not None
        else {},
    )


def object_labels(catalogue: Catalogue, truth: ObjectFrames) -> tuple[str, ...]:
    """(N,) a name for each true object: its class's, with #inst_id where several have that class."""
    classes = truth.class_id.max(axis=1, initial=-1)
    names = [catalogue[int(c)].name if c >= 0 else "unseen" for c in classes]
    return tuple(
        name if names.count(name) == 1 else f"{name}#{inst}" for name, inst in zip(names, truth.name, strict=True)
    )


def _score(
    method: MethodMap, truth: ObjectFrames | None, labels: tuple[str, ...], shapes: dict[int, Shape]
) -> MethodScore:
    estimate = method.estimate
    own = {
        "existing_objects_final": int(estimate.exists[:, -1].sum()) if len(estimate.keyframe_frame) else 0,
        "hypotheses_scored": estimate.meta.get("diagnostics", {}).get("hypotheses_scored"),
    }
    if truth is None:
        return MethodScore({**dict.fromkeys((*METRICS, *COUNTS)), **own, "objects": {}}, None, None)
    matching = match(truth, method.objects, shapes)
    errors = _frame_errors(method, truth, matching, shapes)
    counts = {
        "missed_objects": int(((matching.row < 0) & truth.visible.any(axis=1)).sum()),
        "false_positive_objects": len(matching.unmatched),
    }
    metrics = {**_metrics(errors, truth.visible), **counts, **own, "objects": _by_object(errors, truth.visible, labels)}
    return MethodScore(metrics, errors, matching)


def _frame_errors(method: MethodMap, truth: ObjectFrames, matching: Matching, shapes: dict[int, Shape]) -> FrameErrors:
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
    probability = [
        detection.class_probability(method, int(row), truth.class_id[n]) for n, row in enumerate(matching.row)
    ]
    return FrameErrors(
        class_id=said,
        class_correct=detection.class_correct(truth, method.objects, matching),
        class_probability=np.array(probability).reshape(truth.visible.shape),
        translation_m=translation,
        rotation_rad=rotation,
        mssd_m=mssd,
        add_m=add,
        adds_m=adds,
    )


def _score_detector(run: Run, truth: ObjectFrames | None, labels: tuple[str, ...]) -> MethodScore:
    empty = dict.fromkeys((*METRICS, *COUNTS, "existing_objects_final", "hypotheses_scored"))
    if truth is None:
        return MethodScore({**empty, "false_positive_boxes": None, "objects": {}}, None, None)
    score = detection.score_detections(run, truth)
    objects = {
        label: {**dict.fromkeys(METRICS), **_class_metrics(score.class_correct[n : n + 1], truth.visible[n : n + 1])}
        for n, label in enumerate(labels)
    }
    metrics = {**empty, **_class_metrics(score.class_correct, truth.visible), "false_positive_boxes": score.false_boxes}
    return MethodScore({**metrics, "objects": objects}, None, None)


def _by_object(errors: FrameErrors, visible: Bools, labels: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    rows = ((label, slice(n, n + 1)) for n, label in enumerate(labels))
    return {
        label: _metrics(FrameErrors(**{f.name: getattr(errors, f.name)[n] for f in fields(errors)}), visible[n])
        for label, n in rows
    }


def _metrics(errors: FrameErrors, visible: Bools) -> dict[str, float | None]:
    """The METRICS over the object-frames that count."""
    return {
        "mssd_mm_median": _median(1e3 * errors.mssd_m[visible]),
        "adds_mm_median": _median(1e3 * errors.adds_m[visible]),
        "add_mm_median": _median(1e3 * errors.add_m[visible]),
        "translation_mm_median": _median(1e3 * errors.translation_m[visible]),
        "rotation_deg_median": _median(np.rad2deg(errors.rotation_rad[visible])),
        "posed_share": _mean(np.isfinite(errors.mssd_m[visible])),
        **_class_metrics(errors.class_correct, visible),
    }


def _class_metrics(correct: Bools, visible: Bools) -> dict[str, float | None]:
    half = visible.shape[1] // 2
    return {
        "class_accuracy": _mean(correct[visible]),
        "class_accuracy_last_half": _mean(correct[:, half:][visible[:, half:]]),
    }


def _median(values: Array) -> float | None:
    """None where there are no values, or where half of them are infinite."""
    middle = float(np.median(values)) if len(values) else np.inf
    return middle if np.isfinite(middle) else None


def _mean(values: NDArray[Any]) -> float | None:
    return float(np.mean(values)) if len(values) else None
