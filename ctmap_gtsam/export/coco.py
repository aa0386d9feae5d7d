"""COCO's results of detection (cocodataset.org, "Results format"), with BOP's scene_id and time beside."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ctmap_gtsam.evaluation.detection import best_classes
from ctmap_gtsam.evaluation.views import FrameView
from sequences.types import Run

Result = dict[str, Any]


def coco_results(views: Iterable[FrameView], seconds_per_image: float | None = None) -> list[Result]:
    """Boxes of a map, see `FrameView.boxes`; x, y, width, height in pixels."""
    return [
        _result(view.frame.scene_id, view.frame.im_id, obj_id, box, score, seconds_per_image)
        for view in views
        for obj_id, score, box in view.boxes()
    ]


def coco_detections(run: Run) -> list[Result]:
    """The detector's own boxes, each as its best class."""
    return [
        _result(frame.scene_id, frame.im_id, obj_id, box, score, None)
        for frame, found in zip(run.frames, best_classes(run), strict=True)
        for obj_id, score, box in found
    ]


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
