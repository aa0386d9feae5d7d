"""What a keyframe asks of single objects: each hangs on the keyframe before and on one object alone.

So tasks have no order and may be done by other processes (`ctmap_gtsam.filtering.team`); all draws come from the
object, class and keyframe.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from ctmap_gtsam.filtering.belief import Belief
from ctmap_gtsam.filtering.history import Past
from ctmap_gtsam.filtering.reporting import Reported, Reporter
from ctmap_gtsam.filtering.updating import Updater
from ctmap_gtsam.frontend.association import Track
from ctmap_gtsam.frontend.observation import Observation
from ctmap_gtsam.frontend.proposer import PoseModes, Proposer
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from sequences.types import Detection, LocalisationNoise

Answer_co = TypeVar("Answer_co", covariant=True)


@dataclass(frozen=True)
class Scene:
    """What all objects of a keyframe share."""

    observation: Observation
    surroundings: Surroundings
    """of all objects, each among them"""

    def __reduce__(self) -> tuple[Any, ...]:
        """Sent without the ways to the images: one has been read."""
        frame = replace(self.observation.frame, read_depth=_unread, read_colour=_unread)
        return Scene, (replace(self.observation, frame=frame), self.surroundings)


class Hand:
    """Who does tasks: all that they work with."""

    def __init__(self, model: Model, localisation: LocalisationNoise, *, keep_past: bool) -> None:
        self.model = model
        self.proposer = Proposer(model)
        self.updater = Updater(model, self.proposer, localisation, keep_past=keep_past)
        self.reporter = Reporter(model, self.proposer, localisation)

    def __call__(self, scene: Scene, task: Task[Answer_co]) -> Done[Answer_co]:
        """Do one."""
        before, clock = self.proposer.hypotheses_scored, _Clock()
        answer = task.done(self, scene, clock)
        return Done(answer, self.proposer.hypotheses_scored - before, clock.seconds)


@dataclass(frozen=True)
class Done(Generic[Answer_co]):
    """A task's answer, and what it took."""

    answer: Answer_co
    hypotheses: int
    """that were scored"""
    seconds: Mapping[str, float]
    """by part"""


class Task(Protocol[Answer_co]):
    """Something to be done for one object."""

    def done(self, hand: Hand, scene: Scene, clock: _Clock) -> Answer_co:
        """Do it."""


@dataclass(frozen=True)
class Step:
    """Algorithm 1 for one object, and what is said of it then."""

    belief: Belief
    """its past left out but for the beginning, see `without_past`"""
    detection: Detection | None
    before: Reported | None
    """what was said of it at the keyframe before"""

    def done(self, hand: Hand, scene: Scene, clock: _Clock) -> tuple[Belief, Reported]:
        """The belief, whose past is this keyframe alone, and the report."""
        around = scene.surroundings.without(self.belief.object_id)
        with clock.timed("objects"):
            belief = hand.updater.step(self.belief, self.detection, scene.observation, around)
        if not belief.visible and self.before is not None:
            # what nobody sees is believed to be as it was
            return belief, replace(self.before, visible=False, ledger=())
        with clock.timed("reports"):
            return belief, hand.reporter.report(belief, around, self.before)


@dataclass(frozen=True)
class Search:
    """A full search for a track that has just become consistent, as one class."""

    track: Track
    class_index: int

    def done(self, hand: Hand, scene: Scene, clock: _Clock) -> PoseModes:
        """What was found."""
        around = scene.surroundings.without(self.track.track_id)
        shape: Shape = hand.model.shapes[self.class_index]
        with clock.timed("new objects"):
            return hand.updater.search(self.track, shape, scene.observation, around)


@dataclass(frozen=True)
class Start:
    """The belief of such a track, and what is said of it."""

    track: Track
    found: tuple[PoseModes, ...]
    """of each class"""

    def done(self, hand: Hand, scene: Scene, clock: _Clock) -> tuple[Belief, Reported]:
        """Both."""
        around = scene.surroundings.without(self.track.track_id)
        with clock.timed("new objects"):
            belief = hand.updater.start(self.track, scene.observation, around, self.found)
            return belief, hand.reporter.report(belief, around)


def without_past(belief: Belief) -> Belief:
    """A belief that knows nothing of the keyframes before; a long run's past is not to be sent about."""
    return belief if belief.past is None else replace(belief, past=Past(belief.past.begin))


def with_past(belief: Belief, before: Belief) -> Belief:
    """A belief whose own past begins where that of the belief before it ends, with both."""
    if belief.past is None or before.past is None:
        return belief
    return replace(belief, past=replace(before.past, stages=(*before.past.stages, *belief.past.stages)))


class _Clock:
    """How long parts of a task take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """A block that belongs to a part."""
        began = time.perf_counter()
        yield
        self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - began


def _unread() -> NoReturn:
    raise RuntimeError("a task reads no images")
