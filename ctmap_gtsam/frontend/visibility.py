"""Where in an image an object would appear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.shapes import Shape
from sequences import se3
from sequences.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outlook:
    """The projection of one pose."""

    box: Array
    """(4,) x, y, w, h in pixels, clipped to the image; zero where nothing is in the image"""
    share: float
    """of its vertices that lie in the image, occlusion not considered"""


def outlook(shape: Shape, T_camera_centre: Array, camera: Camera) -> Outlook:
    """Project a shape at a pose (4, 4)."""
    points = se3.transform(T_camera_centre, shape.mesh.vertices)
    pixels = camera.project(points[points[:, 2] > 0])
    size = np.array([camera.width, camera.height])
    inside = ((pixels >= 0) & (pixels < size)).all(-1)
    if not inside.any():
        return Outlook(np.zeros(4), 0.0)
    low, high = np.clip(pixels.min(0), 0, size), np.clip(pixels.max(0), 0, size)
    return Outlook(np.concatenate([low, high - low]), float(inside.sum() / len(points)))
