"""Crockery and pots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation.shapes.shape import Entry
from sequences.simulation.solids import (
    arc,
    assemble,
    bands,
    lathe,
    plain,
    printed,
    scored,
    seam,
    tube,
)

Array = NDArray[np.float64]


def mug() -> Mesh:
    """A mug of 82 x 95 mm with a handle along +x."""
    outside = [[0.0, 0.002], [0.030, 0.002], [0.031, 0.0], [0.0365, 0.0], *arc((0.036, 0.005), 0.005, -60, 0, 3)]
    rim = [[0.041, 0.0819], [0.041, 0.0821], *arc((0.039, 0.093), 0.002, 0, 180, 4)]
    inside = [[0.037, 0.09], [0.037, 0.014], *arc((0.031, 0.012), 0.006, 0, -80, 3), [0.0, 0.006]]
    body = lathe([*outside, *rim, *inside], 32)
    angle = np.radians(np.linspace(90.0, -90.0, 13))
    path = np.stack([0.039 + 0.032 * np.cos(angle), np.zeros(13), 0.05 + 0.029 * np.sin(angle)], axis=-1)
    teal, white = np.array((38, 130, 140)), np.array((244, 242, 236))

    def paint(vertices: Array) -> Array:
        hollow = np.hypot(vertices[:, 0], vertices[:, 1]) < 0.0385
        return np.where(((hollow & (vertices[:, 2] > 0.004)) | (vertices[:, 2] > 0.082))[:, None], white, teal)

    return assemble([(body, paint), (tube(path, 0.0055, 10), plain(teal))])


def bowl() -> Mesh:
    """A thick-walled bowl of 150 x 60 mm."""
    foot = [[0.0, 0.004], [0.028, 0.004], [0.029, 0.0], [0.034, 0.0], [0.035, 0.005]]
    wall = arc((0.022, 0.057), 0.053, -72, 0, 7)
    outside = [*wall[:-1], *seam(wall[-2], wall[-1], 0.045), wall[-1]]
    inside = arc((0.022, 0.057), 0.0485, 0, -85, 7)
    profile = [*foot, *outside, *arc((0.07275, 0.0585), 0.00225, 0, 180, 4), *inside, [0.0, 0.0085]]
    cream, blue = np.array((240, 228, 204)), np.array((62, 92, 156))

    def paint(vertices: Array) -> Array:
        outer = (
            np.hypot(np.maximum(np.hypot(vertices[:, 0], vertices[:, 1]) - 0.022, 0.0), vertices[:, 2] - 0.057) > 0.0505
        )
        return np.where((outer & (vertices[:, 2] > 0.045) & (vertices[:, 2] < 0.0575))[:, None], blue, cream)

    return assemble([(lathe(profile), paint)])


def plate() -> Mesh:
    """A dinner plate of 250 x 24 mm with a blue line round its rim."""
    under = [[0.0, 0.003], [0.068, 0.003], [0.07, 0.0], [0.076, 0.0], [0.079, 0.004], [0.118, 0.0185]]
    rim = arc((0.1225, 0.0215), 0.0025, -60, 120, 5)
    well = [*seam([0.118, 0.0232], [0.085, 0.0112], 0.0222), *seam([0.118, 0.0232], [0.085, 0.0112], 0.0205)]
    inside = [[0.088, 0.0122], [0.082, 0.0095], [0.077, 0.0078], [0.0, 0.0072]]
    white, blue = (240, 240, 236), (54, 78, 140)

    def line(points: Array) -> NDArray[np.bool_]:
        above = np.hypot(points[:, 0], points[:, 1]) < 0.118
        return above & (points[:, 2] > 0.0205) & (points[:, 2] < 0.0222)

    return assemble([(lathe([*under, *rim, *well, *inside], 40), printed(white, (line, blue)))])


def teapot() -> Mesh:
    """A round teapot of 150 mm with a spout along +x, a handle along -x, and a lid with a knob."""
    foot = [[0.0, 0.003], [0.038, 0.003], [0.04, 0.0], [0.045, 0.0], [0.048, 0.004]]
    line = [*seam([0.072, 0.043], [0.0735, 0.058], 0.047), *seam([0.072, 0.043], [0.0735, 0.058], 0.055)]
    belly = [[0.060, 0.018], [0.068, 0.031], *line, [0.0735, 0.06], [0.070, 0.075], [0.060, 0.091], [0.045, 0.104]]
    lid = [[0.041, 0.106], [0.0415, 0.1085], [0.038, 0.111], [0.024, 0.117], [0.009, 0.120]]
    knob = [[0.007, 0.1225], [0.0105, 0.127], [0.0115, 0.1315], [0.009, 0.136], [0.0, 0.138]]
    s = np.linspace(0.0, 1.0, 9)
    rise = 0.5 - 0.5 * np.cos(np.pi * s)
    spout = np.stack([0.056 + 0.066 * s, 0.0 * s, 0.042 + 0.068 * rise], axis=-1)
    angle = np.radians(np.linspace(75.0, 285.0, 11))
    handle = np.stack([-0.068 + 0.043 * np.cos(angle), 0.0 * angle, 0.064 + 0.036 * np.sin(angle)], axis=-1)
    glaze, light = (142, 70, 42), (226, 196, 152)
    return assemble(
        [
            (lathe([*foot, *belly, *lid, *knob], 30), bands(2, [0.047, 0.055], [glaze, light, glaze])),
            (tube(spout, np.interp(s, [0.0, 0.5, 1.0], [0.018, 0.0115, 0.0075]), 12), plain(glaze)),
            (tube(handle, 0.0062, 8, flatten=1.3), plain(glaze)),
        ]
    )


def saucepan() -> Mesh:
    """A steel pan of 180 x 85 mm with a black handle along +x."""
    outside = [[0.0, 0.0], [0.078, 0.0], *arc((0.082, 0.006), 0.006, -80, -10, 4)]
    rim = [[0.0882, 0.08], [0.0912, 0.0825], [0.0908, 0.0846], [0.0865, 0.0835]]
    inside = [[0.0858, 0.08], [0.0856, 0.012], [0.08, 0.004], [0.0, 0.0035]]
    steel, dark, black = (170, 174, 180), (120, 124, 130), (36, 36, 38)
    pan = printed(steel, (lambda v: (np.hypot(v[:, 0], v[:, 1]) < 0.0857) & (v[:, 2] > 0.002), dark))
    path = np.array(
        [[0.085, 0.0, 0.066], [0.105, 0.0, 0.071], [0.12, 0.0, 0.076], [0.15, 0.0, 0.083], [0.21, 0.0, 0.09]]
    )
    handle = scored(tube(path, [0.006, 0.007, 0.0105, 0.011, 0.009], 14, flatten=1.5), 0, [0.117])
    return assemble([(lathe([*outside, *rim, *inside]), pan), (handle, bands(0, [0.117], [steel, black]))])


KITCHEN = (
    Entry(mug, "kitchen", gloss=0.4),
    Entry(bowl, "kitchen", axis=True, gloss=0.3),
    Entry(plate, "kitchen", axis=True, gloss=0.4),
    Entry(teapot, "kitchen", gloss=0.5),
    Entry(saucepan, "kitchen", gloss=0.8),
)
