"""Detections on disk: scene_detections.json, COCO results with class_scores, and who said so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sequences import layout
from sequences.jsonfile import Node
from sequences.problems import Checks
from sequences.types import Detection

Array = NDArray[np.float64]

_MAX_SCORE = 0.999  # of a detection that comes with one score: nothing it says is certain


def read_detections(
    scene: layout.Scene, obj_ids: tuple[int, ...], im_ids: set[int], checks: Checks
) -> dict[int, tuple[Detection, ...]]:
    """Detections by image, in an order that doesn't depend on the file's."""
    file = scene.folder / layout.SCENE_DETECTIONS
    if not file.is_file():
        checks.note(f"scene {scene.scene_id} has no {layout.SCENE_DETECTIONS}: there are no detections")
        return {}
    found: dict[int, list[Detection]] = {}
    elements: list[Node] = []
    with checks.part():
        elements = Node.read(file, "").elements()
    derived = 0
    for node in elements:
        with checks.part():
            im_id = _check_place(node, scene, im_ids)
            box = _box(node["bbox"])
            scores, was_derived = _class_scores(node, obj_ids)
            derived += was_derived
            found.setdefault(im_id, []).append(Detection(box, scores))
    if derived:
        checks.note(
            f"{derived} detections of scene {scene.scene_id} have no class_scores: the score goes to category_id, "
            "the rest is shared equally by background and the other classes"
        )
    return {im_id: tuple(sorted(some, key=_canonical)) for im_id, some in found.items()}


def _canonical(detection: Detection) -> tuple[float, ...]:
    return (*detection.box, *detection.class_scores.tolist())


def _check_place(node: Node, scene: layout.Scene, im_ids: set[int]) -> int:
    scene_id = node.get("scene_id")
    if scene_id is not None and scene_id.integer() != scene.scene_id:
        raise scene_id.error(f"a detection of scene {scene_id.value} in scene {scene.scene_id}", "move it to its scene")
    im_id = node["image_id"].integer()
    if im_id not in im_ids:
        raise node["image_id"].error(
            f"image {im_id} is not in {layout.SCENE_CAMERA}", "remove the detection, or add the image"
        )
    return im_id


def _box(node: Node) -> tuple[float, float, float, float]:
    x, y, width, height = node.numbers(4).tolist()
    if width <= 0 or height <= 0:
        raise node.error("the box has no area", "write x, y, width, height in pixels, or remove the detection")
    return (x, y, width, height)


def _class_scores(node: Node, obj_ids: tuple[int, ...]) -> tuple[Array, bool]:
    """(C + 1,) scores that sum to 1, and whether they had to be derived from one score."""
    given, category = node.get("class_scores"), node.get("category_id")
    if category is not None and obj_ids and category.integer() not in obj_ids:
        raise category.error(
            f"unknown obj_id {category.value}", "add its model to models/, or remove the detections of this class"
        )
    n = len(obj_ids) + 1
    if given is not None:
        scores = given.numbers(n if obj_ids else None)
        if scores.min() < 0 or scores.sum() <= 0:
            raise given.error(
                "scores below zero, or all zero", "write probabilities: background, then obj_ids ascending"
            )
        return scores / scores.sum(), False
    score = node["score"].number()
    if not 0 <= score <= 1:
        raise node["score"].error(f"score {score:g} is not in [0, 1]", "write a probability, or add class_scores")
    score = min(score, _MAX_SCORE)
    scores = np.full(n, (1.0 - score) / max(n - 1, 1))
    if obj_ids:
        scores[1 + obj_ids.index(node["category_id"].integer())] = score
    return scores, True


def detection_json(
    detection: Detection, scene_id: int, im_id: int, obj_ids: tuple[int, ...], source: str
) -> dict[str, Any]:
    """A detection as scene_detections.json has it; `source` is what made it, such as "simulation"."""
    best = int(np.argmax(detection.class_scores[1:]))
    return {
        "scene_id": scene_id,
        "image_id": im_id,
        "category_id": obj_ids[best],
        "bbox": [float(value) for value in detection.box],
        "score": float(detection.class_scores[1 + best]),
        "class_scores": detection.class_scores.tolist(),
        "source": source,
    }


def sources(file: Path) -> set[str | None]:
    """What made the detections of a scene_detections.json; None stands for those that don't say.

    Empty where there is no file, or nothing in it. Raises InputError where it isn't JSON.
    """
    if not file.is_file():
        return set()
    said = [node.get("source") for node in Node.read(file, "").elements()]
    return {None if node is None else node.text() for node in said}
