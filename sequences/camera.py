"""The pinhole camera: OpenCV's convention, +z forward, +x right, +y down; pixel centres at whole numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics of one image, without distortion."""

    fx: float
    """focal length along x, pixels"""
    fy: float
    """focal length along y, pixels"""
    cx: float
    """principal point, pixels"""
    cy: float
    """principal point, pixels"""
    width: int
    """pixels"""
    height: int
    """pixels"""

    @property
    def K(self) -> Array:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: Array) -> Array:
        """Points (..., 3) in the camera frame, metres -> pixels (..., 2). Points at z <= 0 give NaN."""
        z = points[..., 2]
        safe = np.where(z > 0, z, np.nan)
        u = self.fx * points[..., 0] / safe + self.cx
        v = self.fy * points[..., 1] / safe + self.cy
        return np.stack([u, v], axis=-1)

    def backproject(self, u: Array, v: Array, depth: Array) -> Array:
        """Pixels u, v (...) with depth (...) along z, metres -> points (..., 3) in the camera frame."""
        depth = np.asarray(depth, dtype=np.float64)
        x = (np.asarray(u) - self.cx) / self.fx * depth
        y = (np.asarray(v) - self.cy) / self.fy * depth
        return np.stack([x, y, depth], axis=-1)

    def window(self, x: int, y: int, width: int, height: int, step: int = 1) -> Camera:
        """The camera of every step-th pixel of a part of the image.

        Pixel (i, j) of the window is pixel (x + i step, y + j step) of the image, which it may leave.
        """
        return Camera(
            self.fx / step, self.fy / step, (self.cx - x) / step, (self.cy - y) / step, width=width, height=height
        )

    def points(self, depth: NDArray[np.float32]) -> Array:
        """Depth image (h, w), metres -> points (h, w, 3) in the camera frame; zero where depth is 0."""
        v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
        return self.backproject(u, v, depth.astype(np.float64))
