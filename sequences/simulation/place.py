"""A place: a corner of a room with a table and a shelf, and things that stand on them.

World frame: z up, the origin in the corner on the floor. The table's wall is the plane y = 0, the shelf's the plane
x = 0; the room is where y < 0 and x has the sign of `Place.side`. Floor, walls and what hangs on them have no class:
nobody modelled them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from sequences import se3
from sequences.catalogue import Mesh
from sequences.errors import InputError
from sequences.seeds import generator
from sequences.simulation.config import PlaceConfig
from sequences.simulation.room import room_mesh
from sequences.simulation.shapes import SHELF, TABLE, Shape, household
from sequences.simulation.solids import rotation

Array = NDArray[np.float64]

WALL_GAP_M = 0.02  # between furniture and its wall
TRIES = 400
FRONT_YAW_RAD = 0.45  # on a shelf things face the room, more or less


@dataclass(frozen=True)
class Placed:
    """One physical object somewhere."""

    inst_id: int
    shape: Shape
    T_world_object: Array
    """(4, 4)"""
    spot: int = -1
    """position in Place.spots of where it stands; -1 on the floor"""


@dataclass(frozen=True)
class Spot:
    """A part of a support area where a thing may stand with its middle."""

    furniture: int
    """position in Place.furniture"""
    T_world_area: Array
    """(4, 4) z up, origin at the area's centre on its surface, -y towards the room"""
    area_size: Array
    """(2,) what the thing's whole outline must stay in, metres"""
    low: Array
    """(2,) where its middle may be, area frame"""
    high: Array
    """(2,)"""
    headroom_m: float
    faces_room: bool
    """whether things on it face the room"""


@dataclass(frozen=True)
class Place:
    """Furniture and room; what stands where is the visits' business."""

    shapes: tuple[Shape, ...]
    """of the catalogue: those in the place and the distractors"""
    stock: tuple[Shape, ...]
    """one for each small thing"""
    furniture: tuple[Placed, ...]
    spots: tuple[Spot, ...]
    homes: dict[str, int]
    """category -> position in `spots` where such things usually stand"""
    room: Mesh
    """floor, walls and what hangs on them, world frame"""
    side: int
    """+1: the shelf stands left of the table, -1: right of it"""

    @property
    def table(self) -> Placed:
        """The table."""
        return self.furniture[0]

    @property
    def shelf(self) -> Placed:
        """The shelf."""
        return self.furniture[1]


def furnish(config: PlaceConfig, seed: int) -> Place:
    """Set up the room, choose the things and give each category its spot."""
    rng = generator(seed, "simulation.place")
    small = [s for s in household() if s.object_class.movable]
    stock, distractors = _choose(small, config.objects, config.distractors, rng)
    side = int(rng.choice([-1, 1]))
    furniture = _place_furniture(side, len(stock), rng)
    spots = tuple(spot for k, piece in enumerate(furniture) for spot in _spots(k, piece))
    categories = sorted({s.object_class.category for s in small})
    homes = dict(zip(categories, (int(k) for k in rng.permutation(len(spots))), strict=False))
    used = {s.object_class.obj_id for s in (*stock, *distractors, *(p.shape for p in furniture))}
    shapes = tuple(s for s in household() if s.object_class.obj_id in used)
    room = room_mesh(side, furniture[0].T_world_object[:3, 3], generator(seed, "simulation.room"))
    return Place(shapes, stock, furniture, spots, homes, room, side)


def _choose(
    small: Sequence[Shape], n: int, n_distractors: int, rng: np.random.Generator
) -> tuple[tuple[Shape, ...], tuple[Shape, ...]]:
    """Things in random order, one of each category first, so that even a few are of several categories."""
    shuffled = [small[k] for k in rng.permutation(len(small))]
    seen: dict[str, int] = {}
    rank = [seen.setdefault(s.object_class.category, k) != k for k, s in enumerate(shuffled)]
    ordered = [s for _, s in sorted(zip(rank, shuffled, strict=True), key=lambda pair: pair[0])]
    stock = tuple(ordered[k % len(ordered)] for k in range(n))
    return stock, tuple(ordered[n : n + n_distractors])


def _place_furniture(side: int, n_things: int, rng: np.random.Generator) -> tuple[Placed, Placed]:
    """The table at the back wall, the shelf at the side wall; their inst_ids follow those of the things."""
    table_x = side * (SHELF[1] + 0.2 + TABLE[0] / 2 + rng.uniform(0.0, 0.2))
    table = se3.make(np.eye(3), np.array([table_x, -WALL_GAP_M - TABLE[1] / 2, TABLE[2] / 2]))
    shelf_y = -(TABLE[1] + 0.1 + SHELF[0] / 2 + rng.uniform(0.0, 0.15))
    shelf_at = np.array([side * (WALL_GAP_M + SHELF[1] / 2), shelf_y, SHELF[2] / 2])
    shelf = se3.make(rotation("z", side * 90.0), shelf_at)
    shapes = {s.object_class.name: s for s in household()}
    return Placed(n_things + 1, shapes["table"], table), Placed(n_things + 2, shapes["shelf"], shelf)


def _spots(furniture: int, piece: Placed) -> list[Spot]:
    """A table's area makes three spots side by side, a shelf's board one."""
    spots = []
    shelf = len(piece.shape.areas) > 1
    for area in piece.shape.areas:
        T_world_area = piece.T_world_object @ se3.make(np.eye(3), area.centre)
        edges = np.linspace(-0.5, 0.5, 2 if shelf else 4) * area.size[0]
        for left, right in pairwise(edges):
            low, high = np.array([left, -area.size[1] / 2]), np.array([right, area.size[1] / 2])
            spots.append(Spot(furniture, T_world_area, area.size, low, high, area.headroom_m, faces_room=shelf))
    return spots


def stock_place(place: Place, config: PlaceConfig, seed: int) -> tuple[Placed, ...]:
    """Put every thing somewhere: the large ones first, as people do; inst_ids from 1 in the order of `Place.stock`.

    Raises:
        InputError: the place is too full.
    """
    things: dict[int, Placed] = {}
    for k in np.argsort([-s.object_class.diameter_m for s in place.stock], kind="stable"):
        shape, inst_id = place.stock[k], int(k) + 1
        rng = generator(seed, "simulation.stock", inst_id)
        placed = put(place, inst_id, shape, tuple(things.values()), config, rng)
        if placed is None:
            raise InputError(
                f"found no free spot for {shape.object_class.name}, thing {inst_id} of {len(place.stock)}",
                field="place.objects",
                remedy="simulate fewer objects, or set a smaller place.clearance_m",
            )
        things[inst_id] = placed
    return tuple(things[k + 1] for k in range(len(place.stock)))


def put(
    place: Place,
    inst_id: int,
    shape: Shape,
    others: Sequence[Placed],
    config: PlaceConfig,
    rng: np.random.Generator,
    avoid_area: Array | None = None,
) -> Placed | None:
    """Stand a thing on a surface, in a stable rest with a random yaw, clear of the others; None where nothing is free.

    Args:
        place: where.
        inst_id: of the thing.
        shape: of the thing.
        others: what stands there already.
        config: clearance and sense of order.
        rng: draws all of it.
        avoid_area: T_world_area (4, 4) of a surface it shall not stand on.
    """
    for _ in range(TRIES):
        home = place.homes.get(shape.object_class.category, 0)
        k = home if rng.random() < config.together else int(rng.integers(len(place.spots)))
        spot = place.spots[k]
        yaw = rng.uniform(-FRONT_YAW_RAD, FRONT_YAW_RAD) if spot.faces_room else rng.uniform(-np.pi, np.pi)
        rest = shape.rests[min(int(rng.geometric(0.6)) - 1, len(shape.rests) - 1)]
        middle = rng.uniform(spot.low, spot.high)
        if avoid_area is not None and np.array_equal(avoid_area, spot.T_world_area):
            continue
        T_area_object = _rest_on(shape, rotation("z", np.degrees(yaw)) @ rest, middle)
        if _fits(shape, T_area_object, spot, others, place, config):
            return Placed(inst_id, shape, spot.T_world_area @ T_area_object, k)
    return None


def _rest_on(shape: Shape, R: Array, middle: Array) -> Array:
    """T_area_object (4, 4): the lowest vertex on the surface."""
    low = (shape.object_class.mesh.vertices @ R.T)[:, 2].min()
    return se3.make(R, np.array([middle[0], middle[1], -low]))


def _fits(
    shape: Shape, T_area_object: Array, spot: Spot, others: Sequence[Placed], place: Place, config: PlaceConfig
) -> bool:
    points = se3.transform(T_area_object, shape.object_class.mesh.vertices)
    inside = (np.abs(points[:, :2]).max(axis=0) < spot.area_size / 2 - config.clearance_m).all()
    if not inside or points[:, 2].max() > spot.headroom_m - config.clearance_m:
        return False
    outline = footprint(shape, spot.T_world_area @ T_area_object)
    here = [o for o in others if np.array_equal(place.spots[o.spot].T_world_area, spot.T_world_area)]
    return all(separation(outline, footprint(o.shape, o.T_world_object)) >= config.clearance_m for o in here)


def footprint(shape: Shape, T_world_object: Array) -> Array:
    """(n, 2) convex outline seen from above, counter-clockwise, world x and y."""
    points = se3.transform(T_world_object, shape.object_class.mesh.vertices)[:, :2]
    return points[ConvexHull(points).vertices]


def separation(a: Array, b: Array) -> float:
    """The widest gap that a line along an edge leaves between convex outlines (n, 2); negative where they overlap."""
    best = -np.inf
    for one, other in ((a, b), (b, a)):
        edge = np.roll(one, -1, axis=0) - one
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=-1) / np.linalg.norm(edge, axis=-1, keepdims=True)
        gap = np.einsum("nk,mk->nm", normal, other) - np.einsum("nk,nk->n", normal, one)[:, None]
        best = max(best, float(gap.min(axis=1).max()))
    return best
