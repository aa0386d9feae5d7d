"""Things of a bathroom, and what people clean with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation import solids
from sequences.simulation.shapes.shape import BOX_TURNS, EITHER_WAY_UP, Entry
from sequences.simulation.solids import (
    arc,
    assemble,
    bands,
    lathe,
    moved,
    plain,
    printed,
    puff,
    ring,
    rounded_box,
    seam,
    stacked,
    tube,
    within,
)

Array = NDArray[np.float64]


def shampoo_bottle() -> Mesh:
    """A refill bottle of 71 x 71 x 236 mm: square, its shoulders slope to a flat cap as wide as itself.

    Depth can hardly tell it from the milk carton: the surfaces are a millimetre or two apart.
    """
    foot = [[0.032, 0.032, 0.0], [0.0345, 0.0345, 0.0015], [0.0355, 0.0355, 0.005]]
    wall = [(0.0355, 0.0355, z) for z in (0.05, 0.062, 0.135, 0.15)]
    shoulder = [[0.0355, 0.0355, 0.191], [0.0352, 0.033, 0.195], [0.034, 0.0065, 0.2165], [0.0335, 0.0048, 0.2191]]
    cap = [[0.0338, 0.005, 0.222], [0.0335, 0.0042, 0.234], [0.033, 0.0032, 0.236]]
    body = stacked([*foot, *wall, *shoulder, *cap], power=9.0)
    violet, lilac, white, green = (126, 84, 168), (206, 184, 226), (244, 244, 242), (120, 176, 128)
    paint = printed(
        lilac,
        (within(z=(0.05, 0.135)), white),
        (within(x=(-0.03, 0.03), z=(0.062, 0.135)), violet),
        (within(z=(0.135, 0.15)), green),
        (within(z=(0.2191, 1.0)), white),
    )
    return assemble([(body, paint)])


def loofah() -> Mesh:
    """A puff of mesh cloth of 152 x 146 x 83 mm: much of the bowl's outline, but a heap where that is hollow."""

    def ruffles(d: Array) -> Array:
        turn = np.arctan2(d[:, 1], d[:, 0])
        rings = np.sin(9.0 * turn + 7.0 * d[:, 2]) * np.sin(11.0 * np.arcsin(np.clip(d[:, 2], -1.0, 1.0)) + 2.0 * turn)
        return 1.0 + 0.055 * rings * np.sqrt(1.0 - d[:, 2] ** 2 + 1e-9) + 0.02 * np.sin(3.0 * turn + 1.0)

    vertices, faces = puff((0.146, 0.142, 0.096), ruffles, rings=19, segments=36)
    flat = np.maximum(vertices, [-1.0, -1.0, -0.034])  # it lies on its own weight
    pink, pale = np.array((232, 112, 148)), np.array((250, 196, 210))

    def paint(v: Array) -> Array:
        reach = np.linalg.norm(v / (0.073, 0.071, 0.048), axis=-1)
        share = np.clip((reach - 0.93) / 0.14, 0.0, 1.0)[:, None]
        return (1.0 - share) * pink + share * pale

    s = np.radians(np.linspace(20.0, 340.0, 13))
    cord = np.stack([0.06 - 0.018 * np.cos(s), 0.016 * np.sin(s), -0.028 + 0.0 * s], axis=-1)
    white = (240, 238, 236)
    return assemble([((flat, faces), paint), (tube(cord, 0.0022, 8), plain(white))])


def toothbrush_cup() -> Mesh:
    """A tumbler of 74 x 96 mm in which a toothbrush leans."""
    outside = [[0.0, 0.0], [0.029, 0.0], [0.031, 0.002], *seam([0.0312, 0.004], [0.0368, 0.09], 0.07)]
    rim = [*arc((0.0356, 0.0945), 0.0015, 0, 180, 4), [0.0335, 0.09], [0.0285, 0.006], [0.0, 0.005]]
    cup = lathe([*outside, *rim], 32)
    white, aqua, blue = (240, 244, 244), (96, 178, 186), (44, 92, 170)

    def glaze(vertices: Array) -> Array:
        hollow = np.hypot(vertices[:, 0], vertices[:, 1]) < 0.0305 + 0.06 * vertices[:, 2] - 0.0005
        return np.where(((vertices[:, 2] < 0.07) & ~hollow)[:, None], aqua, white)

    lean = solids.rotation("y", 17.0)
    foot = np.array([-0.02, 0.0, 0.007])
    s = np.array([0.0, 0.03, 0.06, 0.1, 0.13, 0.15, 0.175])
    stem = foot + np.stack([0.0 * s, 0.0 * s, s], axis=-1) @ lean.T
    handle = tube(stem, [0.0048, 0.0062, 0.0058, 0.0045, 0.0034, 0.0042, 0.0042], 10, flatten=0.7)
    bristles = moved(rounded_box((0.011, 0.010, 0.027), 0.0015), foot + lean @ [0.007, 0.0, 0.162], lean)
    return assemble([(cup, glaze), (handle, plain(blue)), (bristles, plain(white))])


def soap() -> Mesh:
    """A bar of soap on a dish of 130 x 90 x 44 mm."""
    under = [[0.04, 0.026, 0.0], [0.046, 0.031, 0.002], [0.06, 0.041, 0.014], [0.065, 0.045, 0.02]]
    inside = [[0.0635, 0.0437, 0.0215], [0.061, 0.0415, 0.02], [0.052, 0.034, 0.0115], [0.03, 0.02, 0.009]]
    dish = stacked([*under, *inside], power=2.6)
    levels = [[0.03, 0.019, 0.011], [0.037, 0.0245, 0.0155], [0.04, 0.027, 0.024], [0.0385, 0.0255, 0.034]]
    bar = stacked([*levels, [0.035, 0.022, 0.0395], [0.02, 0.01, 0.042]], power=3.0)
    cream, grey = (236, 222, 176), (150, 176, 184)
    return assemble([(dish, plain(grey)), (bar, plain(cream))])


def toilet_roll() -> Mesh:
    """A roll of 112 x 98 mm; upside down it is the same."""
    half, outer, core = 0.049, 0.056, 0.0215
    low = [[core, -half + 0.0004], [core + 0.0012, -half], *arc((outer - 0.004, -half + 0.004), 0.004, -85, -5, 4)]
    profile = [*low, *[[r, -z] for r, z in reversed(low)]]
    white, shade, card = (242, 241, 238), (228, 226, 222), (176, 148, 116)

    def paint(vertices: Array) -> Array:
        r = np.hypot(vertices[:, 0], vertices[:, 1])
        colours = np.where((np.abs(vertices[:, 2]) > 0.0448)[:, None], shade, white)
        return np.where((r < core + 0.0008)[:, None], card, colours)

    return assemble([(ring(profile, 40), paint)])


def dish_soap() -> Mesh:
    """A flat bottle of 80 x 50 x 205 mm with a flip cap."""
    low = [[0.0, 0.0], [0.034, 0.0], *arc((0.034, 0.006), 0.006, -60, 0, 3)]
    label = [*seam([0.04, 0.02], [0.04, 0.13], 0.032), *seam([0.04, 0.02], [0.04, 0.13], 0.118)]
    shoulder = [*arc((0.022, 0.142), 0.018, 0, 75, 5), *seam([0.0266, 0.1594], [0.0186, 0.166], 0.163)]
    cap = [[0.0195, 0.167], [0.0195, 0.2], *arc((0.0165, 0.202), 0.003, 0, 80, 3), [0.0, 0.205]]
    green, lemon, white = (72, 158, 74), (246, 222, 84), (240, 240, 240)
    paint = bands(2, [0.032, 0.118, 0.163], [green, lemon, green, white])
    return assemble([(solids.scaled(lathe([*low, *label, *shoulder, *cap]), (1.0, 0.62, 1.0)), paint)])


def spray_bottle() -> Mesh:
    """A window cleaner of 255 mm: round bottle, nozzle towards +x, trigger below it."""
    low = [[0.0, 0.0], [0.036, 0.0], *arc((0.036, 0.004), 0.004, -60, 0, 3)]
    label = [*seam([0.04, 0.02], [0.04, 0.12], 0.03), *seam([0.04, 0.02], [0.04, 0.12], 0.105)]
    neck = [[0.039, 0.125], [0.033, 0.15], [0.02, 0.178], [0.0135, 0.19], *seam([0.0135, 0.19], [0.0135, 0.2], 0.195)]
    collar = [[0.0165, 0.197], [0.0165, 0.216], [0.0, 0.216]]
    blue, white, red, dark = (58, 150, 204), (240, 244, 246), (206, 46, 40), (70, 70, 76)
    body = (lathe([*low, *label, *neck, *collar], 32), bands(2, [0.03, 0.105, 0.195], [blue, white, blue, red]))
    head = (moved(rounded_box((0.078, 0.026, 0.034), 0.008), (0.012, 0.0, 0.231)), plain(red))
    nozzle = (tube(np.array([[0.045, 0.0, 0.235], [0.052, 0.0, 0.235], [0.06, 0.0, 0.235]]), 0.0075, 14), plain(dark))
    bend = np.array([[0.034, 0.0, 0.222], [0.04, 0.0, 0.205], [0.041, 0.0, 0.188], [0.047, 0.0, 0.175]])
    return assemble([body, head, nozzle, (tube(bend, [0.006, 0.0055, 0.005, 0.0045], 10), plain(dark))])


def sponge() -> Mesh:
    """A scouring sponge of 110 x 70 x 38 mm."""
    solid = rounded_box(
        (0.11, 0.07, 0.038), 0.005, (solids.cuts_every(0.022, 0.05), solids.cuts_every(0.02, 0.03), (0.009,)), 4
    )
    return assemble([(solid, bands(2, [0.009], [(240, 206, 70), (62, 130, 62)]))])


BATH = (
    Entry(shampoo_bottle, "bath", ("z",), gloss=0.2),
    Entry(loofah, "bath"),
    Entry(toothbrush_cup, "bath", gloss=0.3),
    Entry(soap, "bath", ("z",), gloss=0.2),
    Entry(toilet_roll, "bath", ("x",), axis=True),
)

CLEANING = (
    Entry(dish_soap, "cleaning", ("z",), gloss=0.2),
    Entry(spray_bottle, "cleaning", gloss=0.2),
    Entry(sponge, "cleaning", BOX_TURNS, rests=EITHER_WAY_UP),
)
