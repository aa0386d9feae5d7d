"""What is played: three places in which the detector errs in a set way, and how that is written into a run.

The estimators get a run like any other. Only what the detector says of one thing is set; all else that it says, right
or wrong, is the simulator's.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ctmap_gtsam.runtime.settings import merge, parse_assignments
from sequences import layout
from sequences.atomic import write_json
from sequences.catalogue import Catalogue
from sequences.detections import detection_json
from sequences.errors import InputError
from sequences.seeds import generator
from sequences.simulation import SimulationConfig, simulate_place
from sequences.simulation.detections import Detector
from sequences.simulation.motion import Visit, arrange
from sequences.simulation.place import Place, furnish
from sequences.simulation.shapes import Shape, household
from sequences.simulation.simulator import SOURCE, watch_place
from sequences.types import Detection

FRAMES = 16
FOUND_SHARE = 0.25  # of the images: in so many, the first that show it, the detector finds what it misses in all others
NEAR_M = 0.3  # things so near each other stand beside each other
PLAIN = 0.5  # the evidence (`Visible.evidence`) of a thing in plain view
LEAST_SHARE = 0.35  # of the images show the thing, and what stands beside it, in plain view ...
LEAST_SHARE_MISSED = 0.5  # ... and so many one that is missed in most
TRIES = 400
STAGED = "staged"
"""The source of what is set, in scene_detections.json"""


@dataclass(frozen=True)
class Story:
    """What stands where, and how the detector errs."""

    name: str
    thing: str
    """class of the thing that it is about"""
    called: str | None
    """the class that the detector takes it for, in all images; None: it misses it in most"""
    told: str
    """what is set, in words"""
    kind: str
    """of room"""
    cast: tuple[str, ...]
    """small classes of the catalogue"""
    objects: int
    """how many small things are there"""
    twins: int = 0
    """how many of these are of the same class as another"""
    beside: int = 0
    """things of its own category that stand beside it, at least"""
    distance_m: float | None = None
    """from the camera to what it looks at, where the story needs another than the settings'"""
    cloth: bool = False
    """whether it, and no other furniture, is under a cloth"""

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """What there is to choose from: the cast, and all furniture."""
        return tuple(s for s in household() if s.areas or s.object_class.name in self.cast)

    def settings(self, simulation: SimulationConfig) -> SimulationConfig:
        """The simulator's, with what the story needs: one short visit to a tidy place of its kind."""
        distance_m = simulation.trajectory.distance_m if self.distance_m is None else self.distance_m
        needs = (
            f'place.kind="{self.kind}"',
            f"place.objects={self.objects}",
            f"place.distractors={len(self.cast)}",
            f"place.twins={self.twins}",
            "place.together=0.9",
            f"place.cloth={float(self.cloth)}",
            "motion.visits=1",
            "motion.moves=0",
            "motion.nudges=0",
            f"trajectory.distance_m={distance_m}",
            f"trajectory.frames={min(simulation.trajectory.frames, FRAMES)}",
        )
        return merge(simulation, parse_assignments(needs), "the story")


STORIES = (
    Story(
        name="bowl",
        thing="bowl",
        called="loofah",
        told="The detector takes a bowl for a loofah.",
        kind="kitchen",
        cast=("bowl", "plate", "mug", "teapot", "soup_can", "cereal_box", "apple", "loofah"),
        objects=7,
        beside=1,
    ),
    Story(
        name="shampoo",
        thing="shampoo_bottle",
        called="milk_carton",
        told="The detector takes a shampoo bottle for a milk carton, whose shape is much the same.",
        kind="bathroom",
        cast=("shampoo_bottle", "loofah", "toothbrush_cup", "soap", "toilet_roll", "sponge", "mug", "milk_carton"),
        objects=8,
        twins=2,
        beside=4,
        distance_m=1.3,  # from 1 m depth alone mostly tells the two apart
    ),
    Story(
        name="table",
        thing="table",
        called=None,
        told="The detector finds a table, which wears a cloth, in the first few images and misses it in all others.",
        kind="mixed",
        cast=("mug", "cereal_box", "book", "apple", "teapot", "game_box", "spray_bottle"),
        objects=5,
        cloth=True,
    ),
)


@dataclass(frozen=True)
class Staging:
    """A story in a place."""

    story: Story
    simulation: SimulationConfig
    seed: int
    """of the place"""
    inst_id: int
    """of the thing"""

    def write(self, folder: Path) -> None:
        """Simulate the place and set what the detector says of the thing; the same staging gives the same bytes.

        Raises:
            InputError: the folder is taken.
        """
        simulate_place(folder, self.simulation, self.seed, shapes=self.story.shapes)
        (file,) = (folder / layout.SPLIT).glob(f"*/{layout.SCENE_DETECTIONS}")
        write_json(file, self._staged(json.loads(file.read_text())))

    def _staged(self, said: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """All that the detector says, of the thing what the story wants."""
        own, classes = self._own()
        simulated = _entries(own, classes, SOURCE)
        return [entry for entry in said if entry not in simulated] + _entries(
            _as_told(self.story, own, classes), classes, STAGED
        )

    def _own(self) -> tuple[list[tuple[Detection, ...]], Catalogue]:
        """What the detector says of the thing in each image, as if it looked as in the catalogue; and that."""
        watched = watch_place(self.simulation, self.seed, self.story.shapes)
        ((n, glimpses),) = watched.visits
        camera, things = self.simulation.sensor.camera, {self.inst_id: watched.obj_ids[self.inst_id]}
        size = (camera.width, camera.height)
        detector = Detector(watched.classes, size, self.simulation.detector, self.seed, 0, things, n)
        out = []
        for k, glimpse in enumerate(glimpses):
            nothing_else = replace(glimpse.around, free=np.zeros_like(glimpse.around.free), clutter=())
            out.append(detector.detect(k, glimpse.visible, nothing_else))
        return out, watched.classes


def stage(story: Story, simulation: SimulationConfig, seed: int) -> Staging:
    """The first of the seed's places, in the order drawn, that has what the story needs.

    Nothing is asked of a place but what stands where and what the images show: no estimator has seen it.

    Raises:
        InputError: none has.
    """
    simulation = story.settings(simulation)
    for k in range(TRIES):
        drawn = int(generator(seed, f"bench.highlight.{story.name}", keyframe=k).integers(2**31))
        inst_id = _suitable(story, simulation, drawn)
        if inst_id is not None:
            return Staging(story, simulation, drawn, inst_id)
    raise InputError(
        f"none of {TRIES} places has what the story of the {story.thing} needs", remedy="choose another seed"
    )


def _suitable(story: Story, simulation: SimulationConfig, seed: int) -> int | None:
    """inst_id of the thing; None where there isn't one, its rival is there, or too little shows of what is needed."""
    place = furnish(simulation.place, seed, story.shapes)
    names = {i: shape.object_class.name for i, shape in place.known.items()}
    own = [i for i, name in names.items() if name == story.thing]
    if len(own) != 1 or story.called in names.values():
        return None
    (inst_id,) = own
    (visit,) = arrange(place, simulation, seed)
    beside = _beside(place, visit, inst_id)
    if len(beside) < story.beside or not _dressed_for(story, place, visit):
        return None
    plain = _in_plain_view(story, simulation, seed)
    needed = LEAST_SHARE_MISSED if story.called is None else LEAST_SHARE
    often = {i for i in beside if plain[i] >= LEAST_SHARE}
    return inst_id if plain[inst_id] >= needed and len(often) >= story.beside else None


def _beside(place: Place, visit: Visit, inst_id: int) -> set[int]:
    """inst_ids of the things of a thing's own category that stand beside it."""
    at = {thing.inst_id: thing.T_world_object[:3, 3] for thing in (*visit.arrangements[0].things, *visit.furniture)}
    category = {i: shape.object_class.category for i, shape in place.known.items()}
    kin = {i for i in at if category[i] == category[inst_id] and i != inst_id}
    return {i for i in kin if float(np.linalg.norm(at[i] - at[inst_id])) < NEAR_M}


def _in_plain_view(story: Story, simulation: SimulationConfig, seed: int) -> Mapping[int, float]:
    """inst_id -> the share of the images that show it in plain view."""
    ((n, glimpses),) = watch_place(simulation, seed, story.shapes).visits
    shown = Counter(v.inst_id for glimpse in glimpses for v in glimpse.visible if v.evidence >= PLAIN)
    return defaultdict(float, {i: images / n for i, images in shown.items()})


def _dressed_for(story: Story, place: Place, visit: Visit) -> bool:
    pairs = zip(visit.furniture, place.furniture, strict=True)
    covered = {place.known[now.inst_id].object_class.name for now, bare in pairs if now.body is not bare.body}
    return covered == ({story.thing} if story.cloth else set())


def _as_told(story: Story, own: Sequence[tuple[Detection, ...]], catalogue: Catalogue) -> list[tuple[Detection, ...]]:
    """What the detector says of the thing in each image, in the story."""
    if story.called is None:
        found = [k for k, some in enumerate(own) if some][: round(FOUND_SHARE * len(own))]
        return [some if k in found else () for k, some in enumerate(own)]
    called = 1 + next(k for k, c in enumerate(catalogue.classes) if c.name == story.called)
    return [tuple(_taken_for(d, called) for d in some) for some in own]


def _taken_for(detection: Detection, called: int) -> Detection:
    """As sure of another class: that one's score and the best change places."""
    scores = detection.class_scores.copy()
    best = 1 + int(np.argmax(scores[1:]))
    scores[[called, best]] = scores[[best, called]]
    return replace(detection, class_scores=scores)


def _entries(found: Sequence[Sequence[Detection]], catalogue: Catalogue, source: str) -> list[dict[str, Any]]:
    """As scene_detections.json has them: one visit, whose images are numbered from 1."""
    return [detection_json(d, 1, k + 1, catalogue.obj_ids, source) for k, some in enumerate(found) for d in some]
