"""Surfaces that nobody modelled: the planes of a depth image, and which way is up."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlaneSearch:
    """How `find_planes` looks for planes."""

    samples_across: int = 96
    """of the image's width, at least so many"""
    candidates: int = 150
    """oriented points tried a plane"""
    tolerance_per_m: float = 0.012
    """distance of an inlier from its plane, metres for each metre of depth"""
    normal_tolerance_rad: float = 0.35
    """angle of an inlier's normal to the plane's"""
    min_share: float = 0.04
    """least share of the measured samples on a plane"""
    max_planes: int = 4
    margin_m: float = 0.02
    """by which outlines reach beyond their points"""


@dataclass(frozen=True)
class Plane:
    """A bounded piece of the plane n . p = offset."""

    normal: Array
    """(3,) unit, towards the camera that saw it"""
    offset: float
    """metres along the normal"""
    T_frame_plane: Array
    """(4, 4) z along the normal, origin at the mean of its points"""
    hull: Array
    """(H, 2) convex outline in the plane's x and y, metres, margin included"""
    share: float
    """of the image's samples that have a normal, those that lie on it"""

    @property
    def area(self) -> float:
        """Of the outline, square metres."""
        return float(cv2.contourArea(self.hull.astype(np.float32)))

    def moved(self, T: Array) -> Plane:
        """The same plane in another frame, T_other_frame (4, 4)."""
        normal = T[:3, :3] @ self.normal
        pose = T @ self.T_frame_plane
        return Plane(normal, float(normal @ pose[:3, 3]), pose, self.hull, self.share)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether the feet of points (..., 3) lie within the outline."""
        local = se3.transform(se3.inverse(self.T_frame_plane), points)[..., :2]
        within = np.asarray(((local >= self.hull.min(axis=0)) & (local <= self.hull.max(axis=0))).all(axis=-1))
        edge, offset = np.roll(self.hull, -1, axis=0) - self.hull, local[within][:, None] - self.hull
        side = edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0]
        within[within] = (side >= 0).all(-1) | (side <= 0).all(-1)
        return within


def find_planes(
    camera: Camera, depth: NDArray[np.float32], rng: np.random.Generator, search: PlaneSearch | None = None
) -> tuple[Plane, ...]:
    """Dominant planes of one depth image in the camera frame, largest first (RANSAC on oriented points).

    Args:
        camera: intrinsics.
        depth: (h, w) metres, 0 = no measurement.
        rng: draws the candidates.
        search: settings.
    """
    search = search or PlaneSearch()
    step = max(1, camera.width // search.samples_across)
    window = camera.window(0, 0, -(-camera.width // step), -(-camera.height // step), step)
    grid = window.points(depth[::step, ::step])
    normals, valid = _normals(grid)
    points, normals = grid[valid], normals[valid]
    least = search.min_share * max(1, int((depth[::step, ::step] > 0).sum()))
    planes: list[Plane] = []
    total = len(points)
    while len(planes) < search.max_planes and len(points) > least:
        inliers = _best_candidate(points, normals, rng, search)
        if inliers.sum() < least:
            break
        planes.append(_fit(points[inliers], search, inliers.sum() / total))
        points, normals = points[~inliers], normals[~inliers]
    return tuple(planes)


def plane_depth(planes: tuple[Plane, ...], camera: Camera) -> NDArray[np.float32]:
    """Depth (h, w) of the nearest plane along each pixel's ray, metres; 0 where none is hit within its outline."""
    nearest = np.full((camera.height, camera.width), np.inf)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for plane in planes:
        _draw_plane(intrinsics, plane.normal, plane.offset, se3.inverse(plane.T_frame_plane), plane.hull, nearest)
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw_plane(intrinsics, normal, offset, T_plane_frame, hull, nearest):
    """Lower `nearest` (h, w), depths along z, to the plane's wherever a pixel's ray meets it within its hull."""
    low_x, high_x, low_y, high_y = hull[:, 0].min(), hull[:, 0].max(), hull[:, 1].min(), hull[:, 1].max()
    for v in range(nearest.shape[0]):
        for u in range(nearest.shape[1]):
            rx, ry = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
            z = offset / (rx * normal[0] + ry * normal[1] + normal[2])
            if not (0.0 < z < nearest[v, u]):
                continue
            x = z * rx * T_plane_frame[0, 0] + z * ry * T_plane_frame[0, 1] + z * T_plane_frame[0, 2]
            y = z * rx * T_plane_frame[1, 0] + z * ry * T_plane_frame[1, 1] + z * T_plane_frame[1, 2]
            x, y = x + T_plane_frame[0, 3], y + T_plane_frame[1, 3]
            if not (low_x <= x <= high_x and low_y <= y <= high_y):
                continue
            left, right = True, True
            for i in range(len(hull)):
                j = i + 1 if i + 1 < len(hull) else 0
                side = (hull[j, 0] - hull[i, 0]) * (y - hull[i, 1]) - (hull[j, 1] - hull[i, 1]) * (x - hull[i, 0])
                left &= side >= 0.0
                right &= side <= 0.0
            if left or right:
                nearest[v, u] = z


def up_from_planes(planes: tuple[Plane, ...], up_guess: Array, max_angle_rad: float = 1.2) -> Array | None:
    """The normal of the largest plane that could be level: within an angle of a guess (3,), or None."""
    level = [p for p in planes if p.normal @ up_guess > np.cos(max_angle_rad)]
    # a camera is held more or less upright: of two large planes the one nearer to the guess is the ground
    best = max(level, key=lambda p: p.share * float(p.normal @ up_guess), default=None)
    return None if best is None else best.normal


def _normals(grid: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Normals (h, w, 3) towards the camera by central differences over two samples, and where they can be trusted."""
    valid = grid[..., 2] > 0
    across, down = np.zeros_like(grid), np.zeros_like(grid)
    across[:, 2:-2] = grid[:, 4:] - grid[:, :-4]
    down[2:-2] = grid[4:] - grid[:-4]
    usable = valid.copy()
    usable[:, 2:-2] &= valid[:, 4:] & valid[:, :-4]
    usable[2:-2] &= valid[4:] & valid[:-4]
    usable[:2], usable[-2:], usable[:, :2], usable[:, -2:] = False, False, False, False
    # a jump in depth has no normal
    jump = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2]))
    usable &= jump < 0.15 * np.where(valid, grid[..., 2], 1.0)
    normals = np.cross(across, down)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    usable &= length[..., 0] > 0
    normals = normals / np.where(length == 0, 1.0, length)
    towards = np.sign(-(normals * grid).sum(-1, keepdims=True))
    return normals * np.where(towards == 0, 1.0, towards), usable


def _best_candidate(points: Array, normals: Array, rng: np.random.Generator, search: PlaneSearch) -> NDArray[np.bool_]:
    picks = rng.integers(len(points), size=search.candidates)
    tolerance, parallel = search.tolerance_per_m * points[:, 2], float(np.cos(search.normal_tolerance_rad))
    inliers = _most_supported(points, normals, picks, tolerance, parallel)
    for _ in range(3):
        centre, normal = _least_squares(points[inliers])
        distance = np.abs((points - centre) @ normal)
        inliers = (distance < tolerance) & (np.abs(normals @ normal) > parallel)
        if inliers.sum() < 10:
            break
    return np.asarray(inliers)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _most_supported(points, normals, picks, tolerance, parallel):
    """Which points (n,) lie in the plane of the picked one that most do, within a distance each and a cosine."""
    near, inliers, most = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_), -1
    xs, ys, zs = points.T.copy()
    us, vs, ws = normals.T.copy()
    for pick in picks:
        a, b, c = normals[pick]
        offset, count = a * xs[pick] + b * ys[pick] + c * zs[pick], 0
        for i in range(len(points)):
            distance = abs(a * xs[i] + b * ys[i] + c * zs[i] - offset)
            near[i] = (distance < tolerance[i]) & (a * us[i] + b * vs[i] + c * ws[i] > parallel)
            count += near[i]
        if count > most:
            most = count
            inliers[:] = near
    return inliers


def _least_squares(points: Array) -> tuple[Array, Array]:
    """Mean (3,) and unit normal (3,) towards the origin of a plane through points (n, 3)."""
    centre = points.mean(0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    return centre, normal if normal @ centre < 0 else -normal


def _fit(points: Array, search: PlaneSearch, share: float) -> Plane:
    centre, normal = _least_squares(points)
    x = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    T = se3.make(np.stack([x, np.cross(normal, x), normal], axis=-1), centre)
    flat = se3.transform(se3.inverse(T), points)[:, :2]
    hull = cv2.convexHull(flat.astype(np.float32))[:, 0].astype(np.float64)
    middle = hull.mean(0)
    outward = (hull - middle) / np.linalg.norm(hull - middle, axis=-1, keepdims=True)
    return Plane(normal, float(normal @ centre), T, hull + search.margin_m * outward, float(share))
