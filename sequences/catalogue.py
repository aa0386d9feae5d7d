"""The classes that may be in a place: mesh, category, symmetry, persistence."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in its object's frame."""

    vertices: NDArray[np.float64]
    """(V, 3) metres"""
    faces: NDArray[np.int32]
    """(F, 3) vertex indices"""
    colours: NDArray[np.uint8]
    """(V, 3) RGB; mid-grey where the file has none"""


@dataclass(frozen=True)
class ContinuousSymmetry:
    """Any rotation about a line leaves the object as it is."""

    axis: Array
    """(3,) unit vector in the object frame"""
    offset: Array
    """(3,) a point on the line, metres, object frame"""


@dataclass(frozen=True)
class ObjectClass:
    """One class of the catalogue."""

    obj_id: int
    name: str
    category: str
    persistence_s: float
    """the paper's mu of Equation 2, seconds"""
    supports: bool
    """whether other things rest on it"""
    movable: bool
    mesh: Mesh
    diameter_m: float
    symmetries_discrete: Array
    """(S, 4, 4) metres, identity first: T_world_object @ symmetries_discrete[s] looks the same"""
    symmetries_continuous: tuple[ContinuousSymmetry, ...]


@dataclass(frozen=True)
class Catalogue:
    """The classes, by ascending obj_id."""

    classes: tuple[ObjectClass, ...]

    @cached_property
    def obj_ids(self) -> tuple[int, ...]:
        """Ascending; class_scores[1 + k] belongs to obj_ids[k]."""
        return tuple(c.obj_id for c in self.classes)

    @cached_property
    def _position(self) -> dict[int, int]:
        return {c.obj_id: k for k, c in enumerate(self.classes)}

    def index(self, obj_id: int) -> int:
        """Position of a class; KeyError where the catalogue has none."""
        return self._position[obj_id]

    def __getitem__(self, obj_id: int) -> ObjectClass:
        return self.classes[self._position[obj_id]]

    def __contains__(self, obj_id: object) -> bool:
        return obj_id in self._position

    def __len__(self) -> int:
        return len(self.classes)
