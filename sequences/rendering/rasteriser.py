"""A numba z-buffer: the renderer the estimators score with. No OpenGL, no system library.

Within a triangle 1/z is linear in the image, so it is interpolated with the edge functions (Pineda, SIGGRAPH 1988);
pixels are sampled at their centres, which lie at whole numbers. Triangles that reach behind the near plane are left
out: a hypothesis so close to the camera is not one.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sequences.camera import Camera
from sequences.catalogue import Mesh

Array = NDArray[np.float64]

NEAR_M = 0.05


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def project(vertices, T, fx, fy, cx, cy, projected):
    """Vertices (V, 3), T_camera_object (4, 4) -> projected (V, 3): u, v, 1/z (0 in front of the near plane)."""
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        zc = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if zc > NEAR_M:
            w = 1.0 / zc
            projected[i, 0] = fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) * w + cx
            projected[i, 1] = fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) * w + cy
            projected[i, 2] = w
        else:
            projected[i, 2] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def rasterise(projected, faces, inverse_depth, face_ids):
    """Draw triangles into a buffer of inverse depth, the nearest surface winning.

    Args:
        projected: (V, 3) from `project`.
        faces: (F, 3).
        inverse_depth: (h, w), updated in place; 0 = nothing.
        face_ids: (h, w), updated in place with the face that won; a (0, 0) array where nobody wants them.
    """
    height, width = inverse_depth.shape
    want_ids = face_ids.shape[0] > 0
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        wa, wb, wc = projected[a, 2], projected[b, 2], projected[c, 2]
        if wa == 0.0 or wb == 0.0 or wc == 0.0:
            continue
        ua, va = projected[a, 0], projected[a, 1]
        ub, vb = projected[b, 0], projected[b, 1]
        uc, vc = projected[c, 0], projected[c, 1]
        u0, u1 = max(0, int(np.ceil(min(ua, ub, uc)))), min(width - 1, int(np.floor(max(ua, ub, uc))))
        if u1 < u0:
            continue
        v0, v1 = max(0, int(np.ceil(min(va, vb, vc)))), min(height - 1, int(np.floor(max(va, vb, vc))))
        if v1 < v0:
            continue
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if area == 0.0:
            continue
        scale = 1.0 / area
        # barycentric coordinates of b and c and their steps along u and v
        bu, bv = (vc - va) * scale, (ua - uc) * scale
        cu, cv = (va - vb) * scale, (ub - ua) * scale
        wu, wv = bu * (wb - wa) + cu * (wc - wa), bv * (wb - wa) + cv * (wc - wa)
        for v in range(v0, v1 + 1):
            dv = v - va
            for u in range(u0, u1 + 1):
                du = u - ua
                lb = bu * du + bv * dv
                lc = cu * du + cv * dv
                if lb >= 0.0 and lc >= 0.0 and lb + lc <= 1.0:
                    w = wa + wu * du + wv * dv
                    if w > inverse_depth[v, u]:
                        inverse_depth[v, u] = w
                        if want_ids:
                            face_ids[v, u] = f


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _render(vertices, faces, poses, intrinsics, depth):
    for k in numba.prange(poses.shape[0]):
        projected = np.empty((vertices.shape[0], 3))
        inverse_depth = np.zeros(depth.shape[1:])
        project(vertices, poses[k], intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], projected)
        rasterise(projected, faces, inverse_depth, np.empty((0, 0), np.int32))
        for v in range(depth.shape[1]):
            for u in range(depth.shape[2]):
                if inverse_depth[v, u] > 0.0:
                    depth[k, v, u] = 1.0 / inverse_depth[v, u]


class Rasteriser:
    """The numba z-buffer behind the `DepthRenderer` protocol."""

    name = "rasteriser"

    def available(self) -> str | None:
        """None: it needs nothing from the system."""
        return None

    def render(self, mesh: Mesh, camera: Camera, T_camera_object: Array) -> NDArray[np.float32]:
        """See `DepthRenderer.render`."""
        poses = np.ascontiguousarray(T_camera_object, dtype=np.float64).reshape(-1, 4, 4)
        depth = np.zeros((len(poses), camera.height, camera.width), dtype=np.float32)
        _render(mesh.vertices, mesh.faces, poses, intrinsics(camera), depth)
        return depth


def intrinsics(camera: Camera) -> Array:
    """(4,) fx, fy, cx, cy as the kernels take them."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
