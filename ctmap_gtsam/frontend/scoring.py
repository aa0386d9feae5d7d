"""Hypotheses against a depth image: the fused kernel that renders and scores, and the local refinement.

Both work on a `Tile`, a part of the depth image sampled at a fixed angular step, so that the number of samples on an
object depends on how large it appears and not on the camera's resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from factors.measurement import pixel_past, pixel_ratio, pixel_reach, pixel_without_object
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.geometry import Plane, plane_depth
from sequences.rendering.kernels import project, rasterise
from sequences.rendering.rasteriser import PART, coordinates, intrinsics

Array = NDArray[np.float64]

_SMALL, _LARGE = 1e-200, 1e200  # a pixel's ratio is far from both, so that a product can't leave float64 between tests


@dataclass(frozen=True)
class Tile:
    """Part of one depth image, every step-th pixel."""

    camera: Camera
    """the window's own camera"""
    depth: NDArray[np.float32]
    """(h, w) metres, 0 = no measurement"""
    background: NDArray[np.float32]
    """(h, w) metres: the depth of the surface behind, 0 where none is known"""
    x: int
    """left column of the window in the image"""
    y: int
    """top row of the window in the image"""
    step: int
    """pixels between samples"""
    _shared: dict[tuple[float, ...], tuple[Array, Array]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """parameters -> what all hypotheses of the tile share: worked out once, it is scored many times"""

    def __reduce__(self) -> tuple[Any, ...]:
        """Sent without what is worked out again: seven times the rest."""
        return Tile, (self.camera, self.depth, self.background, self.x, self.y, self.step)

    def without_object(self, parameters: tuple[float, ...]) -> tuple[Array, Array]:
        """What a sample says without the object (h w, 6), and the log ratio where it is seen past (h w,)."""
        if parameters not in self._shared:
            self._shared[parameters] = _without_object(self.depth.ravel(), self.background.ravel(), parameters)
        return self._shared[parameters]


def cut_tile(
    camera: Camera,
    depth: NDArray[np.float32],
    planes: tuple[Plane, ...],
    box: Array,
    step: int,
) -> Tile:
    """The part of a depth image (h, w) within a box (x0, y0, x1, y1), clipped to the image, at least one sample.

    The background is the nearest of the planes, which are in the camera frame.
    """
    x0, y0 = (int(np.clip(np.floor(box[i]), 0, size - 1)) for i, size in ((0, camera.width), (1, camera.height)))
    x1 = int(np.clip(np.ceil(box[2]), x0 + 1, camera.width))
    y1 = int(np.clip(np.ceil(box[3]), y0 + 1, camera.height))
    part = (slice(y0, y1, step), slice(x0, x1, step))
    cut = np.ascontiguousarray(depth[part])
    window = camera.window(x0, y0, cut.shape[1], cut.shape[0], step)
    return Tile(window, cut, plane_depth(planes, window), x0, y0, step)


def coarser(tile: Tile, by: int) -> Tile:
    """Every by-th sample of a tile, across and down: where many hypotheses are looked at for the first time."""
    depth = np.ascontiguousarray(tile.depth[::by, ::by])
    window = tile.camera.window(0, 0, depth.shape[1], depth.shape[0], by)
    return Tile(window, depth, np.ascontiguousarray(tile.background[::by, ::by]), tile.x, tile.y, tile.step * by)


@dataclass(frozen=True)
class Scores:
    """What the fused kernel says of K hypotheses."""

    log_ratio: Array
    """(K,) sum over pixels of log p(z | object) / p(z | background), not yet tempered"""
    covered: Array
    """(K,) samples that the object covers"""
    visible: Array
    """(K,) of those, samples with a measurement that is not in front of the object"""
    box: Array
    """(K, 4) enclosing box (x0, y0, x1, y1) of the visible samples in image pixels; NaN where there are none"""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _without_object(z, background, parameters):
    """What all hypotheses of a tile share: `pixel_without_object` (n, 6), and the log ratio where seen past (n,)."""
    without, past = np.empty((z.size, 6)), np.zeros(z.size)
    for p in range(z.size):
        constants = pixel_without_object(z[p], background[p], parameters)
        for i in range(6):
            without[p, i] = constants[i]
        if z[p] > 0.0:
            past[p] = math.log(pixel_past(constants, parameters))
    return without, past


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _extent(projected, height, width):
    """Rows and columns [v0, v1), [u0, u1) of an image that projected points (3, V) may reach, a pixel to spare.

    What lies outside need not be cleared nor read: most of a tile, as its box has a margin and hypotheses lie anywhere.
    """
    us, vs = projected[0], projected[1]
    left, right, top, bottom = us[0], us[0], vs[0], vs[0]
    for i in range(1, us.size):
        left, right = min(left, us[i]), max(right, us[i])
        top, bottom = min(top, vs[i]), max(bottom, vs[i])
    u0, u1 = np.int64(min(max(left - 1.0, 0.0), width)), np.int64(max(min(right + 2.0, width), 0.0))
    v0, v1 = np.int64(min(max(top - 1.0, 0.0), height)), np.int64(max(min(bottom + 2.0, height), 0.0))
    return v0, v1, u0, u1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _score_tile(inverse_depth, extent, zs, without, past, parameters, margin, near_pixel, near_depth, out):
    """Score one tile (h, w), rendered within `extent`, on measurements (h w,).

    `out` is (7,): log ratio, covered, visible, box in the tile.
    `near_pixel` and `near_depth` are (h w + 1,) to work in.
    """
    height, width = inverse_depth.shape
    near, covered, visible = np.uintp(0), 0, 0
    total = 0.0
    u0, v0, u1, v1 = width, height, -1, -1
    # without branches that pixels would take at random; those near the surface are kept for a loop of their own
    for v in range(extent[0], extent[1]):
        first, last = width, -1
        for u in range(extent[2], extent[3]):
            w = inverse_depth[v, u]
            if w == 0.0:
                continue
            p = np.uintp(v * width + u)
            z, rendered = zs[p], 1.0 / w
            gap, reach = z - rendered, pixel_reach(rendered, parameters)
            measured = z > 0.0
            total += past[p] if gap > reach else 0.0
            near_pixel[near], near_depth[near] = p, rendered
            near += np.uintp(measured & (abs(gap) <= reach))
            seen = measured & (gap > -margin)
            covered += 1
            visible += seen
            first, last = min(first, u if seen else width), max(last, u if seen else -1)
        u0, u1 = min(u0, first), max(u1, last)
        v0, v1 = min(v0, v if last >= 0 else height), v if last >= 0 else v1
    product = 1.0
    for i in range(near):
        p = np.uintp(near_pixel[i])
        shared = (without[p, 0], without[p, 1], without[p, 2], without[p, 3], without[p, 4], without[p, 5])
        product *= pixel_ratio(zs[p], near_depth[i], shared, parameters)
        if not _SMALL < product < _LARGE:  # one logarithm for many pixels
            total += math.log(product)
            product = 1.0
    out[0], out[1], out[2] = total + math.log(product), covered, visible
    out[3], out[4], out[5], out[6] = u0, v0, u1, v1


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _score(vertices, faces, solid, poses, camera, depth, without, past, parameters, margin, window, out):
    zs = depth.ravel()
    x, y, step = window
    for part in numba.prange((len(poses) + PART - 1) // PART):
        projected, inverse_depth = np.empty(vertices.shape), np.empty(depth.shape)
        chosen = np.empty((2, len(faces) + 1), np.int32)
        near_pixel, near_depth = np.empty(zs.size + 1, np.uint32), np.empty(zs.size + 1)
        for k in range(part * PART, min(part * PART + PART, len(poses))):
            project(vertices, poses[k], camera, projected)
            extent = _extent(projected, depth.shape[0], depth.shape[1])
            inverse_depth[extent[0] : extent[1], extent[2] : extent[3]] = 0.0
            rasterise(projected, faces, solid, chosen, inverse_depth, None)
            _score_tile(inverse_depth, extent, zs, without, past, parameters, margin, near_pixel, near_depth, out[k])
            # samples stand for step x step pixels
            for i, at, half in ((3, x, -step / 2.0), (4, y, -step / 2.0), (5, x, step / 2.0), (6, y, step / 2.0)):
                out[k, i] = out[k, i] * step + at + half if out[k, 2] > 0.0 else np.nan


def score_depth(
    mesh: Mesh, tile: Tile, T_camera_object: Array, parameters: tuple[float, ...], margin_m: float
) -> Scores:
    """Render hypotheses (K, 4, 4) of one class into a tile and sum the pixels' log-likelihood ratios.

    Args:
        mesh: the class's mesh (coarse is enough).
        tile: where to look.
        T_camera_object: (K, 4, 4) metres.
        parameters: of `factors.measurement.DepthModel`.
        margin_m: a measurement so far in front of the object is an occluder.
    """
    poses = np.ascontiguousarray(T_camera_object, dtype=np.float64)
    out = np.empty((len(poses), 7))
    camera = intrinsics(tile.camera)
    _score(
        coordinates(mesh),
        mesh.faces,
        mesh.is_solid,
        poses,
        camera,
        tile.depth,
        *tile.without_object(parameters),
        parameters,
        margin_m,
        (tile.x, tile.y, tile.step),
        out,
    )
    return Scores(out[:, 0], out[:, 1], out[:, 2], out[:, 3:])


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _differ(vertices, faces, solid, poses, camera, depth, out):
    for part in numba.prange((len(poses) + PART - 1) // PART):
        projected, inverse_depth = np.empty(vertices.shape), np.empty(depth.shape)
        chosen = np.empty((2, len(faces) + 1), np.int32)
        for k in range(part * PART, min(part * PART + PART, len(poses))):
            inverse_depth[:] = 0.0
            project(vertices, poses[k], camera, projected)
            rasterise(projected, faces, solid, chosen, inverse_depth, None)
            total = 0.0
            for v in range(depth.shape[0]):
                for u in range(depth.shape[1]):
                    if inverse_depth[v, u] > 0.0 and depth[v, u] > 0.0:
                        total += (depth[v, u] - 1.0 / inverse_depth[v, u]) ** 2
            out[k] = total


def squared_differences(mesh: Mesh, tile: Tile, T_camera_object: Array) -> Array:
    """d of Equation 6: the sum (K,) of squared depth differences between hypotheses (K, 4, 4) and a tile, m^2.

    Over the samples that the object covers and the sensor measured, however far behind or in front.
    """
    poses = np.ascontiguousarray(T_camera_object, dtype=np.float64)
    out = np.empty(len(poses))
    _differ(coordinates(mesh), mesh.faces, mesh.is_solid, poses, intrinsics(tile.camera), tile.depth, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(projected, faces, solid, chosen, normals, T, camera, depth, inverse_depth, ids, width_m, H, g):
    """Point-to-plane normal equations of one pose in its own right tangent; returns the sum of weights."""
    v0, v1, u0, u1 = _extent(projected, depth.shape[0], depth.shape[1])
    inverse_depth[v0:v1, u0:u1] = 0.0
    rasterise(projected, faces, solid, chosen, inverse_depth, ids)
    H[:] = 0.0
    g[:] = 0.0
    total = 0.0
    J = np.empty(6)
    for v in range(v0, v1):
        for u in range(u0, u1):
            w = inverse_depth[v, u]
            z = depth[v, u]
            if w == 0.0 or z == 0.0:
                continue
            gap = z - 1.0 / w
            if abs(gap) > 10.0 * width_m:
                continue
            n = normals[ids[v, u]]
            rx, ry = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
            # the observed point in the object frame
            dx, dy, dz = rx * z - T[0, 3], ry * z - T[1, 3], z - T[2, 3]
            px = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz
            py = T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz
            pz = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
            # the ray's direction in the object frame times n: distance to the plane from the gap along the ray
            along = (
                n[0] * (T[0, 0] * rx + T[1, 0] * ry + T[2, 0])
                + n[1] * (T[0, 1] * rx + T[1, 1] * ry + T[2, 1])
                + n[2] * (T[0, 2] * rx + T[1, 2] * ry + T[2, 2])
            )
            r = along * gap
            weight = 1.0 / (1.0 + (r / width_m) ** 2) ** 2
            J[0], J[1], J[2] = py * n[2] - pz * n[1], pz * n[0] - px * n[2], px * n[1] - py * n[0]
            J[3], J[4], J[5] = n[0], n[1], n[2]
            total += weight
            for i in range(6):
                g[i] += weight * J[i] * r
                for j in range(i + 1):
                    H[i, j] += weight * J[i] * J[j]
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _move(T, xi):
    """T exp(xi) in place, for the small steps of the refinement."""
    angle = np.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
    a = 1.0 - angle**2 / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    b = 0.5 - angle**2 / 24.0 if angle < 1e-4 else (1.0 - np.cos(angle)) / angle**2
    c = 1.0 / 6.0 if angle < 1e-4 else (angle - np.sin(angle)) / angle**3
    W = np.array([[0.0, -xi[2], xi[1]], [xi[2], 0.0, -xi[0]], [-xi[1], xi[0], 0.0]])
    W2 = W @ W
    E = np.eye(4)
    E[:3, :3] += a * W + b * W2
    E[:3, 3] = (np.eye(3) + b * W + c * W2) @ xi[3:]
    T[:] = T @ E


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _refine(vertices, faces, solid, normals, poses, camera, depth, widths, hessians):
    for k in numba.prange(poses.shape[0]):
        projected = np.empty(vertices.shape)
        chosen = np.empty((2, len(faces) + 1), np.int32)
        inverse_depth = np.empty(depth.shape)
        ids = np.zeros(depth.shape, np.int32)
        H, g = np.empty((6, 6)), np.empty(6)
        T = poses[k].copy()
        for step in range(widths.shape[0]):
            project(vertices, T, camera, projected)
            total = _normal_equations(
                projected, faces, solid, chosen, normals, T, camera, depth, inverse_depth, ids, widths[step], H, g
            )
            hessians[k] = H
            if total < 6.0:
                break
            for i in range(6):
                # a direction that the surface doesn't hold must not run away: a weak prior of 10 cm and 1 rad
                H[i, i] += 1e-3 * H[i, i] + (1e-4 if i < 3 else 1e-2) * total * 1e-2
            xi = np.linalg.solve(H, g)
            length = np.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
            shift = np.sqrt(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2)
            # the linearisation holds for some 15 degrees and about as far as depth is drawn to the surface
            xi *= min(1.0, 0.3 / max(length, 1e-12), max(0.03, widths[step]) / max(shift, 1e-12))
            _move(T, xi)
            if length < 1e-5 and shift < 1e-6:
                break
        poses[k] = T


def refine_on_depth(
    mesh: Mesh, normals: Array, tile: Tile, T_camera_object: Array, widths_m: Array
) -> tuple[Array, Array]:
    """Projective point-to-plane registration of hypotheses (K, 4, 4) to a tile's depth (Chen and Medioni, 1991).

    The observed points of the pixels that the object covers are drawn to the faces rendered there, with Geman-McClure
    weights whose width falls from step to step (graduated non-convexity).

    Args:
        mesh: the class's mesh.
        normals: (F, 3) unit normals of its faces, object frame.
        tile: where to look.
        T_camera_object: (K, 4, 4) starts.
        widths_m: (steps,) the robust width at each step, metres.

    Returns:
        (K, 4, 4) refined poses, not all better than their start: score them; and (K, 6, 6) the J^T W J of the last
        normal equations.
    """
    poses = np.array(T_camera_object, dtype=np.float64, order="C")
    camera = intrinsics(tile.camera)
    hessians = np.zeros((len(poses), 6, 6))
    widths = np.asarray(widths_m, dtype=np.float64)
    _refine(coordinates(mesh), mesh.faces, mesh.is_solid, normals, poses, camera, tile.depth, widths, hessians)
    return poses, hessians
