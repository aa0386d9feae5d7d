"""Batches of motions, compiled: what the estimators do with many poses at a time.

The same maths as `sequences.se3`, which makes some twenty passes over an array where a loop makes one, and whose last
bits the simulator's recordings hang on. The tests hold both to each other.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SMALL_RAD = 1e-4  # below it the series is exact to the last bit


@numba.njit(cache=True, nogil=True, error_model="numpy")
def compiled_retract(T, xi, out):
    """T exp(xi) of n motions (n, 4, 4) or one (1, 4, 4), and tangents (n, 6), into `out` (n, 4, 4).

    With the rotation vector w = a u, exp(w) = I + s W + k W^2 and V = I + k W + m W^2 (Barfoot, 7.15 and 7.86).
    """
    E = np.empty((3, 4))
    for n in range(len(xi)):
        x, y, z = xi[n, 0], xi[n, 1], xi[n, 2]
        p, q, r = xi[n, 3], xi[n, 4], xi[n, 5]
        a2 = x * x + y * y + z * z
        a = math.sqrt(a2)
        if a < _SMALL_RAD:
            s, k, m = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
        else:
            half = math.sin(0.5 * a)
            s, k = math.sin(a) / a, 2.0 * half * half / a2
            m = (1.0 - s) / a2
        E[0, 0], E[0, 1], E[0, 2] = 1.0 - k * (y * y + z * z), k * x * y - s * z, k * x * z + s * y
        E[1, 0], E[1, 1], E[1, 2] = k * x * y + s * z, 1.0 - k * (x * x + z * z), k * y * z - s * x
        E[2, 0], E[2, 1], E[2, 2] = k * x * z - s * y, k * y * z + s * x, 1.0 - k * (x * x + y * y)
        # w x t, and w x (w x t)
        b, c, d = y * r - z * q, z * p - x * r, x * q - y * p
        E[0, 3] = p + k * b + m * (y * d - z * c)
        E[1, 3] = q + k * c + m * (z * b - x * d)
        E[2, 3] = r + k * d + m * (x * c - y * b)
        A = T[n if len(T) > 1 else 0]
        for i in range(3):
            for j in range(4):
                out[n, i, j] = A[i, 0] * E[0, j] + A[i, 1] * E[1, j] + A[i, 2] * E[2, j]
            out[n, i, 3] += A[i, 3]
        out[n, 3, 0] = out[n, 3, 1] = out[n, 3, 2] = 0.0
        out[n, 3, 3] = 1.0


def retract(T: ArrayLike, xi: ArrayLike) -> Array:
    """T exp(xi): poses (..., 4, 4) and right tangents (..., 6) [rotation, translation], which broadcast."""
    poses, tangents = np.asarray(T, dtype=np.float64), np.asarray(xi, dtype=np.float64)
    batch = np.broadcast_shapes(poses.shape[:-2], tangents.shape[:-1])
    if tangents.shape[:-1] != batch:
        tangents = filled(tangents, (*batch, 6))
    if poses.size != 16 and poses.shape[:-2] != batch:
        poses = filled(poses, (*batch, 4, 4))
    out = np.empty((*batch, 4, 4))
    compiled_retract(
        np.ascontiguousarray(poses).reshape(-1, 4, 4),
        np.ascontiguousarray(tangents).reshape(-1, 6),
        out.reshape(-1, 4, 4),
    )
    return out


def filled(values: Array, shape: tuple[int, ...]) -> Array:
    """Values broadcast to a shape, as a copy: a broadcast view has another type for a compiled kernel, or warns."""
    out = np.empty(shape)
    out[...] = values
    return out
