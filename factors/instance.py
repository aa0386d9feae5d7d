"""phi_ins of Equation 5: how two things of one place stood to each other in other visits.

The relative pose X = T_a^-1 T_b of two objects, one observation a visit, is Gaussian about a mean that the place has,
with mean and covariance unknown. Under a Normal-inverse-Wishart prior (Gelman et al., Bayesian Data Analysis, 3.6),
flat in the mean, what n visits predict of another is a Student t in d dimensions,

    t(r; 0, Psi_n (n + 1) / (n k), k),     k = nu_n - d + 1,    nu_n = nu_0 + n,    Psi_n = Psi_0 + scatter,

r being the tangent from the mean to X. Nothing is known before the first observation: phi_ins / phi_background = 1.

Both objects have symmetries, so X is known up to X -> g_a^-1 X g_b. On the right the residual of `factors.symmetry`
takes them out. On the left, discrete ones are tried, and the one that makes the density greatest is taken; about a
continuous axis a is turned until b's centre lies in one half-plane of a, which takes out one dimension. What has no
orientation at all (a ball) must be b, where it loses three.

The background, to which it is a ratio, is a thing that was moved and put down somewhere else. Gravity says how high it
is then and how it is tilted: only where in the plane it stands and with what yaw is news, three unknowns of six,
uniform over an area and a full turn. Against b anywhere in a volume, anyhow turned, two things that stand upright on
one surface would gain several nats by gravity alone.

What stayed is no news either (Equation 3), and what was moved was moved together with one partner at most. So a thing
with n neighbours that were moved as well has for its place the mixture

    (1 - 1/n) phi_background + 1/n phi_ins                                                        `among_log_ratio`

of its partner, the one of the n that it suits best: one fact, however many stood around. Who has been moved, and whose
partner is whose, is for the estimators to say (`ctmap_gtsam.frontend.company`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln

from factors.symmetry import Symmetry, residual_jacobians
from sequences import se3
from sequences.options import option

Array = NDArray[np.float64]

_ROUNDS = 20
_SETTLED = 1e-10
_LEAST_M = 1e-6  # nearer to a's axis b has no azimuth
_SAME_UP = 0.99  # cosine between up before and after a turn that leaves a thing standing as it stood
_SHOWN = 0.5  # least share of an in-plane motion that the coordinates show


@dataclass(frozen=True)
class InstancePrior:
    """What is believed of a pair before it was seen: as if so many visits had shown such a spread."""

    rotation_rad: float = option(0.15, "standard deviation about each axis, rad", low=1e-3)
    translation_m: float = option(0.05, "the same in each direction, metres", low=1e-4)
    visits: float = option(2.0, "how many visits that is worth; fewer give heavier tails", low=0.1)
    area_m2: float = option(4.0, "where else a thing that was moved may stand, square metres", low=1e-3)


@dataclass(frozen=True, eq=False)
class InstanceRelation:
    """What n other visits predict of a pair in this one."""

    T_a_b: Array
    """(4, 4) mean relative pose"""
    basis: Array
    """(d, 6): residual of the relative pose, in b's tangent -> the coordinates that mean something"""
    precision: Array
    """(d, d) inverse of the scale matrix of the Student t"""
    freedom: float
    """its degrees of freedom k"""
    log_background: float
    """log density of the background in the same coordinates"""

    @property
    def log_peak(self) -> float:
        """log(phi_ins / phi_background) where the pair stands as it did on average, nats."""
        return _log_peak(self.precision, self.freedom) - self.log_background


def instance_relation(
    T_a: ArrayLike,
    T_b: ArrayLike,
    symmetry_a: Symmetry,
    symmetry_b: Symmetry,
    up: ArrayLike,
    prior: InstancePrior | None = None,
) -> InstanceRelation:
    """What is learned from n visits, those in which the pair is not being scored.

    Args:
        T_a: (n, 4, 4) poses in one frame a visit, n at least 1.
        T_b: (n, 4, 4) the same.
        symmetry_a: of the first; it may have one free axis, not all.
        symmetry_b: of the second.
        up: (3,) in the frame of the first visit.
        prior: None = the default.
    """
    prior = prior or InstancePrior()
    A, B = np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64)
    if symmetry_a.free == 3:
        raise ValueError("what has no orientation can't be the first of a pair")
    # isotropic about b's centre, so that it doesn't matter in which image b is written
    spread = np.repeat([prior.rotation_rad, prior.translation_m], [3 - symmetry_b.free, 3]) ** 2
    mean = _canonical(A[:1, None] @ symmetry_a.discrete[:1], B[:1, None], symmetry_a, symmetry_b)[0][0, 0]
    for _ in range(_ROUNDS):
        basis = _basis(mean, symmetry_a, symmetry_b)
        reduced = basis @ symmetry_b.lift
        covariance = np.asarray(reduced @ (spread[:, None] * reduced.T), dtype=np.float64)
        r = _residuals(A, B, mean, basis, np.asarray(np.linalg.inv(covariance)), symmetry_a, symmetry_b)[0]
        step = np.linalg.pinv(basis) @ (r @ basis.T).mean(axis=0)
        mean = se3.retract(mean, step)
        if np.abs(step).max() < _SETTLED:
            break
    n, x = len(A), r @ basis.T
    scatter = (x - x.mean(axis=0)).T @ (x - x.mean(axis=0))
    # of nu_0 = d + 1 + visits the prior's mean is Psi_0 / visits
    freedom = prior.visits + n + 2.0
    scale = (prior.visits * covariance + scatter) * (n + 1.0) / (n * freedom)
    precision = np.linalg.inv(scale)
    # the mean was found from the first visit's pose of b, and written in its frame
    up_b = B[0, :3, :3].T @ np.asarray(up, dtype=np.float64)
    background = _background(mean, basis, precision, freedom, up_b, symmetry_a, symmetry_b, prior)
    return InstanceRelation(mean, basis, precision, freedom, background)


def instance_log_ratio(
    T_a: ArrayLike, T_b: ArrayLike, relation: InstanceRelation, symmetry_a: Symmetry, symmetry_b: Symmetry
) -> Array:
    """log(phi_ins / phi_background) (...) nats of poses (..., 4, 4), which broadcast: for `context_log_ratio`."""
    return instance_log_ratio_jacobians(T_a, T_b, relation, symmetry_a, symmetry_b)[0]


def among_log_ratio(log_ratio: ArrayLike, candidates: ArrayLike) -> Array:
    """The log of 1 - 1/n + phi_ins / (n phi_background) (...): of n that were moved as well, the partner is one."""
    n = np.asarray(candidates, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(np.logaddexp(np.asarray(log_ratio, dtype=np.float64), np.log(n - 1.0)) - np.log(n))


def instance_log_ratio_jacobians(
    T_a: ArrayLike, T_b: ArrayLike, relation: InstanceRelation, symmetry_a: Symmetry, symmetry_b: Symmetry
) -> tuple[Array, Array, Array]:
    """`instance_log_ratio` (...) and its gradients (..., 6) for right perturbations of both poses."""
    x, J_a, J_b = instance_residual_jacobians(T_a, T_b, relation, symmetry_a, symmetry_b)
    pulled = (relation.precision @ x[..., None])[..., 0]
    square = np.einsum("...k,...k->...", x, pulled)
    weight = relation.freedom + x.shape[-1]
    slope = -weight / (relation.freedom + square)
    value = relation.log_peak - 0.5 * weight * np.log1p(square / relation.freedom)
    gradients = (slope[..., None] * np.einsum("...k,...kl->...l", pulled, J) for J in (J_a, J_b))
    return value, *gradients


def instance_residual_jacobians(
    T_a: ArrayLike, T_b: ArrayLike, relation: InstanceRelation, symmetry_a: Symmetry, symmetry_b: Symmetry
) -> tuple[Array, Array, Array]:
    """How far a pair is from its mean (..., d), and the derivatives (..., d, 6) by right perturbations of both poses.

    With `relation.precision` it is the residual of the Student t; a graph holds it by re-weighting: at a residual x its
    energy has the slope of a Gaussian's of information (k + d) / (k + x' P x) P.
    """
    A, B = np.broadcast_arrays(np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64))
    basis = relation.basis
    r, J_a, J_b = _residuals(A, B, relation.T_a_b, basis, relation.precision, symmetry_a, symmetry_b)
    return (basis @ r[..., None])[..., 0], basis @ J_a, basis @ J_b


def _log_peak(precision: Array, freedom: float) -> float:
    """log density of a Student t at its mode."""
    d, k = len(precision), freedom
    volume = 0.5 * np.linalg.slogdet(precision)[1] - 0.5 * d * np.log(k * np.pi)
    return float(gammaln(0.5 * (k + d)) - gammaln(0.5 * k) + volume)


def _residuals(
    A: Array, B: Array, mean: Array, basis: Array, precision: Array, symmetry_a: Symmetry, symmetry_b: Symmetry
) -> tuple[Array, Array, Array]:
    """log(mean^-1 X) (..., 6) of the image of a that is nearest by `precision`, and derivatives (..., 6, 6)."""
    images = symmetry_a.discrete
    X, turned_a, turned_b = _canonical(A[..., None, :, :] @ images, B[..., None, :, :], symmetry_a, symmetry_b)
    r, _, J = residual_jacobians(mean, X, symmetry_b)
    x = (basis @ r[..., None])[..., 0]
    best = np.argmin(np.einsum("...k,kl,...l->...", x, precision, x), axis=-1)
    r, J, X, turned_a, turned_b = (_chosen(v, best) for v in (r, J, X, turned_a, turned_b))
    # X = A'^-1 B: what moves a' moves X the other way, seen from b
    by_turn = -J @ se3.adjoint(se3.inverse(X))
    moved_a = by_turn @ turned_a @ se3.adjoint(se3.inverse(images[best]))
    return r, moved_a, J + by_turn @ turned_b


def _chosen(values: Array, best: NDArray[np.int64]) -> Array:
    """Of values (..., S, *shape) those of image `best` (...)."""
    index = best.reshape(*best.shape, *(1,) * (values.ndim - best.ndim))
    return np.take_along_axis(values, index, axis=best.ndim).squeeze(best.ndim)


def _canonical(A: Array, B: Array, symmetry_a: Symmetry, symmetry_b: Symmetry) -> tuple[Array, Array, Array]:
    """A'^-1 B with a' = a turned about its free axis until b's centre lies in the half-plane of its first direction.

    Returns:
        (..., 4, 4), and how a' moves in its own tangent with a and with b: (..., 6, 6) twice.
    """
    X = se3.inverse(A) @ B
    if not symmetry_a.free:
        shape = (*X.shape[:-2], 6, 6)
        return X, np.broadcast_to(np.eye(6), shape), np.zeros(shape)
    generator, (e1, e2) = symmetry_a.generators[:, 0], _across(symmetry_a)
    at = se3.transform(X, symmetry_b.centre[None])[..., 0, :]
    out = at - symmetry_a.centre
    along, aside = out @ e1, out @ e2
    square = along**2 + aside**2
    T_turn = se3.exp(np.where(square > _LEAST_M**2, np.arctan2(aside, along), 0.0)[..., None] * generator)
    slope = along[..., None] * e2 - aside[..., None] * e1
    slope = np.divide(slope, square[..., None], out=np.zeros_like(slope), where=square[..., None] > _LEAST_M**2)
    # the azimuth's derivatives by a and by b: (..., 6)
    by_a = np.concatenate([np.cross(slope, at), -slope], axis=-1)
    local = (np.swapaxes(X[..., :3, :3], -1, -2) @ slope[..., None])[..., 0]
    by_b = np.concatenate([np.cross(np.broadcast_to(symmetry_b.centre, local.shape), local), local], axis=-1)
    back = se3.inverse(T_turn)
    turned_a = se3.adjoint(back) + generator[:, None] * by_a[..., None, :]
    return back @ X, turned_a, generator[:, None] * by_b[..., None, :]


def _across(symmetry: Symmetry) -> Array:
    """(2, 3) two directions across the free axis: right-handed with it."""
    u = symmetry.generators[:3, 0]
    e1 = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
    e1 /= np.linalg.norm(e1)
    return np.stack([e1, np.cross(u, e1)])


def _basis(mean: Array, symmetry_a: Symmetry, symmetry_b: Symmetry) -> Array:
    """(d, 6): what is left of a residual without b's free directions, and without b's azimuth about a's free axis."""
    P = symmetry_b.projection
    if not symmetry_a.free:
        return P
    azimuth = np.concatenate([np.zeros(len(P) - 3), mean[:3, :3].T @ _across(symmetry_a)[1]])
    left = np.linalg.svd(azimuth[None])[2][1:]
    return np.asarray(left @ P)


def _background(
    mean: Array,
    basis: Array,
    precision: Array,
    freedom: float,
    up_b: Array,
    symmetry_a: Symmetry,
    symmetry_b: Symmetry,
    prior: InstancePrior,
) -> float:
    """log density, in the reduced coordinates, of b put down anywhere in the plane with any yaw.

    It is as high and as tilted as the mean has it. Both have the density that the Student t gives them, so the ratio is
    that of the t's conditional in the plane to a uniform one: itself a Student t, of more degrees of freedom.
    """
    in_plane = np.linalg.svd(up_b[None])[2][1:]
    motions = np.zeros((6, 3))
    motions[:3, 0], motions[3:, 0] = up_b, np.cross(symmetry_b.centre, up_b)
    motions[3:, 1:] = in_plane.T
    meant = int((np.linalg.svd(symmetry_b.projection @ motions)[1] > _SHOWN).sum())
    axes, shares, _ = np.linalg.svd(basis @ motions, full_matrices=False)
    axes, shares = axes[:, shares > _SHOWN], shares[shares > _SHOWN]
    d, n = len(precision), len(shares)
    sliced_freedom = freedom + d - n
    sliced = axes.T @ precision @ axes * (sliced_freedom / freedom)
    log_uniform = -np.log(prior.area_m2) - np.log(shares).sum()
    log_uniform += np.log(_upright(symmetry_a, mean[:3, :3] @ up_b) * _upright(symmetry_b, up_b))
    if meant == len(motions.T):
        log_uniform -= np.log(2.0 * np.pi)
    if n < meant:
        log_uniform += _log_ring(mean, symmetry_a, symmetry_b)
    return _log_peak(precision, freedom) - _log_peak(sliced, sliced_freedom) + float(log_uniform)


def _upright(symmetry: Symmetry, up: Array) -> int:
    """How many of the discrete symmetries are turns about the vertical (3,), given in the object's frame."""
    return int((symmetry.discrete[:, :3, :3] @ up @ up > _SAME_UP).sum())


def _log_ring(mean: Array, symmetry_a: Symmetry, symmetry_b: Symmetry) -> float:
    """The log of the length of the ring of azimuths that are one: as long as it is round."""
    out = se3.transform(mean, symmetry_b.centre[None])[0] - symmetry_a.centre
    return float(np.log(2.0 * np.pi * max(float(np.linalg.norm(_across(symmetry_a) @ out)), _LEAST_M)))
