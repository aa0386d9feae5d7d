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

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ctmap_gtsam.model import Model, localisation_variance
from ctmap_gtsam.shapes import Shape
from factors import mixture, symmetry
from factors.mixture import LOG_2PI
from factors.motions import retract
from sequences import se3
from sequences.types import LocalisationNoise

Array = NDArray[np.float64]

MODE_RADIUS = (0.3, 0.02)
"""rad, metres: particles so near to the heaviest make up its mode"""

_RADII = np.repeat(MODE_RADIUS, 3)
_EDGE = 3.0  # standard deviations within which particles belong to a mode that spreads over its radius
_GROWTHS = 8  # of a mode, at most
_MEANS = 4  # fixed-point steps for a mean; poses of one mode need fewer than five
_MODES = 4  # of one class, at most
_LIGHT = 1e-3, 0.3  # weight, and share of the mean: a mode whose heaviest particle weighs less than both is none
_SPARSE = 2.0  # a kernel so much wider than the prediction closes gaps that the prediction would leave
_DIMENSIONS = 6
_NOTHING = 40.0  # nats: what is so far behind the largest adds nothing to a sum in float64
_SUPPORT = 4  # times as many points hold a belief whose gaps were filled: they cost a prior, not a likelihood
_CELL = (0.15, 0.01)  # rad, metres: sides of the cells that a belief's spread is counted in
_DIVERGENCE = 0.02  # nats that the particles' histogram over cells is off by at most ...
_SURE = 2.326  # ... with probability 0.99: its quantile of the normal distribution
_LEAST_SHARE = 1.0 / 3.0  # of the configured particles: within a cell they still tell mean and covariance
_STRETCHED = 4  # times as many where a mode stretches over cells: a tenth of them has any weight


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

    @property
    def heaviest(self) -> Array:
        """The heaviest pose (4, 4)."""
        return self.T_world_centre[int(np.argmax(self.log_weight))]

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
    log_elsewhere: Array
    """(M,) log density of what did not come from there by the prediction: pushed, or moved in an absence; -inf where
    that can't be"""


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
        return _spin(retract(self.T_world_centre[picks], steps), shape, rng)

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
    return _spin(retract(start, sigma * rng.normal(size=(n, 6))), shape, rng)


def predicted_log_density(particles: Particles, T: Array, spread: Spread, shape: Shape) -> Array:
    """log sum_k w_k phi_p(x | x_k) (K,) at poses (K, 4, 4), over poses modulo the object's symmetries."""
    before, after, constant = _steps(particles.T_world_centre, T, spread, shape)
    out = np.empty(len(T))
    _log_sums(before, after, particles.log_weight, shape.symmetry.order, out)
    return out - constant


def transition_log_density(T_before: Array, T: Array, spread: Spread, shape: Shape) -> Array:
    """log phi_p(x | x_k) (K, M) of poses (K, 4, 4) given each pose before (M, 4, 4), modulo the object's symmetries."""
    before, after, constant = _steps(T_before, T, spread, shape)
    squared = np.maximum((after**2).sum(-1)[:, None] + (before**2).sum(-1) - 2.0 * after @ before.T, 0.0)
    exponent = -0.5 * squared.reshape(len(T), -1, len(T_before))
    return (exponent[:, 0] if shape.symmetry.order == 1 else logsumexp(exponent, axis=1)) - constant


def _steps(T_before: Array, T: Array, spread: Spread, shape: Shape) -> tuple[Array, Array, float]:
    """Features of the poses before (M, D) and of all images of poses (K S, D), and the log of phi_p's normaliser."""
    S = shape.symmetry
    # a pose and its predecessor may be written in different equivalent poses: sum over all of them
    images = (T[:, None] @ S.discrete).reshape(-1, 4, 4)
    turns = 3 - S.free
    constant = turns * (np.log(spread.rotation_rad) + 0.5 * LOG_2PI)
    constant += 3 * (np.log(spread.translation_m) + 0.5 * LOG_2PI)
    return _features(T_before, shape, spread), _features(images, shape, spread), float(constant)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_sums(a, b, log_weight, images, out):
    """log of the sum over rows k of a (M, D) and over each query's images of exp(log_weight_k - |b - a_k|^2 / 2).

    `b` is (K images, D), D a multiple of three, the images of a query next to each other; `out` is (K,).
    """
    n, columns = len(a), np.ascontiguousarray(a.T)
    exponents = np.empty(images * n)
    for query in range(len(out)):
        for i in range(images):
            # three features at a time for all rows, which is vectorised
            squared, row = exponents[i * n : (i + 1) * n], query * images + i
            squared[:] = 0.0
            for d in range(0, len(columns), 3):
                x, y, z = b[row, d], b[row, d + 1], b[row, d + 2]
                xs, ys, zs = columns[d], columns[d + 1], columns[d + 2]
                for k in range(n):
                    squared[k] = squared[k] + (x - xs[k]) ** 2 + (y - ys[k]) ** 2 + (z - zs[k]) ** 2
            for k in range(n):
                squared[k] = log_weight[k] - 0.5 * squared[k]
        largest = _largest(exponents)
        total, least = 0.0, largest - _NOTHING
        for exponent in exponents:
            if exponent > least:
                total += math.exp(exponent - largest)
        out[query] = largest + math.log(total) if total > 0.0 else -np.inf


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _largest(values):
    """Of values (n,), by four at a time: each comparison waits for the one before."""
    a = b = c = d = -np.inf
    whole = len(values) // 4 * 4
    for k in range(0, whole, 4):
        a = values[k] if values[k] > a else a
        b = values[k + 1] if values[k + 1] > b else b
        c = values[k + 2] if values[k + 2] > c else c
        d = values[k + 3] if values[k + 3] > d else d
    for k in range(whole, len(values)):
        a = values[k] if values[k] > a else a
    return max(a, b, c, d)


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


def filled(
    particles: Particles,
    spread: Spread,
    shape: Shape,
    rng: np.random.Generator,
    modes: Iterable[Cluster] | None = None,
) -> Particles:
    """The same belief with what lies between its particles: equally weighted poses, drawn from a kernel density.

    What no view tells apart is believed to be anywhere along a line of poses, and few weighted particles on it leave
    gaps that a prediction of a fraction of a degree doesn't close: at the next keyframe the gaps are impossible, and
    after some keyframes the belief is a point of its own making. So where a mode's particles are sparse beside the
    prediction, new ones are drawn by a Gaussian kernel of the mode's own covariance, whose means are drawn in so that
    mean and covariance stay what they are (West, J. R. Statist. Soc. B 1993; Liu and West, 2001; the regularised
    particle filter of Musso, Oudjane and Le Gland, 2001). Modes that aren't sparse are left alone.

    Args:
        particles: weighted.
        spread: of the prediction that follows.
        shape: their class.
        rng: draws them.
        modes: `clusters` of the particles, where they are known already.
    """
    walk = np.repeat([spread.rotation_rad, spread.translation_m], 3)
    sparse = []
    for mode in clusters(particles, shape) if modes is None else modes:
        share = np.exp(particles.log_weight[mode.rows])
        effective = float(share.sum() ** 2 / (share**2).sum())
        width = (effective * (_DIMENSIONS + 2) / 4.0) ** (-1.0 / (_DIMENSIONS + 4))
        variances, axes = np.linalg.eigh(mode.covariance / np.outer(walk, walk))
        deviations = np.sqrt(np.maximum(variances, 0.0))
        if width * deviations[-1] > _SPARSE:
            sparse.append((mode, np.where(width * deviations > _SPARSE, width, 0.0), deviations, axes))
    if not sparse:
        return particles
    n = _SUPPORT * len(particles.log_weight)
    picks = systematic(particles.log_weight, n, float(rng.random()))
    T, normals = particles.T_world_centre[picks], rng.normal(size=(n, 6))
    for mode, widths, deviations, axes in sparse:
        own = mode.rows[picks]
        images = symmetry.nearest_image(mode.T_world_centre, T[own], shape.symmetry)
        along = (symmetry.residual(mode.T_world_centre, images) / walk) @ axes
        along = np.sqrt(1.0 - widths**2) * along + widths * deviations * normals[own]
        T[own] = retract(mode.T_world_centre, (along @ axes.T) * walk)
    return Particles(T, np.full(n, -np.log(n)))


def sufficient(particles: Particles, most: int, shape: Shape, modes: Iterable[Cluster] | None = None) -> int:
    """How many particles a belief needs: as many as tell its histogram over cells (Fox, KLD-sampling, IJRR 2003).

    Cells are counted about the heaviest particle, so that what lies close together is in one.

    The bound is for draws from the belief itself. Of weighted ones a tenth count, and along a direction that no view
    tells apart nothing mends what their noise has lost: it adds up from keyframe to keyframe. A heaviest mode that
    `stretches` has `_STRETCHED` times the most.

    Args:
        particles: weighted.
        most: the answer at most, but for what stretches.
        shape: their class.
        modes: `clusters` of the particles, where they are known already.
    """
    heaviest = next(iter(clusters(particles, shape) if modes is None else modes), None)
    if heaviest is not None and stretches(heaviest.covariance, shape):
        return _STRETCHED * most
    rows = np.unique(systematic(particles.log_weight, most, 0.5))
    away = symmetry.residual(particles.heaviest, particles.T_world_centre[rows], shape.symmetry)
    cells = occupied(np.round(away / np.repeat(_CELL, 3)))
    return int(np.clip(kld_bound(cells), round(_LEAST_SHARE * most), most))


def occupied(cells: Array) -> int:
    """How many different rows cells (n, d) have."""
    ordered = cells[np.lexsort(cells.T)]
    return 1 + int(np.count_nonzero((ordered[1:] != ordered[:-1]).any(axis=1)))


def stretches(covariance: Array, shape: Shape) -> bool:
    """Whether a mode of a covariance (6, 6) reaches over cells: a standard deviation is longer than a cell's side."""
    S = shape.symmetry
    sides = np.repeat(_CELL, (3 - S.free, 3))
    scaled = S.reduced_covariance(covariance) / np.outer(sides, sides)
    return bool(np.linalg.eigvalsh(scaled)[-1] > 1.0)


def first_count(proposals: Gaussians, most: int, shape: Shape) -> int:
    """How many particles a belief that has no past is drawn with: `_STRETCHED` times the most if its mode stretches."""
    heaviest = int(np.argmax(proposals.log_weight))
    return _STRETCHED * most if stretches(proposals.covariance[heaviest], shape) else most


def predicted_spread(model: Model, localisation: LocalisationNoise, dt_s: float, away_m: float) -> Spread:
    """Sigma = Q dt, and by how much localisation may have gone off in between, at a distance from the camera."""
    dt = max(dt_s, 1e-3)
    walked_round, walked = model.prediction_variances(dt)
    # two recorded poses that lie closer than the correlation time err together
    apart = 2.0 * (1.0 - np.exp(-dt / max(localisation.correlation_time_s, 1e-9)))
    turned, moved = localisation_variance(localisation, away_m)
    return Spread(float(np.sqrt(walked_round + apart * turned)), float(np.sqrt(walked + apart * moved)))


def kld_bound(cells: int) -> int:
    """Draws after which a histogram of so many occupied cells is near to what was drawn from.

    By less than `_DIVERGENCE` in Kullback-Leibler divergence with probability 0.99: the chi-square quantile in the
    approximation of Wilson and Hilferty (Fox, 2003, Equation 7).
    """
    if cells < 2:
        return 1
    freedom = cells - 1.0
    third = 2.0 / (9.0 * freedom)
    return math.ceil(freedom / (2.0 * _DIVERGENCE) * (1.0 - third + math.sqrt(third) * _SURE) ** 3)


@dataclass(frozen=True)
class Cluster:
    """Particles that belong together."""

    rows: NDArray[np.bool_]
    """(M,) which"""
    T_world_centre: Array
    """(4, 4) their mean"""
    covariance: Array
    """(6, 6) of its right tangent"""


def clusters(particles: Particles, shape: Shape) -> Iterator[Cluster]:
    """The mode of the heaviest particle, then of the heaviest one left, as long as they weigh anything.

    A mode is what lies within `MODE_RADIUS` of its heaviest particle. It grows along directions in which its particles
    spread that far: where nothing tells poses apart they are one mode, however far it reaches.
    """
    left, poses, S = particles.log_weight.copy(), particles.T_world_centre, shape.symmetry
    least = np.log(min(_LIGHT[0], _LIGHT[1] / len(left)))
    for _ in range(_MODES):
        heaviest = int(np.argmax(left))
        if left[heaviest] < least:
            return
        free = np.isfinite(left)
        T = poses[heaviest]
        r = np.full((len(poses), 6), np.inf)
        r[free] = symmetry.residual(T, poses[free], S)
        rows = np.linalg.norm(r[:, :3], axis=-1) < MODE_RADIUS[0]
        rows &= np.linalg.norm(r[:, 3:], axis=-1) < MODE_RADIUS[1]
        rows[heaviest] = True
        for growth in range(_GROWTHS + 1):
            own = r[rows]
            T, covariance = symmetry.moments(T, poses[rows], left[rows], S, own, _MEANS)
            variances, axes = np.linalg.eigh(covariance / np.outer(_RADII, _RADII))
            if growth == _GROWTHS or variances[-1] <= _EDGE**-2:
                break
            others = np.flatnonzero(free & ~rows)
            r[rows], r[others] = own, symmetry.residual(T, poses[others], S)
            within = ((r[others] / _RADII @ axes) ** 2 / np.maximum(variances, _EDGE**-2)).sum(axis=-1) < _EDGE**2
            if not within.any():
                break
            rows[others[within]] = True
        yield Cluster(rows, T, covariance)
        left[rows] = -np.inf


def modes_of(c: int, particles: Particles, shape: Shape) -> list[tuple[int, float, Array, Array, Array]]:
    """The modes of a set, moments matched, the one of the heaviest particle first.

    Returns:
        class index `c`, log weight, T_world_centre (4, 4), covariance (6, 6) and free axes (6, f) of each.
    """
    out: list[tuple[int, float, Array, Array, Array]] = []
    free = shape.symmetry.free_axes
    for mode in clusters(particles, shape):
        # no sample variance below a tenth of a millimetre is believed, and a free direction has the circle's
        covariance = mode.covariance + 1e-8 * np.eye(6) + np.pi**2 * free @ free.T
        weight = float(mixture.log_sum(particles.log_weight[mode.rows]))
        out.append((c, weight, mode.T_world_centre, covariance, free))
    return out
