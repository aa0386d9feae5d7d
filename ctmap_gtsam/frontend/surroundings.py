"""What stands around an object when it is weighed: its neighbours' best poses and the level surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numba
import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.company import Company, Partner
from ctmap_gtsam.frontend.observation import reaches_beyond, where_in_image
from ctmap_gtsam.frontend.scoring import Tile
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape, one_place_m
from factors.context import context_log_ratio, doubted, hinge_log_potential
from sequences import se3
from sequences.camera import Camera
from sequences.geometry import Plane, plane_depth
from sequences.rendering.kernels import NEAR_M
from sequences.rendering.scene import render_scene
from sequences.types import Frame

Array = NDArray[np.float64]

_CONTENTION_M = 0.012  # things that reach deeper into each other are rivals for one place
_OWN_M = 0.04  # a surface that lies so near to an object's mesh all over may be its own
_CONTACTS = 64  # surface points of each of two things that are tested for being inside the other


@dataclass(frozen=True)
class Neighbour:
    """Another object by its most likely particle, as Algorithm 1 takes it."""

    object_id: int
    shape: Shape
    T_world_centre: Array
    """(4, 4)"""
    claim: float
    """by which of two in one place has it: evidence of its being there, nats, or the number of its boxes"""

    def yields_to(self, other: Neighbour) -> bool:
        """Whether both claim the same space and the other does so more strongly: the pixels there are its alone."""
        stronger = (other.claim, -other.object_id) > (self.claim, -self.object_id)
        return stronger and self._contends(other)

    def _contends(self, other: Neighbour) -> bool:
        apart = np.linalg.norm(self.T_world_centre[:3, 3] - other.T_world_centre[:3, 3])
        if apart > self.shape.reach_m + other.shape.reach_m:
            return False
        # two of one form in one pose touch everywhere and reach into each other nowhere
        if apart < one_place_m(self.shape, other.shape):
            return True
        T_own_other = (se3.inverse(self.T_world_centre) @ other.T_world_centre)[None]
        return bool(penetration_depth(self.shape, other.shape, T_own_other)[0] > _CONTENTION_M)


@dataclass(frozen=True)
class Surroundings:
    """At one keyframe, in the world frame."""

    neighbours: tuple[Neighbour, ...]
    supports: tuple[Plane, ...]
    """level surfaces, world frame; empty where up is unknown"""
    company: Company = field(default_factory=dict)
    """who was moved together"""
    partner: Partner | None = None
    """of the object that this is around"""
    _surfaces: dict[int, tuple[tuple[Plane, Array], ...]] = field(default_factory=dict, repr=False, compare=False)
    """frame -> supports in its camera's frame and where in its image: the same for all objects, worked out once"""

    def without(self, object_id: int) -> Surroundings:
        """The same for one object: it is not its own neighbour, nor are those that yield to it."""
        own = next((n for n in self.neighbours if n.object_id == object_id), None)
        others = (n for n in self.neighbours if n.object_id != object_id)
        around = tuple(n for n in others if own is None or not n.yields_to(own))
        return replace(self, neighbours=around, partner=self.company.get(object_id))

    def beneath(self, tile: Tile, frame: Frame, box: Array) -> Tile:
        """The tile of a thing with a box (x, y, w, h), with known surfaces behind where this image alone shows none."""
        if frame.index not in self._surfaces:
            moved = (s.moved(frame.T_camera_world) for s in self.supports)
            self._surfaces[frame.index] = tuple((s, where_in_image(s, frame.camera)) for s in moved)
        views = self._surfaces[frame.index]
        others = tuple(s for s, where in views if reaches_beyond(s, where, box, frame.camera))
        known = plane_depth(others, tile.camera)
        return replace(tile, background=np.where(tile.background > 0, tile.background, known))

    def behind(self, tile: Tile, frame: Frame) -> Tile:
        """The tile with the neighbours joined to its background: their pixels are theirs."""
        poses = [(n.shape, frame.T_camera_world @ n.T_world_centre) for n in self.neighbours]
        items = [(shape.mesh, T) for shape, T in poses if _may_show(shape.reach_m, T[:3, 3], tile.camera)]
        if not items:
            return tile
        there = render_scene(items, tile.camera).depth
        nearer = (there > 0) & ((tile.background == 0) | (there < tile.background))
        return replace(tile, background=np.where(nearer, there, tile.background))

    def log_potential(self, model: Model, shape: Shape, T_world_centre: Array) -> Array:
        """The context potential of poses (K, 4, 4), nats (K,): once for a stationary episode. 0 without context."""
        if not model.context or not len(T_world_centre):
            return np.zeros(len(T_world_centre))
        apart = self._apart(T_world_centre)
        together = self._relations(model, shape, T_world_centre, apart)
        together += self._penetration(model, shape, T_world_centre, apart)
        return together + support_log_potential(model, shape, T_world_centre, self.supports)

    def relations(self, model: Model, shape: Shape, T_world_centre: Array) -> dict[int, float]:
        """What each related neighbour, and a partner, says of one pose (4, 4), relative to its greatest value, nats.

        As the graph's factor for the pair says it, there spread over the keyframes that the two share.
        """
        out = {}
        for other in self.neighbours if model.context else ():
            pair = model.relations[shape.index, other.shape.index]
            known = self._partnership(shape, other)
            if pair.together > 0.0 or known is not None:
                distance = np.linalg.norm(T_world_centre[:3, 3] - other.T_world_centre[:3, 3])
                said = context_log_ratio(distance, pair, self._instance(shape, T_world_centre[None], other)[0])
                greatest = context_log_ratio(pair.usual_m, pair, 0.0 if known is None else known.log_peak)
                out[other.object_id] = float(said - greatest)
        return out

    def _apart(self, T_world_centre: Array) -> Array:
        """Distances (N, K) of N neighbours' centres from poses (K, 4, 4), metres."""
        centres = np.array([n.T_world_centre[:3, 3] for n in self.neighbours]).reshape(-1, 1, 3)
        return np.asarray(np.linalg.norm(T_world_centre[:, :3, 3] - centres, axis=-1))

    def _relations(self, model: Model, shape: Shape, T: Array, apart: Array) -> Array:
        classes = np.array([[other.shape.index] for other in self.neighbours], dtype=np.int64).reshape(-1, 1)
        instance = np.array([self._instance(shape, T, other) for other in self.neighbours]).reshape(apart.shape)
        related = model.relations[shape.index, classes]
        return np.asarray(context_log_ratio(apart, related, instance).sum(axis=0))

    def _instance(self, shape: Shape, T: Array, other: Neighbour) -> Array:
        """What earlier visits, or other ones, say of a pair; 0 but for the one that was moved together."""
        known = self._partnership(shape, other)
        return np.zeros(len(T)) if known is None else known.log_ratio(shape, T, other.shape, other.T_world_centre)

    def _partnership(self, shape: Shape, other: Neighbour) -> Partner | None:
        """The partner where it is this neighbour, and both are of the classes that it is known of."""
        own = self.partner
        return own if own is not None and own.concerns(other.object_id, (shape.index, other.shape.index)) else None

    def _penetration(self, model: Model, shape: Shape, T: Array, apart: Array) -> Array:
        settings = model.config.context
        total = np.zeros(len(T))
        reach = np.array([[shape.reach_m + other.shape.reach_m] for other in self.neighbours]).reshape(-1, 1)
        touching = apart < reach
        for n in np.flatnonzero(touching.any(axis=1)):
            other, near = self.neighbours[n], touching[n]
            depth = penetration_depth(shape, other.shape, se3.inverse(T[near]) @ other.T_world_centre)
            sinking = hinge_log_potential(depth - settings.support_tolerance_m, settings.penetration_sigma_m)
            total[near] += doubted(sinking, settings.doubt)
        return total


def _may_show(reach_m: float, centre: Array, camera: Camera) -> bool:
    """Whether any of a ball about a point (3,) in the camera frame can be in the image; never wrongly no."""
    nearest, farthest = centre[2] - reach_m, centre[2] + reach_m
    if nearest < NEAR_M:
        return bool(farthest > 0.0)
    for at, focal, middle, size in (
        (centre[0], camera.fx, camera.cx, camera.width),
        (centre[1], camera.fy, camera.cy, camera.height),
    ):
        low, high = at - reach_m, at + reach_m
        left = focal * low / (nearest if low < 0.0 else farthest) + middle
        right = focal * high / (nearest if high > 0.0 else farthest) + middle
        if right < -1.0 or left > size:
            return False
    return True


def penetration_depth(a: Shape, b: Shape, T_a_b: Array) -> Array:
    """How deep two shapes reach into each other at relative poses (K, 4, 4) of their centre frames: (K,) metres.

    Both ways, as nothing of a box's surface lies inside a thing that is in the box.
    """
    theirs = a.distance.deepest(T_a_b, b.surface_points(_CONTACTS))
    return np.maximum(theirs, b.distance.deepest(se3.inverse(T_a_b), a.surface_points(_CONTACTS)))


def support_log_potential(model: Model, shape: Shape, T_world_centre: Array, supports: tuple[Plane, ...]) -> Array:
    """How well poses (K, 4, 4) stand on the level surface that suits them best, nats (K,); 0 where none is below.

    Floating is a hinge with a floor: a thing may rest on something that was not seen. Sinking has no floor: surfaces
    are solid. A thing wholly beneath a surface has nothing to do with it, and a table doesn't stand on its own top.
    """
    settings = model.config.context
    low, high = heights_above(supports, shape, T_world_centre)
    concerned = high > 0.0
    for row, plane in zip(concerned, supports, strict=True):
        if row.any():
            row &= ~_own_surface(shape, T_world_centre, plane)
    best = np.zeros(len(T_world_centre))
    stands = concerned.any(axis=0)
    if stands.any():
        floating = hinge_log_potential(low - settings.support_tolerance_m, settings.support_sigma_m)
        sinking = hinge_log_potential(-low - settings.support_tolerance_m, settings.penetration_sigma_m)
        potential = doubted(floating, settings.other_support) + doubted(sinking, settings.doubt)
        best[stands] = np.where(concerned, potential, -np.inf).max(axis=0)[stands]
    return best


def heights_above(planes: tuple[Plane, ...], shape: Shape, T_world_centre: Array) -> tuple[Array, Array]:
    """Heights of a shape's lowest and highest points above P planes at poses (K, 4, 4): twice (P, K), metres.

    -inf where the foot of its centre is outside of the plane's outline, as `Plane.contains` has it.
    """
    poses = np.ascontiguousarray(T_world_centre, dtype=np.float64)
    low, high = np.full((2, len(planes), len(poses)), -np.inf)
    for p, plane in enumerate(planes):
        there = plane.normal, plane.offset, plane.T_frame_plane, plane.hull
        _heights_above(poses, shape.hull_points, *there, low[p], high[p])
    return low, high


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _heights_above(poses, points, normal, offset, T_world_plane, outline, low, high):
    """Least and greatest height of points (H, 3) above a plane, into (K,), at poses with their feet in its outline."""
    low_x, high_x, low_y, high_y = outline[:, 0].min(), outline[:, 0].max(), outline[:, 1].min(), outline[:, 1].max()
    nx, ny, nz = normal[0], normal[1], normal[2]
    for k in range(len(poses)):
        dx = poses[k, 0, 3] - T_world_plane[0, 3]
        dy = poses[k, 1, 3] - T_world_plane[1, 3]
        dz = poses[k, 2, 3] - T_world_plane[2, 3]
        x = T_world_plane[0, 0] * dx + T_world_plane[1, 0] * dy + T_world_plane[2, 0] * dz
        y = T_world_plane[0, 1] * dx + T_world_plane[1, 1] * dy + T_world_plane[2, 1] * dz
        if not (low_x <= x <= high_x and low_y <= y <= high_y):
            continue
        left, right = True, True
        for i in range(len(outline)):
            j = i + 1 if i + 1 < len(outline) else 0
            side = (outline[j, 0] - outline[i, 0]) * (y - outline[i, 1])
            side -= (outline[j, 1] - outline[i, 1]) * (x - outline[i, 0])
            left &= side >= 0.0
            right &= side <= 0.0
        if not (left or right):
            continue
        # the normal in the shape's own axes: heights of all its points without moving them
        a = nx * poses[k, 0, 0] + ny * poses[k, 1, 0] + nz * poses[k, 2, 0]
        b = nx * poses[k, 0, 1] + ny * poses[k, 1, 1] + nz * poses[k, 2, 1]
        c = nx * poses[k, 0, 2] + ny * poses[k, 1, 2] + nz * poses[k, 2, 2]
        least, greatest = np.inf, -np.inf
        for h in range(len(points)):
            height = a * points[h, 0] + b * points[h, 1] + c * points[h, 2]
            least = height if height < least else least
            greatest = height if height > greatest else greatest
        centre = nx * poses[k, 0, 3] + ny * poses[k, 1, 3] + nz * poses[k, 2, 3] - offset
        low[k], high[k] = least + centre, greatest + centre


def _own_surface(shape: Shape, T_world_centre: Array, plane: Plane) -> NDArray[np.bool_]:
    """Whether a surface is part of a shape at poses (K, 4, 4): (K,)."""
    own = np.zeros(len(T_world_centre), dtype=np.bool_)
    if _radius(plane.hull) > 2.0 * shape.reach_m:
        return own
    middle = plane.hull.mean(axis=0)
    # halfway in: the outline reaches beyond what was measured
    flat = np.concatenate([middle[None], 0.5 * (middle + plane.hull)])
    points = se3.transform(plane.T_frame_plane, np.concatenate([flat, np.zeros((len(flat), 1))], axis=-1))
    near = np.linalg.norm(T_world_centre[:, :3, 3] - points[0], axis=-1) < 2.0 * shape.reach_m
    inside = se3.transform(se3.inverse(T_world_centre[near]), points)
    own[near] = np.median(np.abs(shape.distance.at(inside)), axis=-1) < _OWN_M
    return own


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _radius(points):
    """Greatest distance of points (n, 2) from their mean."""
    x, y, farthest = 0.0, 0.0, 0.0
    for i in range(len(points)):
        x, y = x + points[i, 0], y + points[i, 1]
    x, y = x / len(points), y / len(points)
    for i in range(len(points)):
        farthest = max(farthest, (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2)
    return math.sqrt(farthest)
