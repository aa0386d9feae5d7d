"""The simulator's catalogue: household things of real sizes, made from numbers, and the furniture they stand on.

Frames: the origin is the centre of the bounding box, z is up as the thing usually stands, and the side that people look
at is -y. Symmetries are of the geometry, which is all that depth can see: a box's half-turns count although its print
differs. A turned thing is a polygon about its axis, true to it within r (1 - cos(pi / 36)), 0.3 mm for the bowl.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.catalogue import Catalogue, ContinuousSymmetry, Mesh, ObjectClass
from sequences.meshes import diameter
from sequences.simulation import solids
from sequences.simulation.solids import (
    Paint,
    arc,
    assemble,
    bands,
    lathe,
    moved,
    plain,
    rotation,
    rounded_box,
    seam,
    tube,
)

Array = NDArray[np.float64]

HOUR = 3600.0
PERSISTENCE_S = {
    "food": 6 * HOUR,
    "kitchen": 12 * HOUR,
    "cleaning": 48 * HOUR,
    "office": 24 * HOUR,
    "tool": 48 * HOUR,
    "furniture": 8760 * HOUR,
}
"""The mu of Equation 2 by category: how soon such things are taken somewhere else"""

IDENTITY = np.eye(3)
HALF_TURNS = {axis: rotation(axis, 180.0) for axis in "xyz"}


@dataclass(frozen=True)
class SupportArea:
    """A flat place of a piece of furniture where things can stand."""

    centre: Array
    """(3,) metres, object frame"""
    size: Array
    """(2,) along x and y, metres"""
    headroom_m: float
    """free height above it"""


@dataclass(frozen=True)
class Shape:
    """A class of the catalogue and what the simulator alone needs to know of it."""

    object_class: ObjectClass
    rests: Array
    """(n, 3, 3) rotations in which it rests on a level surface, before any yaw; the most usual first"""
    areas: tuple[SupportArea, ...] = ()


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
    return assemble([(rounded_box((0.19, 0.065, 0.29), 0.004, (x, (), z)), _printed(yellow, front, 0.03))])


def _printed(
    ground: tuple[int, int, int], panels: list[tuple[float, float, float, tuple[int, int, int]]], y: float
) -> Paint:
    """Rectangles (half width, lowest z, highest z, colour) on the sides of a box that face along y, where |y| > `y`."""

    def paint(vertices: Array) -> Array:
        colours = np.broadcast_to(np.asarray(ground, dtype=np.float64), vertices.shape).copy()
        for half_width, low, high, colour in panels:
            across = (np.abs(vertices[:, 0]) < half_width) & (np.abs(vertices[:, 1]) > y)
            colours[across & (vertices[:, 2] > low) & (vertices[:, 2] < high)] = colour
        return colours

    return paint


def milk_carton() -> Mesh:
    """A gable-top carton of 70 x 70 x 235 mm: its sides fold in to a ridge along x."""
    shoulder, ridge, half = 0.075, 0.1, 0.035
    z = (-0.105, -0.05, 0.02, 0.05, shoulder, ridge)
    vertices, faces = rounded_box((0.07, 0.07, 0.235), 0.003, ((-0.02, 0.02), (-0.012, 0.0, 0.012), z))
    share = np.clip((vertices[:, 2] - shoulder) / (ridge - shoulder), 0.0, 1.0)
    folded = vertices.copy()
    folded[:, 1] *= 1.0 - share * (1.0 - 0.003 / half)
    folded[:, 0] *= 1.0 - 0.25 * share * (
        1.0 - np.abs(vertices[:, 1]) / half
    )  # the gable's ends tuck in below the ridge
    folded[:, 0] *= 1.0 - 0.05 * share
    white, blue, green = (246, 246, 242), (36, 98, 178), (88, 164, 76)
    panels = [(0.04, -0.12, -0.105, blue), (0.04, -0.05, 0.02, blue), (0.02, 0.02, 0.05, green)]
    return assemble([((folded, faces), _printed(white, panels, -1.0))])


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


def mug() -> Mesh:
    """A mug of 82 x 95 mm with a handle along +x."""
    outside = [[0.0, 0.002], [0.030, 0.002], [0.031, 0.0], [0.0365, 0.0], *arc((0.036, 0.005), 0.005, -60, 0, 3)]
    rim = [*seam([0.041, 0.01], [0.041, 0.09], 0.082), *arc((0.039, 0.093), 0.002, 0, 180, 4)]
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


def shampoo_bottle() -> Mesh:
    """A flat bottle of 80 x 50 x 205 mm with a flip cap."""
    low = [[0.0, 0.0], [0.034, 0.0], *arc((0.034, 0.006), 0.006, -60, 0, 3)]
    label = [*seam([0.04, 0.02], [0.04, 0.13], 0.032), *seam([0.04, 0.02], [0.04, 0.13], 0.118)]
    shoulder = [*arc((0.022, 0.142), 0.018, 0, 75, 5), *seam([0.0266, 0.1594], [0.0186, 0.166], 0.163)]
    cap = [[0.0195, 0.167], [0.0195, 0.2], *arc((0.0165, 0.202), 0.003, 0, 80, 3), [0.0, 0.205]]
    violet, lilac, white = (112, 66, 150), (226, 206, 236), (240, 240, 240)
    paint = bands(2, [0.032, 0.118, 0.163], [violet, lilac, violet, white])
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


def book() -> Mesh:
    """A hardback of 150 x 215 x 32 mm, its spine along y at -x."""
    cover, pages, gold = (126, 34, 44), (238, 230, 208), (210, 176, 92)
    board, spine = (0.15, 0.215, 0.003), (0.003, 0.215, 0.032)
    x, y = (-0.045, 0.045), (-0.07, -0.06, 0.03, 0.06)
    boards = rounded_box(board, 0.0012, (x, y, ()))

    def print_title(vertices: Array) -> Array:
        inside = (np.abs(vertices[:, 0]) < 0.045) & (np.abs(vertices[:, 2]) > 0.0145)
        line = (vertices[:, 1] > -0.07) & (vertices[:, 1] < -0.06) | (vertices[:, 1] > 0.03) & (vertices[:, 1] < 0.06)
        return np.where((inside & line)[:, None], gold, cover)

    return assemble(
        [
            (moved(boards, (0.0, 0.0, 0.0145)), print_title),
            (moved(boards, (0.0, 0.0, -0.0145)), print_title),
            (
                moved(rounded_box(spine, 0.0012, ((), (-0.08, -0.07, 0.07, 0.08), ())), (-0.0735, 0.0, 0.0)),
                _ribs(cover, gold),
            ),
            (moved(rounded_box((0.142, 0.207, 0.027), 0.001), (-0.002, 0.0, 0.0)), plain(pages)),
        ]
    )


def _ribs(ground: tuple[int, int, int], line: tuple[int, int, int]) -> Paint:
    return lambda vertices: np.where(
        ((np.abs(vertices[:, 1]) > 0.07) & (np.abs(vertices[:, 1]) < 0.08))[:, None], line, ground
    ).astype(np.float64)


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
    colours = screen_paint(screen[0])
    return assemble([(base, key_paint), (moved(screen, hinge + lean @ [0.0, 0.0, 0.1], lean), lambda _: colours)])


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


TABLE = (1.3, 0.7, 0.74)
SHELF = (0.9, 0.32, 1.5)
BOARDS = (0.09, 0.44, 0.79, 1.13)
BOARD_M = 0.02


def table() -> Mesh:
    """A table of 1.3 x 0.7 m, 0.74 m high."""
    width, depth, height = TABLE
    oak, dark = (186, 140, 92), (150, 108, 68)
    top = rounded_box(
        (width, depth, 0.03), 0.006, (solids.cuts_every(0.13, width / 2), solids.cuts_every(0.1, depth / 2), ())
    )
    leg, reach = rounded_box((0.055, 0.055, height - 0.02), 0.004), (width / 2 - 0.06, depth / 2 - 0.06)
    long_apron, short_apron = (
        rounded_box((width - 0.14, 0.02, 0.08), 0.003),
        rounded_box((0.02, depth - 0.14, 0.08), 0.003),
    )
    legs = [
        (moved(leg, (i * reach[0], j * reach[1], height / 2 - 0.01)), plain(dark)) for i in (-1, 1) for j in (-1, 1)
    ]
    aprons = [(moved(long_apron, (0.0, j * reach[1], height - 0.065)), plain(dark)) for j in (-1, 1)]
    aprons += [(moved(short_apron, (i * reach[0], 0.0, height - 0.065)), plain(dark)) for i in (-1, 1)]
    return assemble([(moved(top, (0.0, 0.0, height - 0.015)), _grain(oak, 0.05)), *legs, *aprons])


def shelf() -> Mesh:
    """A bookcase of 0.9 x 0.32 x 1.5 m with a back, open to -y."""
    width, depth, height = SHELF
    birch, back_colour = (214, 190, 156), (196, 170, 134)
    long_cuts, deep_cuts = solids.cuts_every(0.3, width / 2 - BOARD_M), solids.cuts_every(0.17, depth / 2)
    board = rounded_box((width - 2 * BOARD_M, depth - 0.01, BOARD_M), 0.002, (long_cuts, deep_cuts, ()))
    side = rounded_box((BOARD_M, depth, height), 0.002, ((), deep_cuts, solids.cuts_every(0.4, height / 2)))
    back = rounded_box(
        (width - 2 * BOARD_M, 0.008, height - 0.02), 0.001, (long_cuts, (), solids.cuts_every(0.4, height / 2))
    )
    levels = [*BOARDS, height - 0.005]
    boards = [(moved(board, (0.0, 0.0, z - BOARD_M / 2)), _grain(birch, 0.04)) for z in levels]
    sides = [(moved(side, (i * (width - BOARD_M) / 2, 0.0, height / 2)), _grain(birch, 0.04)) for i in (-1, 1)]
    return assemble([*boards, *sides, (moved(back, (0.0, depth / 2 - 0.004, height / 2)), plain(back_colour))])


def _grain(colour: tuple[int, int, int], depth: float) -> Paint:
    """Wood: streaks along x that need no random numbers."""

    def paint(vertices: Array) -> Array:
        streak = np.sin(61.0 * vertices[:, 1] + 3.0 * np.sin(5.0 * vertices[:, 0])) + np.sin(23.0 * vertices[:, 2])
        return np.asarray(colour) * (1.0 + depth * streak[:, None])

    return paint


def _table_areas() -> tuple[SupportArea, ...]:
    return (SupportArea(np.array([0.0, 0.0, TABLE[2] / 2]), np.array([TABLE[0], TABLE[1]]), 1.0),)


def _shelf_areas() -> tuple[SupportArea, ...]:
    """The boards from knee height up: from a head camera the lowest shows nothing but its edge."""
    above = np.diff([*BOARDS, SHELF[2] - 0.005]) - BOARD_M
    size = np.array([SHELF[0] - 2 * BOARD_M, SHELF[1] - 0.02])
    areas = [
        SupportArea(np.array([0.0, -0.005, z - SHELF[2] / 2]), size, room)
        for z, room in zip(BOARDS, above, strict=True)
    ]
    return tuple(areas[1:])


UPRIGHT = (IDENTITY,)
_BOX_TURNS = ("x", "y", "z")
_Z = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class _Entry:
    make: Callable[[], Mesh]
    category: str
    half_turns: tuple[str, ...] = ()
    axis: bool = False
    rests: tuple[Array, ...] = UPRIGHT
    areas: Callable[[], tuple[SupportArea, ...]] = tuple


_ENTRIES: tuple[_Entry, ...] = (
    _Entry(soup_can, "food", ("x",), axis=True),
    _Entry(cereal_box, "food", _BOX_TURNS, rests=(IDENTITY, rotation("x", 90.0))),
    _Entry(milk_carton, "food", ("z",)),
    _Entry(banana, "food", rests=(IDENTITY, HALF_TURNS["x"])),
    _Entry(mug, "kitchen"),
    _Entry(bowl, "kitchen", axis=True),
    _Entry(shampoo_bottle, "cleaning", ("z",)),
    _Entry(spray_bottle, "cleaning"),
    _Entry(sponge, "cleaning", _BOX_TURNS, rests=(IDENTITY, HALF_TURNS["x"])),
    _Entry(book, "office", ("x",), rests=(IDENTITY, HALF_TURNS["x"])),
    _Entry(laptop, "office"),
    _Entry(hammer, "tool", rests=(IDENTITY, HALF_TURNS["x"])),
    _Entry(table, "furniture", ("z",), areas=_table_areas),
    _Entry(shelf, "furniture", areas=_shelf_areas),
)


@cache
def household() -> tuple[Shape, ...]:
    """All shapes, obj_ids from 1 in this order; the furniture comes last."""
    return tuple(_shape(k + 1, entry) for k, entry in enumerate(_ENTRIES))


def catalogue(shapes: tuple[Shape, ...]) -> Catalogue:
    """The classes of some shapes, by ascending obj_id."""
    return Catalogue(tuple(sorted((s.object_class for s in shapes), key=lambda c: c.obj_id)))


def _shape(obj_id: int, entry: _Entry) -> Shape:
    mesh = entry.make()
    furniture = entry.category == "furniture"
    turns = [IDENTITY, *(HALF_TURNS[axis] for axis in entry.half_turns)]
    object_class = ObjectClass(
        obj_id=obj_id,
        name=entry.make.__name__,
        category=entry.category,
        persistence_s=PERSISTENCE_S[entry.category],
        supports=furniture,
        movable=not furniture,
        mesh=mesh,
        diameter_m=diameter(mesh),
        symmetries_discrete=se3.make(np.stack(turns), np.zeros(3)),
        symmetries_continuous=(ContinuousSymmetry(np.array(_Z), np.zeros(3)),) if entry.axis else (),
    )
    return Shape(object_class, np.stack(entry.rests), entry.areas())
