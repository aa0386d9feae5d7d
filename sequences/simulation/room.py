"""The room itself: floorboards, two walls and what nobody has a model of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation import solids
from sequences.simulation.solids import Paint, Solid, moved, plain, rounded_box

Array = NDArray[np.float64]

SIZE_M = 4.2
HEIGHT_M = 2.6
PLANK_M = (0.14, 1.3)


def room_mesh(side: int, table_at: Array, rng: np.random.Generator) -> Mesh:
    """Floor, walls, skirting, a picture over the table, a basket under it and a plant beside it.

    Args:
        side: sign of x inside the room.
        table_at: (3,) centre of the table, world frame.
        rng: tints and where exactly things hang and stand.
    """
    walls = [(225, 216, 200), (150, 172, 160), (196, 206, 214), (222, 200, 176)]
    tints = [walls[k] for k in rng.permutation(len(walls))[:2]]
    x = float(table_at[0])
    skirting = plain((238, 236, 230))
    parts: list[tuple[Solid, Paint]] = [
        (_wall("y", side), _faded(tints[0], rng)),
        (_wall("x", side), _faded(tints[1], rng)),
        (moved(rounded_box((SIZE_M, 0.015, 0.08), 0.003), (side * SIZE_M / 2, -0.0075, 0.04)), skirting),
        (moved(rounded_box((0.015, SIZE_M, 0.08), 0.003), (side * 0.0075, -SIZE_M / 2, 0.04)), skirting),
        *_picture(x + rng.uniform(-0.25, 0.25), rng),
        *_basket(x + side * rng.uniform(0.1, 0.35)),
        *_plant(x + side * rng.uniform(0.95, 1.05), rng),
    ]
    return solids.join([*parts, *_floor(side, rng)])


def _sheet(origin: Sequence[float], u: Sequence[float], v: Sequence[float], n: int, m: int) -> Solid:
    """A rectangle cut into n x m pieces, facing along u x v."""
    s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
    vertices = np.asarray(origin) + s.reshape(-1, 1) * np.asarray(u) + t.reshape(-1, 1) * np.asarray(v)
    index = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.int32)


def _wall(axis: str, side: int) -> Solid:
    """The plane y = 0 facing -y, or the plane x = 0 facing the room."""
    left = min(0.0, side * SIZE_M)
    if axis == "y":
        return _sheet((left, 0.0, 0.0), (SIZE_M, 0.0, 0.0), (0.0, 0.0, HEIGHT_M), 14, 9)
    start, run = (-SIZE_M, SIZE_M) if side > 0 else (0.0, -SIZE_M)
    return _sheet((0.0, start, 0.0), (0.0, run, 0.0), (0.0, 0.0, HEIGHT_M), 14, 9)


def _faded(colour: tuple[int, int, int], rng: np.random.Generator) -> Paint:
    phase = rng.uniform(0.0, 2 * np.pi, 3)

    def paint(vertices: Array) -> Array:
        along = vertices[:, 0] + vertices[:, 1]
        tone = 1.0 + 0.025 * np.sin(1.7 * along + phase[0]) * np.sin(2.3 * vertices[:, 2] + phase[1])
        return np.asarray(colour) * tone[:, None]

    return paint


def _floor(side: int, rng: np.random.Generator) -> list[tuple[Solid, Paint]]:
    """Boards along x, each with its own tone, the joints staggered."""
    boards: list[tuple[Solid, Paint]] = []
    base, width, length = np.array((158.0, 120.0, 82.0)), PLANK_M[0], PLANK_M[1]
    for row in range(int(np.ceil(SIZE_M / width))):
        start = -float(rng.uniform(0.0, length))
        while start < SIZE_M:
            low, high = max(0.0, start), min(SIZE_M, start + length)
            left = low if side > 0 else -high
            corner = (left, 0.002 - (row + 1) * width, 0.0)
            sheet = _sheet(corner, (high - low - 0.002, 0.0, 0.0), (0.0, width - 0.004, 0.0), 3, 1)
            boards.append((sheet, plain(base * (1.0 + 0.08 * rng.standard_normal()))))
            start += length
    left = min(0.0, side * SIZE_M)
    joints = _sheet((left, -SIZE_M, -0.002), (SIZE_M, 0.0, 0.0), (0.0, SIZE_M, 0.0), 8, 8)
    return [*boards, (joints, plain((88, 64, 42)))]


def _picture(x: float, rng: np.random.Generator) -> list[tuple[Solid, Paint]]:
    """A framed landscape of 0.6 x 0.42 m: meadow, hills and sky, one strip each."""
    phase = rng.uniform(0.0, 2 * np.pi, 3)
    at = np.linspace(-1.0, 1.0, 33)
    meadow = 0.3 + 0.08 * np.sin(2.6 * at + phase[0])
    hills = 0.58 + 0.1 * np.sin(3.6 * at + phase[1]) * np.sin(9.0 * at + phase[2])
    edges = [np.zeros_like(at), meadow, hills, np.ones_like(at)]
    colours = [(98, 134, 70), (98, 124, 140), (186, 208, 224)]
    parts = [(moved(rounded_box((0.6, 0.022, 0.42), 0.004), (x, -0.013, 1.28)), plain((62, 44, 34)))]
    for low, high, colour in zip(edges[:-1], edges[1:], colours, strict=True):
        vertices, faces = _sheet((0.0, -0.0245, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), len(at) - 1, 1)
        column = np.rint(vertices[:, 0] * (len(at) - 1)).astype(int)
        height = np.where(vertices[:, 2] > 0.5, high[column], low[column])
        strip = np.stack([x + 0.265 * at[column], vertices[:, 1], 1.105 + 0.35 * height], axis=-1)
        parts.append(((strip, faces), plain(colour)))
    return parts


def _basket(x: float) -> list[tuple[Solid, Paint]]:
    """A cardboard box on the floor under the table."""
    tape = solids.bands(0, [x - 0.03, x + 0.03], [(184, 142, 94), (210, 186, 140), (184, 142, 94)])
    return [(moved(rounded_box((0.4, 0.3, 0.26), 0.004, ((-0.03, 0.03), (), ())), (x, -0.3, 0.13)), tape)]


def _plant(x: float, rng: np.random.Generator) -> list[tuple[Solid, Paint]]:
    """A pot with long leaves."""
    profile = [[0.0, 0.0], [0.10, 0.0], [0.14, 0.24], [0.145, 0.28], [0.13, 0.28], [0.125, 0.25], [0.0, 0.25]]
    pot = solids.lathe(profile, 24)
    parts = [(moved(pot, (x, -0.25, 0.0)), solids.bands(2, [0.2499], [(176, 98, 66), (120, 74, 52)]))]
    for k in range(11):
        turn, reach, rise = 2.4 * k + rng.uniform(-0.3, 0.3), rng.uniform(0.12, 0.22), rng.uniform(0.5, 0.95)
        s = np.linspace(0.0, 1.0, 7)
        out = 0.03 + reach * s**2
        leaf = np.stack([out * np.cos(turn), out * np.sin(turn), 0.25 + rise * (s - 0.25 * s**3)], axis=-1)
        width = 0.022 * np.sin(np.pi * (0.12 + 0.86 * s))
        green = np.array((64, 118, 62)) * rng.uniform(0.8, 1.25)
        parts.append((moved(solids.tube(leaf, width, 6, flatten=0.15), (x, -0.25, 0.0)), plain(green)))
    return parts
