"""All renderers see the same surfaces: each is held to rays cast one by one, and so to every other."""

from functools import cache

import cv2
import numpy as np
import pytest

from sequences.catalogue import Mesh
from sequences.rendering import RENDERERS, DepthRenderer
from tests.sequences.rendering.shapes import IMAGE, SHAPES, WINDOW, cast_rays, mesh_of, random_poses

INTERIOR_TOLERANCE_M = 1e-4
JUMP_M = 5e-3  # depths of neighbouring samples that differ by more are a silhouette or its own occluding contour
POSES = 40


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
