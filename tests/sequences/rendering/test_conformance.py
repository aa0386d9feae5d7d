"""All renderers see the same surfaces: each is held to rays cast one by one, and so to every other."""

from functools import cache

import cv2
import numpy as np
import pytest
import trimesh

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering import RENDERERS, DepthRenderer

IMAGE = Camera(525.0, 515.0, 319.5, 239.5, 640, 480)
WINDOW = IMAGE.window(290, 215, 30, 26, 2)
INTERIOR_TOLERANCE_M = 1e-4
JUMP_M = 5e-3  # depths of neighbouring samples that differ by more are a silhouette or its own occluding contour
POSES = 40


def _mug() -> trimesh.Trimesh:
    body = trimesh.creation.annulus(0.03, 0.04, 0.09, sections=40)
    handle = trimesh.creation.torus(0.025, 0.006, major_sections=24, minor_sections=12)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    handle.apply_translation((0.045, 0, 0))
    return trimesh.util.concatenate([body, handle])


SHAPES = {
    "box": lambda: trimesh.creation.box((0.10, 0.06, 0.03)),
    "mug": _mug,
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


@cache
def true_depth(shape: str) -> tuple[Mesh, np.ndarray, np.ndarray]:
    mesh, poses = mesh_of(SHAPES[shape]()), random_poses(sum(map(ord, shape)), POSES)
    return mesh, poses, cast_rays(mesh, WINDOW, poses)


@pytest.fixture(scope="module", params=list(RENDERERS))
def renderer(request: pytest.FixtureRequest) -> DepthRenderer:
    made = RENDERERS[request.param]()
    if reason := made.available():
        pytest.skip(reason)
    return made


def neighbourhood(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest depth of the 3 x 3 samples around each."""
    kernel = np.ones((3, 3), np.uint8)
    return (
        np.array([cv2.erode(d, kernel, borderType=cv2.BORDER_REPLICATE) for d in depth]),
        np.array([cv2.dilate(d, kernel, borderType=cv2.BORDER_REPLICATE) for d in depth]),
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_depth_is_that_of_the_surface(renderer: DepthRenderer, shape: str) -> None:
    mesh, poses, truth = true_depth(shape)
    depth = renderer.render(mesh, WINDOW, poses)
    assert depth.dtype == np.float32
    assert depth.shape == truth.shape
    low, high = neighbourhood(truth)
    interior = high - low < JUMP_M
    assert (interior & (truth > 0)).sum() > 5 * POSES, "the poses should show the mesh"
    np.testing.assert_allclose(depth[interior], truth[interior], rtol=0, atol=INTERIOR_TOLERANCE_M)


@pytest.mark.parametrize("shape", SHAPES)
def test_silhouettes_agree_within_a_pixel(renderer: DepthRenderer, shape: str) -> None:
    mesh, poses, truth = true_depth(shape)
    depth = renderer.render(mesh, WINDOW, poses)
    low, high = neighbourhood(truth)
    # a contour that passes within a rounding error of a sample may fall on either side of it, but a depth that no
    # surface near it has (what resolving a multisampled buffer gives) is none
    covered, empty = (truth > 0) & (low == 0), truth == 0
    nearest = np.where(low > 0, low, np.array([_least_positive(d) for d in truth]))
    wrong = (depth > 0) & ((depth < nearest - JUMP_M) | (depth > high + JUMP_M))
    assert not wrong.any()
    assert not (depth[empty & (high == 0)] > 0).any()
    assert (depth[(truth > 0) & ~covered] > 0).all()
    assert ((depth > 0) != (truth > 0)).sum() <= 0.005 * (truth > 0).sum()


def _least_positive(depth: np.ndarray) -> np.ndarray:
    far = np.where(depth > 0, depth, 1e9)
    return cv2.erode(far, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)


def test_a_window_with_a_stride_is_part_of_the_image(renderer: DepthRenderer) -> None:
    mesh, poses, _ = true_depth("ball")
    whole = renderer.render(mesh, IMAGE, poses[:3])
    part = renderer.render(mesh, IMAGE.window(281, 204, 40, 30, 3), poses[:3])
    cut = whole[:, 204 : 204 + 90 : 3, 281 : 281 + 120 : 3]
    both = (cut > 0) & (part > 0)
    assert ((cut > 0) != (part > 0)).sum() <= 2
    np.testing.assert_allclose(part[both], cut[both], rtol=0, atol=INTERIOR_TOLERANCE_M)


def test_each_pose_is_alone_in_its_image(renderer: DepthRenderer) -> None:
    mesh, poses, _ = true_depth("mug")
    together = renderer.render(mesh, WINDOW, poses[:5])
    for k in range(5):
        np.testing.assert_array_equal(renderer.render(mesh, WINDOW, poses[k : k + 1])[0], together[k])


def test_nothing_in_view_is_nothing(renderer: DepthRenderer) -> None:
    mesh = mesh_of(SHAPES["box"]())
    behind, beside = np.eye(4), np.eye(4)
    behind[2, 3], beside[:3, 3] = -1.0, (3.0, 0.0, 1.0)
    assert not renderer.render(mesh, WINDOW, np.stack([behind, beside])).any()
    assert renderer.render(mesh, WINDOW, np.zeros((0, 4, 4))).shape == (0, WINDOW.height, WINDOW.width)
