"""A class as the estimators see it: a coarse mesh about its own centre.

Estimators work with the pose of the *centre frame*, which lies in the middle of the bounding box, or nearby where all
symmetries leave it, so that rotation and translation are nearly independent and a symmetry is a pure rotation.
Poses leave an estimator in the catalogue's mesh frame (`Shape.to_object`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from trimesh.poses import compute_stable_poses

from factors.symmetry import AXIS_TURNS, Symmetry, residual
from sequences import se3
from sequences.catalogue import Catalogue, Mesh, ObjectClass
from sequences.distance import DistanceField, distance_field, spread
from sequences.meshes import simplify

Array = NDArray[np.float64]

_ONE_FACE = 0.98  # cosine between the normals of triangles that face one way
_ONE_FLAT_M = 0.01  # triangles of one flat lie so near to one plane ...
_FLAT_SHARE = 0.02  # ... and make up this share of the surface together
_ONE_PLACE = 0.5  # of the smaller thing's radius
NEARLY = 0.05  # a turn that moves the surface off itself by less than this share of the radius is a near-symmetry, ...
_ALIKE, _ALIKE_M = 0.12, 0.01  # ... or by less than this share and this much, the noise of depth from across a room ...
_TWINS = 3  # ... of which so many are told at most
_SAME_RAD = 0.1  # turns so near to each other are one
_TWIN_POINTS = 1000


@dataclass(frozen=True)
class Shape:
    """One class in its centre frame; lengths in metres."""

    index: int
    """position in the catalogue"""
    source: ObjectClass
    """the class as catalogued"""
    T_object_centre: Array
    """(4, 4) a pure translation"""
    mesh: Mesh
    """coarse, in the centre frame"""
    normals: Array
    """(F, 3) of its faces"""
    symmetry: Symmetry
    """in the centre frame"""
    radius_m: float
    """root mean square distance of the vertices from the centre: turns rad into metres"""

    @cached_property
    def reach_m(self) -> float:
        """Radius of the sphere about the centre that holds it."""
        return float(np.linalg.norm(self.mesh.vertices, axis=-1).max())

    @cached_property
    def hull_points(self) -> Array:
        """(H, 3) vertices of the convex hull, centre frame: what can touch a plane."""
        return self.mesh.vertices[ConvexHull(self.mesh.vertices).vertices]

    @cached_property
    def _stable(self) -> tuple[Array, Array]:
        """Stable rests by convex hull and centre of mass, and how likely each is (Goldberg et al., 1999; trimesh)."""
        hull = trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, process=False).convex_hull
        T, probability = compute_stable_poses(hull, sigma=0.0, n_samples=1, threshold=0.01)
        return np.ascontiguousarray(T[:, :3, :3]), np.sqrt(probability) / np.sqrt(probability).sum()

    @property
    def rests(self) -> Array:
        """(R, 3, 3) rotations of the centre frame to one whose z is up, in which it can stand or lie on a plane."""
        return self._stable[0]

    @property
    def rest_weights(self) -> Array:
        """(R,) how often each is to be tried, of sum 1: by the root of its probability, so that none is rare."""
        return self._stable[1]

    @cached_property
    def _areas(self) -> Array:
        """(F,) of the mesh's faces, square metres."""
        a, b, c = (self.mesh.vertices[self.mesh.faces[:, i]] for i in range(3))
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1))

    @cached_property
    def main_normal(self) -> Array:
        """(3,) normal of the direction that most of the surface faces, this way or the other, centre frame."""
        facing = np.abs(self.normals @ self.normals.T) > _ONE_FACE
        return self.normals[int(np.argmax(facing @ self._areas))]

    @cached_property
    def flats(self) -> Array:
        """(n, 4) the flat parts of the surface, largest first: outward unit normal n and offset, n . p = offset."""
        offsets = (self.normals * self._middles).sum(axis=-1)
        left, total, found = self._areas.copy(), self._areas.sum(), []
        while left.any():
            # the largest triangle's plane, with all that lies in it
            k = int(np.argmax(left))
            one = (self.normals @ self.normals[k] > _ONE_FACE) & (np.abs(offsets - offsets[k]) < _ONE_FLAT_M)
            area = float(left[one].sum())
            if area >= _FLAT_SHARE * total:
                found.append((area, *self.normals[k], float(np.average(offsets[one], weights=left[one] + 1e-12))))
            left[one] = 0.0
        return np.array(sorted(found, reverse=True)).reshape(-1, 5)[:, 1:]

    @cached_property
    def distance(self) -> DistanceField:
        """Signed distance field in the centre frame."""
        return distance_field(self.mesh)

    @cached_property
    def near_symmetries(self) -> Array:
        """(n, 3, 3) near-symmetries: turns about the centre after which the mesh looks nearly, but not just, as before.

        Of the 24 turns that carry the frame's axes into each other, those after which the surface's mean distance from
        itself is least; most meshes that have near-symmetries have their axes along the frame's.
        """
        points = spread(self.mesh)
        points = points[:: -(-len(points) // _TWIN_POINTS)]
        off = np.array([np.abs(self.distance.at(points @ R.T)).mean() for R in AXIS_TURNS])
        nearly = max(NEARLY * self.radius_m, min(_ALIKE * self.radius_m, _ALIKE_M))
        kept: list[Array] = [np.eye(3)]
        for k in np.argsort(off, kind="stable"):
            T = se3.make(AXIS_TURNS[k], np.zeros(3))
            there = se3.make(np.stack(kept), np.zeros((len(kept), 3)))
            apart = np.linalg.norm(residual(there, T, self.symmetry)[..., :3], axis=-1).min()
            if off[k] < nearly and apart > _SAME_RAD and len(kept) <= _TWINS:
                kept.append(AXIS_TURNS[k])
        return np.stack(kept)[1:]

    def surface_points(self, n: int) -> Array:
        """(<= n, 3) middles of faces spread over the surface, centre frame."""
        return np.ascontiguousarray(self._middles[:: max(1, -(-len(self._middles) // n))])

    @cached_property
    def _middles(self) -> Array:
        """(F, 3) of the mesh's faces, centre frame."""
        return np.asarray(self.mesh.vertices[self.mesh.faces].mean(axis=1))

    def to_object(self, T_frame_centre: Array) -> Array:
        """Poses (..., 4, 4) of the centre frame -> of the mesh frame."""
        return T_frame_centre @ se3.inverse(self.T_object_centre)

    def to_centre(self, T_frame_object: Array) -> Array:
        """Poses (..., 4, 4) of the mesh frame -> of the centre frame."""
        return T_frame_object @ self.T_object_centre

    def covariance_to_object(self, covariance: Array) -> Array:
        """Covariances (..., 6, 6) of the centre frame's right tangent -> of the mesh frame's."""
        A = se3.adjoint(self.T_object_centre)
        return A @ covariance @ A.T

    def free_axes_to_object(self, free: Array) -> Array:
        """Orthonormal columns (6, f) in the centre frame's tangent -> spanning the same motions in the mesh frame's."""
        if free.shape[-1] == 0:
            return free
        return np.asarray(np.linalg.qr(se3.adjoint(self.T_object_centre) @ free)[0])


def build_shapes(catalogue: Catalogue, faces: int) -> tuple[Shape, ...]:
    """One shape a class, in the catalogue's order; `faces` bounds the coarse meshes."""
    return tuple(_build(index, source, faces) for index, source in enumerate(catalogue.classes))


def _build(index: int, source: ObjectClass, faces: int) -> Shape:
    coarse = simplify(source.mesh, faces)
    symmetry = Symmetry.of(source)
    centre = centre_of(source)
    mesh = Mesh(np.ascontiguousarray(coarse.vertices - centre), np.ascontiguousarray(coarse.faces), coarse.colours)
    return Shape(
        index=index,
        source=source,
        T_object_centre=se3.make(np.eye(3), centre),
        mesh=mesh,
        normals=_face_normals(mesh),
        symmetry=_about(symmetry, centre),
        radius_m=float(np.sqrt((mesh.vertices**2).sum(-1).mean())),
    )


def centre_of(source: ObjectClass) -> Array:
    """The fixed point of all symmetries nearest to the middle of the bounding box: (3,) in the mesh frame, metres."""
    vertices = source.mesh.vertices
    middle = np.asarray((vertices.min(0) + vertices.max(0)) / 2.0)
    return middle + _about(Symmetry.of(source), middle).centre


def _about(symmetry: Symmetry, origin: Array) -> Symmetry:
    """The same symmetries in axes moved to an origin (3,)."""
    T = se3.make(np.eye(3), origin)
    return Symmetry(
        discrete=se3.inverse(T) @ symmetry.discrete @ T, axes=symmetry.axes, offsets=symmetry.offsets - origin
    )


def _face_normals(mesh: Mesh) -> Array:
    """(F, 3) unit normals; zero for degenerate faces."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    return np.asarray(n / np.where(length == 0, 1.0, length))


def one_place_m(a: Shape, b: Shape) -> float:
    """How near to each other the centres of two things can't be, since both are solid, in metres."""
    return _ONE_PLACE * min(a.radius_m, b.radius_m)
