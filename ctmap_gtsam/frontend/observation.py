"""One keyframe as the estimators see it: depth, the planes in it, the detections. Nothing of other keyframes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera
from sequences.geometry import Plane, PlaneSearch, find_planes, plane_depth, up_from_planes
from sequences.seeds import generator
from sequences.types import Frame, Run

Array = NDArray[np.float64]

CENTRE_REGION = 0.3
"""share of a box's width and height that the paper's "center region" spans"""

OWN_SHARE = 0.8
"""a plane with more than this share of what the image shows of it in an object's box may be the object's own face"""

_GRID = 40  # samples across the image for telling where a plane lies


@dataclass(frozen=True)
class Observation:
    """A keyframe's image data. Holds one depth image: make it, use it, let it go."""

    keyframe: int
    """row of Estimate.keyframe_frame"""
    frame: Frame
    depth: NDArray[np.float32]
    """(h, w) metres"""
    planes: tuple[Plane, ...]
    """dominant planes in the camera frame"""

    @property
    def up_camera(self) -> Array | None:
        """(3,) against gravity in the camera frame, as far as this image alone can tell."""
        return up_from_planes(self.planes, np.array([0.0, -1.0, 0.0]))

    def planes_behind(self, box: Array) -> tuple[Plane, ...]:
        """The planes that may stand behind a thing with a box (x, y, w, h): those that aren't a face of its own."""
        views = zip(self.planes, self._where, strict=True)
        return tuple(p for p, where in views if reaches_beyond(p, where, box, self.frame.camera))

    @cached_property
    def _where(self) -> tuple[Array, ...]:
        return tuple(where_in_image(plane, self.frame.camera) for plane in self.planes)


def observe(frame: Frame, keyframe: int, seed: int) -> Observation:
    """Read a keyframe's depth and find its planes."""
    depth = frame.read_depth()
    rng = generator(seed, "frontend.planes", keyframe=frame.index)
    return Observation(keyframe, frame, depth, find_planes(frame.camera, depth, rng))


def observations(run: Run, keyframes: NDArray[np.int64], seed: int) -> Iterator[Observation]:
    """All keyframes in order, one in memory at a time."""
    frames = run.frames
    for k, index in enumerate(keyframes):
        yield observe(frames[int(index)], k, seed)


def centre_depth(depth: NDArray[np.float32], box: Array) -> float:
    """Median depth in the centre region of a box (x, y, width, height), metres; 0 where nothing was measured."""
    x, y, w, h = box
    cx, cy, half_w, half_h = x + w / 2, y + h / 2, CENTRE_REGION * w / 2, CENTRE_REGION * h / 2
    rows = slice(max(0, int(cy - half_h)), max(0, int(cy + half_h) + 1))
    columns = slice(max(0, int(cx - half_w)), max(0, int(cx + half_w) + 1))
    patch = depth[rows, columns]
    measured = patch[patch > 0]
    return float(np.median(measured)) if measured.size else 0.0


def centre_point(frame: Frame, depth: NDArray[np.float32], box: Array) -> Array | None:
    """The 3-D point (3,) at a box's centre in the world frame, or None where there is no depth."""
    z = centre_depth(depth, box)
    if z == 0.0:
        return None
    x, y, w, h = box
    point = frame.camera.backproject(np.array(x + w / 2), np.array(y + h / 2), np.array(z))
    return se3.transform(frame.T_world_camera, point[None])[0]


def where_in_image(plane: Plane, camera: Camera) -> Array:
    """(n, 2) pixels spread over the image where a plane in the camera frame would be seen if nothing hid it."""
    step = max(1, camera.width // _GRID)
    window = camera.window(0, 0, -(-camera.width // step), -(-camera.height // step), step)
    v, u = np.nonzero(plane_depth((plane,), window))
    return np.stack([u, v], axis=-1).astype(np.float64) * step


def reaches_beyond(plane: Plane, where: Array, box: Array, camera: Camera) -> bool:
    """Whether a plane in the camera frame, seen at pixels (n, 2), reaches well beyond a box (x, y, w, h)."""
    if not len(where):
        return True
    # outlines are wider than what was seen by a margin
    margin = PlaneSearch().margin_m * camera.fx / max(plane.T_frame_plane[2, 3], 0.1)
    inside = ((where >= box[:2] - margin) & (where <= box[:2] + box[2:] + margin)).all(axis=-1)
    return bool(inside.mean() <= OWN_SHARE)
