"""The context potential phi_c = w1 phi_cat + w2 phi_ins: what stands beside what, and on what (Equation 5).

phi_c multiplies into the posterior only as a ratio to how pairs are placed when nothing relates them, so that two
strangers contribute log 1 = 0, and so does a missing neighbour:

    log [ (w1 phi_cat + w2 phi_ins) / phi_background ]                     w1 = w2 = 0.5 in the paper

A Gaussian as a potential of its own, without the ratio, would pay an object for having neighbours (or charge it), by an
amount that depends on its unit.

**Category level.** A related pair is, with probability `strength`, placed together: its distance d has a Gaussian
around a usual distance m, normalised as a density over the plane on which things stand; otherwise it is placed as
strangers are, uniformly over the place's area A:

    phi_cat / phi_background = (1 - strength) + strength A exp(-(d - m)^2 / 2 s^2) / Z(m, s)

Pairs of one category are related, and so are the class pairs of a table (a mouse beside a keyboard).

**Instance level.** phi_ins / phi_background is learned from other visits (`factors.instance`) and comes in as a number;
it is 1 until something is known.

**Physics.** Penetration and floating are matters of possibility, not of likelihood: they are hinges outside the
mixture, -1/2 (max(0, excess) / sigma)^2, so that no weight w1 can buy them off.

The paper multiplies phi_c in at every time step, which raises a prior to the number of frames. A pair is one fact for
as long as it stands still: each of its n keyframes gets 1/n of it (`per_keyframe`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sequences import se3
from sequences.options import option

Array = NDArray[np.float64]

_NEAR_PEAK = 1e-9  # nearer to the peak of a Student t its residual is linear


@dataclass(frozen=True)
class Relation:
    """How strongly two classes belong together, and how far apart they then stand."""

    strength: float = option(0.3, "probability that a pair is placed together rather than anywhere", low=0.0, high=1.0)
    distance_m: float = option(0.0, "usual distance between their centres, metres", low=0.0)
    sigma_m: float = option(0.25, "standard deviation of that distance, metres", low=1e-3)
    area_m2: float | None = option(
        None,
        "area over which unrelated things are spread, as seen at that distance; else that of all relations",
        low=1e-3,
    )

    def mean_bell(self, area_m2: float) -> float:
        """Mean of exp(-(d - m)^2 / 2 s^2) over unrelated pairs: those spread uniformly over an area of the plane."""
        return plane_integral(self.distance_m, self.sigma_m) / (self.area_m2 or area_m2)


@dataclass(frozen=True)
class CategoryRelations:
    """The category-level prior: by hand, as in the paper, or learned (`ctmap train context`)."""

    same_category: Relation = Relation()
    """pairs of classes that share a category"""
    pairs: tuple[tuple[str, str, Relation], ...] = option(
        (), "[class or category, the same, relation] in either order; class names go before categories"
    )
    area_m2: float = option(4.0, "area over which unrelated things are spread, square metres", low=1e-3)
    category_weight: float = option(0.5, "w1 of the paper; w2 is the rest", low=0.0, high=1.0)


@dataclass(frozen=True, eq=False)
class PairMixture:
    """w1 phi_cat / phi_background of pairs of classes as `strangers + together exp(-(d - usual)^2 / 2 sigma^2)`.

    Arrays of one shape (...), to be indexed like one: `table[classes_a, classes_b]`.
    """

    strangers: Array
    """(...) what is left at any distance"""
    together: Array
    """(...) what comes on top at the usual distance"""
    usual_m: Array
    """(...)"""
    sigma_m: Array
    """(...)"""
    instance_weight: float
    """w2"""

    def __getitem__(self, index: Any) -> PairMixture:
        return PairMixture(
            self.strangers[index], self.together[index], self.usual_m[index], self.sigma_m[index], self.instance_weight
        )


def pair_mixture(relation: Relation, area_m2: float, category_weight: float = 0.5) -> PairMixture:
    """The mixture (shape ()) of one related pair in a place of some area, with w1 the category's weight."""
    strangers = category_weight * (1.0 - relation.strength)
    together = category_weight * relation.strength / relation.mean_bell(area_m2)
    values = (strangers, together, relation.distance_m, relation.sigma_m)
    arrays = [np.asarray(value, dtype=np.float64) for value in values]
    return PairMixture(arrays[0], arrays[1], arrays[2], arrays[3], 1.0 - category_weight)


def plane_integral(distance_m: float, sigma_m: float) -> float:
    """Z(m, s), square metres: the integral of exp(-(d - m)^2 / 2 s^2) over the plane, d from a point of it."""
    m, s = distance_m, sigma_m  # in polar coordinates
    tail = m * s * math.sqrt(0.5 * math.pi) * (1.0 + math.erf(m / (s * math.sqrt(2.0))))
    return 2.0 * math.pi * (s * s * math.exp(-0.5 * (m / s) ** 2) + tail)


def relation_table(names: Sequence[str], categories: Sequence[str], relations: CategoryRelations) -> PairMixture:
    """The mixtures (C, C) of all pairs of C classes, by their names and categories; an empty category has no kin."""
    classes = list(zip(names, categories, strict=True))
    pairs = [
        pair_mixture(_related(a, b, relations), relations.area_m2, relations.category_weight)
        for a in classes
        for b in classes
    ]
    parts = np.array([(p.strangers, p.together, p.usual_m, p.sigma_m) for p in pairs]).reshape(len(names), -1, 4)
    weight = 1.0 - relations.category_weight
    return PairMixture(parts[..., 0], parts[..., 1], parts[..., 2], parts[..., 3], weight)


def _related(a: tuple[str, str], b: tuple[str, str], relations: CategoryRelations) -> Relation:
    named = {frozenset(pair[:2]): pair[2] for pair in relations.pairs}
    for x, y in ((a[0], b[0]), (a[0], b[1]), (a[1], b[0]), (a[1], b[1])):
        if frozenset((x, y)) in named:
            return named[frozenset((x, y))]
    return relations.same_category if a[1] and a[1] == b[1] else Relation(strength=0.0)


def pair_distance(T_a: ArrayLike, T_b: ArrayLike, centre_a: ArrayLike, centre_b: ArrayLike) -> Array:
    """Distance (...) in metres between the centres (..., 3), object frames, of objects at T_a and T_b (..., 4, 4)."""
    return pair_distance_jacobians(T_a, T_b, centre_a, centre_b)[0]


def pair_distance_jacobians(
    T_a: ArrayLike, T_b: ArrayLike, centre_a: ArrayLike, centre_b: ArrayLike
) -> tuple[Array, Array, Array]:
    """`pair_distance` (...) and its gradients (..., 6) for right perturbations of T_a and of T_b.

    Where the centres coincide the distance has a kink; the gradients are 0 there.
    """
    A, B = np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64)
    a, b = np.asarray(centre_a, dtype=np.float64), np.asarray(centre_b, dtype=np.float64)
    apart = se3.transform(B, b[..., None, :])[..., 0, :] - se3.transform(A, a[..., None, :])[..., 0, :]
    distance = np.linalg.norm(apart, axis=-1)
    direction = apart / np.where(distance > 0, distance, 1.0)[..., None]
    return distance, -_along(A, a, direction), _along(B, b, direction)


def _along(T: Array, point: Array, direction: Array) -> Array:
    """How fast T exp(xi) point moves along a world direction: the gradient (..., 6) by xi."""
    local = (np.swapaxes(T[..., :3, :3], -1, -2) @ direction[..., None])[..., 0]
    return np.concatenate([np.cross(point, local), local], axis=-1)


def context_log_ratio(distance_m: ArrayLike, pair: PairMixture, instance: ArrayLike = 0.0) -> Array:
    """The log of (w1 phi_cat + w2 phi_ins) / phi_background of pairs at a distance.

    Args:
        distance_m: (...) between the pair's centres.
        pair: of their classes, (...).
        instance: (...) log(phi_ins / phi_background), nats; 0 while nothing is known of the pair in this place.

    Returns:
        (...) nats; 0 for unrelated pairs. `context_residual` has the derivative.
    """
    x = (np.asarray(distance_m, dtype=np.float64) - pair.usual_m) / pair.sigma_m
    base = pair.strangers + pair.instance_weight * np.exp(np.asarray(instance, dtype=np.float64))
    return np.log(base + pair.together * np.exp(-0.5 * x * x))


def context_residual(distance_m: ArrayLike, pair: PairMixture, instance: ArrayLike = 0.0) -> tuple[Array, Array, Array]:
    """The context as a least-squares residual e in the distance: context_log_ratio = peak - 1/2 e^2.

    The energy of the mixture has one minimum in d, at the usual distance; its signed square root, negative nearer and
    positive farther, is smooth there, where the square root alone would have a kink.

    Returns:
        e (...), its derivative by the distance (...), and the peak (...) in nats, the constant that e leaves out.
    """
    x = (np.asarray(distance_m, dtype=np.float64) - pair.usual_m) / pair.sigma_m
    base = pair.strangers + pair.instance_weight * np.exp(np.asarray(instance, dtype=np.float64))
    high = pair.together
    bell = np.exp(-0.5 * x * x)
    now = base + high * bell
    e = np.sign(x) * np.sqrt(2.0 * np.log1p(-high * np.expm1(-0.5 * x * x) / now))
    # d(e^2 / 2) = e de; where e vanishes its slope is the root of the curvature
    flat = np.abs(x) < 1e-6
    slope = high * bell * x / (now * np.where(flat | (e == 0), 1.0, e))
    return e, np.where(flat, np.sqrt(high / (base + high)), slope) / pair.sigma_m, np.log(base + high)


def falling_residual(
    distance_m: ArrayLike, pair: PairMixture, square: ArrayLike, freedom: float, weight: float, log_gain: ArrayLike
) -> tuple[Array, Array, Array]:
    """What an instance level that falls off like a Student t's takes from the context at its peak, as a residual.

    With phi_ins / phi_background = left + gain (1 + q / k)^-m, context_log_ratio(d, q) = context_log_ratio(d, 0) - F,
    and F = 1/2 |f x|^2 for the t's whitened residual x, q = |x|^2: of one minimum, smooth there, and of as many rows as
    x, so that its curvature is known along all of them.

    Args:
        distance_m: (...) d, metres.
        pair: of the classes, with what is left of the instance level in its `strangers`, (...).
        square: (...) q.
        freedom: k.
        weight: m.
        log_gain: (...) of the gain, w2 included.

    Returns:
        f (...), and its derivatives by q and by d (...).
    """
    q = np.asarray(square, dtype=np.float64)
    x = (np.asarray(distance_m, dtype=np.float64) - pair.usual_m) / pair.sigma_m
    bell = pair.together * np.exp(-0.5 * x * x)
    rest, gain = pair.strangers + bell, np.exp(np.asarray(log_gain, dtype=np.float64))
    share = gain / (rest + gain)
    lost = -np.expm1(-weight * np.log1p(q / freedom))
    F = -np.log1p(-share * lost)
    slope_q = share * (1.0 - lost) * weight / (freedom + q) / (1.0 - share * lost)
    slope_d = share * lost / (1.0 - share * lost) / (rest + gain) * bell * x / pair.sigma_m
    small = q < _NEAR_PEAK
    safe = np.where(small, 1.0, q)
    f = np.sqrt(2.0 * np.where(small, slope_q, F / safe))
    by_q = np.where(small, 0.0, (slope_q / safe - F / safe**2) / f)
    by_d = np.where(small, 0.0, slope_d / safe / f)
    return f, by_q, by_d


def hinge_residual(excess_m: ArrayLike, sigma_m: ArrayLike) -> tuple[Array, Array]:
    """max(0, excess) / sigma (...) and its derivative by the excess (...): the residual of `hinge_log_potential`.

    The excess is how deep two objects intersect, or how high one floats above what carries it; below 0 all is well.
    """
    excess, sigma = np.asarray(excess_m, dtype=np.float64), np.asarray(sigma_m, dtype=np.float64)
    return np.maximum(excess, 0.0) / sigma, np.where(excess > 0.0, 1.0 / sigma, 0.0)


def hinge_log_potential(excess_m: ArrayLike, sigma_m: ArrayLike) -> Array:
    """-1/2 (max(0, excess) / sigma)^2 (...) nats, of a penetration depth or a gap to the support, metres."""
    return -0.5 * hinge_residual(excess_m, sigma_m)[0] ** 2


def doubted(log_potential: ArrayLike, doubt: float) -> Array:
    """The log of (1 - doubt) exp(log_potential) + doubt (...): a potential whose premise may be false, nats.

    A neighbour is a point estimate of the keyframe before, and a surface is a plane that was fitted: either may not be
    there. What contradicts them is then charged log(doubt) at most.
    """
    return np.logaddexp(np.log1p(-doubt) + np.asarray(log_potential, dtype=np.float64), np.log(doubt))


def per_keyframe(log_ratio: ArrayLike, keyframes: ArrayLike) -> Array:
    """The share log_ratio / n of each of the n keyframes over which a pair stands; a residual's is e / sqrt(n)."""
    return np.asarray(log_ratio, dtype=np.float64) / np.asarray(keyframes, dtype=np.float64)
