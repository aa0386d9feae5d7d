"""Food and drink."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation.shapes.shape import BOX_TURNS, EITHER_WAY_UP, IDENTITY, Entry
from sequences.simulation.solids import (
    arc,
    assemble,
    bands,
    lathe,
    printed,
    rotation,
    rounded_box,
    seam,
    tube,
    within,
)

Array = NDArray[np.float64]


def soup_can() -> Mesh:
    """A tin of 66 x 101 mm with rims and a paper label; upside down it is the same."""
    rim = [
        [0.0, -0.0475],
        [0.0305, -0.0475],
        [0.0308, -0.0505],
        [0.0326, -0.0505],
        [0.0332, -0.0495],
        [0.0332, -0.0475],
    ]
    low = [*rim, *seam([0.0328, -0.0465], [0.0328, 0.0], -0.044), *seam([0.0328, -0.0465], [0.0328, 0.0], -0.006)]
    high = [[r, -z] for r, z in reversed(low)]
    silver, red, cream, gold = (196, 198, 202), (186, 28, 34), (240, 232, 214), (206, 164, 70)
    paint = bands(2, [-0.044, -0.006, 0.006, 0.044], [silver, cream, gold, red, silver])
    return assemble([(lathe([*low, *high]), paint)])


def cereal_box() -> Mesh:
    """A carton of 190 x 65 x 290 mm."""
    red, yellow, white, brown, blue = (204, 34, 40), (246, 190, 40), (250, 246, 232), (190, 120, 50), (40, 80, 160)
    x, z = (-0.07, -0.04, 0.04, 0.07), (-0.115, -0.085, -0.03, 0.0, 0.045, 0.095, 0.122)
    front = [
        (0.19, -0.145, -0.115, blue),
        (0.04, -0.03, 0.0, brown),
        (0.07, -0.085, -0.03, white),
        (0.07, 0.045, 0.095, red),
        (0.19, 0.122, 0.145, blue),
    ]
    faces = [
        (within(x=(-w, w), y=side, z=(low, high)), colour)
        for w, low, high, colour in front
        for side in ((-1.0, -0.03), (0.03, 1.0))
    ]
    return assemble([(rounded_box((0.19, 0.065, 0.29), 0.004, (x, (), z)), printed(yellow, *faces))])


def milk_carton() -> Mesh:
    """A gable-top carton of 70 x 70 x 235 mm: its sides fold in to a ridge along x."""
    shoulder, ridge, half = 0.075, 0.1, 0.035
    z = (-0.105, -0.05, 0.02, 0.05, shoulder, ridge)
    vertices, faces = rounded_box((0.07, 0.07, 0.235), 0.003, ((-0.02, 0.02), (-0.012, 0.0, 0.012), z))
    share = np.clip((vertices[:, 2] - shoulder) / (ridge - shoulder), 0.0, 1.0)
    folded = vertices.copy()
    folded[:, 1] *= 1.0 - share * (1.0 - 0.003 / half)
    # the gable's ends tuck in below the ridge
    folded[:, 0] *= 1.0 - 0.25 * share * (1.0 - np.abs(vertices[:, 1]) / half)
    folded[:, 0] *= 1.0 - 0.05 * share
    white, blue, green = (246, 246, 242), (36, 98, 178), (88, 164, 76)
    paint = printed(
        white,
        (within(z=(-0.12, -0.105)), blue),
        (within(z=(-0.05, 0.02)), blue),
        (within(x=(-0.02, 0.02), z=(0.02, 0.05)), green),
    )
    return assemble([((folded, faces), paint)])


def banana() -> Mesh:
    """A banana 190 mm along its bend, lying on its side: a stem at -x, a tip at +x."""
    s = np.linspace(0.0, 1.0, 21)
    angle = np.radians(-60.0 + 120.0 * s)
    path = 0.09 * np.stack([np.sin(angle), np.cos(angle), np.zeros_like(s)], axis=-1)
    girth = [0.0055, 0.005, 0.006, 0.0145, 0.0186, 0.019, 0.0186, 0.015, 0.008, 0.0035]
    radius = np.interp(s, [0.0, 0.04, 0.1, 0.17, 0.27, 0.5, 0.74, 0.86, 0.95, 1.0], girth)
    yellow, green, brown = np.array((238, 200, 52)), np.array((170, 180, 60)), np.array((92, 64, 34))

    def paint(vertices: Array) -> Array:
        at = (np.degrees(np.arctan2(vertices[:, 0], vertices[:, 1])) + 60.0) / 120.0
        colours = np.where((at < 0.18)[:, None], green, yellow)
        return np.where(((at < 0.03) | (at > 0.97))[:, None], brown, colours)

    return assemble([(tube(path, radius, 20, flatten=0.92), paint)])


def apple() -> Mesh:
    """An apple of 78 x 73 mm with a hollow round its stalk."""
    angle = np.radians(np.linspace(-82.0, 78.0, 12))
    plump = 0.026 * np.cos(angle) + 0.013 * (1.0 + 0.18 * np.sin(angle)) * np.cos(angle) ** 0.5
    flesh = np.stack([plump, 0.034 * np.sin(angle)], axis=-1).tolist()
    foot, crown = [[0.0, -0.028], [0.006, -0.0315]], [[0.0045, 0.0275], [0.0022, 0.0255]]
    stalk = [[0.0016, 0.027], [0.0016, 0.0272], [0.0018, 0.0385], [0.0, 0.039]]
    red, yellow, green, brown = (188, 34, 38), (226, 176, 70), (132, 150, 62), (92, 66, 40)

    def skin(vertices: Array) -> Array:
        turn, r = np.arctan2(vertices[:, 1], vertices[:, 0]), np.hypot(vertices[:, 0], vertices[:, 1])
        blush = 0.5 + 0.5 * np.sin(turn + 0.6) + 0.12 * np.sin(9.0 * turn) + 4.0 * vertices[:, 2]
        mixed = np.interp(np.clip(blush, 0.0, 1.0), [0.0, 0.45, 1.0], [0.0, 0.75, 1.0])[:, None]
        colours = (1.0 - mixed) * np.array(yellow) + mixed * np.array(red)
        colours[r < 0.009] = green
        colours[(r < 0.0021) & (vertices[:, 2] > 0.0)] = brown
        return colours

    return assemble([(lathe([*foot, *flesh, *crown, *stalk], 32), skin)])


def wine_bottle() -> Mesh:
    """A bottle of 75 x 305 mm, dark green, with a paper label and a foil over its cork."""
    low = [[0.0, 0.012], [0.012, 0.010], [0.026, 0.0], [0.0345, 0.0], *arc((0.0335, 0.004), 0.004, -60, 0, 3)]
    wall = [point for z in (0.045, 0.06, 0.067, 0.084, 0.118, 0.135) for point in seam([0.0375, 0.0], [0.0375, 1.0], z)]
    shoulder = [[0.0375, 0.185], [0.0368, 0.195], [0.0335, 0.207], [0.027, 0.219], [0.0205, 0.230], [0.0165, 0.243]]
    neck = [*seam([0.0165, 0.243], [0.0145, 0.28], 0.252), [0.0145, 0.284], [0.0155, 0.285], [0.0158, 0.296]]
    lip = [*arc((0.0138, 0.3025), 0.002, 0, 80, 3), [0.0, 0.305]]
    glass, foil, cream, gold, ink = (30, 46, 34), (118, 26, 40), (240, 232, 210), (190, 156, 84), (60, 50, 46)
    front = (-1.0, 0.0)
    paint = printed(
        glass,
        (within(y=front, z=(0.045, 0.135)), cream),
        (within(x=(-0.03, 0.03), y=front, z=(0.06, 0.067)), gold),
        (within(x=(-0.023, 0.023), y=front, z=(0.084, 0.118)), ink),
        (within(z=(0.252, 1.0)), foil),
    )
    return assemble([(lathe([*low, *wall, *shoulder, *neck, *lip], 28), paint)])


FOOD = (
    Entry(soup_can, "food", ("x",), axis=True, gloss=0.5),
    Entry(cereal_box, "food", BOX_TURNS, rests=(IDENTITY, rotation("x", 90.0)), gloss=0.1),
    Entry(milk_carton, "food", ("z",), gloss=0.1),
    Entry(banana, "food", rests=EITHER_WAY_UP),
    Entry(apple, "food", axis=True, gloss=0.15),
    Entry(wine_bottle, "food", axis=True, gloss=0.7),
)
