"""Depth held to planes, which needs no truth: the noise of a sensor at distances where no object was recorded.

A plane is linear in inverse depth, so in disparity. Square patches of depth images are fitted by one; the quarter that
fits best is taken to be of planes, alike for real and simulated recordings.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ctmap_gtsam.bench.realism.residuals import robust_sigma
from sequences.camera import Camera
from sequences.simulation.config import FOCAL_PX
from sequences.simulation.sensor import BASELINE_M
from sequences.types import Depth

Array = NDArray[np.float64]

PATCH_PX = 32  # pixels of the sensor a side
Z_BINS_M = (0.4, 0.7, 1.0, 1.4, 1.8, 2.3, 3.0, 4.0)
MEASURED = 0.98  # share of a patch that must have depth
INLIERS = 0.9  # share within three sigmas of the plane
LEAST_PATCHES = 8
LAGS = (1, 2, 4, 8)  # pixels of the sensor
ROUNDS = 4


class Patches:
    """Residuals of depth about fitted planes: z (n,) metres, residual (n, k, k) pixels of disparity, NaN where none."""

    def __init__(self, images: Iterable[tuple[Depth, Camera]]) -> None:
        fitted = [_fit(depth, max(1, round(PATCH_PX * camera.fx / FOCAL_PX))) for depth, camera in images]
        self.z = np.concatenate([z for z, _ in fitted])
        self.residual = np.concatenate([residual for _, residual in fitted])
        self.scale = self.residual.shape[-1] / PATCH_PX

    def planes(self, low: float, high: float) -> Array:
        """(m, k, k) residuals of the quarter that fits best of those between two depths, metres; few are none."""
        here = self.residual[(self.z >= low) & (self.z < high)]
        if len(here) < LEAST_PATCHES:
            return here[:0]
        sigma = np.nanstd(here, axis=(1, 2))
        return here[sigma <= np.quantile(sigma, 0.25)]

    def spread_px(self, low: float, high: float) -> float:
        """Robust sigma of disparity on planes between two depths, pixels of the sensor; NaN without."""
        planes = self.planes(low, high)
        return robust_sigma(planes[np.isfinite(planes)])

    def correlation(self, lag: int) -> float:
        """Of the residuals on planes, so many pixels of the sensor apart along rows and columns."""
        planes, step = self.planes(Z_BINS_M[0], Z_BINS_M[-1]), max(1, round(lag * self.scale))
        if len(planes) == 0:
            return float("nan")
        planes = planes - np.nanmedian(planes, axis=(1, 2), keepdims=True)
        pairs = [(planes[:, :, step:], planes[:, :, :-step]), (planes[:, step:], planes[:, :-step])]
        products = np.concatenate([(a * b).ravel() for a, b in pairs])
        squares = np.concatenate([((a**2 + b**2) / 2.0).ravel() for a, b in pairs])
        return float(np.nansum(products) / np.nansum(squares))


def figures(patches: Patches) -> dict[str, float]:
    """`planes_px_<from>_<to>` for each bin of depth, metres, and `planes_correlation_<lag>`."""
    spread = {f"planes_px_{low:g}_{high:g}": patches.spread_px(low, high) for low, high in pairwise(Z_BINS_M)}
    return spread | {f"planes_correlation_{lag}": patches.correlation(lag) for lag in LAGS}


def _fit(depth: Depth, size: int) -> tuple[Array, Array]:
    """Planes through all patches side by side: their depth (n,) and residuals (n, size, size)."""
    whole = sliding_window_view(depth, (size, size))[::size, ::size].reshape(-1, size * size).astype(np.float64)
    known = whole > 0.0
    enough = known.mean(axis=1) >= MEASURED
    whole, known = whole[enough], known[enough]
    disparity = np.where(known, FOCAL_PX * BASELINE_M / np.where(known, whole, 1.0), 0.0)
    v, u = np.indices((size, size)).reshape(2, -1) / size - 0.5
    A = np.stack([u, v, np.ones(size * size)], axis=-1)
    weight = known.astype(np.float64)
    for _ in range(ROUNDS):
        normal = np.einsum("np,pi,pj->nij", weight, A, A, optimize=True) + 1e-9 * np.eye(3)
        plane = np.linalg.solve(normal, np.einsum("np,pi->ni", weight * disparity, A)[..., None])[..., 0]
        residual = np.where(known, disparity - plane @ A.T, np.nan)
        sigma = 1.4826 * np.nanmedian(np.abs(residual), axis=1, keepdims=True) + 1e-6
        inlier = known & (np.abs(residual) < 3.0 * sigma)
        weight = inlier.astype(np.float64)
    good = inlier.mean(axis=1) >= INLIERS
    return np.median(whole[good], axis=1), residual[good].reshape(-1, size, size)
