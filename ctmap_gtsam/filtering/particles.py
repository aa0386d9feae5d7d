"""Weighted poses of one class, and the steps of a marginal particle filter on them.

The next particles are drawn from a mixture of the prediction and of proposals around the score's modes, and weighted by

    w = [ sum_k w_k phi_p(x | x_k) ] phi_m(x) / q(x)

with the whole previous set in the numerator (the marginal particle filter of Klaas, de Freitas and Doucet, UAI 2005),
so that a particle may come from a proposal that never saw its predecessor. With q equal to the prediction this is
Algorithm 1. The mean weight is the evidence p(z_t | z_1:t-1) of the class.

The prediction is isotropic about the object's centre, so phi_p is a Gaussian in the chord between two rotations and in
the distance between two centres: exact to second order, and a matrix product for all pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ctmap_gtsam.shapes import Shape
from factors import mixture, symmetry
from factors.mixture import LOG_2PI
from sequences import se3

Array = NDArray[np.float64]

MODE_RADIUS = (0.3, 0.02)
"""rad, metres: particles so near to the heaviest make up its mode"""


@dataclass(frozen=True)
class Particles:
    """M weighted poses of one class."""

    T_world_centre: Array
    """(M, 4, 4)"""
    log_weight: Array
    """(M,) normalised"""

    @property
    def effective(self) -> float:
        """Effective sample size, 1 to M."""
        return float(1.0 / np.exp(2.0 * self.log_weight).sum())

    def best(self, n: int) -> Array:
        """The n heaviest poses (n, 4, 4)."""
        return self.T_world_centre[np.argsort(-self.log_weight, kind="stable")[:n]]

    def resampled(self, n: int, uniform: float) -> Array:
        """n poses (n, 4, 4) by systematic resampling with one number in [0, 1)."""
        return self.T_world_centre[systematic(self.log_weight, n, uniform)]


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the prediction phi_p over one step, about the object's centre."""

    rotation_rad: float
    translation_m: float


@dataclass(frozen=True)
class Transition:
    """The prior under which M particles were weighed, given those before them."""

    spread: Spread
    may_jump: NDArray[np.bool_]
    """(M,) which of them may also come from anywhere nearby"""


@dataclass(frozen=True)
class Gaussians:
    """Proposals around modes: n poses with covariances of their right tangents."""

    T_world_centre: Array
    """(n, 4, 4)"""
    covariance: Array
    """(n, 6, 6)"""
    log_weight: Array
    """(n,) normalised"""

    def draw(self, count: int, shape: Shape, rng: np.random.Generator) -> Array:
        """(count, 4, 4); a free rotation is drawn uniformly."""
        picks = rng.choice(len(self.log_weight), size=count, p=np.exp(self.log_weight))
        roots = np.linalg.cholesky(self.covariance + 1e-14 * np.eye(6))
        steps = (roots[picks] @ rng.normal(size=(count, 6, 1)))[..., 0]
        return _spin(se3.retract(self.T_world_centre[picks], steps), shape, rng)

    def log_density(self, T: Array, shape: Shape) -> Array:
        """log q (K,) at poses (K, 4, 4), over poses modulo the object's symmetries."""
        S = shape.symmetry
        r = symmetry.residual(self.T_world_centre[None], T[:, None], S)
        reduced = (S.projection @ r[..., None])[..., 0]
        information = np.linalg.inv(S.reduced_covariance(self.covariance))
        return mixture.mixture_log_density(reduced, information, self.log_weight)


def systematic(log_weight: Array, n: int, uniform: float) -> NDArray[np.int64]:
    """n picks by systematic resampling of log weights (M,), with one number in [0, 1)."""
    edges = np.cumsum(np.exp(log_weight))
    picks = np.searchsorted(edges, (np.arange(n) + uniform) / n * edges[-1])
    return np.minimum(picks, len(edges) - 1)


def predict(particles: Particles, n: int, spread: Spread, shape: Shape, rng: np.random.Generator) -> Array:
    """Draw n poses (n, 4, 4) from the prediction of a weighted set."""
    start = particles.resampled(n, float(rng.random()))
    sigma = np.repeat([spread.rotation_rad, spread.translation_m], 3)
    return _spin(se3.retract(start, sigma * rng.normal(size=(n, 6))), shape, rng)


def predicted_log_density(particles: Particles, T: Array, spread: Spread, shape: Shape) -> Array:
    """log sum_k w_k phi_p(x | x_k) (K,) at poses (K, 4, 4), over poses modulo the object's symmetries."""
    squared, constant = _squared_steps(particles.T_world_centre, T, spread, shape)
    exponent = (particles.log_weight - 0.5 * squared).reshape(len(T), -1)
    return logsumexp(exponent, axis=-1) - constant


def transition_log_density(T_before: Array, T: Array, spread: Spread, shape: Shape) -> Array:
    """log phi_p(x | x_k) (K, M) of poses (K, 4, 4) given each pose before (M, 4, 4), modulo the object's symmetries."""
    squared, constant = _squared_steps(T_before, T, spread, shape)
    exponent = -0.5 * squared.reshape(len(T), -1, len(T_before))
    return (exponent[:, 0] if shape.symmetry.order == 1 else logsumexp(exponent, axis=1)) - constant


def _squared_steps(T_before: Array, T: Array, spread: Spread, shape: Shape) -> tuple[Array, float]:
    """-2 times the exponents of phi_p for every image of every pose (K S, M), and the log of its normaliser."""
    S = shape.symmetry
    # a pose and its predecessor may be written in different equivalent poses: sum over all of them
    images = (T[:, None] @ S.discrete).reshape(-1, 4, 4)
    a, b = _features(T_before, shape, spread), _features(images, shape, spread)
    squared = np.maximum((b**2).sum(-1)[:, None] + (a**2).sum(-1) - 2.0 * b @ a.T, 0.0)
    turns = 3 - S.free
    constant = turns * (np.log(spread.rotation_rad) + 0.5 * LOG_2PI)
    constant += 3 * (np.log(spread.translation_m) + 0.5 * LOG_2PI)
    return squared, float(constant)


def _features(T: Array, shape: Shape, spread: Spread) -> Array:
    """Poses (K, 4, 4) -> vectors (K, D) whose squared distance is -2 times the exponent of phi_p.

    Their rotations' part: |dR|^2 = 2 angle^2 for small angles.
    """
    axis = shape.symmetry.axes
    free = shape.symmetry.free
    if free == 0:
        turned = T[:, :3, :3].reshape(len(T), 9) / np.sqrt(2.0)
    elif free == 1:
        turned = T[:, :3, :3] @ axis[0]
    else:
        turned = np.zeros((len(T), 0))
    return np.concatenate([turned / spread.rotation_rad, T[:, :3, 3] / spread.translation_m], axis=-1)


def _spin(T: Array, shape: Shape, rng: np.random.Generator) -> Array:
    """Uniform over the free rotation: it has no meaning, and must not look as if it had."""
    if shape.symmetry.free != 1:
        return T
    angle = rng.uniform(-np.pi, np.pi, size=(len(T), 1))
    return T @ se3.make(se3.so3_exp(angle * shape.symmetry.axes[0]), np.zeros(3))


def modes_of(c: int, particles: Particles, shape: Shape) -> list[tuple[int, float, Array, Array, Array]]:
    """The heaviest particle's mode, moments matched, and the next one apart from it, if it weighs anything.

    Returns:
        class index `c`, log weight, T_world_centre (4, 4), covariance (6, 6) and free axes (6, f) of each.
    """
    out: list[tuple[int, float, Array, Array, Array]] = []
    left = particles.log_weight.copy()
    for _ in range(2):
        heaviest = int(np.argmax(left))
        if left[heaviest] < np.log(1e-3):
            break
        images = symmetry.nearest_image(particles.T_world_centre[heaviest], particles.T_world_centre, shape.symmetry)
        r = se3.local(particles.T_world_centre[heaviest], images)
        near = (np.linalg.norm(r[:, :3], axis=-1) < MODE_RADIUS[0]) & (
            np.linalg.norm(r[:, 3:], axis=-1) < MODE_RADIUS[1]
        )
        near &= np.isfinite(left)
        near[heaviest] = True
        T, covariance = mixture.moment_match(images[near], None, left[near], iterations=4)
        free = shape.symmetry.free_axes
        # no sample variance below a tenth of a millimetre is believed, and a free direction has the circle's
        covariance = covariance + 1e-8 * np.eye(6) + np.pi**2 * free @ free.T
        out.append((c, float(mixture.log_sum(left[near])), T, covariance, free))
        left[near] = -np.inf
    return out
