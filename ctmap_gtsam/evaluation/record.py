"""All that the metrics need of one method on one run, small enough to keep, and every metric of one or many of them.

`record` does what takes time, once a method and run; `pooled` puts records of several runs together and takes a few
milliseconds, so that a bootstrap over places can call it thousands of times. A pooled figure is that of all
object-frames (object-visits, boxes, ...) together, not a mean over runs; counts are sums.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation import calibration, frames, moves, trajectory, visits
from ctmap_gtsam.evaluation.alike import confusable
from ctmap_gtsam.evaluation.boxes import (
    JudgedBoxes,
    TrueBoxes,
    judge_boxes,
    mean_average_precision,
    pooled_boxes,
    true_boxes,
)
from ctmap_gtsam.evaluation.calibration import ExistenceSamples, PoseSamples
from ctmap_gtsam.evaluation.detection import best_classes, score_detections
from ctmap_gtsam.evaluation.frames import FrameErrors
from ctmap_gtsam.evaluation.identity import identity_switches
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, from_estimate, from_truth, match, shapes_of
from ctmap_gtsam.evaluation.moves import Periods
from ctmap_gtsam.evaluation.trajectory import CameraErrors
from ctmap_gtsam.evaluation.views import DOUBTFUL, final_views, views
from ctmap_gtsam.evaluation.visits import LastSeen, MapEnds
from ctmap_gtsam.evaluation.vsd import Scene, scenes
from sequences.atomic import write_npz
from sequences.errors import InputError
from sequences.types import Run, Truth

Array = NDArray[np.float64]

SCHEMA = 5

DETECTOR = "detector"
"""Name of the method that is the recorded boxes, which have no poses"""

COUNTS = (
    "missed_objects",
    "false_positive_objects",
    "existing_objects_final",
    "hypotheses_scored",
    "false_positive_boxes",
    "identity_switches",
)
"""True objects, visible somewhere, that nothing matches; estimated objects, existing somewhere, that match nothing;
objects in the map of the last keyframe; poses that the method rendered and scored; the detector's boxes that belong to
no visible true object; see `identity`"""

_POSED = (
    *frames.POSES,
    *visits.LAST_SEEN,
    *visits.MAPS,
    *trajectory.TRAJECTORY,
    *moves.MOVES,
    *calibration.POSE_CALIBRATION,
    *calibration.EXISTENCE,
)
METRICS = ("map_50", "map_50_paper", *frames.CLASSES, *_POSED, *COUNTS)
"""What `pooled` gives. map_50: mean average precision at IoU 0.5 of each frame's own estimate; map_50_paper: of the map
at the end of each visit in all of its frames, and of the detector's boxes as they are"""

DRAWN_PX = 320
"""Maps are drawn at most about this wide for their boxes, which are then good to two pixels of a VGA image"""

_BROKEN = (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class Record:
    """One method on one run, ready to be pooled with the same method on other runs."""

    method: str
    run: str
    class_names: tuple[str, ...]
    """(C,) of the catalogue"""
    posed: bool
    """whether the method has poses: the detector has none"""
    counts: Mapping[str, int]
    """those of COUNTS that the method has"""
    frames: FrameErrors
    """at the visible true object-frames"""
    boxes: JudgedBoxes
    """of each frame's own estimate"""
    final_boxes: JudgedBoxes
    """of the map at the end of each frame's visit: the paper's protocol"""
    last_seen: LastSeen
    maps: MapEnds
    cameras: CameraErrors
    periods: Periods
    pose_samples: PoseSamples
    existence: ExistenceSamples

    def save(self, path: Path) -> None:
        """Write one .npz without pickle, whole or not at all; equal records give equal bytes."""
        meta = {"schema": SCHEMA, **{name: getattr(self, name) for name in _PLAIN}}
        arrays = {
            f"{table}.{f.name}": getattr(getattr(self, table), f.name) for table, kind in _TABLES for f in fields(kind)
        }
        write_npz(path, {"meta": np.array(json.dumps(meta)), **arrays})

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read what `save` wrote. Raises InputError where the file isn't a record or has another schema."""
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            meta = json.loads(str(arrays["meta"]))
            if meta.pop("schema") != SCHEMA:
                raise ValueError("another schema")
            tables = {
                table: kind(**{f.name: arrays[f"{table}.{f.name}"] for f in fields(kind)}) for table, kind in _TABLES
            }
            return cls(**{**meta, "class_names": tuple(meta["class_names"])}, **tables)
        except _BROKEN as error:
            raise InputError(
                f"not a record of this version ({error})", file=path, remedy="delete it and judge the method again"
            ) from error


_PLAIN = ("method", "run", "class_names", "posed", "counts")
_TABLES: tuple[tuple[str, type[Any]], ...] = (
    ("frames", FrameErrors),
    ("boxes", JudgedBoxes),
    ("final_boxes", JudgedBoxes),
    ("last_seen", LastSeen),
    ("maps", MapEnds),
    ("cameras", CameraErrors),
    ("periods", Periods),
    ("pose_samples", PoseSamples),
    ("existence", ExistenceSamples),
)


class Judgement(NamedTuple):
    """A record with what it was made from."""

    record: Record
    errors: FrameErrors
    """(N, F) at the true objects and frames"""
    matching: Matching | None
    """rows of the estimate for the true objects; None for the detector"""


class Judge:
    """A run with its truth, ready to judge any number of methods."""

    def __init__(self, run: Run, truth: Truth) -> None:
        self.run = run
        self.truth = truth
        self.objects = from_truth(run, truth)
        self.shapes = shapes_of(run.catalogue)

    @cached_property
    def boxes(self) -> TrueBoxes:
        """The true objects' boxes."""
        return true_boxes(self.run, self.truth, self.objects, self._step)

    @cached_property
    def scenes(self) -> dict[int, Scene]:
        """The depth images that VSD looks at."""
        return scenes(self.run, self._step)

    @cached_property
    def confusable(self) -> frozenset[int]:
        """The classes that look like another one."""
        return confusable(self.run.catalogue)

    def estimate(self, method: MethodMap) -> Judgement:
        """Judge a method that has poses."""
        matching = match(self.objects, method.objects, self.shapes)
        case = self.run, method, self.objects, matching
        errors = frames.frame_errors(*case, self.shapes, self.scenes, self.confusable)
        obj_ids = self.run.catalogue.obj_ids
        own = [view.boxes() for view in views(self.run, method.estimate, self._step, DOUBTFUL)]
        final = [view.boxes() for view in final_views(self.run, method.estimate, self._step, DOUBTFUL)]
        record = self._record(
            method.name,
            posed=True,
            counts={
                "missed_objects": int(((matching.row < 0) & self.objects.visible.any(axis=1)).sum()),
                "false_positive_objects": len(matching.unmatched),
                "identity_switches": identity_switches(self.objects, method.objects, self.shapes),
                **own_counts(method.estimate),
            },
            errors=errors,
            boxes=judge_boxes(self.boxes, own, obj_ids),
            final_boxes=judge_boxes(self.boxes, final, obj_ids),
            last_seen=visits.last_seen(*case, self.shapes),
            maps=visits.map_ends(*case, self.shapes),
            cameras=trajectory.camera_errors(self.run, method.T_world_camera, self.truth.T_world_camera),
            periods=moves.periods(self.run, method, self.truth, self.objects, matching, self.shapes),
            pose_samples=calibration.pose_samples(self.run, method, self.truth, self.objects, matching),
            existence=calibration.existence_samples(*case),
        )
        return Judgement(record, errors, matching)

    def detector(self) -> Judgement:
        """Judge the recorded boxes, each as its best class with that class's score."""
        score = score_detections(self.run, self.objects, self.boxes)
        errors = frames.detector_errors(self.run, score, self.objects, self.confusable)
        boxes = judge_boxes(self.boxes, best_classes(self.run), self.run.catalogue.obj_ids)
        record = self._record(
            DETECTOR,
            posed=False,
            counts={"false_positive_boxes": score.false_boxes},
            errors=errors,
            boxes=boxes,
            final_boxes=boxes,  # the paper judges its detector frame by frame, too
            **{table: _empty(kind) for table, kind in _TABLES if table not in ("frames", "boxes", "final_boxes")},
        )
        return Judgement(record, errors, None)

    @property
    def _step(self) -> int:
        return max([1, *(frame.camera.width // DRAWN_PX for frame in self.run.frames[:1])])

    def _record(self, method: str, *, errors: FrameErrors, **parts: Any) -> Record:
        return Record(
            method=method,
            run=self.run.name,
            class_names=tuple(c.name for c in self.run.catalogue.classes),
            frames=errors.at(self.objects.visible),
            **parts,
        )


def record(run: Run, truth: Truth, name: str, estimate: Estimate | None) -> Record:
    """Judge one method on one run.

    Args:
        run: the recording.
        truth: about it.
        name: of the method.
        estimate: what it said; None for the detector's own boxes.
    """
    judge = Judge(run, truth)
    if estimate is None:
        return replace(judge.detector().record, method=name)
    return judge.estimate(from_estimate(run, name, estimate)).record


def pooled(records: Sequence[Record]) -> dict[str, float | None]:
    """All METRICS of one method over several runs; None where there is none. A run may be among them repeatedly."""
    names = [r.class_names for r in records]
    at_frames = _together([r.frames for r in records])
    metrics: dict[str, float | None] = dict.fromkeys(METRICS)
    metrics["map_50"] = mean_average_precision(pooled_boxes([r.boxes for r in records], names))
    metrics["map_50_paper"] = mean_average_precision(pooled_boxes([r.final_boxes for r in records], names))
    metrics |= frames.class_metrics(at_frames)
    if all(r.posed for r in records):
        metrics |= frames.pose_metrics(at_frames)
        metrics |= visits.last_seen_metrics(_together([r.last_seen for r in records]))
        metrics |= visits.map_metrics(_together([r.maps for r in records]))
        metrics |= trajectory.trajectory_metrics(_together([r.cameras for r in records]))
        metrics |= moves.move_metrics(_together([r.periods for r in records]))
        metrics |= calibration.pose_calibration_metrics(_together([r.pose_samples for r in records]))
        metrics |= calibration.existence_metrics(_together([r.existence for r in records]))
    for name in COUNTS:
        known = [r.counts[name] for r in records if name in r.counts]
        metrics[name] = sum(known) if len(known) == len(records) else None
    return metrics


def pose_curve(records: Sequence[Record], within_m: Array, within_rad: Array, *, last_seen: bool = False) -> Array:
    """Pose accuracy over thresholds, of one method over several runs: the paper's pose figure.

    Args:
        records: of a method with poses.
        within_m: thresholds of the translation error.
        within_rad: of the rotation error; broadcasts against `within_m` (...).
        last_seen: of the maps at the ends of the visits, at the frames in which objects are last seen (the paper's
            protocol), instead of each frame's own estimate.

    Returns:
        (...) share of the object-frames or object-visits within both; NaN where there are none.
    """
    errors = [r.last_seen if last_seen else r.frames for r in records]
    shift = np.concatenate([e.translation_m for e in errors])
    turn = np.concatenate([e.rotation_rad for e in errors])
    return frames.accuracy(shift, turn, np.asarray(within_m), np.asarray(within_rad))


def own_counts(estimate: Estimate) -> dict[str, int]:
    """What a method counts without any truth."""
    scored = estimate.meta.get("diagnostics", {}).get("hypotheses_scored")
    counts = {"existing_objects_final": int(estimate.exists[:, -1].sum()) if len(estimate.keyframe_frame) else 0}
    return counts if scored is None else {**counts, "hypotheses_scored": int(scored)}


Table = TypeVar("Table")


def _together(tables: Sequence[Table]) -> Table:
    """Rows of tables of one kind, one after the other."""
    kind = type(tables[0])
    return kind(**{f.name: np.concatenate([getattr(t, f.name) for t in tables]) for f in fields(kind)})  # type: ignore[arg-type]


def _empty(kind: type[Any]) -> Any:
    return kind(**{f.name: np.zeros(0) for f in fields(kind)})
