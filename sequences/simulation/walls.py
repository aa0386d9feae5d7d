"""What a room is built of: walls with openings, and floors of boards, tiles or carpet.

A wall's frame: the origin is its lower left corner as one sees it from inside, x runs to the right along it, z up,
y into it. So the wall is the plane y = 0, the room where y < 0, as furniture has its front at -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sequences.simulation.solids import Paint, Part, Solid, plain, printed

Array = NDArray[np.float64]
Parts = list[Part]

PLANK_M = (0.14, 1.3)
TILE_M = 0.15  # of walls
GROUT_M = 0.004
OVERLAP_M = 0.005  # of walls with floor, ceiling and each other, so that no light shows through
RECESS_M = 0.12  # of windows and doors in the wall

Opening = tuple[float, float, float, float]
"""left, right, bottom and top of a hole in a wall, metres, wall frame"""


def sheet(origin: ArrayLike, u: ArrayLike, v: ArrayLike, n: int, m: int) -> Solid:
    """A rectangle cut into n x m pieces, facing along u x v.

    Args:
        origin: (3,) its corner, metres.
        u: (3,) its first side.
        v: (3,) its second.
        n: pieces along u.
        m: pieces along v.
    """
    s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
    vertices = np.asarray(origin) + s.reshape(-1, 1) * np.asarray(u) + t.reshape(-1, 1) * np.asarray(v)
    return vertices, _cells(n, m)


def _cells(n: int, m: int, kept: NDArray[np.bool_] | None = None) -> NDArray[np.int32]:
    """Faces of a grid of n x m cells, of those alone that are kept (n, m)."""
    index = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    chosen = np.ones((n, m), dtype=bool) if kept is None else kept
    a, b, c, d = (part[chosen] for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.int32)


def wall(length: float, height: float, openings: Sequence[Opening], paint: Paint, step: float = 0.3) -> Parts:
    """A wall with holes and their reveals, in its own frame.

    Args:
        length: metres.
        height: metres.
        openings: its holes.
        paint: of the wall; the reveals are white.
        step: cells are at most so large, metres, so that shades may change along the wall.
    """
    x = _lines(length, [e for o in openings for e in o[:2]], step)
    z = _lines(height, [e for o in openings for e in o[2:]], step)
    middle_x, middle_z = (x[1:] + x[:-1]) / 2.0, (z[1:] + z[:-1]) / 2.0
    kept = np.ones((len(middle_x), len(middle_z)), dtype=bool)
    for left, right, low, high in openings:
        kept &= ~(((middle_x > left) & (middle_x < right))[:, None] & (middle_z > low) & (middle_z < high))
    xx, zz = np.meshgrid(x, z, indexing="ij")
    vertices = np.stack([xx.ravel(), np.zeros(xx.size), zz.ravel()], axis=-1)
    face = (vertices, _cells(len(middle_x), len(middle_z), kept))
    return [(face, paint), *(reveal for opening in openings for reveal in _reveals(opening))]


def _lines(length: float, edges: Sequence[float], step: float) -> Array:
    even = np.linspace(0.0, length, int(np.ceil(length / step)) + 1)
    near = np.abs(even[:, None] - np.asarray([-1.0, *edges])).min(axis=1) < 0.02  # no slivers beside an edge
    near[[0, -1]] = False
    lines = np.unique(np.concatenate([even[~near], np.clip(edges, 0.0, length)]))
    lines[[0, -1]] += (-OVERLAP_M, OVERLAP_M)
    return lines


def _reveals(opening: Opening) -> Parts:
    """The four inner sides of a hole."""
    left, right, low, high = opening
    w, h, d = right - left, high - low, RECESS_M
    white = plain((236, 234, 228))
    return [
        (sheet((left, 0.0, low), (0.0, d, 0.0), (0.0, 0.0, h), 1, 1), white),
        (sheet((right, d, low), (0.0, -d, 0.0), (0.0, 0.0, h), 1, 1), white),
        (sheet((left, 0.0, low), (w, 0.0, 0.0), (0.0, d, 0.0), 1, 1), white),
        (sheet((left, d, high), (w, 0.0, 0.0), (0.0, -d, 0.0), 1, 1), white),
    ]


def faded(colour: ArrayLike, rng: np.random.Generator) -> Paint:
    """A painted wall, never quite even."""
    phase = rng.uniform(0.0, 2 * np.pi, 3)

    def paint(vertices: Array) -> Array:
        along = vertices[:, 0] + vertices[:, 1]
        tone = 1.0 + 0.025 * np.sin(1.7 * along + phase[0]) * np.sin(2.3 * vertices[:, 2] + phase[1])
        return np.asarray(colour) * tone[:, None]

    return paint


def wall_tiles(
    length: float, top: float, openings: Sequence[Opening], colour: ArrayLike, rng: np.random.Generator
) -> Parts:
    """Tiles of 0.15 m on the lower part of a wall, 4 mm before it, cut to fit its corners and openings."""
    x, z = (np.append(np.arange(0.0, end - 0.02, TILE_M), end) for end in (length, top))
    x = np.unique(np.append(x, [np.clip(e, 0.0, length) for o in openings for e in o[:2]]))
    z = np.unique(np.append(z, [e for o in openings for e in o[2:] if e < top]))
    parts: Parts = []
    for left, right in pairwise(x):
        for low, high in pairwise(z):
            w, h = right - left - GROUT_M, high - low - GROUT_M
            middle = (left + right) / 2.0, (low + high) / 2.0
            if min(w, h) <= 0.0 or any(o[0] < middle[0] < o[1] and o[2] < middle[1] < o[3] for o in openings):
                continue
            shade = np.asarray(colour) * (1.0 + 0.025 * rng.standard_normal())
            parts.append((sheet((left, -0.004, low), (w, 0.0, 0.0), (0.0, 0.0, h), 1, 1), plain(shade)))
    return parts


def boards(size: Sequence[float], rng: np.random.Generator) -> Parts:
    """A floor of boards along x, each with its own tone, the joints staggered, over dark gaps.

    Args:
        size: (2,) of the room, metres; the floor reaches from the origin to it, at z = 0.
        rng: wood and tones.
    """
    woods = np.array([(158.0, 120.0, 82.0), (186.0, 150.0, 108.0), (122.0, 86.0, 60.0), (170.0, 158.0, 140.0)])
    base, parts = woods[int(rng.integers(len(woods)))], []
    width, length = PLANK_M
    for row in range(int(np.ceil(size[1] / width))):
        y = row * width
        deep = min(width, size[1] - y) - GROUT_M
        start = -float(rng.uniform(0.0, length))
        while start < size[0]:
            low, high = max(0.0, start), min(size[0], start + length)
            if high - low > 0.01 and deep > 0.005:
                plank = sheet((low + 0.001, y, 0.0), (high - low - 0.002, 0.0, 0.0), (0.0, deep, 0.0), 8, 2)
                parts.append((plank, _streaks(base * (1.0 + 0.07 * rng.standard_normal()), rng)))
            start += length
    return [*parts, _ground(size, base * 0.55)]


def _streaks(colour: Array, rng: np.random.Generator) -> Paint:
    phase = rng.uniform(0.0, 2 * np.pi)

    def paint(vertices: Array) -> Array:
        wave = np.sin(70.0 * vertices[:, 1] + 2.0 * np.sin(3.0 * vertices[:, 0] + phase) + phase)
        return colour * (1.0 + 0.03 * wave[:, None])

    return paint


def tiles(size: Sequence[float], rng: np.random.Generator) -> Parts:
    """A floor of square tiles, plain or as a chessboard."""
    side = float(rng.choice([0.3, 0.4]))
    pairs = [((196, 190, 180), (196, 190, 180)), ((206, 204, 198), (118, 124, 128)), ((184, 130, 100), (176, 122, 92))]
    pair, parts = pairs[int(rng.integers(len(pairs)))], []
    for i in range(int(np.ceil(size[0] / side))):
        for j in range(int(np.ceil(size[1] / side))):
            x, y = i * side, j * side
            w, d = min(side, size[0] - x) - GROUT_M, min(side, size[1] - y) - GROUT_M
            if min(w, d) > 0.0:
                shade = np.array(pair[(i + j) % 2]) * (1.0 + 0.02 * rng.standard_normal())
                parts.append((sheet((x, y, 0.0), (w, 0.0, 0.0), (0.0, d, 0.0), 1, 1), plain(shade)))
    return [*parts, _ground(size, (140, 136, 130))]


def carpet(size: Sequence[float], rng: np.random.Generator) -> Parts:
    """A fitted carpet, mottled."""
    colours = [(150, 140, 128), (112, 122, 136), (168, 156, 132), (126, 138, 122)]
    base = np.array(colours[int(rng.integers(len(colours)))], dtype=np.float64)
    n, m = (int(np.ceil(s / 0.05)) for s in size)
    floor = _spread(size, 0.0, n, m)
    mottle = 1.0 + 0.035 * rng.standard_normal(len(floor[0]))
    return [(floor, base * mottle[:, None])]


def _ground(size: Sequence[float], colour: ArrayLike) -> Part:
    """What shows between boards or tiles."""
    return _spread(size, -0.002, 8, 8), plain(colour)


def _spread(size: Sequence[float], z: float, n: int, m: int) -> Solid:
    """A level sheet over the floor and a little into the walls."""
    width, depth = (s + 2.0 * OVERLAP_M for s in size)
    return sheet((-OVERLAP_M, -OVERLAP_M, z), (width, 0.0, 0.0), (0.0, depth, 0.0), n, m)


def papered(colour: ArrayLike, rng: np.random.Generator) -> Paint:
    """Striped wallpaper; the wall must be cut every 0.05 m or finer."""
    light = np.minimum(np.asarray(colour) * 1.07, 255.0)
    width, ground = 0.2, faded(colour, rng)

    def stripe(vertices: Array) -> NDArray[np.bool_]:
        return np.mod(vertices[:, 0] + vertices[:, 1], width) < width / 2.0

    return printed(ground, (stripe, light))


def skirting(length: float, doors: Sequence[Opening]) -> Parts:
    """A white board along the foot of a wall, but not across its doors."""
    edges = [0.0, *(e for o in sorted(doors) for e in (o[0] - 0.07, o[1] + 0.07)), length]
    white = plain((238, 236, 230))
    parts: Parts = []
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        if right - left > 0.01:
            front = sheet((left, -0.015, 0.0), (right - left, 0.0, 0.0), (0.0, 0.0, 0.08), 6, 1)
            top = sheet((left, -0.015, 0.08), (right - left, 0.0, 0.0), (0.0, 0.015, 0.0), 6, 1)
            parts += [(front, white), (top, white)]
    return parts
