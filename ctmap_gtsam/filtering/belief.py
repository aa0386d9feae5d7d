"""One object's belief: what Algorithm 1 keeps of it from keyframe to keyframe."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.filtering.history import Past
from ctmap_gtsam.filtering.memory import Memory
from ctmap_gtsam.filtering.particles import (
    Particles,
    Transition,
)
from ctmap_gtsam.frontend.proposer import View
from ctmap_gtsam.model import Model

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ClassBelief:
    """What is believed of one object if it is of one class."""

    particles: Particles
    log_evidence: float
    """log p(depth and boxes so far, at this place | class) against nothing being there"""
    transition: Transition | None = None
    """from the particles before; None where these don't come from them"""


@dataclass(frozen=True)
class Glimpse:
    """The last keyframe that had an object's place in view, as far as its ledger goes."""

    view: View
    T_camera_world: Array
    """(4, 4)"""
    waited_s: float | None
    """since the keyframe in view before; None where it is the first"""


@dataclass(frozen=True)
class Absence:
    """What was believed of one object before nobody saw its place for long enough to have moved it."""

    classes: tuple[Particles | None, ...]
    """of each class; None where it had no pose, or one that was found to be wrong since"""
    log_odds: Array
    """(C,) log of P(moved) / P(stayed) by Equation 3; -inf for what can't be moved"""
    begin_ns: int
    end_ns: int
    """of the first keyframe that had its place in view again"""


@dataclass(frozen=True)
class Belief:
    """What is believed of one object after a keyframe."""

    object_id: int
    classes: tuple[ClassBelief | None, ...]
    """one a class of the catalogue; None where no pose explains anything"""
    score_sum: Array
    """(C,) class scores summed over this visit, as the detector's persistent belief takes them"""
    score_evidence: Array
    """(C,) log evidence of the visits before"""
    log_clutter: float
    """log evidence of something that no mesh explains"""
    witness: float
    """what its boxes and their absences say in this visit for a known thing against a look-alike, nats"""
    witness_before: float
    """what those of the visits before say"""
    log_elsewhere: float
    """log evidence of having been moved to where nobody looked"""
    visit: int
    first_ns: int
    """of the keyframe that it began with"""
    present_ns: int
    """of the last keyframe that found it at its place"""
    time_ns: int
    """of the last keyframe that had its place in view"""
    viewpoint: Array
    """(3,) from the object to the camera at that keyframe, metres, world frame"""
    visible: bool
    steps: int
    """keyframes in view since the start"""
    glimpse: Glimpse
    searched: int = 1
    """steps when it was last searched for"""
    returned: int = 1
    """steps when its last absence ended; the first where there was none"""
    memory: Memory = field(default_factory=Memory)
    past: Past | None = None
    """for the backward pass; None where nobody goes back"""
    absence: Absence | None = None
    """the last one"""

    def class_log_evidence(self, model: Model) -> Array:
        """(C,) log evidence of each class at this place, prior included."""
        return model.between_classes(self.explained) + self.called(model) - np.log(len(self.classes))

    @property
    def explained(self) -> Array:
        """(C,) what depth and boxes say of each class's poses so far; -inf where there are none."""
        return np.array([-np.inf if c is None else c.log_evidence for c in self.classes])

    def witnessed(self, model: Model) -> float:
        """What boxes and their absences say for a known thing against a look-alike, in all visits, nats."""
        return self.witness_before + model.seen_in_visit(self.witness)

    def called(self, model: Model) -> Array:
        """(C,) log evidence of what the detector has called it, in all visits."""
        return self.score_evidence + model.class_evidence(self.score_sum)
