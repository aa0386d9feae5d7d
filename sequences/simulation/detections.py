"""What a detector makes of the images: boxes that jitter, things missed, seen twice or invented, stubborn confusions.

Works from what is truly visible, not from pixels, so it serves any run with truth. One knob, `DetectorConfig.noise`,
scales every imperfection: at 0 all that is visible is found, boxed exactly and named rightly; at 1 it errs like the
constants below. Real detectors err the same way for many images on end, and so does this one: what is taken for a wrong
class is so for a while and for the same one in all visits, what is missed is missed again, and what is invented sits on
something that is there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import ndtr

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue
from sequences.seeds import generator
from sequences.simulation.config import DetectorConfig
from sequences.simulation.visibility import Box, Visible
from sequences.types import Depth, Detection

Array = NDArray[np.float64]

LEAST_EVIDENCE = 0.1  # see Visible.evidence, and
LEAST_SIDE = 0.012  # share of the image's width: less than either is never found
JITTER = 0.035  # of each edge of a box, as a share of its side
MISSED = 0.09  # of things in plain view
HALF_HIDDEN = 0.3  # the evidence at which occlusion alone costs half of the detections
ALIKE = 0.7  # how much of whether a thing is missed carries over to the next image
CONFUSED = 0.16  # of the time that a thing is taken for one wrong class ...
CONFUSED_NAMED = 0.3  # ... or, where the settings name its rival, for that
STRETCH = 8.0  # ... for so many images on end, on average
TWICE = 0.1  # of found things have a second box ...
ANOTHER_CLASS = 0.6  # ... on all of them, of another class; the others on a part of them, of the same
CLUTTER_TAKEN = 0.25  # of the time that a thing nobody modelled is taken for something of the catalogue
PHANTOMS = 0.025  # boxes on nothing in particular that begin in an image ...
PHANTOM_LASTS = 6.0  # ... and come back in the following, so many on average
SEEN_AGAIN = 0.8  # of the images in which they could
SAME_SURFACE_M = 0.08  # a phantom is seen as long as its spot is
PHANTOM_M = (0.05, 0.25)  # its size
CERTAINTY = 5.5  # lead of the believed class in log odds at noise 1, right or wrong: overconfident
FALSE_CERTAINTY = 3.5  # the same of what is invented
SURE = 12.0  # the same at noise 0
RESEMBLANCE = 6.0  # how strongly confusion prefers classes of like size ...
COLOUR = 0.012  # ... and of like colour, per step of 255


@dataclass(frozen=True)
class Surroundings:
    """Where an image was taken and what it shows besides the things that are looked for."""

    camera: Camera
    T_world_camera: Array
    """(4, 4)"""
    depth: Depth
    """(h, w) metres, 0 where it isn't known"""
    free: NDArray[np.bool_]
    """(h, w) pixels that show none of the things"""
    clutter: Sequence[Visible] = ()
    """things nobody modelled, as the image shows them; inst_ids of their own, the same in all images"""


@dataclass
class _Phantom:
    """Something that the detector sees where nothing is."""

    at: Array
    """(3,) world frame"""
    size: Array
    """(2,) width and height, metres"""
    believed: int
    """position in the catalogue"""
    until: int
    """the first image in which it is gone"""


class Detector:
    """A detector during one visit; the images come in their order.

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
        self._seed, self._visit, self._n = seed, visit, n_frames
        looked_for = {i: obj_id for i, obj_id in things.items() if config.furniture or catalogue[obj_id].movable}
        self._like = _likeness(catalogue)
        self._beliefs = {i: self._believed(i, obj_id) for i, obj_id in looked_for.items()}
        self._luck = {i: _luck(n_frames, generator(seed, "simulation.miss", i, visit)) for i in looked_for}
        self._taken: dict[int, NDArray[np.int64]] = {}
        self._phantoms: list[_Phantom] = []

    def detect(self, k: int, visible: Sequence[Visible], around: Surroundings) -> tuple[Detection, ...]:
        """Detections in image `k` of the visit, the most certain first.

        Args:
            k: position of the image.
            visible: what shows of things that look as in the catalogue, in any order; the others are never found.
            around: the rest of the image.
        """
        found: list[Detection] = []
        for v in visible:
            if v.inst_id in self._beliefs:
                found += self._find(k, v)
        for v in around.clutter:
            found += self._mistake(k, v)
        found += self._imagine(k, around)
        return tuple(sorted(found, key=lambda d: -float(d.class_scores[1:].max())))

    def _believed(self, inst_id: int, obj_id: int) -> NDArray[np.int64]:
        """(n,) position in the catalogue of the class that a thing is taken for, image by image.

        Right or wrong for a while. The wrong class is the thing's own, the same in all visits: one that the settings
        name as its rival, else one that looks like it.
        """
        truth = self._catalogue.index(obj_id)
        named = _named_rivals(self._catalogue[obj_id].name, self._catalogue, self._config)
        like = np.isin(np.arange(len(self._catalogue)), named) * 1.0 if named else self._like[truth]
        if like.sum() == 0.0:
            return np.full(self._n, truth)
        rival = int(generator(self._seed, "simulation.rival", inst_id).choice(len(like), p=like / like.sum()))
        share = min(0.9, (CONFUSED_NAMED if named else CONFUSED) * self._config.noise)
        wrong = _stretches(self._n, share, generator(self._seed, "simulation.confusion", inst_id, self._visit))
        return np.where(wrong, rival, truth)

    def _find(self, k: int, v: Visible) -> list[Detection]:
        """The boxes of one thing: none, one or two."""
        noise, rng = self._config.noise, generator(self._seed, f"simulation.detection.{self._visit}", v.inst_id, k)
        if self._luck[v.inst_id][k] >= detection_probability(v, self._image_size, noise):
            return []
        believed, truth = int(self._beliefs[v.inst_id][k]), self._catalogue.index(v.obj_id)
        box = _jittered(v.box, self._image_size, noise, rng)
        found = [Detection(box, self._scores(believed, truth, CERTAINTY, 1.0 - v.evidence, rng))]
        if rng.random() < TWICE * noise:
            found.append(self._second(v, believed, rng))
        return found

    def _second(self, v: Visible, believed: int, rng: np.random.Generator) -> Detection:
        """Another box on the same thing that survives non-maximum suppression, which goes by class and overlap."""
        if rng.random() < ANOTHER_CLASS and len(self._catalogue) > 1:
            like = self._like[believed]
            believed, box = int(rng.choice(len(like), p=like / like.sum())), v.box
        else:
            box = _part(v.box, rng)
        scores = self._scores(believed, believed, FALSE_CERTAINTY, 1.0 - v.evidence, rng)
        return Detection(_jittered(box, self._image_size, self._config.noise, rng), scores)

    def _mistake(self, k: int, v: Visible) -> list[Detection]:
        """Now and then a thing nobody modelled is taken for one of the catalogue's, for some images on end."""
        noise = self._config.noise
        if v.inst_id not in self._taken:
            self._taken[v.inst_id] = self._taken_for(v.inst_id)
        believed = int(self._taken[v.inst_id][k])
        rng = generator(self._seed, f"simulation.clutter.{self._visit}", v.inst_id, k)
        if believed < 0 or rng.random() >= detection_probability(v, self._image_size, noise):
            return []
        scores = self._scores(believed, believed, FALSE_CERTAINTY, 1.0 - v.evidence, rng)
        return [Detection(_jittered(v.box, self._image_size, noise, rng), scores)]

    def _taken_for(self, inst_id: int) -> NDArray[np.int64]:
        """(n,) position in the catalogue of what clutter is taken for, the same in all visits; -1 where for nothing."""
        believed = int(generator(self._seed, "simulation.clutter.class", inst_id).integers(len(self._catalogue)))
        rng = generator(self._seed, "simulation.clutter.taken", inst_id, self._visit)
        return np.where(_stretches(self._n, min(0.9, CLUTTER_TAKEN * self._config.noise), rng), believed, -1)

    def _imagine(self, k: int, around: Surroundings) -> list[Detection]:
        """Boxes on nothing in particular: they begin somewhere in the image and stay there while the camera moves."""
        noise = self._config.noise
        rng = generator(self._seed, f"simulation.phantom.{self._visit}", keyframe=k)
        for _ in range(rng.poisson(PHANTOMS * noise)):
            spots = np.flatnonzero(around.free & (around.depth > 0.0))
            if len(spots):
                v, u = divmod(int(rng.choice(spots)), around.camera.width)
                self._phantoms.append(self._begin(k, u, v, around, rng))
        self._phantoms = [p for p in self._phantoms if p.until > k]
        found: list[Detection] = []
        for phantom in self._phantoms:
            box, again = _box_of(phantom, around), rng.random() < SEEN_AGAIN
            if box is not None and again:
                scores = self._scores(phantom.believed, phantom.believed, FALSE_CERTAINTY, 0.5, rng)
                found.append(Detection(_jittered(box, self._image_size, noise, rng), scores))
        return found

    def _begin(self, k: int, u: int, v: int, around: Surroundings, rng: np.random.Generator) -> _Phantom:
        depth = around.depth[[v], [u]].astype(np.float64)
        point = around.camera.backproject(np.array([u]), np.array([v]), depth)
        low, high = np.log(PHANTOM_M)
        return _Phantom(
            at=se3.transform(around.T_world_camera, point)[0],
            size=np.exp(rng.uniform(low, high) + 0.3 * rng.standard_normal(2)),
            believed=int(rng.integers(len(self._catalogue))),
            until=k + int(rng.geometric(1.0 / PHANTOM_LASTS)),
        )

    def _scores(self, believed: int, truth: int, certainty: float, hidden: float, rng: np.random.Generator) -> Array:
        """(C + 1,) belief over background and classes: as sure when it is wrong as when it is right."""
        noise = self._config.noise
        lead = min(SURE, certainty / max(noise, 1e-6)) + min(noise, 1.0) * rng.standard_normal()
        scores = noise * rng.standard_normal(1 + len(self._catalogue))
        scores[0] += noise * 1.5 * hidden
        scores[1 + believed] += lead
        if believed != truth:
            scores[1 + truth] += 0.4 * lead  # the right class comes second
        return _softmax(scores)


def detection_probability(visible: Visible, image_size: tuple[int, int], noise: float) -> float:
    """Probability of finding a thing in an image (width, height)."""
    if visible.evidence < LEAST_EVIDENCE or max(visible.box[2:]) < LEAST_SIDE * image_size[0]:
        return 0.0
    in_spite_of_occlusion = 1.0 / (1.0 + np.exp(-(visible.evidence - HALF_HIDDEN) / 0.08))
    return float(max(0.0, 1.0 - MISSED * noise) * in_spite_of_occlusion**noise)


def _named_rivals(name: str, catalogue: Catalogue, config: DetectorConfig) -> list[int]:
    """Positions in the catalogue of the classes that the settings say a class is taken for."""
    named = {other for pair in config.confusions if name in pair for other in pair} - {name}
    return [k for k, c in enumerate(catalogue.classes) if c.name in named]


def _likeness(catalogue: Catalogue) -> Array:
    """(C, C) how like each class looks to each, 0 to 1: the sorted sides of their boxes, their mean colours."""
    meshes = [c.mesh for c in catalogue.classes]
    sides = np.log([np.sort(m.vertices.max(axis=0) - m.vertices.min(axis=0)) for m in meshes]).reshape(-1, 3)
    colours = np.array([m.colours.mean(axis=0) for m in meshes]).reshape(-1, 3)
    size = np.abs(sides[:, None] - sides).mean(axis=-1)
    colour = np.abs(colours[:, None] - colours).mean(axis=-1)
    like = np.exp(-RESEMBLANCE * size - COLOUR * colour)
    np.fill_diagonal(like, 0.0)
    return np.asarray(like)


def _stretches(n: int, share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(n,) states of a two-state Markov chain that is on for `share` of the time, STRETCH images on end on average."""
    leave, enter = 1.0 / STRETCH, share / (1.0 - share) / STRETCH
    u = rng.random(n)
    on = np.empty(n, dtype=np.bool_)
    state = bool(u[0] < share) if n else False
    for k in range(n):
        if k > 0:
            state = bool(u[k] >= leave) if state else bool(u[k] < enter)
        on[k] = state
    return on


def _luck(n: int, rng: np.random.Generator) -> Array:
    """(n,) numbers uniform in [0, 1), alike in following images: a Gaussian autoregression, its quantiles."""
    steps = rng.standard_normal(n) * np.sqrt(1.0 - ALIKE**2)
    steps[:1] /= np.sqrt(1.0 - ALIKE**2)
    return np.asarray(ndtr(lfilter([1.0], [1.0, -ALIKE], steps)))


def _part(box: Box, rng: np.random.Generator) -> Box:
    """A part of a box that overlaps the whole by less than half."""
    x, y, width, height = box
    share = np.sqrt(rng.uniform(0.25, 0.45))
    left, top = rng.uniform(0.0, 1.0 - share, 2)
    return (x + left * width, y + top * height, share * width, share * height)


def _box_of(phantom: _Phantom, around: Surroundings) -> Box | None:
    """Where a phantom shows; None where its spot is out of the image, or hidden."""
    point = se3.transform(se3.inverse(around.T_world_camera), phantom.at[None])[0]
    if point[2] < 0.1:
        return None
    u, v = around.camera.project(point)
    column, row = round(float(u)), round(float(v))
    if not (0 <= row < around.depth.shape[0] and 0 <= column < around.depth.shape[1]):
        return None
    if abs(float(around.depth[row, column]) - point[2]) > SAME_SURFACE_M:
        return None
    width, height = phantom.size * around.camera.fx / point[2]
    return (float(u - width / 2), float(v - height / 2), float(width), float(height))


def _jittered(box: Box, image_size: tuple[int, int], noise: float, rng: np.random.Generator) -> Box:
    x, y, width, height = box
    left, right = (x, x + width) + JITTER * noise * width * rng.standard_normal(2)
    top, bottom = (y, y + height) + JITTER * noise * height * rng.standard_normal(2)
    return _clipped(left, top, right, bottom, image_size)


def _clipped(left: float, top: float, right: float, bottom: float, image_size: tuple[int, int]) -> Box:
    """A box of at least one pixel inside the image, COCO's x, y, width, height, rounded to 1/100 pixel."""
    width, height = image_size
    left, top = min(max(left, 0.0), width - 1.0), min(max(top, 0.0), height - 1.0)
    right, bottom = min(max(right, left + 1.0), float(width)), min(max(bottom, top + 1.0), float(height))
    return round(left, 2), round(top, 2), round(right - left, 2), round(bottom - top, 2)


def _softmax(logits: Array) -> Array:
    odds = np.exp(logits - logits.max())
    return np.asarray(odds / odds.sum())
