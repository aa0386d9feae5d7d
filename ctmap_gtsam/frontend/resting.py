"""Poses of things that rest on a level surface, or whose flat parts are the planes that are seen.

Most things stand on something. Where surfaces are known, a pose is a stable rest of the mesh, a yaw, and a place on
the surface, which the pixel of its centre tells: three unknowns instead of six. Furniture and boxes mostly stand along
walls and other upright planes, so half of the yaws turn a face of the thing to such a plane.

Of furniture the camera rarely sees the whole, nor the floor, but planes: a top, a board, a side. Each of them is one of
the few flat parts of the mesh, or the wall behind it, and settles one unknown of the place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.shapes import Shape
from sequences import se3
from sequences.geometry import Plane

Array = NDArray[np.float64]

_UPRIGHT = 0.2  # cosine to the vertical below which a plane counts as upright
_SNAPPED = 0.75  # of the planes that a flat part could be, those that it is taken to be
_ALIGNED = 0.8  # of the yaws that are turned to an upright plane, where poses are drawn to planes
_ONE_DIRECTION = 0.985  # cosine between the normals of a plane and the flat part that it may be
UNIFORMS = 3
"""random numbers in [0, 1) that `resting_poses` and `snapped_poses` take a pose"""


def resting_poses(
    shape: Shape, rays: Array, surfaces: tuple[Plane, ...], planes: tuple[Plane, ...], up: Array, uniforms: Array
) -> Array:
    """Poses (m, 4, 4) T_camera_centre, m <= n, of a shape at rest on surfaces.

    Args:
        shape: the class.
        rays: (n, 3) towards the centres, camera frame, z = 1.
        surfaces: level planes, camera frame; at least one.
        planes: all planes that the image shows, camera frame.
        up: (3,) unit, against gravity, camera frame.
        uniforms: (n, `UNIFORMS`) which rest, which yaw, which surface.

    Returns:
        As many as have their place on their surface before the camera.
    """
    chosen = np.searchsorted(np.cumsum(shape.rest_weights), uniforms[:, 0] * (1.0 - 1e-12))
    R_level_centre = shape.rests[chosen]
    R_camera_level = _level_frame(up)
    yaw = _yaws(R_camera_level, R_level_centre, shape, planes, uniforms[:, 1])
    R = R_camera_level @ _turns(yaw) @ R_level_centre
    surface = np.minimum((uniforms[:, 2] * len(surfaces)).astype(int), len(surfaces) - 1)
    height = -(shape.hull_points @ (up @ R)[..., None])[..., 0].min(axis=-1)
    offset = np.array([s.offset for s in surfaces])[surface]
    normal = np.stack([s.normal for s in surfaces])[surface]
    with np.errstate(divide="ignore"):
        z = (offset + height) / np.einsum("nk,nk->n", normal, rays)
    before = np.isfinite(z) & (z > 0.0)
    return se3.make(R[before], (z[:, None] * rays)[before])


def snapped_poses(
    shape: Shape, centres: Array, planes: tuple[Plane, ...], up: Array, uniforms: Array, rng: np.random.Generator
) -> Array:
    """Poses (n, 4, 4) T_camera_centre of a shape in a stable rest, moved so that flat parts of it lie in planes.

    Args:
        shape: the class.
        centres: (n, 3) about where its centre is, camera frame.
        planes: all planes that the image shows, camera frame.
        up: (3,) unit, against gravity, camera frame.
        uniforms: (n, `UNIFORMS`) which rest, which yaw.
        rng: draws which flat part is which plane.
    """
    chosen = np.searchsorted(np.cumsum(shape.rest_weights), uniforms[:, 0] * (1.0 - 1e-12))
    R_level_centre = shape.rests[chosen]
    R_camera_level = _level_frame(up)
    turned = np.where(uniforms[:, 2] < _ALIGNED, 0.5 + 0.5 * uniforms[:, 1], 0.5 * uniforms[:, 1])
    R = R_camera_level @ _turns(_yaws(R_camera_level, R_level_centre, shape, planes, turned)) @ R_level_centre
    t = centres.copy()
    for plane in planes:
        away, possible = _away(shape, R, t, plane)
        pick = np.argmax(rng.random(possible.shape) * possible, axis=1)
        apt = possible.any(axis=1) & (rng.random(len(t)) < _SNAPPED)
        t += np.where(apt, away[np.arange(len(t)), pick], 0.0)[:, None] * plane.normal
    return se3.make(R, t)


def shifted_poses(shape: Shape, poses: Array, planes: tuple[Plane, ...]) -> Array:
    """Poses (m, 4, 4) beside poses (n, 4, 4) T_camera_centre, one of the planes each being another flat part.

    A shelf whose boards are mistaken for those above them explains most of what is seen.
    """
    out = [np.zeros((0, 4, 4))]
    for plane in planes:
        away, possible = _away(shape, poses[:, :3, :3], poses[:, :3, 3], plane)
        rows, flats = np.nonzero(possible)
        moved = poses[rows].copy()
        moved[:, :3, 3] += away[rows, flats, None] * plane.normal
        out.append(moved)
    return np.concatenate(out)


def _away(shape: Shape, R: Array, t: Array, plane: Plane) -> tuple[Array, NDArray[np.bool_]]:
    """How far (n, F) flat parts lie before a plane, metres, and whether they may be that plane.

    That may be any flat part that faces as the plane does and isn't further off than the thing is large.
    """
    facing = np.einsum("nij,fj,i->nf", R, shape.flats[:, :3], plane.normal) > _ONE_DIRECTION
    away = (plane.offset - t @ plane.normal)[:, None] - shape.flats[:, 3]
    return away, facing & (np.abs(away) < shape.reach_m)


def _level_frame(up: Array) -> Array:
    """(3, 3) R_camera_level: z is up."""
    x = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up], axis=-1)


def _yaws(R_camera_level: Array, R_level_centre: Array, shape: Shape, planes: tuple[Plane, ...], u: Array) -> Array:
    """(n,) rad: from the first half of u anything, from the second half one that turns a face to an upright plane."""
    upright = [n for n in (R_camera_level.T @ p.normal for p in planes) if abs(n[2]) < _UPRIGHT]
    yaw = 4.0 * np.pi * u
    if not upright:
        return yaw
    walls = np.array([np.arctan2(n[1], n[0]) for n in upright])
    faces = R_level_centre @ shape.main_normal
    v = 2.0 * u - 1.0  # of the second half, uniform
    pick = np.floor(np.clip(v, 0.0, 1.0 - 1e-12) * 4 * len(walls)).astype(int)
    quarter = 0.5 * np.pi * (pick % 4)
    aligned = walls[pick // 4] + quarter - np.arctan2(faces[:, 1], faces[:, 0])
    return np.where((v >= 0.0) & (np.abs(faces[:, 2]) < _UPRIGHT), aligned, yaw)


def _turns(yaw: Array) -> Array:
    """(n, 3, 3) about z."""
    return se3.so3_exp(yaw[:, None] * np.array([0.0, 0.0, 1.0]))
