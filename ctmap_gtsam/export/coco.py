"""COCO's results of detection (cocodataset.org, "Results format"), with BOP's scene_id and time beside."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ctmap_gtsam.evaluation.matching import VISIBLE_FRACTION
from ctmap_gtsam.export.views import FrameView
from sequences.types import Run

Result = dict[str, Any]


def coco_results(views: Iterable[FrameView], seconds_per_image: float | None = None) -> list[Result]:
    """Boxes of a map: each object's box encloses its pixels that no other object of the map hides.

    An object of which less than VISIBLE_FRACTION is visible has no box. Coordinates are x, y, width, height in pixels.
    """
    return [
        _result(view.frame.scene_id, view.frame.im_id, int(obj_id), seen.visible_box, float(score), seconds_per_image)
        for view in views
        for obj_id, score, seen in zip(view.class_id, view.score, view.silhouettes, strict=True)
        if seen.visible_box is not None and seen.visible_fraction >= VISIBLE_FRACTION
    ]


def coco_detections(run: Run) -> list[Result]:
    """The detector's own boxes, each as its best class."""
    out = []
    for frame in run.frames:
        for detection in frame.detections:
            best = int(np.argmax(detection.class_scores[1:]))
            score = float(detection.class_scores[1 + best])
            out.append(_result(frame.scene_id, frame.im_id, run.catalogue.obj_ids[best], detection.box, score, None))
    return out


def _result(
    scene_id: int, im_id: int, obj_id: int, box: tuple[float, ...], score: float, seconds: float | None
) -> Result:
    return {
        "scene_id": scene_id,
        "image_id": im_id,
        "category_id": obj_id,
        "bbox": [round(float(value), 3) for value in box],
        "score": round(score, 6),
        "time": -1.0 if seconds is None else seconds,
    }
