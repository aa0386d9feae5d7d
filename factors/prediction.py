"""The prediction potential phi_p for an object in view: it stays, but for small motions (Equation 2).

The paper writes phi_p = exp(-(o_t - o_t-1)^T Sigma^-1 (o_t - o_t-1)), without the 1/2 and without a normaliser, and
with one Sigma for every step. Here the difference of poses is the tangent r = log(T_a^-1 T_b) in the earlier pose's
frame, and the potential is a density,

    log phi_p = -1/2 r^T Sigma^-1 r - 1/2 log det(2 pi Sigma),          Sigma = Q dt

because a mode that spreads wide must pay for it when it stands beside others in a mixture, and because with one Sigma
for every step the same second of waiting would be ten times as uncertain at ten times the frame rate. The paper's Sigma
is twice ours: its exponent has no 1/2. `paper_log_potential` is the literal form.

Q is a rate in rad^2/s and m^2/s, isotropic about the object's centre of symmetry (so that the potential doesn't depend
on which of the equivalent poses is meant), and written in the object's tangent [rotation, translation], right
perturbation. For an object out of view see `factors.persistence`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors import mixture
from factors.mixture import squared_distance
from factors.symmetry import NONE, Symmetry, reduced_residual_jacobians, residual
from sequences import se3

Array = NDArray[np.float64]

_STEEPEST = 100.0  # of a derivative of the residual, by rad and metres


def covariance(
    rotation_rad2_per_s: float, translation_m2_per_s: float, dt_s: ArrayLike, symmetry: Symmetry = NONE
) -> Array:
    """Sigma = Q dt in the object's tangent.

    Args:
        rotation_rad2_per_s: Q of each rotation about the object's centre.
        translation_m2_per_s: Q of each direction of the centre.
        dt_s: (...) seconds, > 0.
        symmetry: of the object; its centre is where Q is isotropic.

    Returns:
        (..., 6, 6).
    """
    rate = np.diag(np.repeat([rotation_rad2_per_s, translation_m2_per_s], 3))
    to_object = se3.adjoint(symmetry.T_object_centre)
    return np.asarray(dt_s, dtype=np.float64)[..., None, None] * (to_object @ rate @ to_object.T)


def log_potential(T_a: ArrayLike, T_b: ArrayLike, sigma: ArrayLike, symmetry: Symmetry = NONE) -> Array:
    """The log of phi_p: the density of T_b given T_a, over SE(3) modulo the object's symmetries.

    Args:
        T_a: (..., 4, 4) T_world_object before.
        T_b: (..., 4, 4) T_world_object after; the shapes broadcast.
        sigma: (..., 6, 6) from `covariance`.
        symmetry: of the object.

    Returns:
        (...) nats, per rad^3 m^3 (a power less for every free direction).
    """
    return mixture.gaussian_log_density(*_reduced(T_a, T_b, sigma, symmetry))


def exponent(T_a: ArrayLike, T_b: ArrayLike, sigma: ArrayLike, symmetry: Symmetry = NONE) -> Array:
    """-1/2 r^T Sigma^-1 r (...): `log_potential` relative to its greatest value, minus the energy of its factor."""
    return -0.5 * squared_distance(*_reduced(T_a, T_b, sigma, symmetry))


def _reduced(T_a: ArrayLike, T_b: ArrayLike, sigma: ArrayLike, symmetry: Symmetry) -> tuple[Array, Array]:
    """The residual (..., 6 - f) without free directions, and its information (..., 6 - f, 6 - f)."""
    information = np.linalg.inv(np.asarray(sigma, dtype=np.float64))
    r = residual(T_a, T_b, symmetry, information)
    reduced = np.linalg.inv(symmetry.reduced_covariance(sigma))
    return (symmetry.projection @ r[..., None])[..., 0], np.asarray(reduced, dtype=np.float64)


def log_potential_jacobians(
    T_a: ArrayLike, T_b: ArrayLike, sigma: ArrayLike, symmetry: Symmetry = NONE
) -> tuple[Array, Array, Array]:
    """`log_potential` (...) and its gradients (..., 6) for right perturbations of T_a and of T_b."""
    r, J_a, J_b = reduced_residual_jacobians(T_a, T_b, symmetry, np.linalg.inv(np.asarray(sigma, np.float64)))
    information = np.linalg.inv(symmetry.reduced_covariance(sigma))
    pull = -(information @ r[..., None])[..., 0][..., None, :]
    return mixture.gaussian_log_density(r, information), (pull @ J_a)[..., 0, :], (pull @ J_b)[..., 0, :]


def integrated_log_potential(
    T_a: ArrayLike,
    covariance_a: ArrayLike,
    T_b: ArrayLike,
    covariance_b: ArrayLike,
    sigma: ArrayLike,
    symmetry: Symmetry = NONE,
) -> Array:
    """The log of phi_p, integrated over a Gaussian around each pose: how well two uncertain modes make one object.

    To first order log N(r; 0, Sigma + J_a S_a J_a^T + J_b S_b J_b^T). Comparing the modes' best poses instead would ask
    more of precise modes than of vague ones.

    Args:
        T_a: (..., 4, 4).
        covariance_a: (..., 6, 6) of the right tangent at T_a.
        T_b: (..., 4, 4).
        covariance_b: (..., 6, 6) of the right tangent at T_b.
        sigma: (..., 6, 6) from `covariance`.
        symmetry: of the object.

    Returns:
        (...) nats.
    """
    r, J_a, J_b = reduced_residual_jacobians(T_a, T_b, symmetry, np.linalg.inv(np.asarray(sigma, np.float64)))
    total = symmetry.reduced_covariance(sigma)
    # turning an object about its free axis only turns the residual with it, which no isotropic Sigma notices
    meant = np.eye(6) - symmetry.generators @ symmetry.reader
    for J, spread in ((J_a @ meant, covariance_a), (J_b @ meant, covariance_b)):
        # where free axes are opposite every turn is as near as any, and the derivative has no bound and no meaning
        J = np.clip(J, -_STEEPEST, _STEEPEST)
        total = total + J @ np.asarray(spread, dtype=np.float64) @ np.swapaxes(J, -1, -2)
    return mixture.gaussian_log_density(r, np.linalg.inv(total))


def paper_log_potential(T_a: ArrayLike, T_b: ArrayLike, paper_sigma: ArrayLike, symmetry: Symmetry = NONE) -> Array:
    """The literal log of Equation 2, -r^T Sigma^-1 r: no 1/2, no normaliser; the paper's Sigma is twice ours.

    Shapes as in `log_potential`; `paper_sigma` (..., 6, 6) belongs to one step, whatever its duration.
    """
    information = np.linalg.inv(np.asarray(paper_sigma, dtype=np.float64))
    return -squared_distance(residual(T_a, T_b, symmetry, information), information)


def sample(T: ArrayLike, sigma: ArrayLike, normals: ArrayLike) -> Array:
    """Draws from phi_p: T (..., 4, 4), sigma (..., 6, 6), standard normals (..., 6) -> (..., 4, 4)."""
    root = np.linalg.cholesky(np.asarray(sigma, dtype=np.float64))
    steps = (root @ np.asarray(normals, dtype=np.float64)[..., None])[..., 0]
    return se3.retract(np.asarray(T, dtype=np.float64), steps)
