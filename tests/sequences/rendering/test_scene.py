"""Laws of scenes: the nearest thing is seen, and lit from the camera."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering import render_scene, shade
from sequences.rendering.kernels import NEAR_M
from sequences.rendering.rasteriser import Rasteriser
from tests.sequences.rendering.shapes import SHAPES, WINDOW, cast_rays, mesh_of, random_poses

SEEDS = st.integers(0, 2**32 - 1)


def sheet(colours: np.ndarray) -> Mesh:
    """A square of 2 m in the plane z = 0, facing -z."""
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32)
    return Mesh(vertices, faces, np.broadcast_to(colours, (4, 3)).astype(np.uint8))


@given(SEEDS)
def test_the_nearest_thing_is_seen(seed: int) -> None:
    meshes = [mesh_of(SHAPES[name]()) for name in ("box", "mug", "ball", "sheet")]
    items = list(zip(meshes, random_poses(seed, 4), strict=True))
    images = render_scene(items, WINDOW)
    alone = np.stack([Rasteriser().render(mesh, WINDOW, T[None])[0] for mesh, T in items])
    far = np.where(alone > 0, alone, np.inf)
    nearest = far.min(axis=0)
    np.testing.assert_allclose(images.depth, np.where(np.isfinite(nearest), nearest, 0.0), rtol=1e-6)
    seen = images.depth > 0
    np.testing.assert_array_equal(images.item >= 0, seen)
    np.testing.assert_array_equal(images.face >= 0, seen)
    v, u = np.nonzero(seen)
    np.testing.assert_allclose(far[images.item[v, u], v, u], images.depth[v, u], rtol=1e-6)


@given(SEEDS)
def test_faces_are_those_of_the_item(seed: int) -> None:
    meshes = [mesh_of(SHAPES[name]()) for name in ("ball", "box", "mug")]
    items = list(zip(meshes, random_poses(seed, 3), strict=True))
    images = render_scene(items, WINDOW)
    for k, (mesh, T) in enumerate(items):
        v, u = np.nonzero(images.item == k)
        a, b, c = np.swapaxes(se3.transform(T, mesh.vertices)[mesh.faces[images.face[v, u]]], 0, 1)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        points = WINDOW.backproject(u, v, images.depth[v, u])
        np.testing.assert_allclose(np.sum(normal * (points - a), axis=-1), 0.0, atol=1e-6)


@given(SEEDS)
def test_what_reaches_behind_the_camera_is_cut_at_the_near_plane(seed: int) -> None:
    """A floor under the camera, seen down to where it is too near, against rays."""
    rng = np.random.default_rng(seed)
    camera = Camera(8.0, 8.0, 15.5, 12.0, 32, 25)
    R = se3.so3_exp(np.array([np.pi / 2 + rng.uniform(-0.4, 0.4), 0.0, 0.0]) + rng.uniform(-0.3, 0.3, 3))
    T = se3.make(R, np.array([0.0, rng.uniform(0.03, 0.2), 0.0]))
    floor = sheet(np.array([90, 90, 90]))
    depth = render_scene([(floor, T)], camera).depth
    truth = cast_rays(floor, camera, T[None])[0]
    truth = np.where(truth > NEAR_M, truth, 0.0)
    both = (depth > 0) & (truth > 0)
    assert both.any()
    assert ((depth > 0) != (truth > 0)).sum() <= 2
    np.testing.assert_allclose(depth[both], truth[both], rtol=1e-5)


def test_of_equal_things_the_earlier_is_seen() -> None:
    mesh, T = mesh_of(SHAPES["ball"]()), random_poses(1, 1)[0]
    images = render_scene([(mesh, T), (mesh, T)], WINDOW)
    assert set(np.unique(images.item)) == {-1, 0}


@pytest.mark.parametrize("items", [[], [(mesh_of(SHAPES["box"]()), se3.make(np.eye(3), np.array([0, 0, -1.0])))]])
def test_nothing_is_nothing(items: list) -> None:
    images = render_scene(items, WINDOW)
    assert not images.depth.any()
    assert (images.item == -1).all()
    assert (images.face == -1).all()
    background = np.arange(WINDOW.height * WINDOW.width * 3, dtype=np.uint8).reshape(WINDOW.height, WINDOW.width, 3)
    np.testing.assert_array_equal(shade(items, WINDOW, images, background), background)


@given(st.tuples(*[st.integers(0, 255)] * 3), st.floats(0.0, 1.2))
def test_light_falls_from_the_camera_by_lamberts_law(colour: tuple[int, int, int], tilt: float) -> None:
    camera = Camera(100.0, 100.0, 5.0, 5.0, 11, 11)
    item = (sheet(np.array(colour)), se3.make(se3.so3_exp(np.array([tilt, 0.0, 0.0])), np.array([0.0, 0.0, 2.0])))
    images = render_scene([item], camera)
    middle = shade([item], camera, images)[5, 5]
    np.testing.assert_allclose(middle, np.array(colour) * (0.35 + 0.65 * np.cos(tilt)), atol=0.51)


def test_colours_are_interpolated_between_vertices() -> None:
    camera = Camera(10.0, 10.0, 10.0, 10.0, 21, 21)
    colours = np.array([[0, 0, 200], [200, 0, 200], [200, 200, 200], [0, 200, 200]])
    item = (sheet(colours), se3.make(np.eye(3), np.array([0.0, 0.0, 1.0])))
    image = shade([item], camera, render_scene([item], camera)).astype(float)
    # red and green rise across the square as blue does not, so light falls out of their ratios
    share = np.arange(21) / 20.0
    np.testing.assert_allclose(image[..., 0] / image[..., 2], np.broadcast_to(share, (21, 21)), atol=0.02)
    np.testing.assert_allclose(image[..., 1] / image[..., 2], np.broadcast_to(share[:, None], (21, 21)), atol=0.02)
