"""The numba z-buffer behind the `DepthRenderer` protocol: no OpenGL, no system library."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.kernels import project, rasterise

Array = NDArray[np.float64]

PART = 16
"""poses that share what a kernel works in"""


class Rasteriser:
    """The renderer that the estimators score with."""

    name = "rasteriser"

    def available(self) -> str | None:
        """None: it needs nothing from the system."""
        return None

    def render(self, mesh: Mesh, camera: Camera, T_camera_object: Array) -> NDArray[np.float32]:
        """See `DepthRenderer.render`."""
        poses = np.ascontiguousarray(T_camera_object, dtype=np.float64).reshape(-1, 4, 4)
        depth = np.empty((len(poses), camera.height, camera.width), dtype=np.float32)
        _render(coordinates(mesh), mesh.faces, mesh.is_solid, poses, intrinsics(camera), depth)
        return depth


def coordinates(mesh: Mesh) -> Array:
    """(3, V) the vertices' x, y and z as the kernels take them."""
    return np.ascontiguousarray(mesh.vertices.T, dtype=np.float64)


def intrinsics(camera: Camera) -> Array:
    """(4,) fx, fy, cx, cy as the kernels take them."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _render(vertices, faces, solid, poses, intrinsics, depth):
    for part in numba.prange((len(poses) + PART - 1) // PART):
        projected, inverse_depth = np.empty(vertices.shape), np.empty(depth.shape[1:])
        chosen = np.empty((2, len(faces) + 1), np.int32)
        for k in range(part * PART, min(part * PART + PART, len(poses))):
            inverse_depth[:] = 0.0
            project(vertices, poses[k], intrinsics, projected)
            rasterise(projected, faces, solid, chosen, inverse_depth, None)
            for v in range(depth.shape[1]):
                for u in range(depth.shape[2]):
                    w = inverse_depth[v, u]
                    depth[k, v, u] = 1.0 / w if w > 0.0 else 0.0
