"""Things that nobody modelled: they stand about in the images, but are in no catalogue and no truth."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation.shapes.shape import UPRIGHT, Clutter
from sequences.simulation.solids import (
    Paint,
    Part,
    arc,
    assemble,
    bands,
    lathe,
    moved,
    placed,
    plain,
    printed,
    puff,
    ring,
    rotation,
    rounded_box,
    seam,
    stacked,
    tube,
    within,
)

Array = NDArray[np.float64]
Parts = list[Part]

GOLDEN_RAD = 2.39996  # from leaf to leaf


def vase() -> Mesh:
    """A vase of 110 x 190 mm with tulips."""
    outside = [[0.0, 0.0], [0.032, 0.0], [0.036, 0.004], [0.052, 0.05], [0.054, 0.08], [0.042, 0.13], [0.03, 0.165]]
    rim = [[0.034, 0.187], [0.0345, 0.189], [0.031, 0.189], [0.026, 0.165], [0.03, 0.15], [0.0, 0.15]]
    parts: Parts = [(lathe([*outside, *rim], 28), plain((70, 104, 150)))]
    for k in range(7):
        turn, out = GOLDEN_RAD * k, 0.02 + 0.011 * k
        s = np.linspace(0.0, 1.0, 5)
        reach = 0.012 + out * s**1.6
        top = 0.16 + (0.17 - 0.012 * k) * s
        stem = np.stack([reach * np.cos(turn), reach * np.sin(turn), top], axis=-1)
        parts.append((tube(stem, 0.0024, 6), plain((86, 134, 72))))
        head = puff((0.034, 0.034, 0.048), lambda d: 1.0 + 0.12 * np.sin(3.0 * np.arctan2(d[:, 1], d[:, 0])), 6, 12)
        colour = ((222, 66, 80), (240, 190, 70), (238, 236, 226))[k % 3]
        parts.append((moved(head, stem[-1] + [0.0, 0.0, 0.014]), plain(colour)))
    return assemble(parts)


def plant_pot() -> Mesh:
    """A small pot of 110 x 100 mm with fleshy leaves."""
    profile = [[0.0, 0.0], [0.036, 0.0], [0.048, 0.078], [0.053, 0.079], [0.054, 0.096], [0.047, 0.097], [0.045, 0.085]]
    pot = (lathe([*profile, [0.0, 0.085]], 28), bands(2, [0.0851], [(196, 108, 74), (200, 116, 82)]))
    soil = (
        moved(puff((0.088, 0.088, 0.012), lambda d: 1.0 + 0.0 * d[:, 0], 4, 20), (0.0, 0.0, 0.085)),
        plain((74, 54, 40)),
    )
    parts: Parts = [pot, soil]
    s = np.linspace(0.0, 1.0, 6)
    for k in range(16):
        turn, lean = GOLDEN_RAD * k, 0.25 + 0.055 * k
        out = 0.006 + (0.055 + 0.02 * lean) * s * np.sin(lean)
        leaf = np.stack([out * np.cos(turn), out * np.sin(turn), 0.085 + 0.08 * s * np.cos(0.75 * lean)], axis=-1)
        width = 0.011 * np.sin(np.pi * (0.15 + 0.83 * s)) ** 0.8
        parts.append((tube(leaf, width, 8, flatten=0.4), plain(np.array((92, 146, 104)) * (0.8 + 0.035 * k))))
    return assemble(parts)


def papers() -> Mesh:
    """Sheets of A4 in a loose pile, 14 mm high."""
    parts: Parts = []
    for k, (yaw, x, y) in enumerate(
        [(2.0, 0.0, 0.0), (-5.0, 0.008, 0.004), (9.0, -0.006, 0.006), (-1.0, 0.003, -0.005)]
    ):
        sheets = rounded_box((0.21, 0.297, 0.0035), 0.0005, ((-0.08, 0.03, 0.08), (-0.1, -0.08, 0.02, 0.1), ()))
        text = printed(
            (238, 237, 232),
            (within(x=(-0.08, 0.08), y=(-0.08, 0.02)), (206, 206, 208)),
            (within(x=(-0.08, 0.03), y=(0.1, 0.13)), (96, 106, 130)),
        )
        parts.append(placed((sheets, text), (x, y, 0.0035 * (k + 0.5)), rotation("z", yaw)))
    return assemble(parts)


def crumpled_towel() -> Mesh:
    """A kitchen towel thrown down: a heap of folds, 260 x 200 x 70 mm."""

    def folds(d: Array) -> Array:
        turn, up = np.arctan2(d[:, 1], d[:, 0]), d[:, 2]
        waves = (
            np.sin(5.0 * turn + 3.0 * up) + 0.7 * np.sin(9.0 * turn - 6.0 * up + 1.0) + 0.5 * np.sin(7.0 * up + turn)
        )
        return 1.0 + 0.13 * waves * (0.4 + 0.6 * np.sqrt(1.0 - np.minimum(up**2, 1.0)))

    vertices, faces = puff((0.24, 0.19, 0.12), folds, 18, 40)
    flat = np.stack([vertices[:, 0], vertices[:, 1], np.maximum(vertices[:, 2], 0.0)], axis=-1)
    flat[:, 2] += 1e-4 * np.hypot(vertices[:, 0], vertices[:, 1]) * (vertices[:, 2] < 0.0)
    return assemble([((flat, faces), _checked((196, 206, 196), (84, 124, 134)))])


def _checked(one: tuple[int, int, int], other: tuple[int, int, int]) -> Paint:
    """Cloth with a soft check that its folds have bent."""

    def paint(vertices: Array) -> Array:
        u, v = vertices[:, 0] + 0.6 * vertices[:, 2], vertices[:, 1] - 0.4 * vertices[:, 2]
        share = np.clip(0.5 + 0.9 * np.sin(130.0 * u) * np.sin(110.0 * v), 0.0, 1.0)[:, None]
        return (1.0 - share) * np.array(one) + share * np.array(other)

    return paint


def fruit_pile() -> Mesh:
    """Oranges and a lemon on a tray of 240 mm."""
    rim = [[0.0, 0.0], [0.1, 0.0], [0.112, 0.006], [0.12, 0.018], [0.117, 0.019], [0.108, 0.0085], [0.0, 0.006]]
    parts: Parts = [(lathe(rim, 32), plain((146, 104, 66)))]
    places = [(0.045, 0.0), (-0.022, 0.039), (-0.022, -0.039), (0.0, 0.0)]
    for k, (x, y) in enumerate(places):
        high = 0.041 if k < 3 else 0.041 + 0.058
        orange = puff(
            (0.072, 0.072, 0.07), lambda d: 1.0 + 0.01 * np.sin(20.0 * d[:, 0]) * np.sin(19.0 * d[:, 1]), 9, 18
        )
        parts.append((moved(orange, (x, y, high)), plain((232 - 6 * k, 134 + 5 * k, 38))))
    lemon = puff((0.052, 0.08, 0.052), lambda d: 1.0 + 0.12 * np.abs(d[:, 1]) ** 9, 10, 16)
    parts.append((moved(lemon, (-0.074, 0.0, 0.035), rotation("z", 20.0)), plain((240, 214, 62))))
    return assemble(parts)


def cable() -> Mesh:
    """A charger's cable, thrown down in loops, with its plug."""
    s = np.linspace(0.0, 1.0, 72)
    turn = 5.2 * np.pi * s
    reach = 0.052 + 0.022 * np.sin(1.7 * turn) + 0.02 * s
    high = 0.0027 + 0.009 * np.clip(s - 0.4, 0.0, 1.0)  # the first loop lies on the ground, the next ones on it
    path = np.stack([reach * np.cos(turn) + 0.05 * s, 0.8 * reach * np.sin(turn), high], axis=-1)
    end = path[-1] * (1.0, 1.0, 0.0) + (0.0, 0.0, 0.0141)
    plug = moved(rounded_box((0.05, 0.034, 0.028), 0.006), end, rotation("z", 40.0))
    return assemble([(tube(path, 0.0027, 8), plain((36, 36, 38))), (plug, plain((44, 44, 46)))])


def tumbler() -> Mesh:
    """A cup without a handle, 80 x 92 mm, speckled."""
    outside = [[0.0, 0.0], [0.028, 0.0], [0.031, 0.002], *seam([0.032, 0.01], [0.039, 0.09], 0.05)]
    rim = [*arc((0.0375, 0.0905), 0.0015, 0, 180, 4), [0.035, 0.085], [0.029, 0.008], [0.0, 0.006]]
    return assemble([(lathe([*outside, *rim], 28), bands(2, [0.05], [(86, 92, 98), (214, 206, 190)]))])


def basket() -> Mesh:
    """A woven basket of 240 x 180 x 120 mm."""
    levels = []
    for k in range(11):
        z = 0.012 * k
        for dz, bulge in ((0.0, 0.0), (0.006, 0.003)):
            levels.append([0.098 + 0.02 * z / 0.12 + bulge, 0.07 + 0.02 * z / 0.12 + bulge, z + dz])
    inside = [[0.106, 0.078, 0.124], [0.092, 0.064, 0.02], [0.05, 0.03, 0.012]]
    cane, dark = np.array((196, 152, 96)), np.array((150, 108, 62))

    def weave(vertices: Array) -> Array:
        turn, row = np.arctan2(vertices[:, 1], vertices[:, 0]), np.round(vertices[:, 2] / 0.012)
        return np.where((np.sin(16.0 * turn + np.pi * row) > 0.0)[:, None], cane, dark)

    handles: Parts = []
    s = np.radians(np.linspace(0.0, 180.0, 9))
    for side in (-1, 1):
        path = np.stack([side * (0.115 + 0.006 * np.sin(s)), 0.035 * np.cos(s), 0.118 + 0.035 * np.sin(s)], axis=-1)
        handles.append((tube(path, 0.006, 8), plain(dark)))
    return assemble([(stacked([[0.07, 0.045, -0.001], *levels, *inside], power=3.0), weave), *handles])


def lamp() -> Mesh:
    """A table lamp of 400 mm with a shade of cloth."""
    foot = [[0.0, 0.0], [0.065, 0.0], [0.068, 0.006], [0.05, 0.016], [0.02, 0.03], [0.03, 0.07], [0.036, 0.1]]
    neck = [[0.026, 0.14], [0.012, 0.17], [0.009, 0.19], [0.009, 0.25], [0.0, 0.25]]
    shade = [[0.112, 0.215], [0.115, 0.215], [0.078, 0.4], [0.075, 0.4]]
    return assemble(
        [
            (lathe([*foot, *neck], 28), plain((64, 96, 104))),
            (ring(shade, 36), bands(2, [0.222, 0.393], [(206, 190, 160), (238, 226, 200), (206, 190, 160)])),
        ]
    )


def toy() -> Mesh:
    """A wooden car of 170 mm."""
    red, yellow, dark, wood = (204, 58, 48), (240, 196, 64), (48, 48, 50), (214, 174, 122)
    body = moved(rounded_box((0.165, 0.07, 0.036), 0.012, steps=4), (0.0, 0.0, 0.04))
    cabin = moved(rounded_box((0.085, 0.06, 0.05), 0.014, steps=4), (-0.012, 0.0, 0.072))
    parts: Parts = [(body, plain(red)), (cabin, plain(yellow))]
    wheel = lathe([[0.0, -0.008], [0.018, -0.008], [0.021, -0.005], [0.021, 0.005], [0.018, 0.008], [0.0, 0.008]], 20)

    def hub(v: Array) -> NDArray[np.bool_]:
        return np.hypot(np.abs(v[:, 0]) - 0.05, v[:, 2] - 0.021) < 0.019

    for x in (-0.05, 0.05):
        for side in (-1, 1):
            at = (x, side * 0.036, 0.021)
            parts.append((moved(wheel, at, rotation("x", 90.0)), printed(dark, (hub, wood))))
    return assemble(parts)


def candle() -> Mesh:
    """A stubby candle on a saucer."""
    saucer = [[0.0, 0.0], [0.035, 0.0], [0.052, 0.009], [0.05, 0.0105], [0.034, 0.004], [0.0, 0.004]]
    wax = [[0.0, 0.004], [0.029, 0.004], [0.0295, 0.075], [0.028, 0.079], [0.02, 0.077], [0.012, 0.074], [0.0, 0.0735]]
    wick = np.array([[0.0, 0.0, 0.07], [0.0005, 0.0, 0.082], [0.002, 0.0, 0.089]])
    return assemble(
        [
            (lathe(saucer, 28), plain((120, 126, 130))),
            (lathe(wax, 24), plain((236, 224, 196))),
            (tube(wick, 0.0012, 6), plain((40, 36, 34))),
        ]
    )


def photo_frame() -> Mesh:
    """A framed photograph of 150 x 200 mm, leaning on its stand."""
    lean = rotation("x", -14.0)
    board = rounded_box((0.15, 0.014, 0.2), 0.003, ((-0.055, 0.055), (), (-0.08, -0.01, 0.03, 0.08)))
    paint = printed(
        (60, 46, 38),
        (within(x=(-0.055, 0.055), y=(-1.0, 0.0), z=(-0.08, 0.08)), (170, 196, 216)),
        (within(x=(-0.055, 0.055), y=(-1.0, 0.0), z=(-0.08, 0.03)), (112, 142, 108)),
        (within(x=(-0.055, 0.055), y=(-1.0, 0.0), z=(-0.08, -0.01)), (196, 178, 132)),
    )
    leaning = placed((board, paint), (0.0, 0.0, -float((board[0] @ lean.T)[:, 2].min())), lean)
    stand = np.array([[0.0, 0.03, 0.15], [0.0, 0.055, 0.075], [0.0, 0.08, 0.01], [0.0, 0.08, 0.0]])
    return assemble([leaning, (tube(stand, 0.006, 8), plain((60, 46, 38)))])


def tissue_box() -> Mesh:
    """A box of tissues of 230 x 115 x 70 mm, one half drawn."""
    box = rounded_box((0.23, 0.115, 0.07), 0.003, ((-0.09, 0.09), (), (-0.022, 0.01)))
    paint = bands(2, [-0.022, 0.01], [(120, 172, 178), (236, 232, 220), (120, 172, 178)])

    def crease(d: Array) -> Array:
        turn = np.arctan2(d[:, 1], d[:, 0])
        return 1.0 + 0.22 * np.sin(3.0 * turn + 4.0 * d[:, 2]) + 0.1 * np.sin(7.0 * turn)

    tissue = moved(puff((0.09, 0.045, 0.13), crease, 10, 20), (0.0, 0.0, 0.046))
    return assemble([(box, paint), (tissue, plain((246, 246, 244)))])


def magazines() -> Mesh:
    """Three magazines on one another."""
    covers = [((64, 96, 140), (232, 200, 96)), ((186, 70, 74), (240, 232, 220)), ((212, 206, 192), (60, 60, 64))]
    parts: Parts = []
    for k, (ground, title) in enumerate(covers):
        solid = rounded_box((0.21, 0.28, 0.006), 0.0015, ((-0.09, 0.09), (-0.12, -0.02, 0.07, 0.11), ()))
        paint = printed(
            ground,
            (within(x=(-0.09, 0.09), y=(0.07, 0.11)), title),
            (within(x=(-0.09, 0.09), y=(-0.12, -0.02)), np.array(ground) * 0.75),
            (within(z=(-0.0016, 0.0016)), (236, 234, 228)),
        )
        at = (0.006 * k, -0.004 * k, 0.003 + 0.006 * k)
        parts.append(placed((solid, paint), at, rotation("z", (4.0, -11.0, 7.0)[k])))
    return assemble(parts)


@cache
def clutter() -> tuple[Clutter, ...]:
    """All of it; each stands upright."""
    dull = (plant_pot, papers, crumpled_towel, fruit_pile, cable, basket, lamp, toy, candle, tissue_box, magazines)
    glossy = (vase, tumbler, photo_frame)
    rests = np.stack(UPRIGHT)
    return tuple(Clutter(make.__name__, make(), rests, 0.4 if make in glossy else 0.0) for make in (*dull, *glossy))
