"""The classes that may be in a place: mesh, category, symmetry, persistence."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

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

    @cached_property
    def is_solid(self) -> bool:
        """Whether the faces enclose volumes and face outwards: seen from outside, a face from behind is hidden."""
        places, welded = np.unique(self.vertices, axis=0, return_inverse=True)
        faces = welded.reshape(-1)[self.faces].astype(np.int64)
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        forth, back = start * len(places) + end, end * len(places) + start
        if len(faces) == 0 or not np.array_equal(np.sort(forth), np.sort(back)):
            return False
        # each of the bodies has its own sign of volume
        body = connected_components(coo_array((np.ones(len(start)), (start, end)), shape=(len(places),) * 2))[1]
        a, b, c = np.swapaxes(places[faces], 0, 1)
        volumes = np.bincount(body[faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=body.max() + 1)
        return bool((volumes[np.unique(body[faces[:, 0]])] > 0.0).all())


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
