"""Kinds of rooms: what furniture stands in them, what is kept there, and how the furniture stands along the walls.

World frame of a place: z up, the floor at 0, the room where 0 <= x <= width and 0 <= y <= depth. The back wall is the
plane y = depth, the left wall x = 0, the right wall x = width. Nothing stands along the fourth wall.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.errors import InputError
from sequences.simulation.solids import rotation

Array = NDArray[np.float64]

WALL_GAP_M = (0.02, 0.05)  # between furniture and its wall: there is skirting
BETWEEN_M = 0.06  # least gap between two pieces of furniture
FRONT_M = 0.7  # kept free before each piece, so that one can get at it
TOGETHER_M = 2.8  # the middles of two pieces are no further apart
ROBOT_M = 0.45  # of room that a robot keeps between its head and furniture or walls
PASSAGE_M = 1.0  # least width of what is left for it
TRIES, TRIES_EACH, CHOICE = 3000, 30, 10  # of so many layouts the closest is taken
ROOM_M = ((3.2, 3.0), (4.6, 4.2))  # least and greatest width and depth
PIECES = {2: 0.35, 3: 0.45, 4: 0.2}  # how many stand in a room, with what probability
OTHERS = 0.35  # how often a category is drawn that isn't at home in the room, when those that are have 1 or more


@dataclass(frozen=True)
class Kind:
    """What kind of room it is."""

    always: tuple[str, ...]
    """names of its furniture"""
    sometimes: tuple[str, ...]
    """what may stand there too"""
    kept: Mapping[str, float]
    """category -> how often a thing of it is kept here, relative; others `OTHERS`"""


KINDS: Mapping[str, Kind] = {
    "kitchen": Kind(("table", "cabinet"), ("shelf", "chair"), {"kitchen": 4.0, "food": 4.0, "cleaning": 1.5}),
    "living room": Kind(
        ("sofa", "side_table", "shelf"), ("cabinet",), {"leisure": 4.0, "office": 1.5, "food": 1.5, "kitchen": 1.5}
    ),
    "bathroom": Kind(("cabinet", "shelf"), ("chair", "side_table"), {"bath": 5.0, "cleaning": 3.0}),
    "study": Kind(("desk", "shelf"), ("chair", "side_table"), {"office": 5.0, "leisure": 2.0, "kitchen": 1.0}),
    "workroom": Kind(("table", "shelf"), ("cabinet", "chair"), {"tool": 5.0, "cleaning": 3.0, "food": 1.0}),
    "mixed": Kind(("table",), ("desk", "cabinet", "shelf", "side_table", "sofa", "chair"), {}),
}


@dataclass(frozen=True)
class Layout:
    """Where the furniture of a room stands."""

    size: Array
    """(2,) width and depth of the room, metres"""
    T_world_furniture: tuple[Array, ...]
    """(4, 4) of each piece: its frame's origin in the middle of its bounding box"""
    free_low: Array
    """(2,) the robot's head stays where free_low <= (x, y) <= free_high, metres"""
    free_high: Array
    """(2,)"""


def choose_furniture(kind: Kind, rng: np.random.Generator) -> list[str]:
    """Names of the pieces: those it always has, and some that it may have."""
    likely = np.array([PIECES.get(len(kind.always) + k, 0.0) for k in range(len(kind.sometimes) + 1)])
    extra = int(rng.choice(len(likely), p=likely / likely.sum()))
    return [*kind.always, *(kind.sometimes[int(k)] for k in rng.permutation(len(kind.sometimes))[:extra])]


def lay_out(sizes: Sequence[Array], rng: np.random.Generator) -> Layout:
    """Stand furniture along the walls: nothing blocks anything, all of it near enough to be seen from between.

    Args:
        sizes: (3,) bounding box of each piece, metres; its back is at +y.
        rng: draws all of it.

    Raises:
        InputError: they fit in no room.
    """
    found = (_try(sizes, rng) for _ in range(TRIES))
    layouts = list(islice((layout for layout in found if layout is not None), CHOICE))
    if not layouts:
        raise InputError(
            f"found no room in which {len(sizes)} pieces of furniture stand and a robot can pass",
            field="catalogue",
            remedy="give a catalogue with smaller furniture, or one that leaves it to the simulator",
        )
    return min(layouts, key=_spread)


def _spread(layout: Layout) -> float:
    """How far apart the furniture stands."""
    middles = np.stack([T[:2, 3] for T in layout.T_world_furniture])
    return float(np.linalg.norm(middles[:, None] - middles, axis=-1).sum())


def _try(sizes: Sequence[Array], rng: np.random.Generator) -> Layout | None:
    room = rng.uniform(ROOM_M[0], ROOM_M[1])
    walls = [_wall(which, room) for which in range(3)]
    pieces: list[_Piece] = []
    for size in sizes:
        options = (_somewhere(walls, room, size, rng) for _ in range(TRIES_EACH))
        piece = next((p for p in options if all(_go_together(p, other) for other in pieces)), None)
        if piece is None:
            return None
        pieces.append(piece)
    low, high = _free(room, pieces)
    if (high - low).min() < PASSAGE_M:
        return None
    return Layout(room, tuple(piece.T_world_furniture for piece in pieces), low, high)


@dataclass(frozen=True)
class _Piece:
    wall: int
    T_world_furniture: Array
    box: Array
    """(2, 2) lowest and highest x and y, seen from above"""
    front: Array
    """(2, 2) the same with the floor before it"""


def _wall(which: int, room: Array) -> Array:
    """T_world_wall (4, 4) of the back, left or right wall: x along it to the right, y into it, z up."""
    turn, corner = ((0.0, (0.0, room[1])), (90.0, (0.0, 0.0)), (-90.0, (room[0], room[1])))[which]
    return se3.make(rotation("z", turn), np.array([*corner, 0.0]))


def _somewhere(walls: Sequence[Array], room: Array, size: Array, rng: np.random.Generator) -> _Piece:
    """A piece anywhere along a wall, the back wall rather than the others."""
    which, share, gap = rng.random(3)
    wall = (1 if which < 0.25 else 2) if which < 0.5 else 0
    length = room[0] if wall == 0 else room[1]
    x = size[0] / 2 + share * (length - size[0])
    y = -WALL_GAP_M[0] - gap * (WALL_GAP_M[1] - WALL_GAP_M[0]) - size[1] / 2
    T = walls[wall].copy()
    T[:3, 3] += T[:3, :3] @ (x, y, size[2] / 2)
    return _Piece(wall, T, _box(T, size), _box(T, size, FRONT_M))


def _box(T: Array, size: Array, front: float = 0.0) -> Array:
    """(2, 2) lowest and highest x and y of a piece seen from above, with so much of the floor before it."""
    corners = T[:2, :2] @ [[-size[0] / 2, size[0] / 2], [size[1] / 2, -size[1] / 2 - front]] + T[:2, 3:]
    return np.sort(corners.T, axis=0)


def _gap(a: Array, b: Array) -> float:
    """Between two boxes along the axis that parts them; negative where they overlap."""
    return float(max(a[0, 0] - b[1, 0], b[0, 0] - a[1, 0], a[0, 1] - b[1, 1], b[0, 1] - a[1, 1]))


def _go_together(a: _Piece, b: _Piece) -> bool:
    apart = np.linalg.norm(a.T_world_furniture[:2, 3] - b.T_world_furniture[:2, 3])
    free = _gap(a.box, b.box) > BETWEEN_M and _gap(a.front, b.box) > 0.0 and _gap(a.box, b.front) > 0.0
    return free and bool(apart < TOGETHER_M)


def _free(room: Array, pieces: Sequence[_Piece]) -> tuple[Array, Array]:
    """The rectangle that is `ROBOT_M` off all furniture and walls; it is convex, so one can drive straight in it."""
    low, high = np.zeros(2), room.copy()
    for piece in pieces:
        if piece.wall == 0:
            high[1] = min(high[1], piece.box[0, 1])
        elif piece.wall == 1:
            low[0] = max(low[0], piece.box[1, 0])
        else:
            high[0] = min(high[0], piece.box[0, 0])
    return low + ROBOT_M, high - ROBOT_M
