"""Anybody's meshes in place of the household: BOP models, and what the simulator must know beyond them, worked out.

How a thing rests comes from its convex hull (Goldberg, Mirtich, Zhuang, Craig, Carlisle and Canny, Part pose
statistics: estimators and experiments, IEEE Transactions on Robotics and Automation 15, 1999, as trimesh has it): the
faces of the hull that a drop onto a table would end on, if it then takes a real tilt to turn the thing over. Furniture
is what the catalogue says supports others or is never moved; things stand on its level faces.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from sequences.catalogue import Mesh, ObjectClass
from sequences.classes import read_catalogue
from sequences.errors import InputError
from sequences.layout import MODELS, mesh_name
from sequences.problems import Checks
from sequences.simulation.shapes import Shape, SupportArea, household

Array = NDArray[np.float64]

USUAL = 0.1  # least probability of a rest; upright, as the model's z has it, is a rest whatever its probability
UPRIGHT_RAD = 0.17
SAME_RAD = 0.12  # rests that differ by less are one
STEADY_RAD = 0.12  # a thing that less of a tilt turns over doesn't rest there: a can on its side
CONTACT_M = 0.0015  # scanned bottoms aren't flat
LEVEL_COS = 0.999
LEAST_SIDE_M, FILLED = 0.2, 0.85  # of a level face that things stand on, and how much of its rectangle it fills
SAME_HEIGHT_M = 0.003
LEAST_ROOM_M = 0.1
SAMPLES = ((0.513, 0.507), (0.131, 0.117), (0.871, 0.123), (0.127, 0.883), (0.877, 0.887))  # shares of its sides
OPEN_M = 1.0  # headroom of what has nothing above it


def load_shapes(folder: Path) -> tuple[Shape, ...]:
    """The classes of a catalogue of meshes, with our furniture where it has none.

    Args:
        folder: holds models/models_info.json and the meshes, as BOP keeps them, and perhaps catalogue.json.

    Raises:
        InputError: broken files, or a mesh that can't stand.
    """
    shapes = tuple(_shape(c, folder) for c in read_catalogue(folder, Checks()).classes)
    if any(s.areas for s in shapes):
        return shapes
    first = 1 + max(s.object_class.obj_id for s in shapes)
    ours = [s for s in household() if s.areas]
    return (*shapes, *(replace(s, object_class=replace(s.object_class, obj_id=first + k)) for k, s in enumerate(ours)))


def _shape(one: ObjectClass, folder: Path) -> Shape:
    if one.movable and not one.supports:
        rests = stable_rests(one.mesh)
        if len(rests) == 0:
            raise InputError(
                f"{one.name} rests in no position",
                file=folder / MODELS / mesh_name(one.obj_id),
                field=str(one.obj_id),
                remedy="give a mesh with a volume, or leave the class out",
            )
        return Shape(one, rests)
    return Shape(one, np.eye(3)[None], level_areas(one.mesh))


def stable_rests(mesh: Mesh) -> Array:
    """(n, 3, 3) rotations in which a mesh rests on a level surface: upright first if it can be, then the likeliest."""
    import trimesh
    from trimesh.poses import compute_stable_poses

    try:
        ConvexHull(mesh.vertices)  # trimesh makes a hull of what is flat, too, and then never ends
    except QhullError:
        return np.zeros((0, 3, 3))
    hull: Any = trimesh.Trimesh(mesh.vertices, process=False).convex_hull
    poses, chances = compute_stable_poses(hull, sigma=0.0, n_samples=1, threshold=0.0)
    found: list[tuple[Array, float]] = []
    for R, chance in zip(poses[:, :3, :3], chances, strict=True):
        alike = next((k for k, (other, _) in enumerate(found) if R[2] @ other[2] > np.cos(SAME_RAD)), None)
        if alike is not None:
            found[alike] = (found[alike][0], found[alike][1] + chance)
        elif _steadiness(hull, R) > STEADY_RAD:
            found.append((R, chance))
    upright = [R[2, 2] > np.cos(UPRIGHT_RAD) for R, _ in found]
    order = sorted(range(len(found)), key=lambda k: (not upright[k], -found[k][1]))
    usual = [k for k in order if upright[k] or found[k][1] >= USUAL] or order[:1]
    return np.stack([found[k][0] for k in usual]) if usual else np.zeros((0, 3, 3))


def _steadiness(hull: Any, R: Array) -> float:
    """Through what angle, rad, one must tilt a solid that rests in R before it turns over."""
    points, middle = hull.vertices @ R.T, R @ hull.center_mass
    low = points[:, 2].min()
    contact = points[points[:, 2] < low + CONTACT_M, :2]
    try:
        equations = ConvexHull(contact).equations
    except (QhullError, ValueError):
        return 0.0
    inside = -(equations[:, :2] @ middle[:2] + equations[:, 2]).max()
    return float(np.arctan2(inside, middle[2] - low))


def level_areas(mesh: Mesh) -> tuple[SupportArea, ...]:
    """The level rectangles of a mesh, z up, that things can stand on, lowest first."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(normals, axis=-1)
    level = np.flatnonzero(normals[:, 2] > LEVEL_COS * double)
    level = level[np.argsort(corners[level][:, :, 2].mean(axis=1), kind="stable")]
    steps = np.diff(corners[level][:, :, 2].mean(axis=1)) > SAME_HEIGHT_M
    areas = []
    for here in np.split(level, np.flatnonzero(steps) + 1):
        low, high = corners[here].min(axis=(0, 1), initial=np.inf), corners[here].max(axis=(0, 1), initial=-np.inf)
        size = (high - low)[:2]
        if size.min() >= LEAST_SIDE_M and double[here].sum() / 2.0 >= FILLED * size.prod():
            room = _headroom(low, high, corners, np.sign(normals[:, 2]))
            if room >= LEAST_ROOM_M:
                areas.append(SupportArea((low + high) / 2.0, size, room))
    return tuple(areas)


def _headroom(low: Array, high: Array, corners: Array, facing: Array) -> float:
    """Free height above a level rectangle (3,) to (3,), at most `OPEN_M`; 0 where it lies inside a body.

    Counted along vertical lines through some of its points: one that leaves bodies more often than it enters them
    began inside.
    """
    free = OPEN_M
    for share in SAMPLES:
        x, y = low[:2] + np.asarray(share) * (high - low)[:2]
        a, b, c = np.swapaxes(corners - [x, y, high[2]], 0, 1)
        weights = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=-1)
        area = weights.sum(axis=-1)
        hit = (weights * np.sign(area)[:, None] >= 0.0).all(axis=-1) & (area != 0.0)
        z = (weights[hit] * np.stack([a, b, c], axis=-1)[hit][:, 2]).sum(axis=-1) / area[hit]
        over = z > SAME_HEIGHT_M
        if facing[hit][over].sum() > 0.0:
            return 0.0
        free = min(free, float(z[over].min(initial=OPEN_M)))
    return free


def _cross(a: Array, b: Array) -> Array:
    """z of a x b for vectors (n, 3)."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
