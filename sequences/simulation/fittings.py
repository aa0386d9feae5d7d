"""What hangs on a room's walls and stands on its floor, though nobody modelled it: window, door, pictures, plants, rug.

Each builder works in the frame of a wall (`sequences.simulation.walls`), or in the room's for what lies on the floor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sequences.simulation.solids import (
    Solid,
    block,
    lathe,
    moved,
    plain,
    printed,
    ring,
    rotation,
    rounded_box,
    stacked,
    tube,
    within,
)
from sequences.simulation.walls import RECESS_M, Opening, Parts, sheet

Array = NDArray[np.float64]

WHITE = (238, 237, 232)


def window(opening: Opening, rng: np.random.Generator) -> Parts:
    """A casement with two wings and a sill board; outside lie hills, trees and the sky."""
    left, right, low, high = opening
    w, h, at = right - left, high - low, RECESS_M - 0.03
    middle, mid_z = (left + right) / 2.0, (low + high) / 2.0
    white = plain(WHITE)
    bars = [(left + 0.03, 0.06), (middle, 0.08), (right - 0.03, 0.06)]
    parts: Parts = [(block((wide, 0.05, h), (x, at, mid_z)), white) for x, wide in bars]
    parts += [(block((w, 0.048, 0.06), (middle, at, z)), white) for z in (low + 0.03, high - 0.03)]
    parts.append((moved(rounded_box((w + 0.12, 0.2, 0.03), 0.006), (middle, -0.0, low - 0.012)), white))
    grip = np.array([[middle + 0.02, at - 0.03, mid_z + dz] for dz in (-0.06, 0.0, 0.06)])
    parts.append((tube(grip, 0.007, 8), plain((150, 150, 152))))
    return [*parts, *_view(opening, rng)]


def _view(opening: Opening, rng: np.random.Generator) -> Parts:
    """What one sees outside, painted on the pane: bushes, hills and the sky, one strip each."""
    left, right, low, high = opening
    phase = rng.uniform(0.0, 2.0 * np.pi, 4)
    x = np.linspace(left, right, 97)
    hills = 0.36 + 0.05 * np.sin(2.3 * x + phase[0]) + 0.02 * np.sin(7.0 * x + phase[1])
    bushes = hills - 0.1 + 0.05 * np.abs(np.sin(5.0 * x + phase[2])) + 0.02 * np.abs(np.sin(17.0 * x + phase[3]))
    edges = [np.zeros_like(x), bushes, hills, np.full_like(x, 0.7), np.ones_like(x)]
    colours = [((70, 104, 62), (104, 142, 84)), ((142, 164, 150), (164, 184, 172)), ((236, 242, 246), (206, 226, 246))]
    colours.append(((206, 226, 246), (174, 206, 242)))
    return [
        (_strip(x, RECESS_M, low + (high - low) * foot, low + (high - low) * head), _shaded(*pair, len(x)))
        for foot, head, pair in zip(edges[:-1], edges[1:], colours, strict=True)
    ]


def _strip(x: Array, y: float, low: Array, high: Array) -> Solid:
    """A band of a picture between two curves over x, facing -y."""
    vertices, faces = sheet((0.0, y, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), len(x) - 1, 1)
    return np.stack([np.repeat(x, 2), vertices[:, 1], np.stack([low, high], axis=-1).ravel()], axis=-1), faces


def _shaded(low: ArrayLike, high: ArrayLike, n: int) -> Array:
    """Colours of a strip of n columns, from its lower edge to its upper."""
    return np.tile(np.array([low, high], dtype=np.float64), (n, 1))


def curtains(opening: Opening, colour: ArrayLike, to_floor: bool) -> Parts:
    """Two curtains drawn aside, in folds, on a rod."""
    left, right, low, high = opening
    foot = 0.03 if to_floor else low - 0.15
    rod = np.array([[x, -0.09, high + 0.12] for x in np.linspace(left - 0.36, right + 0.36, 5)])
    parts: Parts = [(tube(rod, 0.011, 10), plain((92, 84, 78)))]
    top = high + 0.12
    for start in (left - 0.33, right + 0.01):
        cloth, faces = sheet((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 64, 6)
        across, down = cloth[:, 0], 1.0 - cloth[:, 2]
        fold = 0.024 * np.sin(2.0 * np.pi * 6.5 * across) + 0.008 * np.sin(31.0 * across + start)
        x = start + (0.32 - 0.05 * np.sin(np.pi * down)) * across
        vertices = np.stack([x, -0.08 + (0.6 + 0.5 * down) * fold, top - down * (top - foot)], axis=-1)
        shade = np.clip(1.0 - 4.0 * fold, 0.8, 1.12)  # deep folds are darker than the lamp alone makes them
        dyed = np.clip(np.asarray(colour) * shade[:, None], 0.0, 255.0)
        parts.append(((vertices, faces), dyed))
    return parts


def radiator(opening: Opening) -> Parts:
    """A radiator under a window."""
    left, right = opening[:2]
    middle, w = (left + right) / 2.0, min(1.0, right - left)
    n = int(w / 0.05)
    parts: Parts = [
        (moved(rounded_box((0.036, 0.05, 0.5), 0.012), (middle + 0.05 * (k - (n - 1) / 2), -0.07, 0.42)), plain(WHITE))
        for k in range(n)
    ]
    pipe = np.array([[middle - w / 2 + 0.02, y, 0.22] for y in (-0.08, -0.04, 0.0)])
    return [*parts, (tube(pipe, 0.01, 8), plain(WHITE))]


def door(opening: Opening, colour: ArrayLike) -> Parts:
    """A panelled door, shut, with its frame and handle."""
    left, right, _, high = opening
    w, middle = right - left, (left + right) / 2.0
    lighter, shade = np.minimum(np.asarray(colour) * 1.04, 255.0), np.asarray(colour) * 0.93
    parts: Parts = [(block((w, 0.04, high), (middle, 0.03, high / 2.0)), plain(colour))]
    for x, wide in ((left - 0.035, 0.07), (right + 0.035, 0.07)):
        parts.append((block((wide, 0.024, high + 0.07), (x, -0.008, (high + 0.07) / 2.0)), plain(lighter)))
    parts.append((block((w, 0.024, 0.07), (middle, -0.008, high + 0.035)), plain(lighter)))
    for z, tall in ((0.55, 0.72), (1.45, 0.86)):
        for x in (middle - w / 4 + 0.02, middle + w / 4 - 0.02):
            parts.append((moved(rounded_box((w / 2 - 0.14, 0.02, tall), 0.008), (x, 0.006, z)), plain(shade)))
    rose = np.array([[left + 0.07, y, 1.05] for y in (0.01, -0.01, -0.04)])
    lever = np.array([[left + 0.06, -0.04, 1.05], [left + 0.12, -0.042, 1.05], [left + 0.18, -0.04, 1.05]])
    steel = plain((172, 172, 176))
    return [*parts, (tube(rose, 0.009, 10), steel), (tube(lever, 0.009, 10), steel)]


def picture(x: float, z: float, size: Sequence[float], rng: np.random.Generator) -> Parts:
    """A framed picture about (x, z): a landscape, or shapes in a few colours."""
    w, h = size
    frame = [(62, 44, 34), (226, 222, 212), (30, 30, 32), (150, 112, 70)][int(rng.integers(4))]
    parts: Parts = [
        (moved(rounded_box((w, 0.022, h), 0.004), (x, -0.013, z)), plain(frame)),
        (block((w - 0.05, 0.004, h - 0.05), (x, -0.0235, z)), plain((244, 242, 236))),
    ]
    inner = (w - 0.11, h - 0.11)
    return [*parts, *(_landscape(x, z, inner, rng) if rng.random() < 0.5 else _shapes(x, z, inner, rng))]


def _landscape(x: float, z: float, size: Sequence[float], rng: np.random.Generator) -> Parts:
    """Meadow, hills and sky, one strip each."""
    phase = rng.uniform(0.0, 2 * np.pi, 3)
    at = np.linspace(0.0, 1.0, 49)
    meadow = 0.3 + 0.08 * np.sin(5.2 * at + phase[0])
    hills = 0.58 + 0.1 * np.sin(7.2 * at + phase[1]) * np.sin(18.0 * at + phase[2])
    edges = [np.zeros_like(at), meadow, hills, np.ones_like(at)]
    palettes = [((98, 134, 70), (98, 124, 140), (186, 208, 224)), ((196, 150, 90), (158, 96, 84), (240, 204, 160))]
    parts: Parts = []
    left, foot = x - size[0] / 2.0, z - size[1] / 2.0
    for low, high, colour in zip(edges[:-1], edges[1:], palettes[int(rng.integers(2))], strict=True):
        strip = _strip(left + size[0] * at, -0.0262, foot + size[1] * low, foot + size[1] * high)
        parts.append((strip, plain(colour)))
    return parts


def _shapes(x: float, z: float, size: Sequence[float], rng: np.random.Generator) -> Parts:
    """A few discs and bars."""
    palette = [(204, 84, 60), (232, 178, 74), (52, 90, 120), (112, 146, 128), (64, 58, 62), (222, 160, 150)]
    w, h = size
    parts: Parts = []
    for k, c in enumerate(rng.permutation(len(palette))[:4]):
        reach = min(w, h) * rng.uniform(0.12, 0.26)
        u, v = rng.uniform(-1.0, 1.0, 2) * (np.array([w, h]) / 2.0 - reach)
        disc = moved(
            lathe([[0.0, -0.001], [reach, -0.001], [reach, 0.001], [0.0, 0.001]], 28),
            (0.0, 0.0, 0.0),
            rotation("x", 90.0),
        )
        solid = disc if k % 2 else block((2.0 * reach, 0.002, 0.9 * reach))
        parts.append((moved(solid, (x + u, -0.0262 - 0.0004 * k, z + v)), plain(palette[c])))
    return parts


def clock(x: float, z: float) -> Parts:
    """A round clock of 300 mm; it is ten past ten."""
    face = moved(
        lathe([[0.0, -0.02], [0.14, -0.02], [0.15, -0.012], [0.15, 0.0], [0.0, 0.0]], 36),
        (0.0, 0.0, 0.0),
        rotation("x", -90.0),
    )
    front = lathe([[0.0, 0.0], [0.132, 0.0], [0.132, 0.002], [0.0, 0.002]], 36)
    parts: Parts = [
        (moved(face, (x, 0.0, z), rotation("x", 180.0)), plain((44, 46, 50))),
        (moved(front, (x, -0.02, z), rotation("x", 90.0)), plain((244, 243, 238))),
    ]
    for hour in range(12):
        turn = rotation("y", 30.0 * hour)
        parts.append(
            (moved(block((0.006, 0.001, 0.016), (0.0, -0.0228, 0.116)), (x, 0.0, z), turn), plain((40, 40, 44)))
        )
    for degrees, long, wide in ((305.0, 0.07, 0.009), (60.0, 0.105, 0.006)):
        hand = block((wide, 0.001, long), (0.0, -0.0235, long / 2.0 - 0.012))
        parts.append((moved(hand, (x, 0.0, z), rotation("y", degrees)), plain((40, 40, 44))))
    return parts


def switch(x: float, z: float) -> Parts:
    """A light switch, or a socket."""
    return [
        (moved(rounded_box((0.08, 0.012, 0.08), 0.003), (x, -0.006, z)), plain(WHITE)),
        (block((0.05, 0.004, 0.05), (x, -0.013, z)), plain((226, 225, 220))),
    ]


def plant(rng: np.random.Generator) -> Parts:
    """A pot on the floor with long leaves, 0.9 to 1.2 m high and 0.4 m wide, about the origin."""
    profile = [[0.0, 0.0], [0.10, 0.0], [0.14, 0.24], [0.145, 0.28], [0.13, 0.28], [0.125, 0.25], [0.0, 0.25]]
    glaze = [(176, 98, 66), (214, 212, 206), (70, 92, 110)][int(rng.integers(3))]

    def soil(v: Array) -> NDArray[np.bool_]:
        return (np.hypot(v[:, 0], v[:, 1]) < 0.1255) & (v[:, 2] > 0.249)

    parts: Parts = [(lathe(profile, 24), printed(glaze, (soil, (84, 62, 46))))]
    for k in range(13):
        turn, reach, rise = 2.4 * k + rng.uniform(-0.3, 0.3), rng.uniform(0.08, 0.16), rng.uniform(0.5, 0.95)
        s = np.linspace(0.0, 1.0, 7)
        out = 0.03 + reach * s**2
        leaf = np.stack([out * np.cos(turn), out * np.sin(turn), 0.25 + rise * (s - 0.25 * s**3)], axis=-1)
        width = 0.024 * np.sin(np.pi * (0.12 + 0.86 * s))
        green = np.array((64, 118, 62)) * rng.uniform(0.8, 1.25)
        parts.append((tube(leaf, width, 6, flatten=0.15), plain(green)))
    return parts


def floor_lamp() -> Parts:
    """A lamp of 1.55 m on three legs, about the origin."""
    wood, shade = plain((150, 108, 70)), plain((238, 228, 204))
    parts: Parts = []
    for k in range(3):
        c, s = np.cos(2.094 * k + 0.5), np.sin(2.094 * k + 0.5)
        leg = np.array([[0.18 * c, 0.18 * s, 0.0], [0.1 * c, 0.1 * s, 0.6], [0.02 * c, 0.02 * s, 1.2]])
        parts.append((tube(leg, 0.011, 8), wood))
    stem = np.array([[0.0, 0.0, z] for z in (1.18, 1.25, 1.35)])
    hood = [[0.187, 1.25], [0.19, 1.25], [0.133, 1.55], [0.13, 1.55]]
    return [*parts, (tube(stem, 0.014, 8), wood), (ring(hood, 32), shade)]


def floor_basket(rng: np.random.Generator) -> Parts:
    """A cardboard box, a waste-paper bin or a laundry basket, at most 0.42 m wide, about the origin."""
    kind = int(rng.integers(3))
    if kind == 0:
        tape = printed((184, 142, 94), (within(x=(-0.03, 0.03)), (210, 186, 140)))
        return [(moved(rounded_box((0.4, 0.3, 0.26), 0.004, ((-0.03, 0.03), (), ())), (0.0, 0.0, 0.13)), tape)]
    if kind == 1:
        profile = [[0.0, 0.0], [0.1, 0.0], [0.13, 0.28], [0.134, 0.284], [0.128, 0.284], [0.098, 0.006], [0.0, 0.006]]
        return [(lathe(profile, 32), plain((70, 74, 80)))]
    rows = [[0.17 + 0.004 * (k % 2), 0.14 + 0.004 * (k % 2), 0.025 * k] for k in range(20)]
    inside = [[0.165, 0.135, 0.48], [0.16, 0.13, 0.05], [0.08, 0.06, 0.04]]
    cane = printed((206, 186, 152), (within(z=(0.44, 1.0)), (178, 150, 110)))
    return [(stacked([[0.12, 0.1, -0.001], *rows, *inside], power=3.5), cane)]


def rug(low: Array, high: Array, rng: np.random.Generator) -> Parts:
    """A rug 4 mm high from one corner to the other (2,), with a border and a woven field."""
    size = high - low
    palettes = [
        ((150, 56, 50), (222, 200, 160), (48, 58, 84)),
        ((206, 198, 182), (120, 132, 136), (236, 230, 216)),
        ((64, 92, 104), (212, 178, 110), (226, 216, 196)),
    ]
    ground, line, field = (np.array(c, dtype=np.float64) for c in palettes[int(rng.integers(3))])
    phase, striped = rng.uniform(0.0, 1.0, 2), bool(rng.random() < 0.5)
    n, m = (int(np.ceil(s / 0.03)) for s in size)
    top = sheet((low[0], low[1], 0.004), (size[0], 0.0, 0.0), (0.0, size[1], 0.0), n, m)

    def weave(v: Array) -> Array:
        inset = np.minimum(v[:, :2] - low, high - v[:, :2]).min(axis=1)
        x, y = np.mod((v[:, :2] - low) / 0.3 + phase, 1.0).T
        along = np.mod(x if size[0] > size[1] else y, 1.0)
        lozenge = np.abs(x - 0.5) + np.abs(y - 0.5)
        lines, others = (along < 0.2, (along > 0.5) & (along < 0.6)) if striped else (lozenge < 0.26, lozenge > 0.74)
        colours = np.where(lines[:, None], line, np.where(others[:, None], field, ground))
        colours = np.where(((inset < 0.17) & (inset > 0.1))[:, None], field, colours)
        return np.where((inset < 0.1)[:, None], np.where((inset < 0.03)[:, None], ground * 0.8, ground), colours)

    edge = block((size[0], size[1], 0.004), (low[0] + size[0] / 2, low[1] + size[1] / 2, 0.0018))
    return [(top, weave), (edge, plain(ground * 0.8))]
