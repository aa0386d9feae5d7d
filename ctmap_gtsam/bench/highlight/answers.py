"""What each method says in the image that is shown: its boxes, held to the true ones, and its word on the thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate, Snapshot
from ctmap_gtsam.evaluation import pose
from ctmap_gtsam.evaluation.boxes import IOU, TrueBoxes, true_boxes
from ctmap_gtsam.evaluation.detection import best_classes, iou, match_boxes, score_detections
from ctmap_gtsam.evaluation.matching import from_estimate, from_truth, match, shapes_of
from ctmap_gtsam.evaluation.silhouettes import Box
from ctmap_gtsam.evaluation.views import final_views
from ctmap_gtsam.evaluation.visits import ends
from sequences import se3
from sequences.types import VISIBLE_FRACTION, Run, Truth

LEAST_SCORE = 0.3  # boxes that are less sure are not shown


@dataclass(frozen=True)
class Said:
    """A box of a method."""

    name: str
    """of its class"""
    score: float
    box: Box
    right: bool
    """whether it is on a true thing of its class"""
    subject: bool
    """whether it is what the method says of the thing that the story is about"""


class Missed(NamedTuple):
    """A true thing that counts and on which a method has no box, of whatever class."""

    name: str
    box: Box
    subject: bool


@dataclass(frozen=True)
class Word:
    """What a method says of the thing; None where it says nothing, and of poses where the class is wrong."""

    name: str | None = None
    """of the most probable class"""
    probability: float = 0.0
    """P(exists) P(that class); the detector's score"""
    probability_of_truth: float = 0.0
    """P(exists) P(true class); the detector's score"""
    iou: float | None = None
    """of its box with the box of the thing's visible pixels"""
    position_m: float | None = None
    """between the boxes' centres, whatever the class"""
    rotation_rad: float | None = None
    mssd_m: float | None = None


@dataclass(frozen=True)
class Answer:
    """One method in the image that is shown."""

    word: Word
    boxes: tuple[Said, ...]
    missed: tuple[Missed, ...]
    map: Snapshot | None = None
    """seen from the image's camera; the detector has none"""
    row: int = -1
    """of Estimate.object_id for the thing; -1 for none"""


class Case:
    """A played story with its truth, ready to hold methods to it.

    Args:
        run: of one visit.
        truth: about it.
        inst_id: of the thing.
        called: the class that the detector takes it for, None where it misses it: what the image shown is to show.
    """

    def __init__(self, run: Run, truth: Truth, inst_id: int, called: str | None) -> None:
        self.run = run
        self._truth = from_truth(run, truth)
        self._row = int(np.flatnonzero(self._truth.name == inst_id)[0])
        self._shapes = shapes_of(run.catalogue)
        self._true = true_boxes(run, truth, self._truth)
        self._detected = score_detections(run, self._truth, self._true).class_id
        self.frame = self._choose(truth, called)

    @property
    def true_name(self) -> str:
        """Of the thing's class."""
        return self._name(int(self._truth.class_id[self._row].max()))

    @property
    def box(self) -> Box:
        """Of the thing's visible pixels in the image that is shown."""
        rows, boxes = self._true.counting(self.frame)
        x, y, width, height = boxes[list(rows).index(self._row)].tolist()
        return (x, y, width, height)

    @property
    def frames(self) -> tuple[int, int]:
        """Of how many images in which the thing shows, in how many the detector has it right."""
        shows = self._truth.visible[self._row]
        return int(shows.sum()), int((shows & (self._detected[self._row] == self._truth.class_id[self._row])).sum())

    def detector(self) -> Answer:
        """The recorded boxes."""
        found = best_classes(self.run)[self.frame]
        boxes = np.array([box for _, _, box in found], dtype=np.float64).reshape(-1, 4)
        overlap = iou(boxes, np.array([self.box]))[:, 0]
        own = int(np.argmax(overlap)) if len(found) and overlap.max() >= IOU else -1
        word = Word()
        if own >= 0:
            scores = self.run.frames[self.frame].detections[own].class_scores
            true = float(scores[1 + self.run.catalogue.index(self._true_id)])
            word = Word(self._name(found[own][0]), found[own][1], true, float(overlap[own]))
        return Answer(word, *self._judged(found, own))

    def estimate(self, name: str, estimate: Estimate) -> Answer:
        """The map at the end of the visit, seen from the image's camera: the paper's protocol."""
        method = from_estimate(self.run, name, estimate)
        row = int(match(self._truth, method.objects, self._shapes).row[self._row])
        view = final_views(self.run, estimate)[self.frame]
        shown = [
            (k, seen.visible_box)
            for k, seen in enumerate(view.silhouettes)
            if seen.visible_box is not None and seen.visible_fraction >= VISIBLE_FRACTION
        ]
        found = [(int(view.class_id[k]), float(view.score[k]), box) for k, box in shown]
        own = next((j for j, (k, _) in enumerate(shown) if view.objects[k] == row), -1)
        final = int(method.held[ends(self.run)[-1]])
        snapshot = replace(estimate.at_keyframe(final), T_world_camera=method.T_world_camera[self.frame])
        word = self._word(estimate, snapshot, row, found[own][2] if own >= 0 else None)
        return Answer(word, *self._judged(found, own), map=snapshot, row=row)

    @property
    def _true_id(self) -> int:
        return int(self._truth.class_id[self._row, self.frame])

    def _name(self, obj_id: int) -> str:
        return self.run.catalogue[obj_id].name

    def _choose(self, truth: Truth, called: str | None) -> int:
        """Of the later half of the images that show the thing well, the one that shows most.

        Of those, if there are any, in which the detector errs on it as the story wants.
        """
        shares = np.zeros(self._truth.visible.shape)
        for n, thing in enumerate(truth.objects):
            shares[n, thing.frames] = thing.visible_fraction
        own = shares[self._row]
        wanted = -1 if called is None else next(c.obj_id for c in self.run.catalogue.classes if c.name == called)
        well = np.flatnonzero(own >= 0.7 * own.max())
        later = well[len(well) // 2 :]
        errs = later[self._detected[self._row, later] == wanted]
        candidates = errs if len(errs) else later
        return int(candidates[np.argmax(shares.sum(axis=0)[candidates] + 2.0 * own[candidates])])

    def _judged(self, found: Sequence[tuple[int, float, Box]], own: int) -> tuple[tuple[Said, ...], tuple[Missed, ...]]:
        """Boxes with whether they are right, and what no box is on; `own` is the one on the thing, -1 for none."""
        true = self._true
        here = np.flatnonzero(true.frame == self.frame)
        boxes = np.array([box for _, _, box in found], dtype=np.float64).reshape(-1, 4)
        right = _right(true, here, np.array([c for c, _, _ in found]), boxes)
        said = tuple(
            Said(self._name(c), score, box, bool(right[k]), k == own)
            for k, (c, score, box) in enumerate(found)
            if score >= LEAST_SCORE
        )
        counting = here[~true.ignore[here]]
        met = {i for i, _ in match_boxes(true.box[counting], boxes)}
        missed = tuple(
            Missed(self._name(int(true.class_id[b])), _tuple(true.box[b]), int(true.object[b]) == self._row)
            for i, b in enumerate(counting)
            if i not in met
        )
        return said, missed

    def _word(self, estimate: Estimate, snapshot: Snapshot, row: int, box: Box | None) -> Word:
        """On the thing, which row `row` of the estimate matches (-1: none), with its box in the image."""
        at = np.flatnonzero(snapshot.objects == row)
        if row < 0 or not len(at):
            return Word()
        said, true = int(snapshot.class_id[at[0]]), self._true_id
        T = se3.inverse(snapshot.T_world_camera) @ snapshot.T_world_object[at[0]]
        T_true = self._truth.T_camera_object[self._row, self.frame]
        shape, other = self._shapes[true], self._shapes[said]
        column = int(np.flatnonzero(estimate.class_ids == true)[0])
        k = snapshot.keyframe
        word = Word(
            name=self._name(said),
            probability=float(snapshot.score[at[0]]),
            probability_of_truth=float(estimate.existence[row, k] * estimate.class_probability[row, k, column]),
            iou=None if box is None else float(iou(np.array([box]), np.array([self.box]))[0, 0]),
            position_m=float(pose.translation_error(other, T, shape, T_true)),
        )
        if said != true:
            return word
        turn, apart = pose.rotation_error(shape, T, T_true), pose.mssd(shape, T, T_true)
        return replace(word, rotation_rad=float(turn), mssd_m=float(apart))


def _right(
    true: TrueBoxes, here: NDArray[np.int64], class_id: NDArray[np.int64], boxes: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(n,) which boxes (n, 4) of classes (n,) are on a true thing of their class, one each, shown well or not."""
    out = np.zeros(len(boxes), dtype=np.bool_)
    for obj_id in np.unique(class_id):
        ours = np.flatnonzero(class_id == obj_id)
        theirs = here[true.class_id[here] == obj_id]
        for i, _ in match_boxes(boxes[ours], true.box[theirs]):
            out[ours[i]] = True
    return out


def _tuple(box: NDArray[np.float64]) -> Box:
    x, y, width, height = box.tolist()
    return (x, y, width, height)
