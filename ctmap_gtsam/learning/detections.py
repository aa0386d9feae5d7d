"""What the model says of the detector, from its boxes held to what is truly visible.

The box of a true object in a frame is the one that `evaluation.detection.match_boxes` gives it, blind to classes. Given
what is visible of each object, each frame says whether it was found (p_D v), how far its box is off (`box_log_ratio`),
and what the detector believes; and all frames of an object-visit together whether that belief is persistently of
another class (`persistent_class_log_evidence`), the scores being integrated over what it may be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ctmap_gtsam.config import Config
from ctmap_gtsam.evaluation.boxes import true_boxes
from ctmap_gtsam.evaluation.detection import match_boxes
from ctmap_gtsam.evaluation.matching import from_truth
from factors.measurement import box_log_ratio, class_log_ratio, confusion, persistent_class_log_evidence
from sequences.camera import Camera
from sequences.types import Detection, Run, Truth

Array = NDArray[np.float64]

_CONFUSION = np.concatenate([np.geomspace(1e-4, 0.01, 40, endpoint=False), np.linspace(0.01, 0.9, 400)])
_FOUND, _BOX = (0.01, 0.999), (0.005, 1.0)  # within which p_D and the box's sigma are sought


@dataclass(frozen=True)
class Sight:
    """One true object in one frame."""

    visit: int
    """which object-visit"""
    order: int
    """position of the frame in its visit"""
    frames: int
    """of that visit"""
    true_class: int
    """position in the catalogue"""
    visible: float
    """share of its silhouette"""
    scores: Array | None
    """(C,) `class_log_ratio` of its box; None where it was not found"""
    box: Array
    """(2, 4) detected and true box, x y width height, pixels; NaN where it was not found"""
    image_size: tuple[int, int]
    """width and height"""


def sights_of(run: Run, truth: Truth, config: Config, first_visit: int = 0) -> list[Sight]:
    """All true objects in all frames in which they count; object-visits are numbered on from `first_visit`.

    Empty where the run has no detections at all: nobody looked.
    """
    if not any(frame.detections for frame in run.frames):
        return []
    number: dict[tuple[int, int], int] = {}
    sights = []
    true = true_boxes(run, truth, from_truth(run, truth))
    for visit in run.visits:
        for k, frame in enumerate(visit.frames):
            rows, there = true.counting(frame.index)
            boxes = np.array([d.box for d in frame.detections], dtype=np.float64).reshape(-1, 4)
            found = {row: frame.detections[d] for row, d in match_boxes(there, boxes)}
            for row, (thing, box) in enumerate(zip((truth.objects[int(n)] for n in rows), there, strict=True)):
                name = number.setdefault((frame.visit, thing.inst_id), first_visit + len(number))
                share = float(thing.visible_fraction[thing.frames == frame.index][0])
                when = (name, k, len(visit.frames))
                true_class = run.catalogue.index(thing.obj_id)
                sights.append(_sight(when, true_class, share, found.get(row), box, frame.camera, config))
    return sights


def _sight(
    when: tuple[int, int, int],
    true_class: int,
    visible: float,
    found: Detection | None,
    true_box: Array,
    camera: Camera,
    config: Config,
) -> Sight:
    floor = config.detector.score_floor
    return Sight(
        *when,
        true_class=true_class,
        visible=visible,
        scores=None if found is None else class_log_ratio(found.class_scores, floor=floor),
        box=np.stack([np.full(4, np.nan) if found is None else np.array(found.box), true_box]),
        image_size=(camera.width, camera.height),
    )


@dataclass(frozen=True)
class DetectorFit:
    """What the detections say of the settings."""

    detection_probability: float
    box_sigma: float


class DetectorStatistics:
    """All sights, by object-visit, which a bootstrap weighs anew."""

    def __init__(self, sights: Sequence[Sight], config: Config) -> None:
        self._outlier = config.detector.box_outlier
        names, self._visit = np.unique([s.visit for s in sights], return_inverse=True)
        self.visits = len(names)
        self._visible = np.array([s.visible for s in sights])
        self._found = np.array([s.scores is not None for s in sights])
        self._boxes = np.array([s.box for s in sights])[self._found]
        self._size = np.array([s.image_size for s in sights], dtype=np.float64)[self._found].T
        self._belief = self._beliefs(sights)
        self.believed = len(self._belief)

    def fit(self, weight: Array | None = None) -> DetectorFit:
        """The settings, each object-visit counted so many times (V,)."""
        weight = np.ones(self.visits) if weight is None else weight
        by_sight = weight[self._visit]

        def missed(p: float) -> float:
            seen = np.minimum(p * self._visible, 1.0 - 1e-12)
            return -float(by_sight @ np.where(self._found, np.log(seen), np.log1p(-seen)))

        def off(log_sigma: float) -> float:
            detected, true = self._boxes[:, 0], self._boxes[:, 1]
            # images may differ in size: a false alarm's density is that of a unit image over each one's area
            matched = box_log_ratio(detected, true, float(np.exp(log_sigma)), (1.0, 1.0))
            matched = matched + 2.0 * np.log(self._size[0] * self._size[1])
            return -float(
                by_sight[self._found] @ np.logaddexp(np.log1p(-self._outlier) + matched, np.log(self._outlier))
            )

        return DetectorFit(_least(missed, _FOUND), float(np.exp(_least(off, (np.log(_BOX[0]), np.log(_BOX[1]))))))

    def confusion_posterior(self, level: float) -> tuple[float, tuple[float, float]]:
        """Median of `detector.confusion` and the interval that holds so much of its posterior, flat a priori.

        Object-visits are what is counted, and few of them are confused: a bootstrap of few gives no interval.
        """
        log_posterior = np.log(np.gradient(_CONFUSION))
        for true_class, summed in self._belief:
            # uniform over the other classes, as the model has it
            tables = np.stack([confusion(len(summed), 1.0 - p)[true_class] for p in (0.0, 1.0)])
            right, wrong = persistent_class_log_evidence(summed, tables)
            log_posterior += np.logaddexp(np.log1p(-_CONFUSION) + right, np.log(_CONFUSION) + wrong)
        cumulative = np.cumsum(np.exp(log_posterior - log_posterior.max()))
        low, middle, high = np.interp([0.5 - level / 2, 0.5, 0.5 + level / 2], cumulative / cumulative[-1], _CONFUSION)
        return float(middle), (float(low), float(high))

    def _beliefs(self, sights: Sequence[Sight]) -> list[tuple[int, Array]]:
        """For each object-visit with a box its true class and (C,) scores summed."""
        summed: dict[int, tuple[int, Array]] = {}
        for visit, s in zip(self._visit.tolist(), sights, strict=True):
            if s.scores is not None and len(s.scores) > 1:
                before = summed[visit][1] if visit in summed else 0.0
                summed[visit] = (s.true_class, s.scores + before)
        return list(summed.values())


def _least(energy: Callable[[float], float], bounds: tuple[float, float]) -> float:
    return float(minimize_scalar(energy, bounds=bounds, method="bounded", options={"xatol": 1e-4}).x)
