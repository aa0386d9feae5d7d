"""Colour images of a visit: a lamp under the ceiling, daylight through a window, soft shadows, and no OpenGL.

Surfaces scatter light under Lambert's law and, as far as they are glossy, mirror it about the half vector (Blinn,
Models of light reflection for computer synthesized pictures, SIGGRAPH 1977). Lamp and window are sampled at points,
each with a shadow map (Williams, Casting curved shadows on curved surfaces, SIGGRAPH 1978); the rest of the light comes
from a hemisphere that is brighter above.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.rasteriser import intrinsics
from sequences.rendering.scene import render_scene

Array = NDArray[np.float64]

CREASE_RAD = 0.8  # faces that meet at a sharper edge are not shaded as one smooth surface
LAMP_RADIUS_M = 0.35
LAMP_SAMPLES = 18
WINDOW_SAMPLES = 12
SHADOW_MAP = Camera(fx=300.0, fy=300.0, cx=359.5, cy=359.5, width=720, height=720)
SHADOW_OFFSET_M = 0.006  # along the surface's normal, so that a surface doesn't shade itself
AMBIENT, LAMP, SKY = 0.42, 0.95, 0.7
OUTDOORS = 1.1  # light on what lies beyond the window
DAYLIGHT = (0.95, 1.0, 1.08)  # its colour against the lamp's
MIRRORED, SHARPNESS = 0.9, 60.0  # strength and exponent of highlights
SHADE = 0.3  # cosine from the plumb line beyond which the lamp's shade dims it
GAMMA = 1.0 / 2.2


@dataclass(frozen=True)
class Window:
    """Where daylight comes in."""

    T_world_window: Array
    """(4, 4) its middle just inside the pane; x along the wall, y outwards, z up"""
    size: Array
    """(2,) width and height, metres"""


class Surface(NamedTuple):
    """All faces of a scene, world frame."""

    vertices: Array
    """(V, 3)"""
    faces: NDArray[np.int32]
    """(F, 3)"""
    offsets: NDArray[np.int64]
    """(items + 1,) the first face of each item"""
    colours: Array
    """(V, 3) 0 to 255"""
    normals: Array
    """(3 F, 3) unit normal at each corner of each face, outwards"""
    gloss: Array
    """(items,) 0 to 1"""


class Lights(NamedTuple):
    """Points of lamp and window."""

    points: Array
    """(L, 3)"""
    R_light_world: Array
    """(L, 3, 3) z is the way each looks"""
    power: Array
    """(L,) the lamp's is alike all round below it, the window's goes by the cosine"""
    is_sky: NDArray[np.bool_]
    """(L,)"""
    shadow_maps: NDArray[np.float32]
    """(L, h, w) depth before each point"""
    lens: Array
    """(4,) intrinsics of the shadow maps"""
    pane: Array
    """(4,) unit normal outwards and offset of the window's plane: what lies beyond is outdoors; zeros without one"""


@dataclass(frozen=True)
class LitScene:
    """What stands still during a visit, ready to be drawn from anywhere."""

    items: tuple[tuple[Mesh, Array], ...]
    """meshes with T_world_object (4, 4)"""
    surface: Surface
    lights: Lights


def light(
    items: Sequence[tuple[Mesh, Array]],
    lamp: Array,
    window: Window | None = None,
    gloss: Sequence[float] | None = None,
) -> LitScene:
    """Prepare a scene.

    Args:
        items: meshes with T_world_object (4, 4).
        lamp: (3,) where the lamp hangs, metres, world frame.
        window: daylight, if any.
        gloss: of each item, 0 (dull) to 1; all dull by default.
    """
    vertices = [se3.transform(T, mesh.vertices) for mesh, T in items]
    starts = np.cumsum([0] + [len(v) for v in vertices])
    faces = [mesh.faces + np.int32(start) for (mesh, _), start in zip(items, starts, strict=False)]
    normals = [corner_normals(mesh) @ T[:3, :3].T for mesh, T in items]
    surface = Surface(
        vertices=np.concatenate(vertices),
        faces=np.concatenate(faces).astype(np.int32),
        offsets=np.cumsum([0] + [len(f) for f in faces]),
        colours=np.concatenate([mesh.colours for mesh, _ in items]).astype(np.float64),
        normals=np.concatenate(normals),
        gloss=np.zeros(len(items)) if gloss is None else np.asarray(gloss, dtype=np.float64),
    )
    return LitScene(tuple(items), surface, _lights(items, np.asarray(lamp, dtype=np.float64), window))


def _lights(items: Sequence[tuple[Mesh, Array]], lamp: Array, window: Window | None) -> Lights:
    down = np.diag([1.0, -1.0, -1.0])
    poses = [se3.make(down, point) for point in lamp + _disc(LAMP_SAMPLES)]
    power, pane = [4.0 * LAMP / LAMP_SAMPLES] * LAMP_SAMPLES, np.zeros(4)
    if window is not None:
        x, out, up = window.T_world_window[:3, :3].T
        inwards = np.stack([x, -up, -out], axis=-1)
        centre = window.T_world_window[:3, 3]
        for share in _rectangle(WINDOW_SAMPLES) * window.size:
            poses.append(se3.make(inwards, centre + share[0] * x + share[1] * up))
        power += [SKY * float(np.prod(window.size)) / WINDOW_SAMPLES] * WINDOW_SAMPLES
        pane = np.append(out, out @ centre)
    T_light_world = [se3.inverse(T) for T in poses]
    shadow_maps = [
        render_scene([(mesh, T @ T_item) for mesh, T_item in items], SHADOW_MAP).depth for T in T_light_world
    ]
    return Lights(
        points=np.stack([T[:3, 3] for T in poses]),
        R_light_world=np.stack([T[:3, :3] for T in T_light_world]),
        power=np.array(power),
        is_sky=np.arange(len(poses)) >= LAMP_SAMPLES,
        shadow_maps=np.stack(shadow_maps),
        lens=intrinsics(SHADOW_MAP),
        pane=pane,
    )


def _disc(n: int) -> Array:
    """(n, 3) points spread evenly over the lamp (Vogel's spiral)."""
    k = np.arange(n)
    angle, radius = k * np.pi * (3.0 - np.sqrt(5.0)), LAMP_RADIUS_M * np.sqrt((k + 0.5) / n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)], axis=-1)


def _rectangle(n: int) -> Array:
    """(n, 2) points spread evenly over a unit square about 0 (the additive recurrence R2 of Roberts)."""
    plastic = 1.32471795724474602596
    return np.mod(0.5 + np.arange(1, n + 1)[:, None] * np.array([1.0 / plastic, 1.0 / plastic**2]), 1.0) - 0.5


def corner_normals(mesh: Mesh) -> Array:
    """(3 F, 3) unit normals: at each corner the mean over the faces there that don't meet this one at a crease."""
    weighted = _area_vectors(mesh.vertices[mesh.faces])
    unit = _unit(weighted)
    n = mesh.faces.size
    places, place_of = np.unique(mesh.vertices, axis=0, return_inverse=True)  # colours may differ at one place
    corner_at = place_of.reshape(-1)[mesh.faces.ravel()]
    incidence = csr_array((np.ones(n), corner_at, np.arange(n + 1)), shape=(n, len(places)))
    pairs = (incidence @ incidence.T).tocoo()  # corners that meet
    this, other = pairs.coords[0], pairs.coords[1] // 3
    smooth = np.einsum("ij,ij->i", unit[this // 3], unit[other]) > np.cos(CREASE_RAD)
    return _unit(
        np.stack([np.bincount(this[smooth], weighted[other[smooth], d], minlength=n) for d in range(3)], axis=-1)
    )


def _area_vectors(corners: Array) -> Array:
    """Triangles (F, 3, 3) -> (F, 3) their normals, twice their area long."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def photograph(scene: LitScene, camera: Camera, T_world_camera: Array, antialias: int = 2) -> NDArray[np.uint8]:
    """Colour image (h, w, 3) uint8 RGB.

    Args:
        scene: what there is.
        camera: the image wanted.
        T_world_camera: (4, 4).
        antialias: each pixel is the mean of so many samples each way.
    """
    n, shift = antialias, (antialias - 1) / 2.0
    fine = Camera(
        camera.fx * n, camera.fy * n, camera.cx * n + shift, camera.cy * n + shift, camera.width * n, camera.height * n
    )
    T_camera_world = se3.inverse(T_world_camera)
    images = render_scene([(mesh, T_camera_world @ T) for mesh, T in scene.items], fine)
    out = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    _shade(images, intrinsics(fine), T_world_camera, scene.surface, scene.lights, n, out)
    return out


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
def _row(table, k):
    return table[k, 0], table[k, 1], table[k, 2]


@numba.njit(inline="always")
def _blend(weights, a, b, c):
    la, lb, lc = weights
    return la * a[0] + lb * b[0] + lc * c[0], la * a[1] + lb * b[1] + lc * c[1], la * a[2] + lb * b[2] + lc * c[2]


@numba.njit(inline="always")
def _barycentric(point, a, b, c):
    """Weights of three corners at a point of their plane, by areas."""
    along, across, offset = _minus(b, a), _minus(c, a), _minus(point, a)
    plane = _cross(along, across)
    square = max(_dot(plane, plane), 1e-30)
    lb = min(max(_dot(_cross(offset, across), plane) / square, 0.0), 1.0)
    lc = min(max(_dot(_cross(along, offset), plane) / square, 0.0), 1.0 - lb)
    return 1.0 - lb - lc, lb, lc


@numba.njit(inline="always")
def _turned(R, a):
    return (
        R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _incoming(point, normal, view, gloss, lights):
    """Light from the lamp, from the window, and mirrored towards `view`, at a point.

    1 from the lamp is what comes from two metres straight above.
    """
    lamp, sky, mirrored = 0.0, 0.0, 0.0
    lens, shadow_maps = lights.lens, lights.shadow_maps
    for k in range(lights.points.shape[0]):
        towards = _minus(_row(lights.points, k), point)
        square = _dot(towards, towards)
        distance = np.sqrt(square)
        cosine = _dot(towards, normal) / distance
        if cosine <= 0.0:
            continue
        off = SHADOW_OFFSET_M
        from_light = (off * normal[0] - towards[0], off * normal[1] - towards[1], off * normal[2] - towards[2])
        x, y, depth = _turned(lights.R_light_world[k], from_light)
        if depth <= 0.0:  # behind the lamp's shade, or outdoors
            continue
        if depth > 0.1:
            u = int(np.floor(lens[0] * x / depth + lens[2] + 0.5))
            v = int(np.floor(lens[1] * y / depth + lens[3] + 0.5))
            if 0 <= u < shadow_maps.shape[2] and 0 <= v < shadow_maps.shape[1]:
                nearest = shadow_maps[k, v, u]
                if 0.0 < nearest < depth - SHADOW_OFFSET_M:
                    continue
        strength = lights.power[k] / square
        if lights.is_sky[k]:
            strength *= depth / distance
            sky += strength * cosine
        else:
            strength *= min(1.0, depth / distance / SHADE)
            lamp += strength * cosine
        if gloss > 0.0:
            half = (towards[0] / distance + view[0], towards[1] / distance + view[1], towards[2] / distance + view[2])
            mirrored += strength * (_dot(half, normal) / np.sqrt(_dot(half, half))) ** SHARPNESS
    return lamp, sky, mirrored


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _sample(u, v, z, f, gloss, lens, T, surface, lights):
    """Colour (r, g, b), 0 to 255, of face `f` at depth `z` in sample (u, v)."""
    x, y = (u - lens[2]) / lens[0] * z, (v - lens[3]) / lens[1] * z
    ray = _turned(T, (x, y, z))
    point = (ray[0] + T[0, 3], ray[1] + T[1, 3], ray[2] + T[2, 3])
    a, b, c = _row(surface.faces, f)
    vertices, normals, colours = surface.vertices, surface.normals, surface.colours
    weights = _barycentric(point, _row(vertices, a), _row(vertices, b), _row(vertices, c))
    normal = _blend(weights, _row(normals, 3 * f), _row(normals, 3 * f + 1), _row(normals, 3 * f + 2))
    length = np.sqrt(max(_dot(normal, normal), 1e-30))
    normal = (normal[0] / length, normal[1] / length, normal[2] / length)
    base = _blend(weights, _row(colours, a), _row(colours, b), _row(colours, c))
    pane = lights.pane
    if pane[0] * point[0] + pane[1] * point[1] + pane[2] * point[2] > pane[3]:
        tone = OUTDOORS**GAMMA
        return min(255.0, tone * base[0]), min(255.0, tone * base[1]), min(255.0, tone * base[2])
    away = -1.0 / np.sqrt(_dot(ray, ray))
    view = (away * ray[0], away * ray[1], away * ray[2])
    lamp, sky, mirrored = _incoming(point, normal, view, gloss, lights)
    even = AMBIENT * (0.84 + 0.16 * normal[2]) + lamp
    shine = 255.0 * MIRRORED * gloss * mirrored
    return (
        min(255.0, (even + DAYLIGHT[0] * sky) ** GAMMA * base[0] + shine),
        min(255.0, (even + DAYLIGHT[1] * sky) ** GAMMA * base[1] + shine),
        min(255.0, (even + DAYLIGHT[2] * sky) ** GAMMA * base[2] + shine),
    )


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath=True)
def _shade(images, lens, T, surface, lights, antialias, out):
    depth, item, face = images
    for row in numba.prange(out.shape[0]):
        for column in range(out.shape[1]):
            red, green, blue = 0.0, 0.0, 0.0
            last, r, g, b = -1, 0.0, 0.0, 0.0
            for v in range(row * antialias, (row + 1) * antialias):
                for u in range(column * antialias, (column + 1) * antialias):
                    k = item[v, u]
                    if k >= 0:
                        f = surface.offsets[k] + face[v, u]
                        if f != last:  # within a pixel a face has one colour
                            gloss = surface.gloss[k]
                            r, g, b = _sample(u, v, depth[v, u], f, gloss, lens, T, surface, lights)
                            last = f
                        red, green, blue = red + r, green + g, blue + b
            share = 1.0 / (antialias * antialias)
            out[row, column, 0] = np.uint8(red * share + 0.5)
            out[row, column, 1] = np.uint8(green * share + 0.5)
            out[row, column, 2] = np.uint8(blue * share + 0.5)
