"""Which pixels a map's objects would cover: boxes for the detection metrics and the exports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue, Mesh
from sequences.rendering.scene import render_scene

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Box = tuple[float, float, float, float]
Window = tuple[slice, slice]


class Silhouette(NamedTuple):
    """One object in an image, in front of and behind the others."""

    pixels: int
    """pixels of the image that it covers were it alone; 0 where it is out of view"""
    visible_pixels: int
    """pixels of those where no other object of the map is nearer"""
    box: Box | None
    """x, y, width, height of the enclosing box of all of its pixels (COCO); None where there are none"""
    visible_box: Box | None
    """the same of the visible ones"""

    @property
    def visible_fraction(self) -> float:
        """Visible share of what lies in the image; 0 out of view."""
        return self.visible_pixels / self.pixels if self.pixels else 0.0


def silhouettes(
    catalogue: Catalogue,
    class_id: Sequence[int] | NDArray[np.int64],
    T_camera_object: Array,
    camera: Camera,
    step: int = 1,
    hides: Bools | None = None,
) -> list[Silhouette]:
    """Draw n objects of a map, obj_ids (n,) at poses (n, 4, 4), into one camera. Only they hide each other.

    Where `hides` (n,) is given, only those of them do.

    With a step, every `step`-th pixel each way stands for its neighbours: boxes are then good to `step` pixels.
    """
    coarse = camera.window(0, 0, -(-camera.width // step), -(-camera.height // step), step)
    drawn = [draw(catalogue[int(c)].mesh, T, coarse) for c, T in zip(class_id, T_camera_object, strict=True)]
    nearest = np.full((coarse.height, coarse.width), np.inf, dtype=np.float32)
    for k, (window, depth) in enumerate(drawn):
        if hides is None or hides[k]:
            np.minimum(nearest[window], depth, out=nearest[window])
    return [_silhouette(window, depth, nearest, camera, step) for window, depth in drawn]


def draw(mesh: Mesh, T: Array, camera: Camera) -> tuple[Window, NDArray[np.float32]]:
    """The window (rows, columns) that a mesh at T_camera_object may cover, and its depth there, infinite elsewhere."""
    x, y, width, height = _window(mesh, T, camera)
    rows, columns = slice(y, y + height), slice(x, x + width)
    if not width or not height:
        return (rows, columns), np.zeros((height, width), dtype=np.float32)
    depth = render_scene([(mesh, T)], camera.window(x, y, width, height)).depth
    return (rows, columns), np.where(depth > 0, depth, np.float32(np.inf))


def _window(mesh: Mesh, T: Array, camera: Camera) -> tuple[int, int, int, int]:
    points = se3.transform(T, mesh.vertices)
    if points[:, 2].max() <= 0:
        return 0, 0, 0, 0
    if points[:, 2].min() <= 0:  # it reaches behind the camera: its projection has no bounds
        return 0, 0, camera.width, camera.height
    size = np.array([camera.width, camera.height])
    pixels = camera.project(points)
    low = np.clip(np.ceil(pixels.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.floor(pixels.max(axis=0)) + 1, low, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _silhouette(
    window: Window, depth: NDArray[np.float32], nearest: NDArray[np.float32], camera: Camera, step: int
) -> Silhouette:
    covered = np.isfinite(depth)
    visible = covered & (depth <= nearest[window])
    return Silhouette(
        int(covered.sum()) * step**2,
        int(visible.sum()) * step**2,
        _box(covered, window, camera, step),
        _box(visible, window, camera, step),
    )


def _box(covered: Bools, window: Window, camera: Camera, step: int) -> Box | None:
    """What encloses the pixels, each with its share of the way to the next one, in the whole image."""
    rows, columns = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
    if len(rows) == 0:
        return None
    half = 0.5 * (step - 1)
    left, right = (step * (window[1].start + columns[k]) for k in (0, -1))
    top, bottom = (step * (window[0].start + rows[k]) for k in (0, -1))
    x, y = max(left - half, 0.0), max(top - half, 0.0)
    width = min(right + half + 1.0, float(camera.width)) - x
    height = min(bottom + half + 1.0, float(camera.height)) - y
    return (float(x), float(y), float(width), float(height))
