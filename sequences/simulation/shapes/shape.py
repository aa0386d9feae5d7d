"""What the simulator knows of a thing: its class, how it rests, what can stand on it, how it shines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.catalogue import ContinuousSymmetry, Mesh, ObjectClass
from sequences.meshes import diameter
from sequences.simulation.solids import rotation

Array = NDArray[np.float64]

HOUR = 3600.0
PERSISTENCE_S = {
    "food": 6 * HOUR,
    "kitchen": 12 * HOUR,
    "bath": 24 * HOUR,
    "cleaning": 48 * HOUR,
    "office": 24 * HOUR,
    "tool": 48 * HOUR,
    "leisure": 24 * HOUR,
    "furniture": 8760 * HOUR,
}
"""The mu of Equation 2 by category: how soon such things are taken somewhere else"""

IDENTITY = np.eye(3)
HALF_TURNS = {axis: rotation(axis, 180.0) for axis in "xyz"}
UPRIGHT = (IDENTITY,)
EITHER_WAY_UP = (IDENTITY, HALF_TURNS["x"])
BOX_TURNS = ("x", "y", "z")


@dataclass(frozen=True)
class SupportArea:
    """A flat place of a piece of furniture where things can stand."""

    centre: Array
    """(3,) metres, object frame"""
    size: Array
    """(2,) along x and y, metres"""
    headroom_m: float
    """free height above it"""


class Body(Protocol):
    """Anything that stands in a place, whether the catalogue knows it or not."""

    @property
    def mesh(self) -> Mesh:
        """What is really there."""

    @property
    def rests(self) -> Array:
        """(n, 3, 3) rotations in which it rests on a level surface, before any yaw; the most usual first."""

    @property
    def gloss(self) -> float:
        """0 (dull) to 1 (a mirror): how much of the sensor's pattern is reflected away."""


@dataclass(frozen=True)
class Shape:
    """A class of the catalogue and what the simulator alone needs to know of it."""

    object_class: ObjectClass
    rests: Array
    """(n, 3, 3) rotations in which it rests on a level surface, before any yaw; the most usual first"""
    areas: tuple[SupportArea, ...] = ()
    gloss: float = 0.0
    """0 (paper, cloth) to 1 (a mirror): how much of the sensor's pattern is reflected away instead of scattered"""
    appearance: Mesh | None = None
    """what is really there where that isn't the catalogue's mesh, object frame: a table under its cloth"""

    @property
    def mesh(self) -> Mesh:
        """What is really there, object frame."""
        return self.object_class.mesh if self.appearance is None else self.appearance


@dataclass(frozen=True)
class Clutter:
    """A thing that nobody modelled: it shows in the images, but in no catalogue and no truth."""

    name: str
    mesh: Mesh
    rests: Array
    """(n, 3, 3) as Shape.rests"""
    gloss: float = 0.0
    """as Shape.gloss"""


@dataclass(frozen=True)
class Entry:
    """How a class of the household is made; its name is that of the function."""

    make: Callable[[], Mesh]
    category: str
    half_turns: tuple[str, ...] = ()
    """axes about which half a turn changes nothing"""
    axis: bool = False
    """whether any turn about z changes nothing"""
    rests: tuple[Array, ...] = UPRIGHT
    areas: Callable[[], tuple[SupportArea, ...]] = tuple
    gloss: float = 0.0

    def shape(self, obj_id: int) -> Shape:
        """The class, made."""
        mesh = self.make()
        furniture = self.category == "furniture"
        turns = [IDENTITY, *(HALF_TURNS[axis] for axis in self.half_turns)]
        object_class = ObjectClass(
            obj_id=obj_id,
            name=self.make.__name__,
            category=self.category,
            persistence_s=PERSISTENCE_S[self.category],
            supports=furniture,
            movable=not furniture,
            mesh=mesh,
            diameter_m=diameter(mesh),
            symmetries_discrete=se3.make(np.stack(turns), np.zeros(3)),
            symmetries_continuous=(ContinuousSymmetry(np.array([0.0, 0.0, 1.0]), np.zeros(3)),) if self.axis else (),
        )
        return Shape(object_class, np.stack(self.rests), self.areas(), self.gloss)
