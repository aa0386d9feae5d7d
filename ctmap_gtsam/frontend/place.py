"""What nobody modelled but everything rests on: which way is up, and the level surfaces, as far as has been seen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.observation import Observation
from sequences import se3
from sequences.geometry import Plane
from sequences.types import Run

Array = NDArray[np.float64]

_LEVEL_RAD = 0.35  # planes steeper than this carry nothing
_SAME_RAD, _SAME_M = 0.2, 0.025  # two views of one surface differ by less


class Place:
    """Grows keyframe by keyframe; what it says depends on the past alone."""

    def __init__(self, run: Run) -> None:
        self._given = run.up_world is not None
        self.up_world: Array | None = run.up_world
        self._sum = np.zeros(3)
        self._surfaces: list[tuple[Plane, float]] = []

    @property
    def surfaces(self) -> tuple[Plane, ...]:
        """Level planes in the world frame: anonymous fixed supports."""
        return tuple(plane for plane, _ in self._surfaces)

    def update(self, observation: Observation) -> None:
        """Take in one keyframe."""
        T = observation.frame.T_world_camera
        up = observation.up_camera
        if not self._given and up is not None:
            self._sum = self._sum + T[:3, :3] @ up
            self.up_world = self._sum / np.linalg.norm(self._sum)
        if self.up_world is None:
            return
        for plane in observation.planes:
            seen = plane.moved(T)
            if seen.normal @ self.up_world > np.cos(_LEVEL_RAD):
                self._merge(seen)

    def _merge(self, seen: Plane) -> None:
        """Join a view of a surface to the one it is, the mean weighed by how much of the image it filled."""
        for i, (known, weight) in enumerate(self._surfaces):
            middle = seen.T_frame_plane[:3, 3]
            apart = abs(known.normal @ middle - known.offset)
            if known.normal @ seen.normal > np.cos(_SAME_RAD) and apart < _SAME_M:
                self._surfaces[i] = _mean(known, weight, seen), weight + seen.share
                return
        self._surfaces.append((seen, seen.share))


def describe(place: Place) -> dict[str, Any]:
    """Up and surfaces as JSON, for the meta data of an estimate."""
    return {
        "up_world": None if place.up_world is None else place.up_world.tolist(),
        "surfaces": [
            {"normal": s.normal.tolist(), "offset_m": s.offset, "outline_world_m": _corners(s).tolist()}
            for s in place.surfaces
        ],
    }


def _mean(known: Plane, weight: float, seen: Plane) -> Plane:
    """The weighted mean of two views, with an outline that holds both."""
    total = weight + seen.share
    normal = (weight * known.normal + seen.share * seen.normal) / total
    normal /= np.linalg.norm(normal)
    middle = (weight * known.T_frame_plane[:3, 3] + seen.share * seen.T_frame_plane[:3, 3]) / total
    x = known.T_frame_plane[:3, 0]
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    T = se3.make(np.stack([x, np.cross(normal, x), normal], axis=-1), middle)
    corners = np.concatenate([_corners(known), _corners(seen)])
    flat = se3.transform(se3.inverse(T), corners)[:, :2]
    hull = cv2.convexHull(flat.astype(np.float32))[:, 0].astype(np.float64)
    return replace(known, normal=normal, offset=float(normal @ middle), T_frame_plane=T, hull=hull)


def _corners(plane: Plane) -> Array:
    """(H, 3) outline in the plane's outer frame."""
    flat = np.concatenate([plane.hull, np.zeros((len(plane.hull), 1))], axis=-1)
    return se3.transform(plane.T_frame_plane, flat)
