"""Tools."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation.shapes.shape import EITHER_WAY_UP, Entry
from sequences.simulation.solids import (
    assemble,
    bands,
    loft,
    moved,
    plain,
    ring,
    rounded_box,
    scored,
    tube,
)

Array = NDArray[np.float64]


def hammer() -> Mesh:
    """A claw hammer 290 mm long, lying on its side: handle along x, head along y."""
    x = np.array([-0.145, -0.142, -0.10, -0.05, -0.035, -0.03, 0.04, 0.115])
    radius = np.array([0.012, 0.016, 0.0165, 0.014, 0.0155, 0.0125, 0.0115, 0.011])
    path = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=-1)
    wood, grip, steel = (176, 124, 70), (40, 62, 120), (128, 132, 138)
    handle = (tube(path, radius, 16, flatten=0.8), bands(0, [-0.0325], [grip, wood]))
    eye = (moved(rounded_box((0.032, 0.044, 0.026), 0.004), (0.128, 0.0, 0.0)), plain(steel))
    face = np.array([[0.128, -0.015, 0.0], [0.128, -0.036, 0.0], [0.128, -0.037, 0.0], [0.128, -0.058, 0.0]])
    claw = np.array([[0.13, 0.018, 0.0], [0.129, 0.036, 0.0], [0.122, 0.052, 0.0], [0.108, 0.066, 0.0]])
    return assemble(
        [
            handle,
            eye,
            (tube(face, [0.0095, 0.0095, 0.0135, 0.0135], 18), plain(steel)),
            (tube(claw, [0.0125, 0.011, 0.008, 0.004], 14, flatten=0.8), plain(steel)),
        ]
    )


def screwdriver() -> Mesh:
    """A screwdriver 235 mm long, lying: a fluted handle at -x, a flat tip at +x."""
    x = np.array([-0.115, -0.1145, -0.108, -0.07, -0.02, -0.012, -0.008, -0.0075])
    radius = np.array([0.011, 0.013, 0.0155, 0.0165, 0.015, 0.0105, 0.0125, 0.0105])
    angle = 2.0 * np.pi * np.arange(36) / 36
    flutes = 1.0 - 0.09 * (np.cos(6.0 * angle) > 0.4)  # six grooves, so that it lies on two ridges
    fluted = np.where(((x > -0.11) & (x < -0.015))[:, None], flutes, 1.0)
    handle = _about_x(x, radius[:, None] * fluted, angle + np.pi / 6.0)
    shaft_x = np.array([-0.008, 0.098, 0.108, 0.119, 0.12])
    width, thick = np.array([3.2, 3.2, 4.6, 4.0, 3.8]) * 1e-3, np.array([3.2, 3.2, 1.7, 0.6, 0.5]) * 1e-3
    round_ = np.stack([np.cos(angle[::2]), np.sin(angle[::2])], axis=-1)
    section = round_ * np.stack([width, thick], axis=-1)[:, None]
    shaft = loft(np.concatenate([np.broadcast_to(shaft_x[:, None, None], (5, 18, 1)), section], axis=-1))
    red, black, steel = (200, 44, 36), (34, 34, 36), (178, 180, 186)
    return assemble(
        [(scored(handle, 0, [-0.09, -0.045]), bands(0, [-0.09, -0.045], [black, red, black])), (shaft, plain(steel))]
    )


def _about_x(x: Array, radius: Array, angle: Array) -> tuple[Array, NDArray[np.int32]]:
    """A skin over sections across x with a radius (m, n) for each angle (n,)."""
    along = np.broadcast_to(x[:, None], radius.shape)
    return loft(np.stack([along, radius * np.cos(angle), radius * np.sin(angle)], axis=-1))


def tape_roll() -> Mesh:
    """A roll of parcel tape of 120 x 50 mm on its cardboard core, lying flat; upside down it is the same."""
    half, outer, core, card_m = 0.025, 0.06, 0.038, 0.0405
    low = [[core, -half], [card_m, -half], [outer - 0.001, -half], [outer, -half + 0.001]]
    outline = [*low, *[[r, -z] for r, z in reversed(low)]]
    brown, card, side = (186, 136, 76), (150, 116, 84), (206, 166, 108)

    def paint(vertices: Array) -> Array:
        r = np.hypot(vertices[:, 0], vertices[:, 1])
        colours = np.where((np.abs(vertices[:, 2]) > half - 2e-5)[:, None], side, brown)
        return np.where((r < card_m)[:, None], card, colours)

    return assemble([(ring(outline, 40), paint)])


def drill() -> Mesh:
    """A cordless drill of 190 x 70 x 195 mm, standing on its battery, its chuck towards +x."""
    yellow, black, steel = (240, 186, 38), (38, 38, 40), (150, 152, 158)
    battery = moved(rounded_box((0.105, 0.07, 0.042), 0.008), (0.0, 0.0, 0.021))
    grip = np.array([[-0.012, 0.0, 0.035], [-0.018, 0.0, 0.075], [-0.026, 0.0, 0.115], [-0.03, 0.0, 0.15]])
    handle = tube(grip, [0.021, 0.0175, 0.019, 0.021], 18, flatten=0.85)
    x = np.array([-0.088, -0.086, -0.078, -0.03, 0.045, 0.058, 0.06])
    radius = np.array([0.022, 0.027, 0.031, 0.033, 0.031, 0.026, 0.022])
    motor = tube(np.stack([x, 0.0 * x, 0.165 + 0.0 * x], axis=-1), radius, 24)
    nose = np.array([0.055, 0.0551, 0.088, 0.1, 0.102])
    chuck = tube(np.stack([nose, 0.0 * nose, 0.165 + 0.0 * nose], axis=-1), [0.019, 0.02, 0.02, 0.012, 0.008], 18)
    trigger = moved(rounded_box((0.014, 0.014, 0.03), 0.005), (0.0, 0.0, 0.122))
    return assemble(
        [
            (battery, plain(black)),
            (handle, plain(yellow)),
            (scored(motor, 0, [-0.06, 0.03]), bands(0, [-0.06, 0.03], [black, yellow, black])),
            (chuck, plain(steel)),
            (trigger, plain((176, 40, 36))),
        ]
    )


TOOLS = (
    Entry(hammer, "tool", rests=EITHER_WAY_UP, gloss=0.3),
    Entry(screwdriver, "tool", ("x",), gloss=0.2),
    Entry(tape_roll, "tool", ("x",), axis=True, gloss=0.2),
    Entry(drill, "tool", gloss=0.1),
)
