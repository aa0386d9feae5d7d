"""Furniture: what other things stand on. The side that people use is -y."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation.shapes.shape import Entry, SupportArea
from sequences.simulation.solids import (
    Part,
    Solid,
    assemble,
    block,
    cuts_every,
    grained,
    moved,
    plain,
    rotation,
    rounded_box,
    tube,
)

Array = NDArray[np.float64]

TABLE = (1.3, 0.7, 0.74)
DESK = (1.2, 0.6, 0.73)
SIDE_TABLE = (0.55, 0.42, 0.5)
CABINET = (0.8, 0.4, 0.86)
KNOB_M = 0.015  # by which its knobs stand out before its top
SHELF = (0.9, 0.32, 1.5)
BOARDS = (0.09, 0.44, 0.79, 1.13)
BOARD_M = 0.02
SOFA = (1.5, 0.82, 0.8)
SEAT = (0.62, 0.56, 0.42)  # of the sofa: width and depth of a cushion, height of the seat
CHAIR = (0.43, 0.46, 0.86)
CHAIR_SEAT_M = 0.45
OPEN_M = 1.0  # headroom of what has nothing above it


def table() -> Mesh:
    """A table of 1.3 x 0.7 m, 0.74 m high."""
    width, depth, height = TABLE
    oak, dark = (186, 140, 92), (150, 108, 68)
    top = moved(_board((width, depth, 0.03), 0.006), (0.0, 0.0, height - 0.015))
    reach = (width / 2 - 0.06, depth / 2 - 0.06)
    leg, z = block((0.055, 0.055, height - 0.02)), height - 0.065
    legs = [moved(leg, (i * reach[0], j * reach[1], height / 2 - 0.01)) for i in (-1, 1) for j in (-1, 1)]
    aprons = [block((width - 0.14, 0.02, 0.08), (0.0, j * reach[1], z)) for j in (-1, 1)]
    aprons += [block((0.02, depth - 0.14, 0.08), (i * reach[0], 0.0, z)) for i in (-1, 1)]
    return assemble([(top, grained(oak, 0.05)), *((solid, plain(dark)) for solid in (*legs, *aprons))])


def desk() -> Mesh:
    """A desk of 1.2 x 0.6 m, 0.73 m high, with drawers under its right end."""
    width, depth, height = DESK
    white, steel, front = (222, 218, 208), (72, 74, 78), (206, 200, 188)
    top = _board((width, depth, 0.028), 0.003)
    leg = block((0.05, 0.05, height - 0.02))
    legs: list[Part] = [
        (moved(leg, (-width / 2 + 0.04, j * (depth / 2 - 0.04), height / 2 - 0.01)), plain(steel)) for j in (-1, 1)
    ]
    beam = moved(block((width - 0.1, 0.02, 0.06)), (0.0, depth / 2 - 0.04, height - 0.058))
    chest = moved(block((0.38, depth - 0.06, height - 0.03)), (width / 2 - 0.21, 0.0, height / 2 - 0.015))
    drawers: list[Part] = []
    for k in range(3):
        z = height - 0.15 - 0.225 * k
        at = (width / 2 - 0.21, -depth / 2 + 0.026, z)
        drawers.append((block((0.364, 0.018, 0.215), at), plain(front)))
        grip = block((0.12, 0.012, 0.01), (at[0], -depth / 2 + 0.013, z + 0.06))
        drawers.append((grip, plain(steel)))
    top_at = moved(top, (0.0, 0.0, height - 0.014))
    return assemble([(top_at, grained(white, 0.02)), *legs, (beam, plain(steel)), (chest, plain(white)), *drawers])


def side_table() -> Mesh:
    """A low table of 0.55 x 0.42 m, 0.5 m high, with a board below its top."""
    width, depth, height = SIDE_TABLE
    walnut, dark = (116, 78, 52), (92, 62, 42)
    top = _board((width, depth, 0.024), 0.008)
    board = block((width - 0.08, depth - 0.08, 0.016))
    legs: list[Part] = []
    for i in (-1, 1):
        for j in (-1, 1):
            x, y = i * (width / 2 - 0.045), j * (depth / 2 - 0.045)
            foot = (x + 0.015 * i, y + 0.015 * j)
            path = np.array([[*foot, 0.0], [*foot, 0.02], [x, y, height / 2], [x, y, height - 0.02]])
            legs.append((tube(path, [0.012, 0.012, 0.017, 0.02], 10), plain(dark)))
    lower = moved(board, (0.0, 0.0, 0.16))
    return assemble([(moved(top, (0.0, 0.0, height - 0.012)), grained(walnut, 0.06)), (lower, plain(dark)), *legs])


def cabinet() -> Mesh:
    """A cabinet of 0.8 x 0.4 x 0.86 m on feet, two doors and a drawer above each."""
    width, depth, height = CABINET
    paint, front, knob, oak = (168, 182, 176), (182, 196, 190), (196, 164, 96), (178, 136, 92)
    body = moved(block((width - 0.02, depth - 0.03, height - 0.125)), (0.0, 0.005, 0.1 + (height - 0.125) / 2))
    top = _board((width, depth, 0.028), 0.005)
    parts: list[Part] = [(body, plain(paint))]
    for i in (-1, 1):
        x, y = i * (width - 0.02) / 4, -depth / 2 + 0.014
        for z, tall in ((0.37, 0.5), (0.73, 0.19)):
            parts.append((block((width / 2 - 0.03, 0.018, tall), (x, y, z)), plain(front)))
            parts.append((block((width / 2 - 0.13, 0.006, tall - 0.1), (x, y - 0.009, z)), plain(paint)))
        for at in ((i * 0.04, y - 0.015, 0.42), (x, y - 0.018, 0.73)):
            grip = np.array([at]) + np.array(
                [[0.0, 0.011, 0.0], [0.0, 0.0, 0.0], [0.0, -0.009, 0.0], [0.0, -0.011, 0.0]]
            )
            parts.append((tube(grip, [0.007, 0.009, 0.012, 0.009], 8), plain(knob)))
        for j in (-1, 1):
            foot = np.array([[i * (width / 2 - 0.06), j * (depth / 2 - 0.06), z] for z in (0.0, 0.06, 0.11)])
            parts.append((tube(foot, [0.014, 0.019, 0.024], 8), plain(oak)))
    return assemble([(moved(top, (0.0, 0.0, height - 0.014)), grained(oak, 0.05)), *parts])


def shelf() -> Mesh:
    """A bookcase of 0.9 x 0.32 x 1.5 m with a back, open to -y."""
    width, depth, height = SHELF
    birch, back_colour = (214, 190, 156), (196, 170, 134)
    long, deep, tall = cuts_every(0.25, width / 2), cuts_every(0.17, depth / 2), cuts_every(0.4, height / 2)
    board = block((width - 2 * BOARD_M, depth - 0.01, BOARD_M), cuts=(long, deep, ()))
    side = block((BOARD_M, depth, height), cuts=((), deep, tall))
    back = block((width - 2 * BOARD_M, 0.008, height - 0.02), (0.0, depth / 2 - 0.004, height / 2))
    levels = [*BOARDS, height - 0.005]
    boards = [(moved(board, (0.0, 0.0, z - BOARD_M / 2)), grained(birch, 0.04)) for z in levels]
    sides = [(moved(side, (i * (width - BOARD_M) / 2, 0.0, height / 2)), grained(birch, 0.04, axis=2)) for i in (-1, 1)]
    return assemble([*boards, *sides, (back, plain(back_colour))])


def sofa() -> Mesh:
    """A sofa for two of 1.5 x 0.82 x 0.8 m with loose cushions, its back at +y."""
    width, depth, height = SOFA
    cloth, seat_cloth, wood = (104, 120, 134), (116, 132, 146), (86, 60, 42)
    front = -depth / 2
    base = moved(block((width - 0.04, depth - 0.04, 0.2)), (0.0, 0.0, 0.2))
    back = moved(rounded_box((width, 0.18, height - 0.1), 0.05), (0.0, depth / 2 - 0.09, 0.1 + (height - 0.1) / 2))
    parts: list[Part] = [(base, plain(cloth)), (back, plain(cloth))]
    lean = rotation("x", -12.0)
    for i in (-1, 1):
        arm = moved(rounded_box((0.13, depth, 0.5), 0.05), (i * (width / 2 - 0.065), 0.0, 0.34))
        cushion = rounded_box((SEAT[0] - 0.006, SEAT[1], 0.14), 0.03)
        bolster = moved(rounded_box((SEAT[0] - 0.02, 0.13, 0.36), 0.055), (i * SEAT[0] / 2, 0.19, 0.58), lean)
        seat = moved(cushion, (i * SEAT[0] / 2, front + 0.01 + SEAT[1] / 2, SEAT[2] - 0.07))
        parts += [(arm, plain(cloth)), (seat, plain(seat_cloth)), (bolster, plain(seat_cloth))]
        for j in (-1, 1):
            foot = np.array([[i * (width / 2 - 0.1), j * (depth / 2 - 0.1), z] for z in (0.0, 0.12)])
            parts.append((tube(foot, [0.018, 0.026], 8), plain(wood)))
    return assemble(parts)


def chair() -> Mesh:
    """A wooden chair of 0.43 x 0.46 x 0.86 m, its back at +y."""
    width, depth, height = CHAIR
    beech, dark = (200, 158, 108), (176, 134, 88)
    seat = moved(_board((width, depth - 0.04, 0.022), 0.008), (0.0, -0.02, CHAIR_SEAT_M - 0.011))
    parts: list[Part] = [(seat, grained(beech, 0.05))]
    for i in (-1, 1):
        x = i * (width / 2 - 0.03)
        front = np.array([[x, -depth / 2 + 0.03, z] for z in (0.0, CHAIR_SEAT_M - 0.01)])
        rear = [
            [x, depth / 2 - 0.018, 0.0],
            [x, depth / 2 - 0.018, 0.02],
            [x, depth / 2 - 0.045, 0.4],
            [x, depth / 2 - 0.045, 0.5],
        ]
        post = np.array([*rear, [x, depth / 2 - 0.02, height - 0.02]])
        parts += [(tube(front, [0.014, 0.018], 10), plain(dark)), (tube(post, 0.0175, 8), plain(dark))]
        rail = np.array([[x, y, 0.16] for y in (-depth / 2 + 0.03, depth / 2 - 0.03)])
        parts.append((tube(rail, 0.0095, 8), plain(dark)))
    for z, tall in ((0.62, 0.045), (0.71, 0.045), (0.82, 0.08)):
        lean = (z - 0.5) * 0.07
        slat = block((width - 0.06, 0.014, tall), (0.0, depth / 2 - 0.045 + lean, z))
        parts.append((slat, grained(beech, 0.05)))
    return assemble(parts)


def _board(size: tuple[float, float, float], radius: float) -> Solid:
    """A board with rounded edges, cut where its grain changes."""
    return rounded_box(size, radius, (cuts_every(0.22, size[0] / 2), cuts_every(0.22, size[1] / 2), ()))


def _top(size: tuple[float, float, float]) -> tuple[SupportArea, ...]:
    """The whole of a level top."""
    width, depth, height = size
    return (SupportArea(np.array([0.0, 0.0, height / 2]), np.array([width, depth]), OPEN_M),)


def _cabinet_areas() -> tuple[SupportArea, ...]:
    (area,) = _top(CABINET)
    return (replace(area, centre=area.centre + np.array([0.0, KNOB_M / 2, 0.0])),)


def _shelf_areas() -> tuple[SupportArea, ...]:
    """The boards from knee height up: from a head camera the lowest shows nothing but its edge."""
    above = np.diff([*BOARDS, SHELF[2] - 0.005]) - BOARD_M
    size = np.array([SHELF[0] - 2 * BOARD_M, SHELF[1] - 0.02])
    areas = [
        SupportArea(np.array([0.0, -0.005, z - SHELF[2] / 2]), size, room)
        for z, room in zip(BOARDS, above, strict=True)
    ]
    return tuple(areas[1:])


def _sofa_areas() -> tuple[SupportArea, ...]:
    """The flat part of each seat cushion, before the loose cushions of the back."""
    z, y = SEAT[2] - SOFA[2] / 2, -SOFA[1] / 2 + 0.01 + 0.03 + 0.2
    return tuple(
        SupportArea(np.array([i * SEAT[0] / 2, y, z]), np.array([SEAT[0] - 0.08, 0.4]), OPEN_M) for i in (-1, 1)
    )


def _chair_areas() -> tuple[SupportArea, ...]:
    size = np.array([CHAIR[0] - 0.03, CHAIR[1] - 0.13])
    return (SupportArea(np.array([0.0, -0.045, CHAIR_SEAT_M - CHAIR[2] / 2]), size, OPEN_M),)


FURNITURE = (
    Entry(table, "furniture", ("z",), areas=lambda: _top(TABLE)),
    Entry(desk, "furniture", areas=lambda: _top(DESK)),
    Entry(side_table, "furniture", ("z",), areas=lambda: _top(SIDE_TABLE)),
    Entry(cabinet, "furniture", areas=_cabinet_areas),
    Entry(shelf, "furniture", areas=_shelf_areas),
    Entry(sofa, "furniture", areas=_sofa_areas),
    Entry(chair, "furniture", areas=_chair_areas),
)
