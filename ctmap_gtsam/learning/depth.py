"""What the model says of depth, from depth at true poses: sigma(z), kappa, and the bias of an object-visit.

A sample's residual, measured minus true depth, is J b + n: b ~ N(0, Sigma_b) is what all frames of an object-visit
share, a motion of the object about its centre (J: by how much depth grows with it), and n has the standard deviation
sigma(z) = a + b z^2 and is correlated within an image, so that a sum over samples counts kappa times. Neither b nor n
is seen alone, so expectation and maximisation take turns (Dempster, Laird and Rubin, JRSS B 1977):

- given all else, b of each visit is Gaussian with mean and covariance C;
- sigma maximises the likelihood of the residuals less J b, outliers allowed for as `factors.measurement` does;
- 1 / kappa is `correlated_pixels` of the whitened residuals less J b, with what C adds to the products: a bias fitted
  to few frames takes some of their noise with it;
- Sigma_b maximises the likelihood of all frames' residuals, b integrated out.

Samples are those that the estimators take, every few pixels, so that kappa counts samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ctmap_gtsam.bench.realism.residuals import CUTOFF, glances
from ctmap_gtsam.config import Config
from ctmap_gtsam.parameters import Sensor
from ctmap_gtsam.shapes import centre_of
from factors.measurement import correlated_pixels_of, lag_products
from sequences.types import Run, Truth

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bounds = tuple[tuple[float, float], tuple[float, float]]

ROUNDS, SETTLED = 60, 0.003  # at most so many, or until nothing changes by more than this share
_SIGMA: Bounds = ((1e-5, 0.05), (1e-6, 0.05))  # within which a (metres) and b (1/m) are sought
_BIAS: Bounds = ((1e-5, 0.5), (1e-6, 0.1))  # the same of Sigma_b's roots: rad, metres
_BINS = (24, 64)  # of depth and residual, in which the likelihood of sigma is added up
_LEAST_M, _MOST_M = 1e-6, 0.05  # the residuals' bins


@dataclass(frozen=True)
class View:
    """The samples (n) of one object in one frame at its true pose."""

    visit: int
    """which object-visit"""
    order: int
    """position of the frame in its visit"""
    frames: int
    """of that visit"""
    residual: Array
    """(n,) measured minus true depth, metres"""
    depth: Array
    """(n,) true, metres"""
    jacobian: Array
    """(n, 6) of depth by the object's pose in its centre frame; rad, metres"""
    at: Ints
    """(n, 2) row and column on the grid of samples"""


@dataclass(frozen=True)
class DepthFit:
    """What depth says of the settings."""

    sigma_m: float
    sigma_quadratic_per_m: float
    kappa: float
    bias_rotation_rad: float
    bias_translation_m: float


def views_of(run: Run, truth: Truth, config: Config, first_visit: int = 0) -> list[View]:
    """All movable objects in all frames in which they show well; object-visits are numbered on from `first_visit`."""
    number: dict[tuple[int, int], int] = {}
    order = {frame.index: k for visit in run.visits for k, frame in enumerate(visit.frames)}
    of = {o.inst_id: run.catalogue[o.obj_id] for o in truth.objects}
    views = []
    for glance in glances(run, truth, 1, lambda frame, items, images: frame.read_depth()):
        step = max(1, round(run.frames[glance.frame].camera.fx * config.frontend.angular_step_rad))
        jacobian = glance.jacobian(centre_of(of[glance.thing[1]]))[::step, ::step]
        residual, depth = glance.raw[::step, ::step], glance.depth[::step, ::step]
        rows, columns = np.nonzero(np.isfinite(residual))
        if len(rows):
            visit = number.setdefault(glance.thing, first_visit + len(number))
            at = np.stack([rows, columns], axis=-1)
            mine = (residual[rows, columns], depth[rows, columns], jacobian[rows, columns])
            views.append(View(visit, order[glance.frame], len(run.visits[glance.thing[0]].frames), *mine, at))
    return views


class DepthStatistics:
    """What is left of views once the fit has converged: sums by object-visit, which a bootstrap weighs anew."""

    def __init__(self, views: Sequence[View], sensor: Sensor) -> None:
        self._sensor = sensor
        self._views = sorted(views, key=lambda v: (v.visit, v.order))
        by_visit = [list(some) for _, some in groupby(self._views, key=lambda v: v.visit)]
        self._visits = [_Joined.of(some) for some in by_visit]
        self.images = np.array([len(some) for some in by_visit], dtype=np.float64)
        self.samples = np.array([len(v.residual) for v in self._visits], dtype=np.float64)
        self._depth_edges = np.quantile(
            np.concatenate([v.depth for v in self._visits]), np.linspace(0, 1, _BINS[0] + 1)
        )
        whole = np.ones(len(self._visits))
        self.sigma = (sensor.sigma_m, sensor.sigma_quadratic_per_m)
        self._roots = (sensor.bias_rotation_rad, sensor.bias_translation_m)
        bias, covariance = np.zeros((len(self._visits), 6)), np.zeros((len(self._visits), 6, 6))
        for _ in range(ROUNDS):
            before = (*self.sigma, *self._roots)
            self._add_up(bias, covariance)
            self.sigma = self._fit_sigma(whole)
            self._correlate(bias, covariance)
            kappa = self._fit_kappa(whole)
            self._inform(bias)
            self._roots = self._fit_bias(whole, kappa)
            bias, covariance = self._posterior(kappa)
            if np.abs(np.log(np.divide((*self.sigma, *self._roots), before))).max() < SETTLED:
                break

    def fit(self, weight: Array | None = None) -> DepthFit:
        """The settings, each object-visit counted so many times (V,)."""
        weight = np.ones(len(self._visits)) if weight is None else weight
        a, b = self._fit_sigma(weight)
        kappa = self._fit_kappa(weight)
        return DepthFit(a, b, kappa, *self._fit_bias(weight, kappa))

    def _add_up(self, bias: Array, covariance: Array) -> None:
        """Residuals less J b in bins: (V, depth, residual) counts, and what depth and residual they stand for."""
        edges = np.geomspace(_LEAST_M, _MOST_M, _BINS[1] + 1)
        counts, total, square = [], np.zeros(_BINS), np.zeros(_BINS)
        for visit, b, C in zip(self._visits, bias, covariance, strict=True):
            left = (visit.residual - visit.jacobian @ b) ** 2 + visit.variance(C)
            row = np.clip(np.searchsorted(self._depth_edges, visit.depth) - 1, 0, _BINS[0] - 1)
            column = np.clip(np.searchsorted(edges, np.sqrt(left)) - 1, 0, _BINS[1] - 1)
            counts.append(np.zeros(_BINS))
            np.add.at(counts[-1], (row, column), 1.0)
            np.add.at(total, (row, column), visit.depth)
            np.add.at(square, (row, column), left)
        self._counts = np.stack(counts)
        n = np.maximum(self._counts.sum(axis=0), 1.0)
        self._bin_depth, self._bin_square = total / n, square / n

    def _fit_sigma(self, weight: Array) -> tuple[float, float]:
        count = np.tensordot(weight, self._counts, axes=1)
        outlier = self._sensor.outlier_weight

        def energy(a: float, b: float) -> float:
            s = a + b * self._bin_depth**2
            inlier = (1.0 - outlier) / (np.sqrt(2.0 * np.pi) * s) * np.exp(-0.5 * self._bin_square / s**2)
            return -float((count * np.log(inlier + outlier / self._sensor.range_m)).sum())

        return _least(energy, _SIGMA, self.sigma)

    def _correlate(self, bias: Array, covariance: Array) -> None:
        """Products of whitened samples by their distance (V, R): of residuals less J b, and what C adds to them."""
        rings = []
        for visit, b, C in zip(self._visits, bias, covariance, strict=True):
            white = (visit.residual - visit.jacobian @ b) / self._noise(visit)
            spread = visit.jacobian @ _root(C) / self._noise(visit)[:, None]
            parts = np.concatenate([np.clip(white, -CUTOFF, CUTOFF)[:, None], spread], axis=1)
            rings.append([lag_products(image) for image in visit.images(parts)])
        longest = max(len(r) for some in rings for r in some)
        self._rings = np.array([sum(np.pad(r, (0, longest - len(r))) for r in some) for some in rings])

    def _fit_kappa(self, weight: Array) -> float:
        return 1.0 / correlated_pixels_of(weight @ self._rings, float((weight @ self.samples) / (weight @ self.images)))

    def _inform(self, bias: Array) -> None:
        """What the samples say of b if they were independent: information (V, 6, 6), and information times mean (V, 6).

        A sample counts by the probability that it is no outlier.
        """
        information, vector = [], []
        for visit, b in zip(self._visits, bias, strict=True):
            s = self._noise(visit)
            outlier = self._sensor.outlier_weight
            left = (visit.residual - visit.jacobian @ b) / s
            inlier = (1.0 - outlier) / (np.sqrt(2.0 * np.pi) * s) * np.exp(-0.5 * left**2)
            weighted = visit.jacobian * (inlier / (inlier + outlier / self._sensor.range_m) / s**2)[:, None]
            information.append(weighted.T @ visit.jacobian)
            vector.append(weighted.T @ visit.residual)
        self._information, self._vector = np.stack(information), np.stack(vector)

    def _fit_bias(self, weight: Array, kappa: float) -> tuple[float, float]:
        information, vector = kappa * self._information, kappa * self._vector

        def energy(rotation: float, translation: float) -> float:
            root = np.repeat([rotation, translation], 3)
            # in units of the prior: b = root x
            A = np.eye(6) + root[:, None] * information * root
            g = root * vector
            gained = np.einsum("vk,vk->v", g, np.linalg.solve(A, g[..., None])[..., 0])
            return 0.5 * float(weight @ (np.linalg.slogdet(A)[1] - gained))

        return _least(energy, _BIAS, self._roots)

    def _posterior(self, kappa: float) -> tuple[Array, Array]:
        """b of each visit: mean (V, 6) and covariance (V, 6, 6)."""
        prior = np.diag(np.repeat(self._roots, 3) ** -2.0)
        covariance = np.linalg.inv(prior + kappa * self._information)
        return np.einsum("vkl,vl->vk", covariance, kappa * self._vector), np.asarray(covariance)

    def _noise(self, visit: _Joined) -> Array:
        a, b = self.sigma
        return np.asarray(a + b * visit.depth**2)


@dataclass(frozen=True)
class _Joined:
    """All views of one object-visit, their samples (n) end to end."""

    residual: Array
    depth: Array
    jacobian: Array
    at: tuple[Ints, ...]
    """(n_f, 2) of each view"""

    @classmethod
    def of(cls, views: Sequence[View]) -> _Joined:
        return cls(
            np.concatenate([v.residual for v in views]),
            np.concatenate([v.depth for v in views]),
            np.concatenate([v.jacobian for v in views]),
            tuple(v.at for v in views),
        )

    def variance(self, covariance: Array) -> Array:
        """(n,) of J b."""
        return np.einsum("nk,kl,nl->n", self.jacobian, covariance, self.jacobian)

    def images(self, parts: Array) -> Iterator[Array]:
        """Numbers (n, m) of the samples as images (m, h, w), view by view; 0 where there is none."""
        start = 0
        for at in self.at:
            image = np.zeros((parts.shape[1], *(at.max(axis=0) + 1)))
            image[:, at[:, 0], at[:, 1]] = parts[start : start + len(at)].T
            start += len(at)
            yield image


def _root(covariance: Array) -> Array:
    """(6, 6) whose square with its transpose is a covariance, which may be zero."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _least(energy: Callable[[float, float], float], bounds: Bounds, start: tuple[float, float]) -> tuple[float, float]:
    """Two positive numbers within bounds where an energy is least, by their logarithms (Nelder and Mead)."""
    low, high = np.log(np.array(bounds)).T
    begin = np.clip(np.log(start), low, high)
    found = minimize(
        lambda x: energy(*np.exp(x)),
        begin,
        method="Nelder-Mead",
        bounds=list(zip(low, high, strict=True)),
        options={
            "xatol": 1e-3,
            "fatol": 1e-3,
            "initial_simplex": begin + np.array([[0.0, 0.0], [0.3, 0.0], [0.0, -0.3]]),
        },
    )
    first, second = np.exp(found.x)
    return float(first), float(second)
