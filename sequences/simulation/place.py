"""A place: a furnished room, the things that belong in it, and where each category of them has its spot.

World frame: see `sequences.simulation.layouts`. Floor, walls and what hangs on them have no class: nobody modelled
them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from sequences import se3
from sequences.errors import InputError
from sequences.seeds import generator
from sequences.simulation.config import PlaceConfig
from sequences.simulation.layouts import KINDS, OTHERS, Kind, Layout, choose_furniture, lay_out
from sequences.simulation.room import Room, room
from sequences.simulation.shapes import Body, Clutter, Shape, clutter, household

Array = NDArray[np.float64]

SPOT_M = 0.5  # surfaces longer than this have several spots side by side
KIN = (("food", "kitchen"), ("bath", "cleaning"), ("office", "leisure"))
"""Categories whose spots are neighbours"""
SEATS = {"sofa": 0.3, "chair": 0.3}
"""What is nobody's usual spot, and how often things are put there, when on other furniture it is 1"""
LOOK_ALIKE = 6.0  # how much rather distractors are of the size of things that are there


@dataclass(frozen=True)
class Placed:
    """Something somewhere."""

    inst_id: int
    """which physical object; clutter has numbers too, after those of the truth"""
    body: Body
    T_world_object: Array
    """(4, 4)"""
    outline: Array
    """(n, 2) convex, seen from above, counter-clockwise, world x and y"""
    surface: int = -1
    """position in Place.surfaces of what it stands on; -1 on the floor"""


@dataclass(frozen=True)
class Surface:
    """Where things can stand: an area of a piece of furniture."""

    furniture: int
    """position in Place.furniture"""
    T_world_area: Array
    """(4, 4) z up, origin at the area's centre, -y towards the room"""
    size: Array
    """(2,) what a thing's whole outline must stay in, metres"""
    headroom_m: float
    open: bool
    """whether one sees it from above; on a board in a shelf things face the room"""


@dataclass(frozen=True)
class Spot:
    """A part of a surface where a thing may stand with its middle."""

    surface: int
    """position in Place.surfaces"""
    low: Array
    """(2,) area frame, metres"""
    high: Array
    """(2,)"""


@dataclass(frozen=True)
class Place:
    """The room and what belongs in it; what stands where is the visits' business."""

    kind: str
    """of room, a key of layouts.KINDS"""
    shapes: tuple[Shape, ...]
    """the catalogue: the things, the furniture, and the distractors"""
    stock: tuple[Shape, ...]
    """one for each small thing; their inst_ids are 1, 2, ... in this order"""
    clutter: tuple[Clutter, ...]
    """one for each thing that nobody modelled"""
    furniture: tuple[Placed, ...]
    """inst_ids after those of the stock"""
    surfaces: tuple[Surface, ...]
    spots: tuple[Spot, ...]
    homes: Mapping[str, int]
    """category -> position in `spots` where such things usually stand"""
    layout: Layout
    seed: int
    """the room's looks come from it"""

    @cached_property
    def room(self) -> Room:
        """Floor, walls and what hangs on them."""
        boxes = np.stack([_box(piece) for piece in self.furniture])
        return room(tuple(self.layout.size), boxes, generator(self.seed, "simulation.room"), self.kind)

    @cached_property
    def odds(self) -> Array:
        """(furniture,) how likely something is put on each piece when it has no reason to stand anywhere."""
        odds = np.array([SEATS.get(_shape_of(p).object_class.name, 1.0) for p in self.furniture])
        return np.asarray(odds / odds.sum())

    def furniture_under(self, spot: int) -> int:
        """Position in `furniture` of what a spot is on."""
        return self.surfaces[self.spots[spot].surface].furniture

    @cached_property
    def spots_on(self) -> tuple[tuple[int, ...], ...]:
        """(furniture,) positions in `spots` of those on each piece."""
        return tuple(
            tuple(k for k in range(len(self.spots)) if self.furniture_under(k) == piece)
            for piece in range(len(self.furniture))
        )

    @cached_property
    def known(self) -> dict[int, Shape]:
        """inst_id -> shape of all things and furniture."""
        return dict(enumerate((*self.stock, *(_shape_of(p) for p in self.furniture)), start=1))

    @cached_property
    def loose(self) -> dict[int, Body]:
        """inst_id -> body of all that can be moved: the stock, then the clutter, numbered after the furniture."""
        bodies: dict[int, Body] = dict(enumerate(self.stock, start=1))
        return bodies | dict(enumerate(self.clutter, start=len(self.known) + 1))

    @cached_property
    def hulls(self) -> dict[int, Array]:
        """inst_id -> corners (n, 3) of the convex hull, object frame: all that touches or sticks out is among them."""
        hulls = {id(body): hull_of(body) for body in self.loose.values()}
        return {i: hulls[id(body)] for i, body in self.loose.items()}

    def support(self, placed: Placed) -> int | None:
        """inst_id of the furniture that something stands on; None on the floor."""
        return None if placed.surface < 0 else self.furniture[self.surfaces[placed.surface].furniture].inst_id


def hull_of(body: Body) -> Array:
    """(n, 3) corners of a body's convex hull, object frame."""
    vertices = body.mesh.vertices
    return vertices[ConvexHull(vertices).vertices]


def outline_of(points: Array) -> Array:
    """Points (n, 3) -> their convex outline (m, 2) seen from above, counter-clockwise."""
    return points[ConvexHull(points[:, :2]).vertices, :2]


def furnish(config: PlaceConfig, seed: int, shapes: Sequence[Shape] | None = None) -> Place:
    """Set up the room, choose the things and give each category its spot.

    Args:
        config: settings.
        seed: the run's.
        shapes: what there is to choose from, furniture included; the household where not given.

    Raises:
        InputError: nothing to choose from, or furniture that fits in no room.
    """
    shapes = household() if shapes is None else tuple(shapes)
    rng = generator(seed, "simulation.place")
    kind = str(rng.choice(list(KINDS))) if config.kind == "any" else config.kind
    small = [s for s in shapes if s.object_class.movable and not s.areas]
    stock = _stock(small, KINDS[kind], config, rng)
    layout, furniture = _stand_furniture(shapes, KINDS[kind], len(stock), rng)
    surfaces = tuple(surface for k, piece in enumerate(furniture) for surface in _surfaces(k, piece))
    spots = tuple(spot for k, surface in enumerate(surfaces) for spot in _spots(k, surface))
    there = {s.object_class.obj_id: s for s in (*stock, *map(_shape_of, furniture))}
    rng = generator(seed, "simulation.distractors")
    distractors = _distractors([s for s in small if s.object_class.obj_id not in there], stock, config.distractors, rng)
    return Place(
        kind=kind,
        shapes=(*there.values(), *distractors),
        stock=stock,
        clutter=_clutter(config.clutter, generator(seed, "simulation.clutter")),
        furniture=furniture,
        surfaces=surfaces,
        spots=spots,
        homes=_homes(sorted({s.object_class.category for s in small}), furniture, surfaces, spots, rng),
        layout=layout,
        seed=seed,
    )


def _shape_of(piece: Placed) -> Shape:
    assert isinstance(piece.body, Shape)  # furniture is
    return piece.body


def _stock(small: Sequence[Shape], kind: Kind, config: PlaceConfig, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Things that are kept in such a room rather than others; all classes before any comes again, but for twins."""
    if not small:
        raise InputError(
            "no class is movable and small",
            field="catalogue",
            remedy="give a catalogue with things that can stand on furniture",
        )
    ordered = [small[k] for k in _weighted_order([_how_often(s, kind) for s in small], rng)]
    twins = min(config.twins, config.objects // 2)
    once = [ordered[k % len(ordered)] for k in range(config.objects - twins)]
    return (*once, *(once[int(k)] for k in rng.permutation(len(once))[:twins]))


def _how_often(shape: Shape, kind: Kind) -> float:
    return kind.kept.get(shape.object_class.category, OTHERS if kind.kept else 1.0)


def _weighted_order(weights: Sequence[float], rng: np.random.Generator) -> list[int]:
    """All positions, drawn without replacement (Efraimidis and Spirakis, Information Processing Letters 97, 2006)."""
    keys = rng.exponential(size=len(weights)) / np.asarray(weights)
    return [int(k) for k in np.argsort(keys)]


def _distractors(
    absent: Sequence[Shape], stock: Sequence[Shape], n: int, rng: np.random.Generator
) -> tuple[Shape, ...]:
    """Classes that aren't there, rather such as one might take for what is."""
    if not absent:
        return ()
    sides, others = (np.stack([_log_sides(s) for s in some]) for some in (absent, stock))
    unlike = np.abs(sides[:, None] - others).mean(axis=-1).min(axis=1)
    return tuple(absent[k] for k in _weighted_order(list(np.exp(-LOOK_ALIKE * unlike)), rng)[:n])


def _log_sides(shape: Shape) -> Array:
    """(3,) of the bounding box, in order of size."""
    return np.log(np.sort(np.ptp(shape.object_class.mesh.vertices, axis=0)))


def _clutter(n: int, rng: np.random.Generator) -> tuple[Clutter, ...]:
    kinds = clutter()
    order = rng.permutation(len(kinds))
    return tuple(kinds[int(order[k % len(kinds)])] for k in range(n))


def _stand_furniture(
    shapes: Sequence[Shape], kind: Kind, n_things: int, rng: np.random.Generator
) -> tuple[Layout, tuple[Placed, ...]]:
    """The pieces of such a room, or, from a catalogue that has none of them, any that it has."""
    by_name = {s.object_class.name: s for s in shapes if s.areas}
    names = [name for name in choose_furniture(kind, rng) if name in by_name]
    pieces = [by_name[name] for name in names or list(by_name)[:3]]
    if not pieces:
        raise InputError(
            "no class has a surface to stand on",
            field="catalogue",
            remedy="give a catalogue with furniture, or one that leaves it to the simulator",
        )
    bounds = [_bounds(piece) for piece in pieces]
    layout = lay_out([high - low for low, high in bounds], rng)
    placed = []
    for k, (piece, T, (low, high)) in enumerate(zip(pieces, layout.T_world_furniture, bounds, strict=True)):
        T_world_object = T @ se3.make(np.eye(3), -(low + high) / 2.0)
        outline = outline_of(se3.transform(T_world_object, hull_of(piece)))
        placed.append(Placed(n_things + 1 + k, piece, T_world_object, outline))
    return layout, tuple(placed)


def _bounds(shape: Shape) -> tuple[Array, Array]:
    vertices = shape.object_class.mesh.vertices
    return vertices.min(axis=0), vertices.max(axis=0)


def _box(piece: Placed) -> Array:
    """(2, 3) its least and greatest corner, world frame."""
    points = se3.transform(piece.T_world_object, piece.body.mesh.vertices)
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _surfaces(furniture: int, piece: Placed) -> list[Surface]:
    areas = _shape_of(piece).areas
    return [
        Surface(
            furniture=furniture,
            T_world_area=piece.T_world_object @ se3.make(np.eye(3), area.centre),
            size=area.size,
            headroom_m=area.headroom_m,
            open=len({a.centre[2] for a in areas}) == 1,
        )
        for area in areas
    ]


def _spots(k: int, surface: Surface) -> list[Spot]:
    n = max(1, round(surface.size[0] / SPOT_M))
    edges = np.linspace(-0.5, 0.5, n + 1) * surface.size[0]
    half = surface.size[1] / 2
    return [Spot(k, np.array([edges[i], -half]), np.array([edges[i + 1], half])) for i in range(n)]


def _homes(
    categories: Sequence[str],
    furniture: Sequence[Placed],
    surfaces: Sequence[Surface],
    spots: Sequence[Spot],
    rng: np.random.Generator,
) -> dict[str, int]:
    """A spot for each category, on all furniture alike, those of kin side by side; seats are nobody's.

    Where there are few spots, they are shared.
    """
    on = np.array([surfaces[spot.surface].furniture for spot in spots])
    seat = np.array([_shape_of(piece).object_class.name in SEATS for piece in furniture])
    usual = [k for k in range(len(spots)) if not seat[on[k]]] or list(range(len(spots)))
    middles = np.stack([_middle(spots[k], surfaces) for k in usual])
    taken = np.zeros(len(usual), dtype=int)
    homes: dict[str, int] = {}
    for category in (categories[k] for k in rng.permutation(len(categories))):
        if category in homes:
            continue
        crowd = np.bincount(on[usual], weights=taken, minlength=len(furniture))[on[usual]]
        away = crowd + rng.random(len(usual))
        for one in next((kin for kin in KIN if category in kin), (category,)):
            if one in categories:
                best = int(np.argmin(np.where(taken == taken.min(), away, np.inf)))
                homes[one] = usual[best]
                taken[best] += 1
                away = np.linalg.norm(middles - middles[best], axis=1)
    return homes


def _middle(spot: Spot, surfaces: Sequence[Surface]) -> Array:
    flat = np.array([*(spot.low + spot.high) / 2.0, 0.0])
    return se3.transform(surfaces[spot.surface].T_world_area, flat[None])[0]
