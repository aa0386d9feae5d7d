"""What stands around an object when it is weighed: its neighbours' best poses and the level surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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
        for other, away in zip(self.neighbours, apart, strict=True):
            near = np.flatnonzero(away < shape.reach_m + other.shape.reach_m)
            if len(near):
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
    best = np.full(len(T_world_centre), -np.inf)
    for plane in supports:
        above = plane.contains(T_world_centre[:, :3, 3])
        if not above.any():
            continue
        # the normal in the shape's own axes: heights of all its points without moving them
        along = plane.normal @ T_world_centre[:, :3, :3]
        heights = along @ shape.hull_points.T + (T_world_centre[:, :3, 3] @ plane.normal - plane.offset)[:, None]
        low, high = heights.min(axis=-1), heights.max(axis=-1)
        floating = hinge_log_potential(low - settings.support_tolerance_m, settings.support_sigma_m)
        sinking = hinge_log_potential(-low - settings.support_tolerance_m, settings.penetration_sigma_m)
        potential = doubted(floating, settings.other_support) + doubted(sinking, settings.doubt)
        concerned = above & (high > 0.0) & ~_own_surface(shape, T_world_centre, plane)
        best = np.where(concerned, np.maximum(best, potential), best)
    return np.where(np.isneginf(best), 0.0, best)


def _own_surface(shape: Shape, T_world_centre: Array, plane: Plane) -> NDArray[np.bool_]:
    """Whether a surface is part of a shape at poses (K, 4, 4): (K,)."""
    own = np.zeros(len(T_world_centre), dtype=np.bool_)
    middle = plane.hull.mean(axis=0)
    if np.linalg.norm(plane.hull - middle, axis=-1).max() > 2.0 * shape.reach_m:
        return own
    # halfway in: the outline reaches beyond what was measured
    flat = np.concatenate([middle[None], 0.5 * (middle + plane.hull)])
    points = se3.transform(plane.T_frame_plane, np.concatenate([flat, np.zeros((len(flat), 1))], axis=-1))
    near = np.linalg.norm(T_world_centre[:, :3, 3] - points[0], axis=-1) < 2.0 * shape.reach_m
    inside = se3.transform(se3.inverse(T_world_centre[near]), points)
    own[near] = np.median(np.abs(shape.distance.at(inside)), axis=-1) < _OWN_M
    return own
