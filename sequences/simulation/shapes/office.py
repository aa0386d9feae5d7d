"""What lies on a desk, and what people play with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation.shapes.shape import EITHER_WAY_UP, Entry
from sequences.simulation.solids import (
    Part,
    assemble,
    bands,
    block,
    moved,
    placed,
    plain,
    printed,
    rotation,
    rounded_box,
    scored,
    stacked,
    within,
)

Array = NDArray[np.float64]


def book() -> Mesh:
    """A hardback of 150 x 215 x 32 mm, its spine along y at -x."""
    cover, pages, gold = (126, 34, 44), (238, 230, 208), (210, 176, 92)
    board, spine = (0.15, 0.215, 0.003), (0.003, 0.215, 0.032)
    x, y = (-0.045, 0.045), (-0.07, -0.06, 0.03, 0.06)
    boards = rounded_box(board, 0.0012, (x, y, ()))
    back = rounded_box(spine, 0.0012, ((), (-0.08, -0.07, 0.07, 0.08), ()))
    lines = [(within(x=x, y=limits), gold) for limits in ((-0.07, -0.06), (0.03, 0.06))]
    # the boards' inner sides are hidden by the pages but for a narrow edge
    ribs = [(within(y=limits), gold) for limits in ((-0.08, -0.07), (0.07, 0.08))]
    return assemble(
        [
            (moved(boards, (0.0, 0.0, 0.0145)), printed(cover, *lines)),
            (moved(boards, (0.0, 0.0, -0.0145)), printed(cover, *lines)),
            (moved(back, (-0.0735, 0.0, 0.0)), printed(cover, *ribs)),
            (moved(rounded_box((0.142, 0.207, 0.027), 0.001), (-0.002, 0.0, 0.0)), plain(pages)),
        ]
    )


def laptop() -> Mesh:
    """An open laptop of 310 x 215 mm, its screen leaning back by 20 degrees, the user at -y."""
    grey, keys, frame, glow = (176, 178, 182), (52, 54, 58), (30, 30, 32), (92, 140, 190)
    x, y = (-0.135, -0.05, 0.05, 0.135), (-0.095, -0.035, -0.022, 0.075)
    base = rounded_box((0.31, 0.215, 0.016), 0.005, (x, y, ()))
    screen = rounded_box((0.31, 0.008, 0.2), 0.003, ((-0.145, 0.145), (), (-0.085, 0.085)))

    def key_paint(vertices: Array) -> Array:
        top = vertices[:, 2] > 0.007
        keyboard = top & (np.abs(vertices[:, 0]) < 0.135) & (vertices[:, 1] > -0.022) & (vertices[:, 1] < 0.075)
        pad = top & (np.abs(vertices[:, 0]) < 0.05) & (vertices[:, 1] > -0.095) & (vertices[:, 1] < -0.035)
        return np.where(keyboard[:, None], keys, np.where(pad[:, None], (150, 152, 156), grey)).astype(np.float64)

    def screen_paint(vertices: Array) -> Array:
        front = vertices[:, 1] < 0.0
        lit = front & (np.abs(vertices[:, 0]) < 0.145) & (np.abs(vertices[:, 2]) < 0.085)
        return np.where(lit[:, None], glow, np.where(front[:, None], frame, grey)).astype(np.float64)

    lean = rotation("x", -20.0)
    hinge = np.array([0.0, 0.104, 0.006])
    lid = placed((screen, screen_paint), hinge + lean @ [0.0, 0.0, 0.1], lean)
    places = [(0.0205 * (column - 6), 0.0615 - 0.0235 * row) for row in range(4) for column in range(13)]
    caps = [(block((0.0175, 0.019, 0.002), (x, y, 0.0076)), plain((84, 86, 92))) for x, y in places]
    return assemble([(base, key_paint), *caps, lid])


KEY_M = 0.019  # from one key to the next


def keyboard() -> Mesh:
    """A keyboard of 436 x 136 mm, higher at the back, the numbers right, the user at -y."""
    tilt = rotation("x", 3.5)
    body = moved(rounded_box((0.436, 0.136, 0.014), 0.004), (0.0, 0.0, 0.0), tilt)
    low = float(body[0][:, 2].min())
    black, dark, light = (34, 35, 38), (58, 60, 64), (86, 88, 94)
    parts: list[Part] = [(body, plain(black))]
    parts += [(block((0.03, 0.01, -low), (i * 0.18, 0.052, low / 2)), plain(black)) for i in (-1, 1)]  # feet
    for row, count in enumerate((14, 15, 14, 13, 12)):
        y = 0.043 - KEY_M * row - (0.006 if row else 0.0)
        for k, (x, width) in enumerate(_row_of_keys(row, count)):
            key = block((width - 0.003, KEY_M - 0.003, 0.006), (x, y, 0.0085))
            parts.append((moved(key, (0.0, 0.0, 0.0), tilt), plain(light if k in (0, count - 1) else dark)))
    return assemble(parts)


def _row_of_keys(row: int, count: int) -> list[tuple[float, float]]:
    """Middle and width of the keys in a row, metres: the main block at -x, the numbers at +x."""
    main = 15 * KEY_M
    left, middle = -0.21, [(KEY_M * (i + 0.5), KEY_M) for i in range(count)]
    if row == 4:  # the space bar
        sides = [(0.6, 1.2), (1.85, 1.3), (3.15, 1.3), (11.5, 1.2), (12.75, 1.3), (14.2, 1.6)]
        middle = [(KEY_M * x, KEY_M * w) for x, w in sides] + [(KEY_M * 7.35, KEY_M * 7.1)]
    else:
        spare = main - KEY_M * count
        middle = [(KEY_M * (i + 0.5) + spare / 2.0 * (i > 0), KEY_M) for i in range(count - 1)]
        middle[0] = (KEY_M / 2.0 + spare / 4.0, KEY_M + spare / 2.0)
        middle.append((main - KEY_M / 2.0 - spare / 4.0, KEY_M + spare / 2.0))
    numbers = [(main + 0.018 + KEY_M * (i + 0.5), KEY_M) for i in range(4)] if row else []
    return [(left + x, width) for x, width in (*middle, *numbers)]


def computer_mouse() -> Mesh:
    """A mouse of 62 x 108 x 38 mm, its buttons at +y, the wheel between them."""
    levels = [[0.028, 0.051, 0.0, 0.0, 0.0], [0.031, 0.054, 0.004, 0.0, 0.0], [0.0305, 0.0535, 0.012, 0.0, -0.0003]]
    levels += [[0.029, 0.051, 0.02, 0.0, -0.001], [0.0255, 0.0455, 0.028, 0.0, -0.003]]
    levels += [[0.019, 0.034, 0.0345, 0.0, -0.006], [0.009, 0.016, 0.0375, 0.0, -0.008]]
    shell = scored(scored(stacked(levels, power=2.5, segments=28), 0, [-0.0012, 0.0012]), 1, [0.008])
    grey, black, red = (64, 66, 72), (22, 22, 24), (170, 50, 46)
    gap = within(x=(-0.0012, 0.0012), y=(0.008, 1.0), z=(0.006, 1.0))
    paint = printed(bands(2, [0.006], [black, grey]), (gap, black))
    wheel = moved(rounded_box((0.007, 0.02, 0.016), 0.003), (0.0, 0.026, 0.026))
    return assemble([(shell, paint), (wheel, plain(red))])


def stapler() -> Mesh:
    """A stapler of 150 x 38 x 62 mm, its mouth at +x, a little open."""
    black, steel, red = (40, 40, 44), (176, 178, 184), (172, 34, 38)
    base = moved(rounded_box((0.148, 0.036, 0.010), 0.004), (0.0, 0.0, 0.005))
    anvil = moved(rounded_box((0.03, 0.02, 0.003), 0.001), (0.052, 0.0, 0.0108))
    heel = moved(rounded_box((0.04, 0.03, 0.034), 0.006), (-0.05, 0.0, 0.021))
    lift = rotation("y", -7.0)
    rail = moved(rounded_box((0.13, 0.018, 0.012), 0.002), (0.004, 0.0, 0.035), lift)
    top = rounded_box((0.14, 0.034, 0.02), 0.009, steps=4)
    arched = top[0] + np.stack([0.0 * top[0][:, 0], 0.0 * top[0][:, 0], -1.2 * top[0][:, 0] ** 2], axis=-1)
    arm = moved((arched, top[1]), (0.0, 0.0, 0.048), lift)
    return assemble(
        [(base, plain(black)), (anvil, plain(steel)), (heel, plain(black)), (rail, plain(steel)), (arm, plain(red))]
    )


def game_box() -> Mesh:
    """A board game of 290 x 200 x 52 mm, its lid a little wider than what it covers."""
    x, y = (-0.11, -0.03, 0.03, 0.11), (-0.07, -0.035, 0.02, 0.065)
    lid = moved(rounded_box((0.29, 0.2, 0.04), 0.002, (x, y, ())), (0.0, 0.0, 0.006))
    inner = moved(rounded_box((0.283, 0.193, 0.02), 0.002), (0.0, 0.0, -0.016))
    night, orange, white, green, red = (34, 52, 108), (238, 138, 42), (246, 242, 230), (70, 150, 88), (200, 44, 48)
    top = (0.0255, 1.0)
    paint = printed(
        night,
        (within(x=(-0.11, 0.11), y=(0.02, 0.065), z=top), orange),
        (within(x=(-0.11, -0.03), y=(-0.07, -0.035), z=top), green),
        (within(x=(-0.03, 0.03), y=(-0.07, -0.035), z=top), white),
        (within(x=(0.03, 0.11), y=(-0.07, -0.035), z=top), red),
        (within(x=(-0.11, 0.11), y=(-1.0, -0.095), z=(-0.008, 0.02)), orange),
    )
    return assemble([(lid, paint), (inner, plain(white))])


def remote_control() -> Mesh:
    """A remote control of 50 x 178 x 22 mm, its transmitter at +y."""
    body = rounded_box((0.05, 0.178, 0.018), 0.006, ((), (-0.03, 0.04), ()), steps=4)
    waist = body[0] * np.stack(
        [1.0 - 8.0 * (0.05 - body[0][:, 1]).clip(0.0) ** 2, *np.ones((2, len(body[0])))], axis=-1
    )
    black, grey, red, blue = (32, 32, 35), (112, 114, 120), (206, 40, 40), (60, 96, 176)
    keys: list[Part] = [(block((0.012, 0.008, 0.003), (-0.014, 0.075, 0.0095)), plain(red))]
    for row in range(6):
        for column in range(3):
            at = (0.0135 * (column - 1), 0.052 - 0.0145 * row - 0.008 * (row > 1), 0.0095)
            keys.append((block((0.0095, 0.0085, 0.003), at), plain(blue if row == 1 else grey)))
    return assemble([((waist, body[1]), plain(black)), *keys])


OFFICE = (
    Entry(book, "office", ("x",), rests=EITHER_WAY_UP, gloss=0.1),
    Entry(laptop, "office", gloss=0.3),
    Entry(keyboard, "office"),
    Entry(computer_mouse, "office", gloss=0.1),
    Entry(stapler, "office", gloss=0.2),
)

LEISURE = (
    Entry(game_box, "leisure", ("z",), gloss=0.1),
    Entry(remote_control, "leisure", gloss=0.1),
)
