"""What a depth sensor must know of the surfaces before it besides where they are.

How much light they scatter and mirror, and the error that is theirs: a thing is never quite its mesh, and what it is
made of shifts its depth, so on real recordings the residual of depth about the true surface comes back from frame to
frame at the same spot of the thing (`ctmap bench realism`). It is modelled as a constant for each thing and visit, and
a smooth field over the thing, the same in all visits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.scene import SceneImages
from sequences.seeds import generator
from sequences.simulation.config import SensorConfig
from sequences.simulation.sensor import View, rays

Array = NDArray[np.float64]

CELLS = 32  # of the periodic volume that all fields are cut from, each way
SMOOTH_CELLS = 1.5
TAILS = 0.3  # h
DEEPEST_DYE = 0.15  # share of near infrared light that a black dye still scatters: most are less dark there


@dataclass(frozen=True)
class SurfaceError:
    """The error of depth that belongs to one thing in one visit."""

    bias_m: float
    """everywhere"""
    sigma_m: float
    """of what changes over its surface ..."""
    length_m: float
    """... over about this length"""
    T_volume_object: Array
    """(4, 4) where in the volume of noise its field is cut out, metres"""

    def at(self, points: Array) -> Array:
        """(n,) metres at points (n, 3) of its surface, object frame."""
        if self.sigma_m == 0.0:
            return np.full(len(points), self.bias_m)
        cells = se3.transform(self.T_volume_object, points) * (SMOOTH_CELLS / self.length_m)
        field = map_coordinates(_volume(), cells.T, order=1, mode="grid-wrap")
        return self.bias_m + self.sigma_m * field


EXACT = SurfaceError(0.0, 0.0, 1.0, np.eye(4))
"""A surface that is where it should be"""


def surface_error(inst_id: int, diameter_m: float, config: SensorConfig, seed: int, visit: int) -> SurfaceError:
    """Draw the error of one thing in one visit."""
    bias = config.object_bias_m * generator(seed, "simulation.bias", inst_id, visit).standard_normal()
    rng = generator(seed, "simulation.surface", inst_id)
    T = se3.make(se3.rotation_from_quaternion(rng.normal(size=4)), rng.uniform(0.0, 10.0, 3))
    return SurfaceError(bias, config.surface_sigma_m, config.surface_length * diameter_m, T)


@cache
def _volume() -> Array:
    """Numbers of robust sigma 1 on a periodic grid, alike over SMOOTH_CELLS: Tukey's h distribution, long tails.

    Most of a mesh is true, and some of it isn't at all.
    """
    white = generator(0, "simulation.surface.volume").standard_normal((CELLS, CELLS, CELLS))
    smooth = gaussian_filter(white, SMOOTH_CELLS, mode="wrap")
    normal = np.clip((smooth - smooth.mean()) / smooth.std(), -3.0, 3.0)
    field = normal * np.exp(0.5 * TAILS * normal**2)
    return np.asarray(field / (1.4826 * np.median(np.abs(field))))


class Surfaces:
    """All surfaces of a scene that stands still.

    Args:
        items: meshes with T_world_object (4, 4), in the order in which they are drawn.
        gloss: (n,) share of light that each mirrors.
        errors: of each.
    """

    def __init__(self, items: Sequence[tuple[Mesh, Array]], gloss: Sequence[float], errors: Sequence[SurfaceError]):
        self._T_world_object = [T for _, T in items]
        self._errors = list(errors)
        self._gloss = np.array([*gloss, 0.0], dtype=np.float32)  # the last is that of nothing
        self._start = np.cumsum([0] + [len(mesh.faces) for mesh, _ in items])
        self._normals = np.concatenate([*(_face_normals(*item) for item in items), np.zeros((1, 3), np.float32)])
        self._albedo = np.concatenate([*(_face_albedo(mesh) for mesh, _ in items), np.zeros(1, np.float32)])

    def view(self, images: SceneImages, camera: Camera, T_world_camera: Array) -> View:
        """What a camera that drew them as `images` has before it."""
        face = np.where(images.item >= 0, self._start[images.item] + images.face, len(self._normals) - 1)
        normal = self._normals[face] @ T_world_camera[:3, :3].astype(np.float32)
        outwards = np.einsum("hwk,hwk->hw", normal, rays(camera)) < 0.0
        return View(
            camera=camera,
            depth=images.depth,
            normal=np.where(outwards[..., None], normal, -normal),
            albedo=self._albedo[face],
            gloss=self._gloss[images.item],
            error_m=self._error(images, rays(camera), T_world_camera),
        )

    def _error(self, images: SceneImages, ray: NDArray[np.float32], T_world_camera: Array) -> NDArray[np.float32]:
        out = np.zeros(images.depth.shape, dtype=np.float32)
        for k in np.unique(images.item[images.item >= 0]):
            here = images.item == k
            T_object_camera = se3.inverse(self._T_world_object[k]) @ T_world_camera
            points = se3.transform(T_object_camera, ray[here].astype(np.float64) * images.depth[here][:, None])
            out[here] = self._errors[k].at(points)
        return out


def _face_normals(mesh: Mesh, T_world_object: Array) -> NDArray[np.float32]:
    """(F, 3) unit normals, world frame."""
    a, b, c = np.swapaxes(mesh.vertices[mesh.faces], 0, 1)
    normals = np.cross(b - a, c - a) @ T_world_object[:3, :3].T
    return (normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)).astype(np.float32)


def _face_albedo(mesh: Mesh) -> NDArray[np.float32]:
    """(F,) share of near infrared light that each face scatters, guessed from its colours."""
    return albedo(mesh.colours)[mesh.faces].mean(axis=1).astype(np.float32)


def albedo(colours: NDArray[np.uint8]) -> Array:
    """Share of near infrared light that surfaces of colours (..., 3) sRGB scatter: at least what a black dye does."""
    linear = (np.asarray(colours, dtype=np.float64) / 255.0) ** 2.2
    return DEEPEST_DYE + (1.0 - DEEPEST_DYE) * linear.mean(axis=-1)
