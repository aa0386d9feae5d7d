"""Methods side by side on one run: every metric of every method, from their estimates alone.

A method is judged by each frame's own estimate first, see `frames`; all figures are those of its `record`. In JSON,
which knows no infinity, what is infinite is null.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation.agreement import Agreement, agree
from ctmap_gtsam.evaluation.frames import POSES, FrameErrors, class_metrics, pose_metrics
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames, from_estimate, shapes_of
from ctmap_gtsam.evaluation.pose import Shape
from ctmap_gtsam.evaluation.record import DETECTOR, METRICS, Judge, Judgement, Record, own_counts, pooled
from sequences.catalogue import Catalogue
from sequences.truth import load_truth
from sequences.types import Run

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

REFERENCE = "smooth-ct"
"""The method that the others are held to where they are compared with each other"""


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
    record: Record | None
    """what the metrics are made from, to be pooled with other runs; None without truth"""


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

    def row(self, method: str, label: str) -> int | None:
        """The row of a method's estimate for a true object of `labels`; None where nothing matches it.

        Raises KeyError for a method that isn't there or has no poses, and for an unknown label.
        """
        matching = self.methods[method].matching
        if matching is None or label not in self.labels:
            raise KeyError(label if matching is not None else method)
        row = int(matching.row[self.labels.index(label)])
        return row if row >= 0 else None

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
    truth = load_truth(run)
    judge = None if truth is None else Judge(run, truth)
    labels = () if judge is None else object_labels(run.catalogue, judge.objects)
    maps = {name: from_estimate(run, name, estimate) for name, estimate in estimates.items()}
    asked: dict[str, MethodMap | None] = {**({DETECTOR: None} if detector else {}), **maps}
    methods = {name: _judged(judge, one, labels) for name, one in asked.items()}
    reference = REFERENCE if REFERENCE in maps else next(reversed(maps), None)
    times = np.array([frame.time_ns for frame in run.frames], dtype=np.int64)
    return Comparison(
        run=run.name,
        time_s=np.asarray((times - times[:1]) * 1e-9, dtype=np.float64),
        visit=np.array([frame.visit for frame in run.frames], dtype=np.int64),
        labels=labels,
        class_names={c.obj_id: c.name for c in run.catalogue.classes},
        truth=None if judge is None else judge.objects,
        methods=methods,
        reference=reference,
        agreement=_agreements(maps, reference, shapes_of(run.catalogue)),
    )


def _agreements(maps: Mapping[str, MethodMap], reference: str | None, shapes: dict[int, Shape]) -> dict[str, Agreement]:
    if reference is None:
        return {}
    return {name: agree(maps[reference], other, shapes) for name, other in maps.items() if name != reference}


def _judged(judge: Judge | None, method: MethodMap | None, labels: tuple[str, ...]) -> MethodScore:
    """The score of a method, None for the detector."""
    if judge is None:
        return _score_without_truth(None if method is None else method.estimate)
    return _score(judge.detector() if method is None else judge.estimate(method), judge.objects.visible, labels)


def object_labels(catalogue: Catalogue, truth: ObjectFrames) -> tuple[str, ...]:
    """(N,) a name for each true object: its class's, with #inst_id where several have that class."""
    classes = truth.class_id.max(axis=1, initial=-1)
    names = [catalogue[int(c)].name if c >= 0 else "unseen" for c in classes]
    return tuple(
        name if names.count(name) == 1 else f"{name}#{inst}" for name, inst in zip(names, truth.name, strict=True)
    )


def _score_without_truth(estimate: Estimate | None) -> MethodScore:
    counts = {} if estimate is None else own_counts(estimate)
    return MethodScore({**dict.fromkeys(METRICS), **counts, "objects": {}}, None, None, None)


def _score(judgement: Judgement, visible: Bools, labels: tuple[str, ...]) -> MethodScore:
    record, errors, matching = judgement
    objects = {label: _object_metrics(errors, visible, n, record.posed) for n, label in enumerate(labels)}
    metrics = {**pooled([record]), "objects": objects}
    return MethodScore(metrics, errors if record.posed else None, matching, record)


def _object_metrics(errors: FrameErrors, visible: Bools, n: int, posed: bool) -> dict[str, float | None]:
    """The metrics of one true object over the frames where it is visible."""
    only = np.zeros_like(visible)
    only[n] = visible[n]
    own = errors.at(only)
    poses: Mapping[str, float | None] = pose_metrics(own) if posed else dict.fromkeys(POSES)
    return {**poses, **class_metrics(own)}
