"""Which classes look alike: those whose surfaces a depth camera could hardly tell apart.

What counts of two meshes is how far one's surface is from the other's where they are laid over each other best: the
mean distance to the nearest point, of both ways (the symmetric mean surface distance; Aspert, Santa-Cruz and Ebrahimi,
MESH: Measuring errors between surfaces using the Hausdorff distance, ICME 2002). Two classes are alike where that is
within ALIKE_M. Nothing but the catalogue is looked at: no run, no detector, no estimator; nor where a mesh's frame
lies, nor its colour.

Laying over: principal axes onto principal axes in the 24 ways that turn them into each other, then iterated closest
points (Besl and McKay, A method for registration of 3-D shapes, PAMI 1992) from the best of these.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from factors.symmetry import AXIS_TURNS
from sequences import se3
from sequences.catalogue import Catalogue, Mesh
from sequences.distance import spread

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

ALIKE_M = 0.0075
"""Surfaces nearer to each other than this are alike: two standard deviations of depth about the true surfaces of the
simulated places (`ctmap bench realism`), so that a pixel hardly tells them apart"""

_DENSE, _SPARSE = 6000, 400  # points of a surface that are looked up in, and that are looked up
_FEW = 100  # points that tell which of the ways are worth a closer look
_WAYS, _STEPS = 3, 10  # that so many get, and steps of the closest points
_SIZES = 4.0  # whose extents differ by more than so many times what is alike need no laying over


class Surface:
    """Points all over a mesh's surface, about their middle and along their principal axes, metres."""

    def __init__(self, mesh: Mesh) -> None:
        every = spread(mesh)
        every = every - every.mean(axis=0)
        axes = np.linalg.eigh(every.T @ every)[1]
        axes[:, 2] *= np.linalg.det(axes)
        dense = _thinned(every @ axes, _DENSE)
        self.tree = cKDTree(dense)
        self.points = _thinned(dense, _SPARSE)
        self.extents = np.sort(np.ptp(dense, axis=0))


def confusable(catalogue: Catalogue) -> frozenset[int]:
    """obj_id of the classes that look like another one of the catalogue."""
    rivalled = np.flatnonzero(look_alikes(catalogue).any(axis=1))
    return frozenset(catalogue.obj_ids[k] for k in rivalled)


def look_alikes(catalogue: Catalogue, within_m: float = ALIKE_M) -> Bools:
    """(C, C) which other classes each class looks like, in the catalogue's order: symmetric, nothing is its own."""
    surfaces = [Surface(c.mesh) for c in catalogue.classes]
    out = np.zeros((len(surfaces), len(surfaces)), dtype=np.bool_)
    for a, b in combinations(range(len(surfaces)), 2):
        if np.abs(surfaces[a].extents - surfaces[b].extents).max() <= _SIZES * within_m:
            out[a, b] = out[b, a] = surface_distance(surfaces[a], surfaces[b]) <= within_m
    return out


def surface_distance(a: Surface, b: Surface) -> float:
    """Mean distance between two surfaces laid over each other, metres."""
    return min(_laid_over(a, b), _laid_over(b, a))


def _laid_over(a: Surface, b: Surface) -> float:
    """The same with a drawn onto b."""
    few = _thinned(a.points, _FEW)
    off = np.array([b.tree.query(few @ R.T)[0].mean() for R in AXIS_TURNS])
    return min(_apart(a, b, _drawn(a, b, AXIS_TURNS[k])) for k in np.argsort(off, kind="stable")[:_WAYS])


def _drawn(a: Surface, b: Surface, R: Array) -> Array:
    """T_b_a (4, 4) after iterated closest points from a rotation (3, 3); each step is Kabsch's (1976), by SciPy."""
    T = se3.make(R, np.zeros(3))
    for _ in range(_STEPS):
        pairs = b.tree.data[b.tree.query(se3.transform(T, a.points))[1]]
        middle, other = a.points.mean(axis=0), pairs.mean(axis=0)
        R = Rotation.align_vectors(pairs - other, a.points - middle)[0].as_matrix()
        T = se3.make(R, other - R @ middle)
    return T


def _apart(a: Surface, b: Surface, T_b_a: Array) -> float:
    """Mean distance of each one's points from the other, of both ways."""
    there = b.tree.query(se3.transform(T_b_a, a.points))[0].mean()
    back = a.tree.query(se3.transform(se3.inverse(T_b_a), b.points))[0].mean()
    return float(there + back) / 2.0


def _thinned(points: Array, n: int) -> Array:
    """About n of points (m, 3), spread over the list."""
    return points[:: -(-len(points) // n)]
