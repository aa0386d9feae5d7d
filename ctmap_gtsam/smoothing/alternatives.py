"""What else a pose may be: other modes, other ways round, and the place of a thing that looks the same.

What all views get wrong alike no number of views puts right. Two such errors are no matter of a covariance: the way
round of a thing that looks nearly the same when turned, which its own surface's error may decide in every view, and
which of two alike things is which, once both may have been in somebody's hands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import NEARLY, Shape
from ctmap_gtsam.smoothing.belief import Thing
from ctmap_gtsam.smoothing.discrete import Stage
from ctmap_gtsam.smoothing.modes import Recording
from factors.symmetry import residual
from sequences import se3

Array = NDArray[np.float64]

_SAME = 0.99  # of the scatter of one pose's views: a mode within it is no other pose
_ONE_WAY_RAD = 0.5  # a mode within this of a way round is the thing, turned so
_FOUND = 3  # ways round that no near-symmetry explains, at most
_LESS = 0.98  # of the reported pose's share: what another way round, or an exchanged thing's place, has at most


@dataclass(frozen=True)
class Mode:
    """A pose that an object may have at a keyframe."""

    share: float
    """of the belief in its class"""
    T_world_centre: Array
    """(4, 4)"""
    covariance: Array
    """(6, 6) of its right tangent"""

    def times(self, factor: float) -> Mode:
        """With a smaller share."""
        return replace(self, share=self.share * factor)

    def says_the_same(self, other: Mode, shape: Shape) -> bool:
        """Whether a single view's mode says nothing else than this one: it lies where views scatter anyhow."""
        S = shape.symmetry
        r = S.projection @ residual(self.T_world_centre, other.T_world_centre, S)
        d = float(r @ np.linalg.solve(S.reduced_covariance(self.covariance + other.covariance), r))
        return d <= float(chi2.ppf(_SAME, len(r)))


@dataclass(frozen=True)
class Ways:
    """Other ways round that a thing may stand, in the frame of the reported pose."""

    T_own_way: Array
    """(n, 4, 4)"""
    lead: Array
    """(n,) by how many nats a view the reported pose is ahead; inf where no view tells"""


def ways_round(
    own: Mode, others: Sequence[Mode], shape: Shape, ways: Ways, sigma: float
) -> tuple[Mode, tuple[Mode, ...]]:
    """The belief where depth's word between ways round has an end.

    The error of a thing's own surface, which is the same in each view, favours a way by some nats a view, with standard
    deviation `sigma`: more views are no more certain than the mean of them, and another way is the true one with
    probability Phi(-lead / sigma), if the views together don't give it more. The reported pose stays the reported one.

    Args:
        own: the reported pose.
        others: further modes of the same view, those that are all but impossible included: they are where a turned
            thing fits best.
        shape: the class.
        ways: see `other_ways`.
        sigma: as above.

    Returns:
        Both with new shares, and a mode for each way that had none.
    """
    if not len(ways.lead):
        return own, tuple(others)
    members: list[list[Mode]] = [[] for _ in ways.lead]
    rest: list[Mode] = []
    for mode in others:
        way = _way(own.T_world_centre @ ways.T_own_way, mode.T_world_centre[None], shape)[0]
        (rest if way < 0 else members[way]).append(mode)
    wrong = norm.cdf(-ways.lead / sigma)
    odds = np.minimum(wrong / np.maximum(1.0 - wrong, wrong), _LESS)
    out = rest
    for turn, way, ratio in zip(ways.T_own_way, members, odds.tolist(), strict=True):
        # the view's best pose of that way takes what is missing; where the view has none, the reported pose turned
        best = max(way, key=lambda m: m.share, default=_turned(own, turn, shape))
        missing = max(ratio * own.share - sum(m.share for m in way), 0.0)
        out += [replace(m, share=m.share + (missing if m is best else 0.0)) for m in way or [best]]
    total = own.share + sum(mode.share for mode in out)
    return own.times(1.0 / total), tuple(mode.times(1.0 / total) for mode in out)


def other_ways(thing: Thing, visit: int, own: Array, recording: Recording, model: Model) -> Ways:
    """The ways round that look nearly the same, and those that views of a visit took for the pose, and their leads.

    Of a near-symmetry the views count that have a mode of both. Any other way is one that happened to fit some views,
    such as that of a thing half hidden: where a view hasn't kept it, it is as good as the worst that it has, at most.

    Args:
        thing: the object.
        visit: whose views count.
        own: (4, 4) its pose in the world.
        recording: the run.
        model: potentials.
    """
    c = thing.reported_class
    shape = model.shapes[c]
    stages = [
        stage for stage in thing.stages[c] if recording.visit(stage.keyframe) == visit and len(stage.log_evidence)
    ]
    near = se3.make(np.concatenate([np.eye(3)[None], shape.near_symmetries]), np.zeros(3))
    turns = _with_found(near, own, stages, shape)
    lead = np.full((len(stages), len(turns) - 1), np.inf)
    for row, stage in zip(lead, stages, strict=True):
        which, nats = _way(own @ turns, stage.T_world_centre, shape), stage.log_evidence
        best = np.array([nats[which == w].max(initial=-np.inf) for w in range(len(turns))])
        if np.isfinite(best[0]):
            at_most = nats.min() if len(nats) >= model.config.frontend.max_modes else 0.0
            best[len(near) :] = np.maximum(best[len(near) :], at_most)
            row[:] = best[0] - best[1:]
    known = np.isfinite(lead)
    mean = np.where(known, lead, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return Ways(turns[1:], np.where(known.any(axis=0), mean, np.inf))


def _with_found(turns: Array, own: Array, stages: Sequence[Stage], shape: Shape) -> Array:
    """(n, 4, 4) T_own_way of known ways, and of those that modes of views are turned in besides, the best first."""
    if not stages:
        return turns
    poses = np.concatenate([stage.T_world_centre for stage in stages])
    nats = np.concatenate([stage.log_evidence for stage in stages])
    turned = np.linalg.norm(residual(own, poses, shape.symmetry)[:, :3], axis=-1) > _ONE_WAY_RAD
    left = poses[turned][np.argsort(-nats[turned], kind="stable")]
    for _ in range(_FOUND):
        left = left[_way(own @ turns, left, shape) < 0] if len(left) else left
        if not len(left):
            break
        turns = np.concatenate([turns, se3.inverse(own) @ left[:1]])
    return turns


def _way(ways: Array, T: Array, shape: Shape) -> NDArray[np.int64]:
    """(m,) which of the poses (n, 4, 4) each of the poses (m, 4, 4) is nearly turned as; -1 for none."""
    r = residual(np.broadcast_to(ways[:, None], (len(ways), *T.shape)), T[None], shape.symmetry)
    apart = np.where(np.linalg.norm(r[..., 3:], axis=-1) < shape.radius_m, np.linalg.norm(r[..., :3], axis=-1), np.inf)
    return np.where(apart.min(axis=0) < _ONE_WAY_RAD, np.argmin(apart, axis=0), -1)


def _turned(own: Mode, turn: Array, shape: Shape) -> Mode:
    """The pose turned by a near-symmetry, as well known as the two surfaces agree."""
    A = se3.adjoint(se3.inverse(turn))
    off = np.repeat([NEARLY, NEARLY * shape.radius_m], 3)
    return Mode(0.0, own.T_world_centre @ turn, A @ own.covariance @ A.T + np.diag(off**2))


@dataclass(frozen=True)
class Exchanges:
    """Which alike things may have taken each other's places."""

    in_place_of: Mapping[int, Mapping[int, Mapping[int, float]]]
    """object -> visit -> other object -> P(it is where the other is taken to be)"""

    def at(self, object_id: int, visit: int) -> Mapping[int, float]:
        """Other object -> probability."""
        return self.in_place_of.get(object_id, {}).get(visit, {})


def exchanges(things: Mapping[int, Thing], recording: Recording, model: Model) -> Exchanges:
    """What nobody can see: in a gap between visits, two alike things that were both handled may be either.

    A thing was handled if it moved, and otherwise by Equation 3 at 1 - S; of two that both were, each is in the other's
    place with probability 1/2. Equation 3 says how long a place is held, not by which of two that nobody tells apart:
    `smoother.exchange` of the pairs change places anyhow. A thing's name is that of the visit from which most of its
    boxes are likely its own.
    """
    found: dict[int, dict[int, dict[int, float]]] = {}
    there = [t for _, t in sorted(things.items()) if t.exists and t.best_class == t.reported_class]
    for a, b in combinations(there, 2):
        if a.best_class != b.best_class or not model.shapes[a.best_class].source.movable:
            continue
        for visit, share in _exchanged(a, b, recording, model).items():
            for own, other in ((a, b), (b, a)):
                found.setdefault(own.object_id, {}).setdefault(visit, {})[other.object_id] = share
    return Exchanges(found)


def _exchanged(a: Thing, b: Thing, recording: Recording, model: Model) -> dict[int, float]:
    """Visit -> P(an odd number of exchanges between it and the visit that names the two)."""
    visits = [recording.visit(k) for k in range(len(recording.keyframes))]
    n = max(visits) + 1
    handled = [_handled(thing, visits, n, recording, model) for thing in (a, b)]
    kept = 1.0 - 2.0 * model.config.smoother.exchange
    # an even number of exchanges is ahead of an odd one by prod(1 - 2 q), for handled ones q = h h / 2
    ahead = np.eye(n)
    for v in range(n - 1):
        ahead[: v + 1, v + 1] = ahead[: v + 1, v] * (1.0 - handled[0][v] * handled[1][v]) * kept
    odd = 0.5 * (1.0 - np.maximum(ahead, ahead.T))
    seen = np.bincount([visits[k] for thing in (a, b) for k in thing.boxes], minlength=n)
    named = int(np.argmin(odd @ seen))
    return {v: float(odd[named, v]) for v in range(n) if odd[named, v] > 0.0}


def _handled(thing: Thing, visits: Sequence[int], n: int, recording: Recording, model: Model) -> Array:
    """(n - 1,) P(somebody had it in hand) in the gap after each visit but the last."""
    out = np.zeros(n - 1)
    keyframes, source = thing.keyframes, model.shapes[thing.best_class].source
    for i, moved in enumerate(thing.posteriors[thing.best_class].moved):
        before, after = keyframes[i], keyframes[i + 1]
        away_s = recording.time_s(after) - recording.time_s(before)
        if visits[before] < visits[after] and away_s > model.config.prediction.significant_period_s:
            stayed = (1.0 - float(moved)) * model.stay_probability(source, away_s)
            out[visits[before] : visits[after]] = 1.0 - stayed
    return out


def elsewhere(
    own: Mode, others: Sequence[Mode], shares: Mapping[int, float], places: Mapping[int, Mode]
) -> tuple[Mode, tuple[Mode, ...]]:
    """The belief with the places of alike things that it may be exchanged with.

    Args:
        own: the reported pose, which stays the most probable one.
        others: its other modes.
        shares: other object -> P(this one is where that one is taken to be).
        places: other object -> its reported pose, where it has one.
    """
    known = {i: share for i, share in shares.items() if i in places}
    total = sum(known.values())
    if not total:
        return own, tuple(others)
    most = min(total, _LESS * own.share / (1.0 + own.share))
    moved = [replace(places[i], share=most * share / total) for i, share in known.items()]
    return own.times(1.0 - most), (*(mode.times(1.0 - most) for mode in others), *moved)
