"""What of each thing an image shows: the box of its visible pixels and how much of its silhouette they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.scene import render_scene

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]

SILHOUETTE_PX = 160  # a silhouette is counted on a grid of at most so many samples each way
NEAREST_M = 0.05  # vertices nearer than this say nothing of where a silhouette lies


class Thing(NamedTuple):
    """One physical object as a camera has it in front of it."""

    inst_id: int
    obj_id: int
    mesh: Mesh
    T_camera_object: Array
    """(4, 4)"""


@dataclass(frozen=True)
class Visible:
    """One thing as an image shows it."""

    inst_id: int
    obj_id: int
    box: Box
    """x, y, width, height of its visible pixels; zeros where nothing of it shows"""
    fraction: float
    """visible share of its silhouette, the part outside the image included: BOP's visib_fract"""
    unoccluded: float
    """visible share of the part of its silhouette that lies in the image"""

    @property
    def evidence(self) -> float:
        """How much of it there is to recognise, 0 to 1: to be cut by the image's edge harms less than to be hidden."""
        return float(np.sqrt(self.fraction * self.unoccluded))


def look(things: Sequence[Thing], item: NDArray[np.int32], camera: Camera) -> list[Visible]:
    """What shows of each thing.

    Args:
        things: in the order in which they were drawn, the first of all items drawn.
        item: (h, w) position of what each pixel sees; other numbers, such as -1, are none of them.
        camera: of the image.
    """
    known = np.where((item >= 0) & (item < len(things)), item, -1)
    boxes = find_objects(known + 1, max_label=len(things))
    counts = np.bincount(known.ravel() + 1, minlength=len(things) + 1)[1:]
    return [
        Visible(thing.inst_id, thing.obj_id, _box(box), *_visible_shares(int(count), thing, camera))
        for thing, box, count in zip(things, boxes, counts, strict=True)
    ]


def _box(slices: tuple[slice, slice] | None) -> Box:
    if slices is None:
        return (0.0, 0.0, 0.0, 0.0)
    rows, columns = slices
    return (float(columns.start), float(rows.start), float(columns.stop - columns.start), float(rows.stop - rows.start))


def _visible_shares(seen_px: int, thing: Thing, camera: Camera) -> tuple[float, float]:
    """What share of a thing's silhouette is visible: of all of it, and of the part in the image.

    As in BOP, "all" reaches out of the image by the image's own size each way. Large ones are counted on a coarse grid.
    """
    if seen_px == 0:
        return 0.0, 0.0
    points = se3.transform(thing.T_camera_object, thing.mesh.vertices)
    pixels = camera.project(points[points[:, 2] > NEAREST_M])
    size = np.array([camera.width, camera.height])
    low = np.floor(np.clip(pixels.min(axis=0), -size, size)).astype(int)
    high = np.ceil(np.clip(pixels.max(axis=0), 0, 2 * size)).astype(int)
    step = int(np.ceil((high - low + 1).max() / SILHOUETTE_PX))
    columns, rows = -(-(high - low + 1) // step)
    window = camera.window(int(low[0]), int(low[1]), int(columns), int(rows), step)
    silhouette = render_scene([(thing.mesh, thing.T_camera_object)], window).item >= 0
    u, v = low[0] + step * np.arange(columns), low[1] + step * np.arange(rows)
    inside = ((v >= 0) & (v < camera.height))[:, None] & (u >= 0) & (u < camera.width)
    seen = seen_px / step**2
    return min(1.0, seen / max(int(silhouette.sum()), 1)), min(1.0, seen / max(int((silhouette & inside).sum()), 1))
