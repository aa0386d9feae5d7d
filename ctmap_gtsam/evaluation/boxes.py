"""Mean average precision of boxes at IoU 0.5 (Everingham et al., PASCAL VOC, IJCV 2010), as COCO interpolates it.

Boxes are matched to true boxes by faster-coco-eval, COCO's rules: within an image and class, by descending score, each
to the free true box that it overlaps most. What is kept of that is enough to pool images of many runs again and again
and get the same precision at 101 recalls (Lin et al., Microsoft COCO, ECCV 2014) as faster-coco-eval gets.

A true box encloses the visible pixels of an object (BOP's bbox_visib). Objects of which less than VISIBLE_FRACTION is
visible are ignored, as in BOP: the box of all their pixels in the image is an ignore region (COCO's iscrowd), and
estimates of their class that lie in it by half or more count neither for nor against.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.evaluation.matching import ObjectFrames
from ctmap_gtsam.evaluation.silhouettes import Box, silhouettes
from sequences.catalogue import Catalogue
from sequences.types import Frame, Run, Truth

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

IOU = 0.5
"""Two boxes are of one thing from this overlap on"""

RECALLS = np.linspace(0.0, 1.0, 101)
"""Where COCO reads precision"""


@dataclass(frozen=True)
class TrueBoxes:
    """Boxes (B) of the true objects over a run, by frame."""

    frame: Ints
    """(B,)"""
    object: Ints
    """(B,) row of the truth"""
    class_id: Ints
    """(B,) obj_id"""
    box: Array
    """(B, 4) x, y, width, height, pixels (COCO)"""
    ignore: Bools
    """(B,) too little is visible for the object to count: a region to ignore"""

    def counting(self, frame: int) -> tuple[Ints, Array]:
        """Rows of the truth (n,) and boxes (n, 4) of the objects that count in a frame."""
        here = (self.frame == frame) & ~self.ignore
        return self.object[here], self.box[here]


@dataclass(frozen=True)
class JudgedBoxes:
    """Boxes (D) of one method with what matching made of them, images in order and scores descending in each."""

    category: Ints
    """(D,) position in the catalogue"""
    score: Array
    """(D,)"""
    true_positive: Bools
    """(D,) matched to a true box that counts"""
    ignored: Bools
    """(D,) matched to an ignore region"""
    positives: Ints
    """(C,) true boxes of each class that count"""


def true_boxes(run: Run, truth: Truth, objects: ObjectFrames, step: int = 1) -> TrueBoxes:
    """The boxes of a run's true objects: the truth's own where it has them, else drawn.

    Args:
        run: the recording.
        truth: about it.
        objects: the same in the true cameras, see `matching.from_truth`.
        step: only every `step`-th pixel each way is drawn. What is drawn is hidden by other true objects alone.
    """
    known = np.full((*objects.class_id.shape, 4), np.nan)
    for n, thing in enumerate(truth.objects):
        known[n, thing.frames] = thing.visible_box
    rows = [
        row for frame in run.frames for row in _boxes_in(run.catalogue, frame, objects, known[:, frame.index], step)
    ]
    return TrueBoxes(
        frame=np.array([r[0] for r in rows], dtype=np.int64),
        object=np.array([r[1] for r in rows], dtype=np.int64),
        class_id=np.array([objects.class_id[r[1], r[0]] for r in rows], dtype=np.int64),
        box=np.array([r[2] for r in rows], dtype=np.float64).reshape(-1, 4),
        ignore=np.array([not objects.visible[r[1], r[0]] for r in rows], dtype=np.bool_),
    )


def _boxes_in(
    catalogue: Catalogue, frame: Frame, objects: ObjectFrames, known: Array, step: int
) -> list[tuple[int, int, Box]]:
    """Frame, row and box of each true object that shows in a frame; `known` (N, 4), NaN where it has to be drawn."""
    f = frame.index
    counts, present = objects.visible[:, f], objects.present[:, f]
    given = counts & np.isfinite(known[:, 0])
    drawn: dict[int, Box | None] = {}
    # what doesn't count is drawn alone; what counts has to be drawn with all that may hide it
    rows = np.flatnonzero(present if (counts & ~given).any() else present & ~given)
    if len(rows):
        poses = objects.T_camera_object[rows, f]
        seen = silhouettes(catalogue, objects.class_id[rows, f], poses, frame.camera, step)
        drawn = {int(n): s.visible_box if counts[n] else s.box for n, s in zip(rows, seen, strict=True)}
    boxes = {int(n): tuple(known[n].tolist()) if given[n] else drawn[int(n)] for n in np.flatnonzero(present)}
    return [(f, n, box) for n, box in boxes.items() if box is not None]


def judge_boxes(
    truth: TrueBoxes, said: Iterable[Sequence[tuple[int, float, Box]]], obj_ids: Sequence[int]
) -> JudgedBoxes:
    """Match a method's boxes to the true ones.

    Args:
        truth: of the run.
        said: for each frame of the run obj_id, score and box (x, y, width, height, pixels) of each thing.
        obj_ids: (C,) of the catalogue, ascending.
    """
    category = {obj_id: c for c, obj_id in enumerate(obj_ids)}
    # COCO takes the best first, of equals the first; so do we when images are pooled
    ordered = [sorted(boxes, key=lambda b: -b[1]) for boxes in said]
    results = [
        {"image_id": f, "category_id": obj_id, "bbox": list(box), "score": score}
        for f, boxes in enumerate(ordered)
        for obj_id, score, box in boxes
    ]
    matched = _matched(truth, results, len(ordered), obj_ids)
    ignored = (matched >= 0) & np.append(truth.ignore, False)[matched]
    return JudgedBoxes(
        category=np.array([category[obj_id] for boxes in ordered for obj_id, *_ in boxes], dtype=np.int64),
        score=np.array([score for boxes in ordered for _, score, _ in boxes], dtype=np.float64),
        true_positive=(matched >= 0) & ~ignored,
        ignored=ignored,
        positives=np.array([np.sum((truth.class_id == o) & ~truth.ignore) for o in obj_ids], dtype=np.int64),
    )


def pooled_boxes(tables: Sequence[JudgedBoxes], class_names: Sequence[Sequence[str]]) -> JudgedBoxes:
    """Boxes of several runs as of one. Classes are the same where their names are, and are ordered by name.

    Args:
        tables: one a run.
        class_names: of each run's catalogue.
    """
    names = {name: c for c, name in enumerate(sorted({name for known in class_names for name in known}))}
    columns = [np.array([names[name] for name in known], dtype=np.int64) for known in class_names]
    positives = np.zeros(len(names), dtype=np.int64)
    for table, column in zip(tables, columns, strict=True):
        positives[column] += table.positives
    return JudgedBoxes(
        category=np.concatenate([c[t.category] for t, c in zip(tables, columns, strict=True)]),
        score=np.concatenate([t.score for t in tables]),
        true_positive=np.concatenate([t.true_positive for t in tables]),
        ignored=np.concatenate([t.ignored for t in tables]),
        positives=positives,
    )


def average_precision(boxes: JudgedBoxes) -> Array:
    """(C,) AP of each class: the mean over RECALLS of the best precision at that recall or more; NaN without a box."""
    out = np.full(len(boxes.positives), np.nan)
    counted = np.flatnonzero(~boxes.ignored)
    order = counted[np.argsort(-boxes.score[counted], kind="stable")]
    category, correct = boxes.category[order], boxes.true_positive[order]
    for c in np.flatnonzero(boxes.positives):
        hits = np.cumsum(correct[category == c])
        precision = hits / np.arange(1, len(hits) + 1)
        precision = np.maximum.accumulate(precision[::-1])[::-1]
        first = np.searchsorted(hits / boxes.positives[c], RECALLS, side="left")
        out[c] = np.append(precision, 0.0)[first].mean()
    return out


def mean_average_precision(boxes: JudgedBoxes) -> float | None:
    """The mean of AP over the classes that have true boxes; None where none has."""
    return float(average_precision(boxes)[boxes.positives > 0].mean()) if boxes.positives.any() else None


def evaluation(truth: TrueBoxes, results: list[dict[str, Any]], frames: int, obj_ids: Sequence[int]) -> Any:
    """faster-coco-eval's COCOeval of COCO results at IoU, after evaluate() and accumulate()."""
    from faster_coco_eval import COCO, COCOeval_faster

    annotations = [
        {"id": k + 1, "image_id": int(f), "category_id": int(c), "bbox": box.tolist(), "iscrowd": int(ignore)}
        | {"area": float(box[2] * box[3])}
        for k, (f, c, box, ignore) in enumerate(zip(truth.frame, truth.class_id, truth.box, truth.ignore, strict=True))
    ]
    images = [{"id": f} for f in range(frames)]
    dataset = COCO(
        {"info": {}, "images": images, "annotations": annotations, "categories": [{"id": o} for o in obj_ids]}
    )
    found = COCOeval_faster(dataset, dataset.loadRes(results), "bbox", print_function=lambda *_: None, extra_calc=True)
    found.params.iouThrs = np.array([IOU])
    found.params.areaRng, found.params.areaRngLbl = [[0, 1e10]], ["all"]
    found.params.maxDets = [max(100, len(results))]
    found.evaluate()
    found.accumulate()
    return found


def _matched(truth: TrueBoxes, results: list[dict[str, Any]], frames: int, obj_ids: Sequence[int]) -> Ints:
    """(D,) the true box of each result, -1 for none."""
    out = np.full(len(results), -1, dtype=np.int64)
    if results and len(truth.frame):
        for pair in evaluation(truth, results, frames, obj_ids).eval["matched"]:
            d, t = pair.split("_")
            out[int(d) - 1] = int(t) - 1
    return out
