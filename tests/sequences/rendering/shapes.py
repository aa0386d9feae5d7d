"""Meshes, poses and an oracle for the tests of renderers."""

import numpy as np
import trimesh

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh

IMAGE = Camera(525.0, 515.0, 319.5, 239.5, 640, 480)
WINDOW = IMAGE.window(290, 215, 30, 26, 2)


def _mug_shape() -> trimesh.Trimesh:
    body = trimesh.creation.annulus(0.03, 0.04, 0.09, sections=40)
    handle = trimesh.creation.torus(0.025, 0.006, major_sections=24, minor_sections=12)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    handle.apply_translation((0.045, 0, 0))
    return trimesh.util.concatenate([body, handle])


SHAPES = {
    "box": lambda: trimesh.creation.box((0.10, 0.06, 0.03)),
    "mug": _mug_shape,
    "ball": lambda: trimesh.creation.icosphere(3, 0.05),
    "sheet": lambda: trimesh.Trimesh([[0.0, 0, 0], [0.1, 0, 0], [0, 0.08, 0]], [[0, 1, 2]]),
}


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    colours = np.full((len(shape.vertices), 3), 128, dtype=np.uint8)
    return Mesh(np.array(shape.vertices, dtype=np.float64), np.array(shape.faces, dtype=np.int32), colours)


def random_poses(seed: int, n: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t = np.column_stack([rng.uniform(-0.05, 0.05, n), rng.uniform(-0.05, 0.05, n), rng.uniform(0.4, 1.5, n)])
    return se3.make(se3.rotation_from_quaternion(rng.normal(size=(n, 4))), t)


def cast_rays(mesh: Mesh, camera: Camera, T_camera_object: np.ndarray) -> np.ndarray:
    """The oracle: every ray against every triangle (Moeller and Trumbore, 1997), float64, (K, h, w)."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = camera.backproject(u.ravel(), v.ravel(), np.ones(u.size))
    out = np.zeros((len(T_camera_object), u.size))
    for k, T in enumerate(T_camera_object):
        a, b, c = np.swapaxes(se3.transform(T, mesh.vertices)[mesh.faces], 0, 1)
        ab, ac = b - a, c - a
        p = np.cross(rays[:, None], ac)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / np.sum(p * ab, axis=-1)
            lb = np.sum(p * -a, axis=-1) * inverse
            q = np.cross(-a, ab)
            lc = (rays @ q.T) * inverse
            z = np.sum(q * ac, axis=-1) * inverse
            hit = (lb >= 0) & (lc >= 0) & (lb + lc <= 1) & (z > 0)
        nearest = np.where(hit, z, np.inf).min(axis=1)
        out[k] = np.where(np.isfinite(nearest), nearest, 0.0)
    return out.reshape(-1, camera.height, camera.width)
