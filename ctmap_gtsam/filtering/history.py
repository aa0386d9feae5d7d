"""What the filter believed of an object, keyframe by keyframe: what the backward pass goes back through.

It is kept only where somebody will go back (`ctmap_gtsam.filtering.backward`). A pose takes 28 bytes and its weights 8;
classes that sleep at a keyframe keep nothing there. An object with 300 particles and five classes awake takes some
15 kB a keyframe.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.filtering.particles import Particles, Spread, Transition
from sequences import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Kept:
    """M weighted poses of one class at one keyframe, in single precision."""

    pose: NDArray[np.float32]
    """(M, 7) T_world_centre: quaternion x, y, z, w and metres"""
    log_weight: NDArray[np.float32]
    """(M,)"""
    spread: Spread | None
    """of the prediction from the poses of this class that were kept last; None: from none of them"""
    log_elsewhere: NDArray[np.float32]
    """(M,) log density of having come from elsewhere, pushed or moved; -inf where that can't be"""

    @classmethod
    def of(cls, particles: Particles, transition: Transition | None) -> Kept:
        """What particles are, and how they came from those before."""
        T = particles.T_world_centre
        pose = np.concatenate([se3.quaternion(T[:, :3, :3]), T[:, :3, 3]], axis=-1)
        nowhere = np.full(len(T), -np.inf)
        spread, elsewhere = (None, nowhere) if transition is None else (transition.spread, transition.log_elsewhere)
        single = (pose.astype(np.float32), particles.log_weight.astype(np.float32))
        return cls(*single, spread, elsewhere.astype(np.float32))

    def particles(self) -> Particles:
        """Them again."""
        pose = self.pose.astype(np.float64)
        T = se3.make(se3.rotation_from_quaternion(pose[:, :4]), pose[:, 4:])
        return Particles(T, self.log_weight.astype(np.float64))


@dataclass(frozen=True)
class Stage:
    """What was believed after one keyframe that had the object's place in view."""

    keyframe: int
    time_ns: int
    away_m: float
    """from the camera to the object"""
    classes: Mapping[int, Kept]
    """class index -> its particles; those that slept are left out"""
    log_evidence: Array
    """(C,) of each class at this place, prior and scores included"""
    log_clutter: float
    witness: float
    """for a known thing against one of unknown mesh that looks alike, nats"""
    joins: bool = False
    """the stages before are of another belief, which turned out to be of the same object"""


@dataclass(frozen=True)
class Past:
    """All stages of an object at one place, and its past at the place before."""

    begin: int
    """keyframe of the first box"""
    stages: tuple[Stage, ...] = ()
    before: Past | None = None
    """where it stood before it was moved, as far as that is known"""

    def joined(self, stage: Stage) -> Past:
        """With one keyframe more."""
        return replace(self, stages=(*self.stages, stage))

    def after(self, other: Past) -> Past:
        """The same object's past where what another belief had kept from earlier on is its past, too."""
        if self.before is not None or not self.stages:
            return self
        first, *rest = self.stages
        earlier = tuple(stage for stage in other.stages if stage.keyframe < first.keyframe)
        begin = min(self.begin, other.begin)
        if not earlier:
            return replace(self, begin=begin, before=other.before)
        return Past(begin, (*earlier, replace(first, joins=True), *rest), other.before)

    def moved_from(self, other: Past) -> Past:
        """The past of what stood elsewhere before."""
        return replace(self, before=other if self.before is None else self.before.moved_from(other))


def one_past(kept: Past | None, other: Past | None) -> Past | None:
    """The past of one object of which two were believed in, by the belief that is kept; None where nothing is kept."""
    return kept if kept is None or other is None else kept.after(other)


def moved_past(found: Past | None, old: Past | None) -> Past | None:
    """The past of an object that was found again elsewhere; None where nothing is kept."""
    return found if found is None or old is None else found.moved_from(old)
