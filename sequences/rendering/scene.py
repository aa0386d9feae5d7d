"""Images of many things at once: depth, which thing, which face, and a colour image of them. No OpenGL.

The simulator, the report and the notebooks draw with these; the estimators score with the tile kernels of
`sequences.rendering.kernels`, whose sampling they share: pixels at their centres, 1/z linear within a triangle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.kernels import NEAR_M, rasterise
from sequences.rendering.rasteriser import intrinsics

Array = NDArray[np.float64]
Items = Sequence[tuple[Mesh, Array]]

AMBIENT = 0.35  # share of the light that comes from everywhere, the rest from the camera


class SceneImages(NamedTuple):
    """What each pixel of a camera sees, (height, width) each."""

    depth: NDArray[np.float32]
    """metres along z, 0 where nothing is"""
    item: NDArray[np.int32]
    """position in the list of things, -1 where nothing is"""
    face: NDArray[np.int32]
    """face of that thing's mesh, -1 where nothing is"""


def render_scene(items: Items, camera: Camera) -> SceneImages:
    """Draw things into one image, the nearest surface winning, equal ones the earlier thing.

    Args:
        items: pairs of mesh and T_camera_object (4, 4), metres. Faces are seen from both sides; what reaches behind the
            near plane (`kernels.NEAR_M`) is cut there.
        camera: the image; a window of it (`Camera.window`) does as well.
    """
    vertices, faces, offsets = _in_camera(items)
    projected, drawn, origin = _clip_and_project(vertices, faces, intrinsics(camera))
    inverse_depth = np.zeros((camera.height, camera.width))
    ids = np.full((camera.height, camera.width), -1, dtype=np.int32)
    rasterise(projected, drawn, False, np.empty((2, len(drawn) + 1), dtype=np.int32), inverse_depth, ids)
    return _unpack(inverse_depth, ids, origin, offsets)


def shade(
    items: Items,
    camera: Camera,
    images: SceneImages,
    background: tuple[int, int, int] | NDArray[np.uint8] = (255, 255, 255),
) -> NDArray[np.uint8]:
    """Colour image (height, width, 3) uint8 RGB of what `render_scene` drew: Lambert's law, the light at the camera.

    Args:
        items: as given to `render_scene`. The colours of their vertices are interpolated over each face.
        camera: as given to `render_scene`.
        images: what it returned for them.
        background: RGB, or an image (height, width, 3), where nothing is.
    """
    out = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    out[:] = np.asarray(background, dtype=np.uint8)
    vertices, faces, offsets = _in_camera(items)
    colours = [np.ascontiguousarray(mesh.colours, dtype=np.uint8).reshape(-1, 3) for mesh, _ in items]
    colours.append(np.zeros((0, 3), dtype=np.uint8))
    _shade(vertices, faces, np.concatenate(colours), offsets, intrinsics(camera), *images, out)
    return out


def _in_camera(items: Items) -> tuple[Array, NDArray[np.int32], NDArray[np.int64]]:
    """All vertices (V, 3) in the camera frame, all faces (F, 3), and the first face of each thing (n + 1,)."""
    vertices, faces, start = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int32)], 0
    offsets = np.zeros(len(items) + 1, dtype=np.int64)
    for k, (mesh, T_camera_object) in enumerate(items):
        vertices.append(se3.transform(np.asarray(T_camera_object, dtype=np.float64), mesh.vertices))
        faces.append(mesh.faces.astype(np.int32) + np.int32(start))
        start += len(mesh.vertices)
        offsets[k + 1] = offsets[k] + len(mesh.faces)
    return np.concatenate(vertices), np.concatenate(faces), offsets


@numba.njit(cache=True, nogil=True)
def _clip_and_project(vertices, faces, intrinsics):
    """Cut faces at the near plane.

    Args:
        vertices: (V, 3) in the camera frame, metres.
        faces: (F, 3).
        intrinsics: (4,) fx, fy, cx, cy.

    Returns:
        Projected vertices (3, V') u, v, 1/z, faces (F', 3) of them, and the face (F',) each is a part of.
    """
    n = faces.shape[0]
    crossing = 0
    for f in range(n):
        inside = 0
        for k in range(3):
            inside += vertices[faces[f, k], 2] > NEAR_M
        crossing += 0 < inside < 3
    points = np.empty((vertices.shape[0] + 2 * crossing, 3))
    points[: vertices.shape[0]] = vertices
    drawn, origin = np.empty((n + crossing, 3), np.int32), np.empty(n + crossing, np.int32)
    used, count = vertices.shape[0], 0
    corners = np.empty(4, np.int32)
    for f in range(n):
        size = 0
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            za, zb = vertices[a, 2], vertices[b, 2]
            if za > NEAR_M:
                corners[size] = a
                size += 1
            if (za > NEAR_M) != (zb > NEAR_M):
                share = (NEAR_M - za) / (zb - za)
                for d in range(3):
                    points[used, d] = vertices[a, d] + share * (vertices[b, d] - vertices[a, d])
                corners[size] = used
                used += 1
                size += 1
        for k in range(2, size):
            drawn[count, 0], drawn[count, 1], drawn[count, 2] = corners[0], corners[k - 1], corners[k]
            origin[count] = f
            count += 1
    fx, fy, cx, cy = intrinsics
    projected = np.zeros((3, used))
    for i in range(used):
        if points[i, 2] > 0.0:
            w = 1.0 / points[i, 2]
            projected[0, i], projected[1, i], projected[2, i] = (
                fx * points[i, 0] * w + cx,
                fy * points[i, 1] * w + cy,
                w,
            )
    return projected, drawn[:count], origin[:count]


@numba.njit(cache=True, nogil=True)
def _unpack_into(inverse_depth, ids, origin, offsets, depth, item, face):
    for v in range(ids.shape[0]):
        for u in range(ids.shape[1]):
            if ids[v, u] >= 0:
                f = origin[ids[v, u]]
                k = np.searchsorted(offsets, f, side="right") - 1
                depth[v, u], item[v, u], face[v, u] = 1.0 / inverse_depth[v, u], k, f - offsets[k]


def _unpack(
    inverse_depth: Array, ids: NDArray[np.int32], origin: NDArray[np.int32], offsets: NDArray[np.int64]
) -> SceneImages:
    depth = np.zeros(ids.shape, dtype=np.float32)
    item, face = np.full(ids.shape, -1, dtype=np.int32), np.full(ids.shape, -1, dtype=np.int32)
    _unpack_into(inverse_depth, ids, origin, offsets, depth, item, face)
    return SceneImages(depth, item, face)


@numba.njit(inline="always")
def _subtract(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(inline="always")
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shade(vertices, faces, colours, offsets, intrinsics, depth, item, face, out):
    fx, fy, cx, cy = intrinsics
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if item[v, u] < 0:
                continue
            f = offsets[item[v, u]] + face[v, u]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            x, y = (u - cx) / fx, (v - cy) / fy
            along = _subtract(vertices[b], vertices[a])
            across = _subtract(vertices[c], vertices[a])
            normal = _cross(along, across)
            # the pixel's point in the face's plane, and its barycentric coordinates by areas
            z = depth[v, u]
            point = (x * z - vertices[a, 0], y * z - vertices[a, 1], z - vertices[a, 2])
            square = _dot(normal, normal)
            lb = min(max(_dot(_cross(point, across), normal) / square, 0.0), 1.0)
            lc = min(max(_dot(_cross(along, point), normal) / square, 0.0), 1.0 - lb)
            cosine = abs(_dot(normal, (x, y, 1.0))) / np.sqrt(square * (x * x + y * y + 1.0))
            light = AMBIENT + (1.0 - AMBIENT) * cosine
            for d in range(3):
                base = colours[a, d] * (1.0 - lb - lc) + colours[b, d] * lb + colours[c, d] * lc
                out[v, u, d] = np.uint8(light * base + 0.5)
