"""What stands flat on a level surface: a fact that no view measures, and that every view's tilt is held to.

A view tells the tilt of a cup by the depth's error over the cup's radius, a degree or two, and what all views get wrong
alike stays. A thing at rest lies on one of its stable faces, as far as its surface and the floor are even.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.place import Place
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from sequences.geometry import Plane

Array = NDArray[np.float64]

_UPRIGHT = 0.99  # cosine between a free axis and the face that is up, from which on the thing stands on its end
_COMPATIBLE = 3.0  # standard deviations of what views get wrong alike, within which a tilt is none


@dataclass(frozen=True)
class Footing:
    """A stretch of an object's views through which it stands on one face."""

    rows: NDArray[np.int64]
    """(n,) of its measured modes"""
    level: Array
    """(m, 3) directions of the centre frame that are level then: two, or the axis alone of what lies and may roll"""


def footings(
    T_world_centre: Array, stays: Sequence[bool], shape: Shape, place: Place, model: Model
) -> Iterator[Footing]:
    """Where an object stands flat, for each stretch of views in which it stays where it is.

    It does if its mean tilt is no more than views get wrong alike, and it ends at a surface that is known.

    Args:
        T_world_centre: (n, 4, 4) as measured, in order of time.
        stays: (n,) whether each is in the same place as the one before.
        shape: the class.
        place: which way is up, and the level surfaces; where up is unknown nothing stands.
        model: settings.
    """
    up = place.up_world
    if up is None or not len(T_world_centre):
        return
    begins = np.flatnonzero([not (stay and i) for i, stay in enumerate(stays)])
    for rows in np.split(np.arange(len(T_world_centre)), begins[1:]):
        level = _level(T_world_centre[rows, :3, :3].swapaxes(-1, -2) @ up, shape, model)
        if level is not None and _bears(T_world_centre[rows[len(rows) // 2]], shape, place.surfaces, model):
            yield Footing(rows, level)


def _level(up: Array, shape: Shape, model: Model) -> Array | None:
    """What is level of the stable face that is least tilted, by the direction that is up (n, 3), centre frame."""
    mean = up.mean(axis=0)
    faces = [(face, _directions(face, shape)) for face in shape.rests[:, 2]]
    tilts = [
        (float(np.linalg.norm(level @ mean)), k)
        for k, (face, level) in enumerate(faces)
        if len(level) == 1 or (len(level) == 2 and face @ mean > 0.0)
    ]
    if not tilts:
        return None
    tilt, k = min(tilts)
    certain = np.hypot(model.config.context.standing_tilt_rad, model.bias_sigmas(shape)[0])
    return faces[k][1] if tilt <= _COMPATIBLE * certain else None


def _directions(face: Array, shape: Shape) -> Array:
    """(m, 3) directions that are level when a face (3,) is up, of those that the symmetry leaves anything to say of."""
    axes = shape.symmetry.free_rotations.T
    if len(axes) == 3:
        return np.zeros((0, 3))
    if len(axes) == 1 and abs(float(axes[0] @ face)) < _UPRIGHT:
        across = axes[0] - float(axes[0] @ face) * face
        return np.asarray(across / np.linalg.norm(across))[None]
    return np.linalg.svd(face[None])[2][1:]


def _bears(T_world_centre: Array, shape: Shape, surfaces: tuple[Plane, ...], model: Model) -> bool:
    """Whether a pose (4, 4) ends at a surface, as exactly as surfaces and supports are known."""
    points = shape.hull_points @ T_world_centre[:3, :3].T + T_world_centre[:3, 3]
    return any(
        abs(float((points @ plane.normal).min() - plane.offset)) <= model.config.context.bearing_m
        for plane in surfaces
        if plane.contains(T_world_centre[None, :3, 3]).item()
    )
