"""The simulator's catalogue: household things of real sizes, made from numbers, and the furniture they stand on.

Frames: the origin is the centre of the bounding box, z is up as the thing usually stands, and the side that people look
at is -y. Symmetries are of the geometry, which is all that depth can see: a box's half-turns count although its print
differs. A turned thing is a polygon about its axis, true to it within r (1 - cos(pi / 36)), 0.3 mm for the bowl.
"""

from __future__ import annotations

from functools import cache

from sequences.catalogue import Catalogue
from sequences.simulation.shapes.bath import BATH, CLEANING
from sequences.simulation.shapes.cloth import clothed
from sequences.simulation.shapes.clutter import clutter
from sequences.simulation.shapes.food import FOOD
from sequences.simulation.shapes.furniture import FURNITURE, SHELF, TABLE
from sequences.simulation.shapes.kitchen import KITCHEN, mug
from sequences.simulation.shapes.office import LEISURE, OFFICE
from sequences.simulation.shapes.shape import Body, Clutter, Shape, SupportArea
from sequences.simulation.shapes.tools import TOOLS

__all__ = [
    "SHELF",
    "TABLE",
    "Body",
    "Clutter",
    "Shape",
    "SupportArea",
    "catalogue",
    "clothed",
    "clutter",
    "household",
    "mug",
]


@cache
def household() -> tuple[Shape, ...]:
    """All shapes, obj_ids from 1 in this order; the furniture comes last."""
    entries = (*FOOD, *KITCHEN, *BATH, *CLEANING, *OFFICE, *LEISURE, *TOOLS, *FURNITURE)
    return tuple(entry.shape(k + 1) for k, entry in enumerate(entries))


def catalogue(shapes: tuple[Shape, ...]) -> Catalogue:
    """The classes of some shapes, by ascending obj_id."""
    return Catalogue(tuple(sorted((s.object_class for s in shapes), key=lambda c: c.obj_id)))
