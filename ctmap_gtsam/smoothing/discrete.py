"""The trellis: modes, absences and moves of one object of one class over the run, by forward-backward.

States at a keyframe are the view's modes and "gone" (not here at all: not yet, no longer, or elsewhere). A mode's
evidence is its likelihood times the volume under it, which is the integral of exp(log f - 1/2 r^T L r) over poses;
transitions integrate the prediction over the mode's Gaussian and over what its most probable past knows (a switching
Kalman filter that keeps one component a state; Bar-Shalom, Li and Kirubarajan 2001, ch. 11): integrating over single
views would charge a long track for every view anew. The normaliser is the class evidence, against nothing being there;
one pass gives which mode, when present, and whether it moved. Log space throughout (Rabiner, Proc. IEEE 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors import prediction, symmetry
from factors.mixture import LOG_2PI, log_sum
from sequences import se3

Array = NDArray[np.float64]

PRESENT_AT_FIRST = 0.5
"""prior probability that an object is there from the start"""


@dataclass(frozen=True)
class Stage:
    """The states of one keyframe in view: n modes, and gone."""

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
    """(n + 1,) marginal of each stage's states, gone last"""
    path: tuple[int, ...]
    """the most probable states; n stands for gone"""
    moved: Array
    """(stages - 1,) probability that the object did not simply stay between two stages, given it was there at either"""


def solve(stages: Sequence[Stage], model: Model, shape: Shape, noise_variance: Array) -> Posterior:
    """Forward-backward and the best path.

    Args:
        stages: in order of time, at least one.
        model: potentials.
        shape: the class.
        noise_variance: (6,) of what moves a mode between two views but isn't the object: localisation's error.
    """
    emissions = [_emission(stage, shape) for stage in stages]
    uniform = model.log_uniform(shape)
    first = np.full(len(stages[0].log_evidence), np.log(PRESENT_AT_FIRST) + uniform)
    start = np.append(first, np.log1p(-PRESENT_AT_FIRST))
    forward, steps, known = [start + emissions[0]], [], _Known(stages[0].T_world_centre, stages[0].covariance)
    for a, b, emission in zip(stages, stages[1:], emissions[1:], strict=False):
        between = _Between.of(a, b, model, shape, noise_variance)
        step = _transition(known, b, between, model, shape)
        known = _update(known, b, between, forward[-1][:-1, None] + step.log_stay, shape)
        steps.append(step)
        forward.append(log_sum(forward[-1][:, None] + step.log_total, axis=0) + emission)
    backward = [np.zeros(len(emissions[-1]))]
    for step, emission in zip(reversed(steps), reversed(emissions[1:]), strict=True):
        backward.insert(0, log_sum(step.log_total + emission + backward[0], axis=1))
    total = float(log_sum(forward[-1]))
    marginals = tuple(np.exp(f + b - total) for f, b in zip(forward, backward, strict=True))
    moved = [_moved(step, forward[i], emissions[i + 1] + backward[i + 1], total) for i, step in enumerate(steps)]
    return Posterior(total, marginals, _viterbi(start, emissions, steps), np.array(moved))


@dataclass(frozen=True)
class _Step:
    log_total: Array
    """(n + 1, m + 1) log probability (density at modes) of each transition"""
    log_stay: Array
    """(n, m) the part of mode-to-mode transitions in which the object stayed"""


def _emission(stage: Stage, shape: Shape) -> Array:
    """(n + 1,): a mode's integral over poses; gone is what everything is compared with, 0."""
    if not len(stage.log_evidence):
        return np.zeros(1)
    reduced = shape.symmetry.reduced_covariance(stage.covariance)
    volume = 0.5 * (np.linalg.slogdet(reduced)[1] + reduced.shape[-1] * LOG_2PI)
    return np.append(stage.log_evidence + volume, 0.0)


@dataclass(frozen=True)
class _Known:
    """What each mode's most probable past and the mode itself know together."""

    T_world_centre: Array
    """(n, 4, 4)"""
    covariance: Array
    """(n, 6, 6)"""


@dataclass(frozen=True)
class _Between:
    """What may happen from one stage to the next."""

    stay: float
    """probability that the object simply stays"""
    sigma: Array
    """(6, 6) of the prediction, what localisation and the depth's bias add included"""

    @classmethod
    def of(cls, a: Stage, b: Stage, model: Model, shape: Shape, noise_variance: Array) -> _Between:
        settings = model.config.prediction
        dt = max(b.time_s - a.time_s, 1e-3)
        stay = model.stay_probability(shape.source, dt) if dt > settings.significant_period_s else 1.0
        sigma = model.prediction_covariance(dt) + np.diag(noise_variance)
        return cls(min(stay, 1.0 - settings.jump_probability), sigma)


def _transition(known: _Known, b: Stage, between: _Between, model: Model, shape: Shape) -> _Step:
    n, m = len(known.covariance), len(b.log_evidence)
    log_stay = np.zeros((n, m))
    if n and m:
        log_stay = np.log(between.stay) + prediction.integrated_log_potential(
            known.T_world_centre[:, None],
            known.covariance[:, None],
            b.T_world_centre[None],
            b.covariance[None],
            between.sigma,
            shape.symmetry,
        )
    # what did not stay is gone or elsewhere nearby, each as likely
    leave = np.log1p(-between.stay) - np.log(2.0)
    appear = leave + model.log_uniform(shape)
    out = np.empty((n + 1, m + 1))
    out[:n, :m] = np.logaddexp(log_stay, appear)
    out[:n, m] = leave
    out[n, :m] = appear
    out[n, m] = np.log1p(-np.exp(leave))
    return _Step(out, log_stay)


def _update(known: _Known, b: Stage, between: _Between, log_joint: Array, shape: Shape) -> _Known:
    """Kalman's update of the best predecessor's knowledge by each mode of b; a mode without one knows itself."""
    if not log_joint.size:
        return _Known(b.T_world_centre, b.covariance)
    best = np.argmax(log_joint, axis=0)
    T = known.T_world_centre[best]
    before = known.covariance[best] + between.sigma
    gain = before @ np.linalg.inv(before + b.covariance)
    r = symmetry.residual(T, b.T_world_centre, shape.symmetry)
    return _Known(se3.retract(T, (gain @ r[..., None])[..., 0]), before - gain @ before)


def _moved(step: _Step, forward: Array, ahead: Array, total: float) -> float:
    joint = forward[:, None] + step.log_total + ahead
    there = float(np.exp(log_sum(joint.ravel()) - total)) - float(np.exp(joint[-1, -1] - total))
    if there < 1e-9:  # it was gone before and after
        return 0.0
    if not step.log_stay.size:
        return 1.0
    stayed = float(np.exp(log_sum((forward[:-1, None] + step.log_stay + ahead[:-1]).ravel()) - total))
    return float(np.clip(1.0 - stayed / there, 0.0, 1.0))


def _viterbi(start: Array, emissions: list[Array], steps: list[_Step]) -> tuple[int, ...]:
    score = start + emissions[0]
    back: list[NDArray[np.int64]] = []
    for step, emission in zip(steps, emissions[1:], strict=True):
        joint = score[:, None] + step.log_total
        back.append(np.argmax(joint, axis=0))
        score = joint.max(axis=0) + emission
    path = [int(np.argmax(score))]
    for pointers in reversed(back):
        path.insert(0, int(pointers[path[0]]))
    return tuple(path)
