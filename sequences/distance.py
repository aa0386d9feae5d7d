"""How far a point is from a mesh, and on which side: a signed distance field on a grid.

The sign is that of the generalised winding number (Jacobson, Kavan and Sorkine-Hornung, SIGGRAPH 2013), which forgives
holes and needs no consistent normals at edges; solid angles after van Oosterom and Strackee (IEEE Trans. Biomed. Eng.
1983).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from sequences.catalogue import Mesh

Array = NDArray[np.float64]

_SAMPLES = 20000


@dataclass(frozen=True)
class DistanceField:
    """Signed distances on a regular grid, linear between, in the mesh's frame."""

    origin: Array
    """(3,) of the first node, metres"""
    spacing_m: float
    values: NDArray[np.float32]
    """(nx, ny, nz) metres, negative inside"""

    def at(self, points: Array) -> Array:
        """Signed distance (...) at points (..., 3), metres; beyond the grid that of its border."""
        grid = (points - self.origin) / self.spacing_m
        return np.asarray(
            map_coordinates(self.values, np.moveaxis(grid, -1, 0), order=1, mode="nearest", output=np.float64)
        )

    def deepest(self, T_mesh_points: Array, points: Array) -> Array:
        """How deep the deepest of points (P, 3) lies inside at poses (K, 4, 4): (K,) metres, 0 where all are outside.

        What `at` says of all of them, without the K x P points in memory.
        """
        poses = np.ascontiguousarray(T_mesh_points, dtype=np.float64)
        return np.asarray(_deepest(poses, points, self.origin, 1.0 / self.spacing_m, self.values))


def distance_field(mesh: Mesh, nodes: int = 32) -> DistanceField:
    """Compute the field of a mesh with so many nodes along its longest side, a margin of two around it."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    spacing = float((high - low).max() / max(nodes - 5, 1))
    count = np.ceil((high - low) / spacing).astype(int) + 5
    origin = (low + high) / 2 - spacing * (count - 1) / 2
    axes = [origin[i] + spacing * np.arange(count[i]) for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = cKDTree(spread(mesh)).query(points)[0]
    inside = np.abs(_winding(points, mesh.vertices, mesh.faces)) > 0.5
    signed = np.where(inside, -distance, distance).astype(np.float32)
    return DistanceField(origin, spacing, signed.reshape(count))


def spread(mesh: Mesh) -> Array:
    """Points (n, 3) all over the surface, every face at a density of its area: a lattice of barycentric coordinates."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    per_side = np.maximum(np.ceil(np.sqrt(2.0 * _SAMPLES * area / max(area.sum(), 1e-12))), 1).astype(int)
    parts = []
    for n in np.unique(per_side):
        rows = per_side == n
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        u, v = i / n, j / n
        w = np.stack([1.0 - u - v, u, v])
        parts.append(np.einsum("kp,kfd->fpd", w, np.stack([a[rows], b[rows], c[rows]])).reshape(-1, 3))
    return np.concatenate(parts)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _deepest(poses, points, origin, inverse_spacing, values):
    out = np.zeros(poses.shape[0])
    last_x, last_y, last_z = values.shape[0] - 1.0, values.shape[1] - 1.0, values.shape[2] - 1.0
    for k in range(poses.shape[0]):
        T, lowest = poses[k], 0.0
        for p in range(points.shape[0]):
            a, b, c = points[p, 0], points[p, 1], points[p, 2]
            x = (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3] - origin[0]) * inverse_spacing
            y = (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3] - origin[1]) * inverse_spacing
            z = (T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3] - origin[2]) * inverse_spacing
            # the grid's border lies outside of the mesh
            if not (0.0 <= x < last_x and 0.0 <= y < last_y and 0.0 <= z < last_z):
                continue
            i, j, m = int(x), int(y), int(z)
            u, v, w = x - i, y - j, z - m
            near = (1.0 - v) * ((1.0 - w) * values[i, j, m] + w * values[i, j, m + 1])
            near += v * ((1.0 - w) * values[i, j + 1, m] + w * values[i, j + 1, m + 1])
            far = (1.0 - v) * ((1.0 - w) * values[i + 1, j, m] + w * values[i + 1, j, m + 1])
            far += v * ((1.0 - w) * values[i + 1, j + 1, m] + w * values[i + 1, j + 1, m + 1])
            lowest = min(lowest, (1.0 - u) * near + u * far)
        out[k] = -lowest
    return out


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _winding(points, vertices, faces):
    out = np.zeros(points.shape[0])
    for p in numba.prange(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        total = 0.0
        for f in range(faces.shape[0]):
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, az = vertices[i, 0] - x, vertices[i, 1] - y, vertices[i, 2] - z
            bx, by, bz = vertices[j, 0] - x, vertices[j, 1] - y, vertices[j, 2] - z
            cx, cy, cz = vertices[k, 0] - x, vertices[k, 1] - y, vertices[k, 2] - z
            la = np.sqrt(ax * ax + ay * ay + az * az)
            lb = np.sqrt(bx * bx + by * by + bz * bz)
            lc = np.sqrt(cx * cx + cy * cy + cz * cz)
            volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            flat = la * lb * lc
            flat += (ax * bx + ay * by + az * bz) * lc
            flat += (bx * cx + by * cy + bz * cz) * la
            flat += (cx * ax + cy * ay + cz * az) * lb
            total += np.arctan2(volume, flat)
        out[p] = total / (2.0 * np.pi)
    return out
