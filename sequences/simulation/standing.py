"""How things stand on surfaces: in a stable rest, all of their outline on the surface, clear of each other.

Outlines are convex hulls seen from above, so what is kept apart here can't touch, whatever its shape.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.simulation.config import PlaceConfig
from sequences.simulation.place import Place, Placed, outline_of
from sequences.simulation.shapes import Shape
from sequences.simulation.solids import rotation

Array = NDArray[np.float64]

TRIES_AT_HOME, TRIES = 100, 400
FRONT_YAW_RAD = 0.45  # on a shelf's board things face the room, more or less
USUAL_REST = 0.7  # of the rests that are left, the next most usual is taken so often


def put(
    place: Place,
    inst_id: int,
    others: Sequence[Placed],
    config: PlaceConfig,
    rng: np.random.Generator,
    leave: int | None = None,
) -> Placed | None:
    """Stand a thing on a surface with a random yaw, rather where its category has its spot; None where nothing is free.

    Args:
        place: where.
        inst_id: of the thing, of `Place.loose`.
        others: what stands there already.
        config: clearance and sense of order.
        rng: draws all of it.
        leave: inst_id of a piece of furniture that it shall not stand on.
    """
    body, hull = place.loose[inst_id], place.hulls[inst_id]
    home = place.homes.get(body.object_class.category) if isinstance(body, Shape) else None
    for k in _spots_to_try(place, home, config, leave, rng):
        spot = place.spots[k]
        across, along, turn, usual = rng.random(4)
        yaw = (2.0 * turn - 1.0) * (np.pi if place.surfaces[spot.surface].open else FRONT_YAW_RAD)
        rest = body.rests[min(int(np.log(1.0 - usual) / np.log(1.0 - USUAL_REST)), len(body.rests) - 1)]
        middle = spot.low + np.array([across, along]) * (spot.high - spot.low)
        T_area_object = _rest_on(hull, rotation("z", np.degrees(yaw)) @ rest, middle)
        placed = _standing(place, inst_id, T_area_object, spot.surface, others, config)
        if placed is not None:
            return placed
    return None


def _spots_to_try(
    place: Place, home: int | None, config: PlaceConfig, leave: int | None, rng: np.random.Generator
) -> Iterator[int]:
    """Positions in Place.spots: home many times where the thing shall stand there, then any, piece by piece."""
    there = [piece.inst_id for piece in place.furniture]
    orderly = rng.random() < config.together
    if home is not None and orderly and there[place.furniture_under(home)] != leave:
        yield from repeat(home, TRIES_AT_HOME)
    pieces = [k for k, inst_id in enumerate(there) if inst_id != leave]
    shares = np.cumsum(place.odds[pieces])
    for _ in range(TRIES if pieces else 0):
        piece, spot = rng.random(2)
        spots = place.spots_on[pieces[int(np.searchsorted(shares, piece * shares[-1]))]]
        yield spots[int(spot * len(spots))]


def shift(
    place: Place, placed: Placed, others: Sequence[Placed], config: PlaceConfig, metres: Array, yaw: float
) -> Placed | None:
    """Push a thing along its surface by metres (2,), area frame, and turn it by a yaw, rad; None where it can't."""
    T_world_area = place.surfaces[placed.surface].T_world_area
    T_area_object = se3.inverse(T_world_area) @ placed.T_world_object
    T = T_area_object.copy()
    T[:3, :3] = rotation("z", np.degrees(yaw)) @ T_area_object[:3, :3]
    T[:2, 3] += metres
    return _standing(place, placed.inst_id, T, placed.surface, others, config)


def _rest_on(hull: Array, R: Array, middle: Array) -> Array:
    """T_area_object (4, 4): the lowest point on the surface."""
    return se3.make(R, np.array([middle[0], middle[1], -(hull @ R[2]).min()]))


def _standing(
    place: Place, inst_id: int, T_area_object: Array, on: int, others: Iterable[Placed], config: PlaceConfig
) -> Placed | None:
    """The thing there, if it fits: its outline within the surface, under what is above, clear of the others."""
    surface = place.surfaces[on]
    points = se3.transform(T_area_object, place.hulls[inst_id])
    inside = (np.abs(points[:, :2]).max(axis=0) < surface.size / 2 - config.clearance_m).all()
    if not inside or points[:, 2].max() > surface.headroom_m - config.clearance_m:
        return None
    outline = outline_of(se3.transform(surface.T_world_area, points))
    here = (o.outline for o in others if o.surface == on and o.inst_id != inst_id)
    if not all(_clear(outline, other, config.clearance_m) for other in here):
        return None
    return Placed(inst_id, place.loose[inst_id], surface.T_world_area @ T_area_object, outline, on)


def _clear(a: Array, b: Array, least: float) -> bool:
    """Whether there is at least so much between two outlines (n, 2)."""
    boxes = np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0)).max()  # the quicker test
    return bool(boxes >= least) or separation(a, b) >= least


def separation(a: Array, b: Array) -> float:
    """The widest gap that a line along an edge leaves between convex outlines (n, 2); negative where they overlap."""
    best = -np.inf
    for one, other in ((a, b), (b, a)):
        edge = np.roll(one, -1, axis=0) - one
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=-1) / np.linalg.norm(edge, axis=-1, keepdims=True)
        gap = np.einsum("nk,mk->nm", normal, other) - np.einsum("nk,nk->n", normal, one)[:, None]
        best = max(best, float(gap.min(axis=1).max()))
    return best
