"""The trellis: modes, absences and moves of one object of one class over the run, by forward-backward.

States at a keyframe are the view's modes, "unmeasured" (it is where it was, and none of the modes is its pose) and
"gone" (not here at all: not yet, no longer, or elsewhere). A mode's evidence is its likelihood times the volume under
it, which is the integral of exp(log f - 1/2 r^T L r) over poses, shared where modes lie on one hump; transitions
integrate the prediction over the mode's Gaussian and over what its most probable past knows (a switching Kalman filter
that keeps one component a state; Bar-Shalom, Li and Kirubarajan 2001, ch. 11): integrating over single views would
charge a long track for every view anew. Unmeasured explains a view as well as a pose could that has nothing to do with
the thing, at a price: a view that is misread, or a silhouette that something unknown hides, is no move. The normaliser
is the class evidence, against nothing being there; one pass gives which mode, when present, and whether it moved. Log
space throughout (Rabiner, Proc. IEEE 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.landing import landing_log_density
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors import prediction, symmetry
from factors.mixture import LOG_2PI, log_sum
from sequences import se3
from sequences.geometry import Plane

Array = NDArray[np.float64]

PRESENT_AT_FIRST = 0.5
"""prior probability that an object is there from the start"""

_STAYED = 0.5


@dataclass(frozen=True, slots=True)  # a map holds one for each object, class and keyframe
class Stage:
    """The states of one keyframe in view: n modes, unmeasured, and gone."""

    keyframe: int
    time_s: float
    T_world_centre: Array
    """(n, 4, 4)"""
    covariance: Array
    """(n, 6, 6)"""
    log_evidence: Array
    """(n,) log likelihood, context's share included"""


@dataclass(frozen=True)
class Posterior:
    """What the trellis says of one class."""

    log_evidence: float
    """log of all paths together, against nothing ever being there"""
    modes: tuple[Array, ...]
    """(n + 2,) marginal of each stage's states: modes, unmeasured, gone"""
    path: tuple[int, ...]
    """the most probable states, given where it is likelier there than gone; n stands for unmeasured, n + 1 for gone"""
    path_stays: tuple[bool, ...]
    """(stages - 1,) whether the path's own two states are one place rather than two"""
    moved: Array
    """(stages - 1,) probability that the object was there at either of two stages and did not simply stay"""

    def stayed(self, i: int) -> bool:
        """Whether it more likely stayed from the stage before stage i to that one, and the path says so, too.

        Among many ways to have stayed the one best path may still be a jump. What the path calls two places must not be
        held together: a graph that did would tear at everything else.
        """
        return bool(self.moved[i - 1] < _STAYED) and self.path_stays[i - 1]


def solve(
    stages: Sequence[Stage],
    model: Model,
    shape: Shape,
    noise_variance: Array,
    supports: tuple[Plane, ...] = (),
) -> Posterior:
    """Forward-backward and the best path.

    Args:
        stages: in order of time, at least one.
        model: potentials.
        shape: the class.
        noise_variance: (6,) of what moves a mode between two views but isn't the object: localisation's error.
        supports: level surfaces, world frame, that it may have been moved onto.
    """
    emissions = [_emission(stage, model, shape) for stage in stages]
    first = np.full(len(stages[0].log_evidence), np.log(PRESENT_AT_FIRST) + model.log_uniform(shape))
    # what hasn't been met yet can't be where it was
    start = np.concatenate([first, [-np.inf, np.log1p(-PRESENT_AT_FIRST)]])
    forward, steps, known = [start + emissions[0]], [], _Known.at_first(stages[0])
    for a, b, emission in zip(stages, stages[1:], emissions[1:], strict=False):
        between = _Between.of(a, b, model, shape, noise_variance, supports)
        step = _transition(known, b, between, shape)
        known = _update(known, b, between, forward[-1], step, shape)
        steps.append(step)
        forward.append(log_sum(forward[-1][:, None] + step.log_total, axis=0) + emission)
    backward = [np.zeros(len(emissions[-1]))]
    for step, emission in zip(reversed(steps), reversed(emissions[1:]), strict=True):
        backward.insert(0, log_sum(step.log_total + emission + backward[0], axis=1))
    total = float(log_sum(forward[-1]))
    marginals = tuple(np.exp(f + b - total) for f, b in zip(forward, backward, strict=True))
    moved = [_moved(step, forward[i], emissions[i + 1] + backward[i + 1], total) for i, step in enumerate(steps)]
    path = _best_path(start, emissions, steps, marginals)
    stays = tuple(step.stays(a, b) for step, (a, b) in zip(steps, pairwise(path), strict=True))
    return Posterior(total, marginals, path, stays, np.array(moved))


@dataclass(frozen=True)
class _Step:
    log_total: Array
    """(n + 2, m + 2) log probability (density at modes) of each transition"""
    log_stay: Array
    """(n + 1, m + 1) the part of transitions among modes and unmeasured in which the object stayed"""
    log_appear: Array
    """(m,) the other part of each transition to a mode, whatever was before: it came from elsewhere"""

    def stays(self, a: int, b: int) -> bool:
        """Whether from state a to state b it more likely stayed than came from elsewhere."""
        n, m = (size - 1 for size in self.log_stay.shape)
        if a > n or b > m:  # gone
            return False
        return b == m or bool(self.log_stay[a, b] > self.log_appear[b])


def _emission(stage: Stage, model: Model, shape: Shape) -> Array:
    """(n + 2,): a mode's part of the integral over poses; gone is what everything is compared with, 0."""
    if not len(stage.log_evidence):
        return np.zeros(2)  # nothing was measured, nothing is misread
    reduced = shape.symmetry.reduced_covariance(stage.covariance)
    volume = 0.5 * (np.linalg.slogdet(reduced)[1] + reduced.shape[-1] * LOG_2PI)
    modes = stage.log_evidence + _log_own_share(stage, shape, reduced) + volume
    anyhow = max(float(log_sum(modes)) + model.log_uniform(shape), 0.0)
    p = model.config.smoother.unmeasured
    with np.errstate(divide="ignore"):
        return np.concatenate([modes + np.log1p(-p), [np.log(p) + anyhow, 0.0]])


def _log_own_share(stage: Stage, shape: Shape, reduced: Array) -> Array:
    """(n,) of the likelihood where a mode has its peak, its share in the sum of all modes' Gaussians there.

    Of several modes on one hump, such as a ridge that depth leaves flat, each would count the whole hump, and so would
    each view: the way round with more modes a hump would win.
    """
    apart = symmetry.residual(stage.T_world_centre[:, None], stage.T_world_centre[None], shape.symmetry)
    apart = apart @ shape.symmetry.projection.T
    squared = (apart * np.linalg.solve(reduced[:, None], apart[..., None])[..., 0]).sum(axis=-1)
    return stage.log_evidence - np.asarray(log_sum(stage.log_evidence[:, None] - 0.5 * squared, axis=0))


@dataclass(frozen=True)
class _Known:
    """What the most probable past of each mode and of unmeasured, and the state itself, know together."""

    T_world_centre: Array
    """(n + 1, 4, 4)"""
    covariance: Array
    """(n + 1, 6, 6)"""

    @classmethod
    def at_first(cls, stage: Stage) -> _Known:
        """Modes know themselves; unmeasured is impossible here, so what it knows is never asked for."""
        return cls(
            np.concatenate([stage.T_world_centre, np.eye(4)[None]]), np.concatenate([stage.covariance, np.eye(6)[None]])
        )


@dataclass(frozen=True)
class _Between:
    """What may happen from one stage to the next."""

    log_stay: float
    """that the object simply stays; this and the next two as `Model.log_transitions` has them"""
    log_leave: float
    log_remain: float
    walk: Array
    """(6, 6) of the prediction"""
    sigma: Array
    """(6, 6) of it and of what localisation and the depth's bias add to what is measured"""

    log_elsewhere: Array
    """(m,) log density of each mode's pose for what came from elsewhere: averaged over the mode's Gaussian"""

    @classmethod
    def of(
        cls, a: Stage, b: Stage, model: Model, shape: Shape, noise_variance: Array, supports: tuple[Plane, ...]
    ) -> _Between:
        dt = max(b.time_s - a.time_s, 1e-3)
        absence = dt > model.config.prediction.significant_period_s
        walk = model.prediction_covariance(dt)
        # a push leaves a thing nearby; what somebody took away is put down somewhere
        landing = landing_log_density(model, shape, b.T_world_centre, supports if absence else (), b.covariance)
        return cls(*model.log_transitions(shape.source, dt), walk, walk + np.diag(noise_variance), landing)


def _transition(known: _Known, b: Stage, between: _Between, shape: Shape) -> _Step:
    n, m = len(known.covariance), len(b.log_evidence)
    log_stay = np.full((n, m + 1), between.log_stay)
    if m:
        log_stay[:, :m] += prediction.integrated_log_potential(
            known.T_world_centre[:, None],
            known.covariance[:, None],
            b.T_world_centre[None],
            b.covariance[None],
            between.sigma,
            shape.symmetry,
        )
    # what did not stay is gone or elsewhere, each as likely
    appear = between.log_leave + between.log_elsewhere
    out = np.full((n + 1, m + 2), -np.inf)
    out[:n, : m + 1] = log_stay
    out[:, :m] = np.logaddexp(out[:, :m], appear)
    out[:n, m + 1] = between.log_leave
    out[n, m + 1] = between.log_remain
    return _Step(out, log_stay, appear)


def _update(known: _Known, b: Stage, between: _Between, forward: Array, step: _Step, shape: Shape) -> _Known:
    """The best predecessor's knowledge, by Kalman's update with each mode of b, and carried on unmeasured.

    A mode that the object more probably came to from elsewhere than stayed at knows itself and no past.
    """
    log_joint = forward[:-1, None] + step.log_stay
    best = np.argmax(log_joint, axis=0)
    T, covariance = known.T_world_centre[best], known.covariance[best]
    before = covariance[:-1] + between.sigma
    gain = before @ np.linalg.inv(before + b.covariance)
    r = symmetry.residual(T[:-1], b.T_world_centre, shape.symmetry)
    T_modes, updated = se3.retract(T[:-1], (gain @ r[..., None])[..., 0]), before - gain @ before
    reached = log_joint.max(axis=0)[:-1] > log_sum(forward) + step.log_appear
    T_modes = np.where(reached[:, None, None], T_modes, b.T_world_centre)
    updated = np.where(reached[:, None, None], updated, b.covariance)
    carried = covariance[-1:] + between.walk
    return _Known(np.concatenate([T_modes, T[-1:]]), np.concatenate([updated, carried]))


def _moved(step: _Step, forward: Array, ahead: Array, total: float) -> float:
    """P(there before or after, and not simply stayed)."""
    joint = forward[:, None] + step.log_total + ahead
    gone = np.exp(joint[-1, -1] - total)
    stayed = np.exp(log_sum((forward[:-1, None] + step.log_stay + ahead[:-1]).ravel()) - total)
    return float(np.clip(1.0 - gone - stayed, 0.0, 1.0))


def _best_path(start: Array, emissions: list[Array], steps: list[_Step], marginals: Sequence[Array]) -> tuple[int, ...]:
    """Viterbi's path among those that are there just where that is more likely than not.

    Poses that differ little share what speaks for them, and the one state of being gone shares with nobody: over all
    paths the best could be gone where hardly any is.
    """
    allowed = [_likelier(marginal) for marginal in marginals]
    score = start + emissions[0] + allowed[0]
    back: list[NDArray[np.int64]] = []
    for step, emission, here in zip(steps, emissions[1:], allowed[1:], strict=True):
        joint = score[:, None] + step.log_total
        back.append(np.argmax(joint, axis=0))
        score = joint.max(axis=0) + emission + here
    path = [int(np.argmax(score))]
    for pointers in reversed(back):
        path.insert(0, int(pointers[path[0]]))
    return tuple(path)


def _likelier(marginal: Array) -> Array:
    """(n + 2,) 0 for the states of the likelier of there and gone, -inf for the others."""
    gone = marginal[-1] > 0.5
    return np.append(np.full(len(marginal) - 1, -np.inf if gone else 0.0), 0.0 if gone else -np.inf)
