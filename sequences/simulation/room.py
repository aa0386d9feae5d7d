"""The room itself: floor, walls, and what hangs on them and stands about though nobody modelled it.

The room's frame: the origin is a corner on the floor, x and y run along two walls into the room, z is up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.catalogue import Mesh
from sequences.simulation import fittings, solids
from sequences.simulation.lighting import Window
from sequences.simulation.solids import placed, plain, rotation
from sequences.simulation.walls import (
    RECESS_M,
    Opening,
    Parts,
    boards,
    carpet,
    faded,
    papered,
    sheet,
    skirting,
    tiles,
    wall,
    wall_tiles,
)

Array = NDArray[np.float64]

HEIGHT_M = 2.6
BEFORE_WALL_M = 0.5  # what is nearer to a wall than this stands before it
DOOR_M = (0.86, 2.05)
DOOR_CLEAR_M = 1.0  # free floor before a door
OFF_WALL_M = 0.025  # where there is skirting
STEP_M = 0.05  # between the places tried for a fitting
TILED_M = 1.35  # height of a wall's tiles
GAP_M = 0.08  # between fittings, and between what stands on the floor
TINTS = ((228, 222, 210), (204, 214, 206), (206, 212, 218), (226, 208, 186), (216, 218, 222), (196, 204, 190))
ACCENTS = ((150, 172, 160), (140, 158, 178), (196, 150, 120), (176, 166, 190), (206, 184, 130))
CURTAINS = ((232, 226, 212), (134, 152, 168), (196, 110, 88), (168, 178, 140), (214, 190, 120))
DOORS = ((236, 234, 228), (176, 130, 86), (206, 200, 188))


@dataclass(frozen=True)
class Style:
    """What is usual in a kind of room."""

    floors: tuple[Callable[[Sequence[float], np.random.Generator], Parts], ...]
    """drawn from evenly"""
    finish: tuple[str, ...]
    """of the one wall that differs from the others, drawn from evenly: papered, tinted or tiled"""
    rug: float
    """probability that one is laid where there is space"""


STYLES: Mapping[str, Style] = {
    "kitchen": Style((tiles, tiles, boards), ("tiled", "tiled", "tinted"), 0.2),
    "living room": Style((boards, boards, carpet), ("papered", "tinted"), 0.9),
    "bathroom": Style((tiles,), ("tiled",), 0.3),
    "study": Style((boards, carpet), ("papered", "tinted"), 0.6),
    "workroom": Style((tiles, boards), ("tinted",), 0.0),
}
ANY = Style((boards, boards, tiles, carpet), ("papered", "tinted", "tiled"), 0.8)


@dataclass(frozen=True)
class Room:
    """What is there besides furniture and things."""

    mesh: Mesh
    """the room's frame"""
    window: Window | None
    """None where no wall had space for one"""


@dataclass
class _Wall:
    """A wall while it is being furnished."""

    length: float
    T_room_wall: Array
    boxes: Array
    """(n, 2, 3) low and high corners of what stands in the room, wall frame: the room is where y < 0"""
    openings: list[Opening] = field(default_factory=list)
    taken: list[Opening] = field(default_factory=list)
    """what is hung or cut already, with its margin"""
    parts: Parts = field(default_factory=list)
    """wall frame"""

    def find(
        self, width: float, low: float, high: float, rng: np.random.Generator, clear_m: float = BEFORE_WALL_M
    ) -> Opening | None:
        """A free rectangle of a width between two heights, nothing within `clear_m` before it; None where none is."""
        near = self.boxes[(self.boxes[:, 1, 1] > -clear_m) & (self.boxes[:, 1, 2] > low)]
        blocked = [(b[0, 0], b[1, 0]) for b in near] + [t[:2] for t in self.taken if t[3] > low and t[2] < high]
        starts = np.arange(GAP_M, self.length - width - GAP_M, STEP_M)
        for left in rng.permutation(starts):
            if all(left > b or left + width < a for a, b in blocked):
                return (float(left), float(left + width), low, high)
        return None

    def take(self, place: Opening, margin: float = GAP_M) -> None:
        """Nothing else may hang there."""
        left, right, low, high = place
        self.taken.append((left - margin, right + margin, low - margin, high + margin))


def room(size: Sequence[float], boxes: Array, rng: np.random.Generator, kind: str = "mixed") -> Room:
    """A room that somebody lives in.

    What it adds keeps clear of what stands in it: a window comes only over low furniture, a door only where one can
    walk in, plants and baskets only on free floor along the walls, a rug only on free floor.

    Args:
        size: (2,) along x and y, metres.
        boxes: (n, 2, 3) least and greatest corner of each piece of furniture, and of any other space to be kept clear,
            metres, the room's frame.
        rng: draws all of it.
        kind: one of STYLES; anything goes in a room of another kind.
    """
    style = STYLES.get(kind, ANY)
    boxes = np.asarray(boxes, dtype=np.float64).reshape(-1, 2, 3)
    walls = _walls(np.asarray(size, dtype=np.float64), boxes)
    in_any_order = [walls[int(k)] for k in rng.permutation(4)]
    door_floor = _add_door(in_any_order, rng)
    window = _add_window(in_any_order[::-1], rng)
    _hang_pictures(in_any_order, rng)
    _paint_walls(walls, style, rng)
    floor = style.floors[int(rng.integers(len(style.floors)))](size, rng)
    ceiling = sheet((0.0, 0.0, HEIGHT_M), (0.0, size[1], 0.0), (size[0], 0.0, 0.0), 8, 8)
    kept_clear = [*(b[:, :2] for b in boxes), *door_floor]
    parts: Parts = [
        *floor,
        (ceiling, plain((246, 245, 242))),
        *(part for w in walls for part in _put(w.parts, w.T_room_wall)),
        *_stand_about(walls, kept_clear, rng),
    ]
    if rng.random() < style.rug:
        parts += _lay_rug(np.asarray(size, dtype=np.float64), kept_clear, rng)
    return Room(solids.join(parts), window)


def _walls(size: Array, boxes: Array) -> list[_Wall]:
    """The four, each turned so that one sees it from inside."""
    x, y = size
    corners = [(x, 0.0, y, 0.0), (y, -90.0, y, x), (x, 180.0, 0.0, x), (y, 90.0, 0.0, 0.0)]
    walls = []
    for length, yaw, at_y, at_x in corners:
        T_room_wall = se3.make(rotation("z", yaw), np.array([at_x, at_y, 0.0]))
        local = se3.transform(se3.inverse(T_room_wall), boxes.reshape(-1, 3)).reshape(-1, 2, 3)
        walls.append(_Wall(float(length), T_room_wall, np.stack([local.min(axis=1), local.max(axis=1)], axis=1)))
    return walls


def _put(parts: Parts, T: Array) -> Parts:
    """Parts moved by T (4, 4)."""
    return [placed(part, T[:3, 3], T[:3, :3]) for part in parts]


def _add_door(walls: Sequence[_Wall], rng: np.random.Generator) -> list[Array]:
    """A door in the first wall that has space; what floor (2, 2) must stay free before it, if any."""
    colour = DOORS[int(rng.integers(len(DOORS)))]
    for w in walls:
        place = w.find(DOOR_M[0], 0.0, DOOR_M[1], rng, clear_m=DOOR_CLEAR_M)
        if place is not None:
            w.openings.append(place)
            w.take(place, margin=0.16)
            right_of_it = place[1] + 0.2 < w.length - 0.1
            w.parts += [
                *fittings.door(place, colour),
                *fittings.switch(place[1] + 0.2 if right_of_it else place[0] - 0.2, 1.1),
            ]
            corners = np.array([[place[0], 0.0, 0.0], [place[1], -DOOR_CLEAR_M, 0.0]])
            there = se3.transform(w.T_room_wall, corners)[:, :2]
            return [np.stack([there.min(axis=0), there.max(axis=0)])]
    return []


def _add_window(walls: Sequence[_Wall], rng: np.random.Generator) -> Window | None:
    """A window with curtains in the first wall that has space, a radiator under it where that is free."""
    low, high, width = 0.95, 2.15, float(rng.uniform(1.0, 1.5))
    colour, long = CURTAINS[int(rng.integers(len(CURTAINS)))], bool(rng.random() < 0.5)
    side = 0.36  # of a curtain beside the opening
    for w in walls:
        place = w.find(width + 2.0 * side, low - 0.1, high + 0.2, rng)
        if place is None:
            continue
        opening = (place[0] + side, place[1] - side, low, high)
        w.openings.append(opening)
        w.take(place)
        floor_is_free = not any(b[1, 1] > -BEFORE_WALL_M and b[0, 0] < place[1] and b[1, 0] > place[0] for b in w.boxes)
        w.parts += [*fittings.window(opening, rng), *fittings.curtains(opening, colour, long and floor_is_free)]
        if floor_is_free:
            w.parts += fittings.radiator(opening)
        middle = np.array([(opening[0] + opening[1]) / 2.0, RECESS_M - 0.01, (low + high) / 2.0])
        return Window(w.T_room_wall @ se3.make(np.eye(3), middle), np.array([width, high - low]))
    return None


def _hang_pictures(walls: Sequence[_Wall], rng: np.random.Generator) -> None:
    """One to three pictures a wall as far as there is space, and a clock on one of them."""
    for k, w in enumerate(walls):
        if k == 0 and (place := w.find(0.3, 1.75, 2.05, rng)) is not None:
            w.take(place)
            w.parts += fittings.clock((place[0] + place[1]) / 2.0, 1.9)
        for _ in range(int(rng.integers(1, 4))):
            wide, tall = [(0.6, 0.42), (0.42, 0.6), (0.32, 0.32), (0.8, 0.55)][int(rng.integers(4))]
            z = 1.5 + rng.uniform(-0.08, 0.08)
            place = w.find(wide, z - tall / 2.0, z + tall / 2.0, rng)
            if place is not None:
                w.take(place, margin=0.12)
                w.parts += fittings.picture((place[0] + place[1]) / 2.0, z, (wide, tall), rng)


def _paint_walls(walls: Sequence[_Wall], style: Style, rng: np.random.Generator) -> None:
    """One tint all round, but for one wall of the style's finish; where nothing but tiles is usual, all are tiled."""
    tint, accent = TINTS[int(rng.integers(len(TINTS)))], ACCENTS[int(rng.integers(len(ACCENTS)))]
    finish, special = style.finish[int(rng.integers(len(style.finish)))], int(rng.integers(4))
    for k, w in enumerate(walls):
        here = finish if k == special or style.finish == ("tiled",) else "plain"
        paints = {"papered": papered(accent, rng), "tinted": faded(accent, rng)}
        step = 0.05 if here == "papered" else 0.3
        w.parts += wall(w.length, HEIGHT_M, w.openings, paints.get(here, faded(tint, rng)), step)
        w.parts += skirting(w.length, [o for o in w.openings if o[2] == 0.0])
        if here == "tiled":
            framed = [(o[0] - 0.08, o[1] + 0.08, *o[2:]) for o in w.openings]
            w.parts += wall_tiles(w.length, TILED_M, framed, accent, rng)


def _stand_about(walls: Sequence[_Wall], kept_clear: Sequence[Array], rng: np.random.Generator) -> Parts:
    """A plant, a lamp and one or two baskets on free floor along the walls."""
    parts, blocked = [], [*kept_clear]
    wanted = [(0.41, fittings.plant(rng)), (0.4, fittings.floor_lamp()), (0.44, fittings.floor_basket(rng))]
    for width, thing in wanted[: 2 + int(rng.integers(2))]:
        places = [(w, x) for w in walls for x in np.arange(width / 2.0 + 0.05, w.length - width / 2.0 - 0.05, 0.1)]
        # corners first, as people do
        distance = [min(x, w.length - x) + rng.uniform(0.0, 0.6) for w, x in places]
        for k in np.argsort(distance):
            w, x = places[int(k)]
            (at,) = se3.transform(w.T_room_wall, np.array([[x, -width / 2.0 - OFF_WALL_M, 0.0]]))
            square = np.stack([at[:2] - width / 2.0, at[:2] + width / 2.0])
            hung = [t for t in w.taken if t[2] < 1.6 and t[1] > x - width / 2.0 and t[0] < x + width / 2.0]
            if not hung and not any(_overlap(square, b) for b in blocked):
                blocked.append(square)
                turn = w.T_room_wall[:3, :3] @ rotation("z", float(rng.uniform(-6.0, 6.0)))
                parts += _put(thing, se3.make(turn, at))
                break
    return parts


def _overlap(a: Array, b: Array) -> bool:
    """Whether two level rectangles, (2, 2) low and high corner, come nearer than a gap."""
    return bool((a[0] < b[1] + GAP_M).all() and (b[0] < a[1] + GAP_M).all())


def _lay_rug(size: Array, kept_clear: Sequence[Array], rng: np.random.Generator) -> Parts:
    """A rug on the largest free piece of floor that a few tries find, but nowhere if that is small."""
    best: Array | None = None
    for _ in range(300):
        extent = rng.uniform((1.0, 0.8), (2.2, 1.5)) if rng.random() < 0.5 else rng.uniform((0.8, 1.0), (1.5, 2.2))
        if (extent + 0.6 > size).any():
            continue
        low = rng.uniform(0.3, size - extent - 0.3)
        field_ = np.stack([low, low + extent])
        if any(_overlap(field_, b) for b in kept_clear):
            continue
        if best is None or np.prod(extent) > np.prod(best[1] - best[0]):
            best = field_
    return [] if best is None else fittings.rug(best[0], best[1], rng)
