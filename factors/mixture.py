"""Gaussians in information form, and mixtures of them: the one place that knows their normalisers.

A Gaussian over a residual r of dimension d with information L has

    log N(r) = c(L) - 1/2 r^T L r,          c(L) = 1/2 log det(L / 2 pi)

and a mixture's mode costs 1/2 r^T L r - c(L) - log w. Leaving c(L) out is the classic mistake with mixtures: the widest
mode then wins everywhere, because its quadratic term is always the smallest. GTSAM calls -c(L) `negLogConstant`.

Densities over poses are per rad^3 m^3 of the right tangent [rotation, translation]; SO(3) then has volume 8 pi^2. Every
mixture of measurement modes holds one broad null mode, so that a wrong mode can be given up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sequences import se3

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LOG_2PI = float(np.log(2.0 * np.pi))
LOG_ROTATIONS = float(np.log(8.0 * np.pi**2))
"""log of the volume of SO(3), rad^3"""


def squared_distance(residuals: ArrayLike, informations: ArrayLike) -> Array:
    """r^T L r for r (..., d) and L (..., d, d) -> (...)."""
    r, information = np.asarray(residuals, dtype=np.float64), np.asarray(informations, dtype=np.float64)
    return (r[..., None, :] @ information @ r[..., :, None])[..., 0, 0]


def log_constant(informations: ArrayLike) -> Array:
    """c(L) = 1/2 log det(L / 2 pi) for L (..., d, d) -> (...); -inf where L leaves a direction without information."""
    information = np.asarray(informations, dtype=np.float64)
    sign, log_determinant = np.linalg.slogdet(information)
    return np.where(sign > 0, 0.5 * (log_determinant - information.shape[-1] * LOG_2PI), -np.inf)


def gaussian_log_density(residuals: ArrayLike, informations: ArrayLike) -> Array:
    """The log of N(r; 0, L^-1), for r (..., d) and L (..., d, d) -> (...) nats."""
    return log_constant(informations) - 0.5 * squared_distance(residuals, informations)


def log_sum(log_values: ArrayLike, axis: int = -1) -> Array:
    """The log of the sum of exp along an axis; -inf over an empty axis or where every value is -inf."""
    return np.asarray(np.logaddexp.reduce(np.asarray(log_values, dtype=np.float64), axis=axis))


def normalised(log_weights: ArrayLike, axis: int = -1) -> Array:
    """Log weights shifted so that they sum to one along an axis; uniform where every one is -inf."""
    values = np.asarray(log_weights, dtype=np.float64)
    total = np.logaddexp.reduce(values, axis=axis, keepdims=True)
    dead = total == -np.inf
    if not dead.any():
        return np.asarray(values - total)
    return np.where(dead, -np.log(values.shape[axis]), values - np.where(dead, 0.0, total))


def mode_log_densities(residuals: ArrayLike, informations: ArrayLike, log_weights: ArrayLike) -> Array:
    """The modes' log w_k + log N(r_k; 0, L_k^-1), for r (..., K, d), L (..., K, d, d), log w (..., K) -> (..., K)."""
    return np.asarray(log_weights, dtype=np.float64) + gaussian_log_density(residuals, informations)


def mixture_log_density(residuals: ArrayLike, informations: ArrayLike, log_weights: ArrayLike) -> Array:
    """The log of sum_k w_k N(r_k; 0, L_k^-1): shapes as in `mode_log_densities` -> (...)."""
    return log_sum(mode_log_densities(residuals, informations, log_weights))


def select_mode(residuals: ArrayLike, informations: ArrayLike, log_weights: ArrayLike) -> tuple[Ints, Array]:
    """The mode that explains a residual best: argmin_k 1/2 r_k^T L_k r_k - c(L_k) - log w_k.

    Args:
        residuals: (..., K, d), each mode's own residual.
        informations: (..., K, d, d).
        log_weights: (..., K).

    Returns:
        index (...) and energy (...) of the best mode, nats; ties go to the first.
    """
    energies = -mode_log_densities(residuals, informations, log_weights)
    best = np.argmin(energies, axis=-1)
    return best, np.take_along_axis(energies, best[..., None], axis=-1)[..., 0]


def product(means: ArrayLike, informations: ArrayLike) -> tuple[Array, Array, Array]:
    """The product of K Gaussians over one vector: what independent measurements say together.

    Args:
        means: (..., K, d).
        informations: (..., K, d, d), their sum regular.

    Returns:
        mean (..., d), information (..., d, d), and the log of the product's integral (...), which is the evidence that
        the K agree (-inf where one of them is improper). For K = 2 this is the Kalman update.
    """
    m, information = np.asarray(means, dtype=np.float64), np.asarray(informations, dtype=np.float64)
    total = information.sum(axis=-3)
    mean = np.linalg.solve(total, (information @ m[..., None]).sum(axis=-3))[..., 0]
    at_mean = gaussian_log_density(mean[..., None, :] - m, information).sum(axis=-1)
    return mean, total, at_mean - log_constant(total)


def moment_match(
    T: ArrayLike, covariances: ArrayLike | None, log_weights: ArrayLike, iterations: int = 10
) -> tuple[Array, Array]:
    """One pose and covariance with the first two moments of a mixture on SE(3), in the tangent at its mean.

    Args:
        T: (..., K, 4, 4) the modes, symmetric images already brought together.
        covariances: (..., K, 6, 6) of the right tangent at each mode; None for points.
        log_weights: (..., K), of any scale.
        iterations: fixed-point steps for the mean; few modes within a turn of each other need fewer than five.

    Returns:
        T_mean (..., 4, 4) and covariance (..., 6, 6).
    """
    modes = np.asarray(T, dtype=np.float64)
    weights = np.exp(normalised(log_weights))[..., None]
    heaviest = np.argmax(weights[..., 0], axis=-1)
    mean = np.take_along_axis(modes, heaviest[..., None, None, None], axis=-3)[..., 0, :, :]
    for _ in range(iterations):
        mean = se3.retract(mean, (weights * se3.local(mean[..., None, :, :], modes)).sum(axis=-2))
    tangents = se3.local(mean[..., None, :, :], modes)
    between = np.swapaxes(weights * tangents, -1, -2) @ tangents
    if covariances is None:
        return mean, between
    J = se3.right_jacobian_inverse(tangents)
    within = J @ np.asarray(covariances, dtype=np.float64) @ np.swapaxes(J, -1, -2)
    return mean, (weights[..., None] * within).sum(axis=-3) + between


def null_information(rotation_sigma_rad: float = np.pi, translation_sigma_m: float = 1.0) -> Array:
    """(6, 6) information of the broad null mode: what is still believed when every proper mode is wrong."""
    return np.diag(np.repeat([rotation_sigma_rad, translation_sigma_m], 3) ** -2.0)


def square_root(information: ArrayLike, relative_floor: float = 1e-12) -> Array:
    """R (..., d, d) with R^T R = L (..., d, d): a whitener, whose row is zero for each direction in which L is flat.

    Eigenvalues below `relative_floor` of the largest count as none.
    """
    values, vectors = np.linalg.eigh(np.asarray(information, dtype=np.float64))
    kept = values > relative_floor * np.maximum(values[..., -1:], 0.0)
    return np.sqrt(np.where(kept, values, 0.0))[..., None] * np.swapaxes(vectors, -1, -2)
