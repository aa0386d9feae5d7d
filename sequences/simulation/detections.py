"""What a detector makes of the images: boxes that jitter, things missed or invented, and stubborn confusions.

Works from what is truly visible, not from pixels, so it serves any run with truth. One knob, `DetectorConfig.noise`,
scales every imperfection: at 0 all that is visible is found, boxed exactly and named rightly; at 1 it errs like the
constants below.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Catalogue, ObjectClass
from sequences.seeds import generator
from sequences.simulation.config import DetectorConfig
from sequences.simulation.visibility import Visible
from sequences.types import Detection

Array = NDArray[np.float64]

LEAST_EVIDENCE = 0.1  # see Visible.evidence, and
LEAST_SIDE = 0.012  # share of the image's width: less than either is never found
JITTER = 0.03  # of each edge of a box, as a share of its side
MISSED = 0.08  # of things in plain view
HALF_HIDDEN = 0.3  # the evidence at which occlusion alone costs half of the detections
FALSE_POSITIVES = 0.12  # an image
CONFUSED = 0.15  # of the time that a thing is taken for one wrong class ...
STRETCH = 8.0  # ... for so many images on end, on average
CERTAINTY = 5.0  # lead of the believed class in log odds at noise 1, right or wrong: overconfident
SURE = 12.0  # the same at noise 0
RESEMBLANCE = 6.0  # how strongly confusion prefers classes of like size


class Detector:
    """A detector during one visit.

    Args:
        catalogue: the classes.
        image_size: width and height, pixels.
        config: settings.
        seed: the run's.
        visit: position of the visit, so that visits differ.
        things: inst_id -> obj_id of all that may be seen.
        n_frames: images of the visit.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        image_size: tuple[int, int],
        config: DetectorConfig,
        seed: int,
        visit: int,
        things: Mapping[int, int],
        n_frames: int,
    ) -> None:
        self._catalogue, self._image_size, self._config = catalogue, image_size, config
        self._seed, self._visit = seed, visit
        self._beliefs = {
            inst_id: _beliefs(inst_id, obj_id, n_frames, catalogue, config, seed, visit)
            for inst_id, obj_id in things.items()
        }

    def detect(self, k: int, visible: Sequence[Visible]) -> tuple[Detection, ...]:
        """Detections in image `k` of the visit, the most certain first; what was visible comes in any order."""
        found: list[Detection] = []
        for v in visible:
            rng = generator(self._seed, f"simulation.detection.{self._visit}", v.inst_id, k)
            found += _detect(v, int(self._beliefs[v.inst_id][k]), self._catalogue, self._image_size, self._config, rng)
        rng = generator(self._seed, f"simulation.false_positive.{self._visit}", keyframe=k)
        found += _invent(self._catalogue, self._image_size, self._config, rng)
        return tuple(sorted(found, key=lambda d: -float(d.class_scores[1:].max())))


def _beliefs(
    inst_id: int, obj_id: int, n: int, catalogue: Catalogue, config: DetectorConfig, seed: int, visit: int
) -> NDArray[np.int64]:
    """(n,) position in the catalogue of the class that the detector takes a thing for, image by image.

    A two-state Markov chain, right or wrong. The wrong class is the thing's own, the same in all visits.
    """
    truth = catalogue.index(obj_id)
    rivals = _resemblance(catalogue[obj_id], catalogue)
    rivals[truth] = 0.0
    if rivals.sum() == 0.0:
        return np.full(n, truth)
    rival = int(generator(seed, "simulation.rival", inst_id).choice(len(catalogue), p=rivals / rivals.sum()))
    share = min(0.9, CONFUSED * config.noise)
    leave, enter = 1.0 / STRETCH, share / (1.0 - share) / STRETCH
    u = generator(seed, "simulation.confusion", inst_id, visit).random(n)
    wrong = np.empty(n, dtype=bool)
    state = bool(u[0] < share)
    for k in range(n):
        if k > 0:
            state = bool(u[k] >= leave) if state else bool(u[k] < enter)
        wrong[k] = state
    return np.where(wrong, rival, truth)


def _resemblance(one: ObjectClass, catalogue: Catalogue) -> Array:
    """(C,) how like each class looks to one of them, 0 to 1: by the sorted sides of their bounding boxes."""
    sides = np.stack([np.sort(np.ptp(c.mesh.vertices, axis=0)) for c in catalogue.classes])
    own = np.sort(np.ptp(one.mesh.vertices, axis=0))
    return np.exp(-RESEMBLANCE * np.abs(np.log(sides / own)).mean(axis=1))


def _detect(
    visible: Visible,
    believed: int,
    catalogue: Catalogue,
    image_size: tuple[int, int],
    config: DetectorConfig,
    rng: np.random.Generator,
) -> list[Detection]:
    """At most one detection of one thing."""
    chance = rng.random()
    if not config.furniture and not catalogue[visible.obj_id].movable:
        return []
    if chance >= detection_probability(visible, image_size, config.noise):
        return []
    lead = min(SURE, CERTAINTY / max(config.noise, 1e-6)) + min(config.noise, 1.0) * rng.standard_normal()
    scores = config.noise * rng.standard_normal(1 + len(catalogue))
    scores[0] += config.noise * 1.5 * (1.0 - visible.evidence)
    scores[1 + believed] += lead
    truth = catalogue.index(visible.obj_id)
    if believed != truth:
        scores[1 + truth] += 0.4 * lead  # the right class comes second
    return [Detection(_jittered(visible.box, image_size, config.noise, rng), _softmax(scores))]


def detection_probability(visible: Visible, image_size: tuple[int, int], noise: float) -> float:
    """Probability of finding a thing in an image (width, height)."""
    if visible.evidence < LEAST_EVIDENCE or max(visible.box[2:]) < LEAST_SIDE * image_size[0]:
        return 0.0
    in_spite_of_occlusion = 1.0 / (1.0 + np.exp(-(visible.evidence - HALF_HIDDEN) / 0.08))
    return float(max(0.0, 1.0 - MISSED * noise) * in_spite_of_occlusion**noise)


def _jittered(
    box: tuple[float, float, float, float], image_size: tuple[int, int], noise: float, rng: np.random.Generator
) -> tuple[float, float, float, float]:
    x, y, width, height = box
    left, right = (x, x + width) + JITTER * noise * width * rng.standard_normal(2)
    top, bottom = (y, y + height) + JITTER * noise * height * rng.standard_normal(2)
    return _clipped(left, top, right, bottom, image_size)


def _clipped(
    left: float, top: float, right: float, bottom: float, image_size: tuple[int, int]
) -> tuple[float, float, float, float]:
    """A box of at least one pixel inside the image, COCO's x, y, width, height, rounded to 1/100 pixel."""
    width, height = image_size
    left, top = min(max(left, 0.0), width - 1.0), min(max(top, 0.0), height - 1.0)
    right, bottom = min(max(right, left + 1.0), float(width)), min(max(bottom, top + 1.0), float(height))
    return round(left, 2), round(top, 2), round(right - left, 2), round(bottom - top, 2)


def _invent(
    catalogue: Catalogue, image_size: tuple[int, int], config: DetectorConfig, rng: np.random.Generator
) -> list[Detection]:
    """False positives: boxes anywhere, of a size that things have, less certain than true ones."""
    found = []
    for _ in range(rng.poisson(FALSE_POSITIVES * config.noise)):
        width, height = image_size[0] * np.exp(rng.uniform(np.log(0.05), np.log(0.25), 2))
        x, y = rng.uniform(0.0, 1.0, 2) * (image_size[0] - width, image_size[1] - height)
        scores = rng.standard_normal(1 + len(catalogue))
        scores[0] += 1.5
        scores[1 + rng.integers(len(catalogue))] += 2.5
        found.append(Detection(_clipped(x, y, x + width, y + height, image_size), _softmax(scores)))
    return found


def _softmax(logits: Array) -> Array:
    odds = np.exp(logits - logits.max())
    return odds / odds.sum()
