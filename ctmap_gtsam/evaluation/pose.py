"""How wrong a pose is: translation, rotation, MSSD, MSPD, ADD and ADD-S, all but ADD the best over symmetries.

Every function takes batches of two poses of one object in one frame of reference, here the camera's, and gives one
number a pair: metres, radians or pixels. With a symmetry S of the class, ``T_true S`` is as true as ``T_true``.

Sources: Hodan et al., BOP Challenge 2020 on 6D Object Localization (ECCV Workshops 2020), for MSSD, MSPD and for
turning continuous symmetries into steps; Hinterstoisser et al., Model Based Training, Detection and Pose Estimation
(ACCV 2012), for ADD and ADD-S (there for objects with indistinguishable views; ADI in BOP).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import ContinuousSymmetry, ObjectClass

Array = NDArray[np.float64]

CONTINUOUS_STEPS = 315
"""Steps of a full turn, as bop_toolkit takes them: no vertex moves further than 1 % of the diameter between two"""

ADDS_POINTS = 1000
"""Vertices of the true mesh that ADD-S looks up at most; they are searched among all vertices of the other"""


@dataclass(frozen=True)
class Shape:
    """What the errors need to know of a class; each part is computed when it is first asked for."""

    of: ObjectClass

    @cached_property
    def centre(self) -> Array:
        """(3,) centre of the mesh's bounding box, metres, object frame.

        Mesh frames differ from class to class; this point can be compared where the class is wrong.
        """
        vertices = self.of.mesh.vertices
        return 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))

    @cached_property
    def extreme_points(self) -> Array:
        """(H, 3) vertices of the convex hull.

        The distance between two poses of a point is a convex function of the point, so its maximum over the mesh is
        taken on the hull: leaving the other vertices out changes no MSSD.
        """
        vertices = self.of.mesh.vertices
        try:
            return vertices[np.sort(ConvexHull(vertices).vertices)]
        except (QhullError, ValueError):  # flat, or too few points
            return vertices

    @cached_property
    def vertices(self) -> Array:
        """(V, 3) all vertices, those of the hull first: a maximum over them is then soon nearly known."""
        return np.concatenate([self.extreme_points, self.of.mesh.vertices])

    @cached_property
    def sample(self) -> Array:
        """(n, 3) every vertex, or ADDS_POINTS of them spread over the list."""
        vertices = self.of.mesh.vertices
        if len(vertices) <= ADDS_POINTS:
            return vertices
        return vertices[np.linspace(0, len(vertices) - 1, ADDS_POINTS).round().astype(np.int64)]

    @cached_property
    def tree(self) -> cKDTree:
        """Of all vertices."""
        return cKDTree(self.of.mesh.vertices)

    @cached_property
    def symmetries(self) -> Array:
        """(S, 4, 4) all symmetries, continuous ones in steps: ``T_world_object @ symmetries[s]`` looks the same."""
        return discretise(self.of.symmetries_discrete, self.of.symmetries_continuous)


def discretise(discrete: Array, continuous: tuple[ContinuousSymmetry, ...]) -> Array:
    """All symmetries as a finite set, as bop_toolkit's get_symmetry_transformations makes it.

    Args:
        discrete: (D, 4, 4), identity first, metres.
        continuous: lines about which the object may turn; each becomes CONTINUOUS_STEPS turns after each discrete one.

    Returns:
        (S, 4, 4) metres, the first D those given.
    """
    if not continuous:
        return discrete
    angles = 2.0 * np.pi * np.arange(CONTINUOUS_STEPS) / CONTINUOUS_STEPS
    turns = []
    for line in continuous:
        R = se3.so3_exp(angles[:, None] * line.axis)
        turns.append(se3.make(R, line.offset - R @ line.offset))
    combined = np.concatenate(turns)[:, None] @ discrete  # (steps, D, 4, 4): the turn last, in the object's frame
    return np.concatenate([discrete, combined.reshape(-1, 4, 4)])


def translation_error(estimated: Shape, T_estimated: Array, true: Shape, T_true: Array) -> Array:
    """Distance between the centres of the two bounding boxes.

    Args:
        estimated: shape of the estimated class, which may be the wrong one.
        T_estimated: (..., 4, 4) its pose, metres.
        true: shape of the true class. Where the two classes are one, the true pose is taken up to symmetry: at the
            symmetric twin that MSSD finds the nearest.
        T_true: (..., 4, 4) its pose in the same frame of reference.

    Returns:
        (...) metres. (The translation error of Hodan et al., On Evaluation of 6D Object Pose Estimation, ECCVW 2016,
        taken at the centre of the box instead of the mesh's origin, since origins differ from class to class.)
    """
    if estimated.of.obj_id == true.of.obj_id:
        T_true = T_true @ true.symmetries[_nearest_twin(true, T_estimated, T_true)[1]]
    ours, theirs = se3.transform(T_estimated, estimated.centre[None]), se3.transform(T_true, true.centre[None])
    return np.linalg.norm(ours - theirs, axis=-1)[..., 0]


def rotation_error(shape: Shape, T_estimated: Array, T_true: Array) -> Array:
    """Angle between two orientations: the least over discrete symmetries, turns about a symmetry axis ignored.

    About a line of symmetry only the angle between the two directions of the line counts; an object with two lines or
    more is a sphere and has no orientation. Poses (..., 4, 4) -> (...) rad in [0, pi].
    (The paper: "for symmetrical objects, the rotation error with respect to the symmetric axis is ignored".)
    """
    R_true, R_estimated = T_true[..., :3, :3], T_estimated[..., :3, :3]
    relative = np.swapaxes(R_true, -1, -2) @ R_estimated
    # R_true C D ~ R_true: the error of D is relative D^-1, up to turns C on its left
    errors = relative[..., None, :, :] @ np.swapaxes(shape.of.symmetries_discrete[:, :3, :3], -1, -2)
    lines = shape.of.symmetries_continuous
    if not lines:
        return np.linalg.norm(se3.so3_log(errors), axis=-1).min(axis=-1)
    if any(np.linalg.norm(np.cross(line.axis, lines[0].axis)) > 1e-6 for line in lines[1:]):
        return np.zeros(relative.shape[:-2])
    axis = lines[0].axis
    moved = errors @ axis
    angles = np.arctan2(np.linalg.norm(np.cross(moved, axis), axis=-1), moved @ axis)
    return angles.min(axis=-1)


def mssd(shape: Shape, T_estimated: Array, T_true: Array) -> Array:
    """Maximum Symmetry-Aware Surface Distance of BOP: min over symmetries of max over vertices.

    Poses (..., 4, 4) -> (...) metres: ``min_S max_x |T_estimated x - T_true S x|``.
    """
    return _nearest_twin(shape, T_estimated, T_true)[0]


def mspd(shape: Shape, T_estimated: Array, T_true: Array, camera: Camera) -> Array:
    """Maximum Symmetry-Aware Projection Distance of BOP: min over symmetries of max over vertices, in the image.

    Poses (..., 4, 4) in the camera -> (...) pixels: ``min_S max_x |project(T_estimated x) - project(T_true S x)|``.
    Vertices that are truly behind the camera don't count; where the estimate puts another one there, it is infinite.
    """
    batch = T_estimated.shape[:-2]
    ours = np.ascontiguousarray(T_estimated.reshape(-1, 4, 4))
    true = np.ascontiguousarray((T_true[..., None, :, :] @ shape.symmetries).reshape(-1, len(shape.symmetries), 4, 4))
    return _least_projection(ours, true, np.ascontiguousarray(shape.vertices), camera.fx, camera.fy).reshape(batch)


def add(shape: Shape, T_estimated: Array, T_true: Array) -> Array:
    """Average Distance of model points: poses (..., 4, 4) -> (...) metres, mean over vertices, no symmetry."""
    vertices = shape.of.mesh.vertices
    difference = T_estimated - T_true
    moved = vertices @ np.swapaxes(difference[..., :3, :3], -1, -2) + difference[..., None, :3, 3]
    return np.linalg.norm(moved, axis=-1).mean(axis=-1)


def adds(shape: Shape, T_estimated: Array, T_true: Array) -> Array:
    """ADD-S (ADI): mean over the true mesh's vertices of the distance to the nearest vertex of the estimated mesh.

    Poses (..., 4, 4) -> (...) metres. At most ADDS_POINTS vertices of a mesh are looked up; the mean of so many differs
    from the whole mesh's by a few hundredths of itself.
    """
    relative = se3.inverse(T_estimated) @ T_true
    points = se3.transform(relative, shape.sample)  # (..., n, 3) in the estimated object's frame
    distance, _ = shape.tree.query(points)
    return distance.mean(axis=-1)


def _nearest_twin(shape: Shape, T_estimated: Array, T_true: Array) -> tuple[Array, NDArray[np.int64]]:
    """Poses (..., 4, 4) -> MSSD (...), metres, and the symmetry (...) that attains it."""
    batch = T_estimated.shape[:-2]
    difference = T_estimated[..., None, :, :] - T_true[..., None, :, :] @ shape.symmetries  # (..., S, 4, 4)
    maps = np.ascontiguousarray(difference.reshape(-1, len(shape.symmetries), 4, 4)[:, :, :3, :])
    distance, index = _least_maximum(maps, np.ascontiguousarray(shape.extreme_points))
    return distance.reshape(batch), index.reshape(batch)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _least_maximum(maps, points):
    """Maps (N, S, 3, 4), points (H, 3) -> min over S of max over H of the image's length, and its S: (N,) each."""
    out, index = np.empty(maps.shape[0]), np.zeros(maps.shape[0], np.int64)
    for n in range(maps.shape[0]):
        least = np.inf
        for s in range(maps.shape[1]):
            m = maps[n, s]
            largest = 0.0
            for h in range(points.shape[0]):
                x, y, z = points[h, 0], points[h, 1], points[h, 2]
                square = 0.0
                for d in range(3):
                    image = m[d, 0] * x + m[d, 1] * y + m[d, 2] * z + m[d, 3]
                    square += image * image
                largest = max(largest, square)
                if largest >= least:  # this symmetry can't win any more
                    break
            if largest < least:
                least, index[n] = largest, s
        out[n] = np.sqrt(least)
    return out, index


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _least_projection(ours, true, points, fx, fy):
    """Poses (N, 4, 4) and (N, S, 4, 4), points (V, 3) -> (N,) min over S of max over V of the distance of the images.

    The principal point is the same in both images, so it doesn't matter.
    """
    out = np.full(ours.shape[0], np.inf)
    image = np.empty((points.shape[0], 2))
    for n in range(ours.shape[0]):
        for v in range(points.shape[0]):
            image[v, 0], image[v, 1] = _projection(ours[n], points[v], fx, fy)
        least = np.inf
        for s in range(true.shape[1]):
            largest = 0.0
            for v in range(points.shape[0]):
                x, y = _projection(true[n, s], points[v], fx, fy)
                if np.isfinite(x):
                    square = (image[v, 0] - x) ** 2 + (image[v, 1] - y) ** 2
                    largest = max(largest, square if np.isfinite(square) else np.inf)
                if largest >= least:
                    break
            least = min(least, largest)
        out[n] = np.sqrt(least)
    return out


@numba.njit(inline="always")
def _projection(T, point, fx, fy):
    """Infinite behind the camera."""
    x, y, z = point[0], point[1], point[2]
    depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if depth <= 0.0:
        return np.inf, np.inf
    u = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    v = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    return fx * u / depth, fy * v / depth
