"""Exact distances and insides of triangle meshes by brute force, to hold the simulator's meshes and places to."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(inline="always")
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(inline="always")
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(inline="always")
def _to_segment(p, a, b):
    """Squared distance of a point to a segment."""
    ab, ap = _minus(b, a), _minus(p, a)
    share = min(max(_dot(ap, ab) / max(_dot(ab, ab), 1e-300), 0.0), 1.0)
    d = (ap[0] - share * ab[0], ap[1] - share * ab[1], ap[2] - share * ab[2])
    return _dot(d, d)


@numba.njit
def _to_triangle(p, a, b, c):
    """Squared distance of a point to a triangle: to its plane where the foot is inside, else to its edges."""
    normal = _cross(_minus(b, a), _minus(c, a))
    ap = _minus(p, a)
    inside = (
        _dot(_cross(_minus(b, a), ap), normal) >= 0
        and _dot(_cross(_minus(c, b), _minus(p, b)), normal) >= 0
        and _dot(_cross(_minus(a, c), _minus(p, c)), normal) >= 0
    )
    if inside:
        return _dot(ap, normal) ** 2 / max(_dot(normal, normal), 1e-300)
    return min(_to_segment(p, a, b), _to_segment(p, b, c), _to_segment(p, c, a))


@numba.njit(inline="always")
def _row(table, k):
    return table[k, 0], table[k, 1], table[k, 2]


@numba.njit(cache=True)
def distances(points, vertices, faces):
    """(n,) distance of points (n, 3) to the surface."""
    out = np.empty(len(points))
    for i in range(len(points)):
        best = np.inf
        p = _row(points, i)
        for f in range(len(faces)):
            a, b, c = _row(vertices, faces[f, 0]), _row(vertices, faces[f, 1]), _row(vertices, faces[f, 2])
            best = min(best, _to_triangle(p, a, b, c))
        out[i] = np.sqrt(best)
    return out


@numba.njit(cache=True)
def winding_numbers(points, vertices, faces):
    """(n,) how often the surface winds round each point: 1 inside, 0 outside (van Oosterom and Strackee, 1983)."""
    out = np.zeros(len(points))
    for i in range(len(points)):
        p = _row(points, i)
        for f in range(len(faces)):
            a = _minus(_row(vertices, faces[f, 0]), p)
            b = _minus(_row(vertices, faces[f, 1]), p)
            c = _minus(_row(vertices, faces[f, 2]), p)
            la, lb, lc = np.sqrt(_dot(a, a)), np.sqrt(_dot(b, b)), np.sqrt(_dot(c, c))
            below = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
            out[i] += np.arctan2(_dot(a, _cross(b, c)), below) / (2.0 * np.pi)
    return out
