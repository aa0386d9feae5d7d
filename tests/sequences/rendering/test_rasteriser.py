"""Laws of the numba z-buffer that no other renderer is needed for."""

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.kernels import NEAR_M, project, rasterise
from sequences.rendering.rasteriser import Rasteriser, coordinates, intrinsics
from tests.sequences.rendering.shapes import IMAGE, SHAPES, WINDOW, mesh_of, random_poses

SEEDS = st.integers(0, 2**32 - 1)
RENDERER = Rasteriser()


def drawn(mesh: Mesh, camera: Camera, T: np.ndarray, *, solid: bool) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth and faces."""
    projected = np.empty((3, len(mesh.vertices)))
    inverse_depth = np.zeros((camera.height, camera.width))
    ids = np.full(inverse_depth.shape, -1, dtype=np.int32)
    project(coordinates(mesh), T, intrinsics(camera), projected)
    rasterise(projected, mesh.faces, solid, np.empty((2, len(mesh.faces) + 1), np.int32), inverse_depth, ids)
    return inverse_depth, ids


@given(st.floats(0.2, 3.0), st.integers(2, 38), st.integers(2, 28), st.integers(1, 9), st.integers(1, 9))
def test_a_sheet_across_the_view_covers_the_samples_inside_it(z: float, u: int, v: int, w: int, h: int) -> None:
    camera = Camera(60.0, 55.0, 20.0, 15.0, 40, 30)
    # its edges lie between samples
    us, vs = u - 0.5 + np.array([0, w, w, 0]), v - 0.5 + np.array([0, 0, h, h])
    corners = camera.backproject(us, vs, np.full(4, z))
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), np.zeros((4, 3), np.uint8))
    depth = RENDERER.render(mesh, camera, np.eye(4)[None])[0]
    expected = np.zeros((30, 40), dtype=np.float32)
    expected[v : v + h, u : u + w] = z
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


@given(SEEDS)
def test_samples_on_shared_edges_are_never_missed(seed: int) -> None:
    """A flat fan of triangles whose edges pass exactly through samples has no crack."""
    rng = np.random.default_rng(seed)
    camera = Camera(50.0, 50.0, 16.0, 16.0, 33, 33)
    ring = np.array([(0, 0), (16, 0), (32, 0), (32, 16), (32, 32), (16, 32), (0, 32), (0, 16)], dtype=np.float64)
    middle = rng.integers(4, 29, 2)
    pixels = np.vstack([middle, ring])
    corners = camera.backproject(pixels[:, 0], pixels[:, 1], np.full(9, rng.uniform(0.3, 2.0)))
    faces = np.array([[0, 1 + k, 1 + (k + 1) % 8] for k in range(8)], dtype=np.int32)
    depth = RENDERER.render(Mesh(corners, faces, np.zeros((9, 3), np.uint8)), camera, np.eye(4)[None])[0]
    assert (depth[1:-1, 1:-1] > 0).all()


@pytest.mark.parametrize("shape", ["box", "mug", "ball"])
def test_leaving_out_the_far_side_of_a_solid_changes_nothing(shape: str) -> None:
    mesh = mesh_of(SHAPES[shape]())
    for T in random_poses(3, 30):
        whole, culled = drawn(mesh, WINDOW, T, solid=False)[0], drawn(mesh, WINDOW, T, solid=True)[0]
        assert (whole > 0).any()
        np.testing.assert_allclose(culled, whole, rtol=1e-9)


@given(SEEDS)
def test_order_of_vertices_and_faces_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh, poses = mesh_of(SHAPES["mug"]()), random_poses(seed, 3)
    order = rng.permutation(len(mesh.vertices))
    renamed = np.argsort(order).astype(np.int32)[rng.permutation(mesh.faces)]
    renamed = np.array([np.roll(face, rng.integers(0, 3)) for face in renamed])
    other = Mesh(mesh.vertices[order], renamed, mesh.colours)
    np.testing.assert_allclose(
        RENDERER.render(other, WINDOW, poses), RENDERER.render(mesh, WINDOW, poses), rtol=0, atol=1e-6
    )


def test_the_number_of_threads_does_not_matter() -> None:
    mesh, poses = mesh_of(SHAPES["mug"]()), random_poses(5, 50)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = RENDERER.render(mesh, WINDOW, poses)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(RENDERER.render(mesh, WINDOW, poses), alone)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 26), (30, 1), (2, 2), (3, 26)])
def test_thin_images_are_parts_of_the_image(width: int, height: int) -> None:
    mesh, poses = mesh_of(SHAPES["mug"]()), random_poses(7, 20)
    whole = RENDERER.render(mesh, WINDOW, poses)
    x, y = (WINDOW.width - width) // 2, (WINDOW.height - height) // 2
    part = RENDERER.render(mesh, WINDOW.window(x, y, width, height), poses)
    assert (part > 0).any()
    np.testing.assert_allclose(part, whole[:, y : y + height, x : x + width], rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_a_pose_that_is_none_shows_nothing_and_harms_no_other(bad: float) -> None:
    mesh, poses = mesh_of(SHAPES["ball"]()), random_poses(9, 3)
    clean = RENDERER.render(mesh, WINDOW, poses)
    broken = poses.copy()
    broken[1, 0, 2] = bad
    depth = RENDERER.render(mesh, WINDOW, broken)
    assert not depth[1].any()
    np.testing.assert_array_equal(depth[[0, 2]], clean[[0, 2]])


def test_triangles_without_area_or_behind_the_near_plane_are_left_out() -> None:
    vertices = np.array([[0, 0, 1], [0.1, 0, 1], [0.2, 0, 1], [0, 0.1, NEAR_M / 2], [0, 0.1, -1.0]])
    faces = np.array([[0, 1, 2], [0, 0, 1], [0, 1, 3], [0, 1, 4], [3, 4, 3]], dtype=np.int32)
    mesh = Mesh(vertices, faces, np.zeros((5, 3), np.uint8))
    assert not RENDERER.render(mesh, IMAGE, np.eye(4)[None]).any()


@given(SEEDS)
def test_the_face_that_won_lies_at_the_depth(seed: int) -> None:
    mesh, T = mesh_of(SHAPES["mug"]()), random_poses(seed, 1)[0]
    inverse_depth, ids = drawn(mesh, WINDOW, T, solid=True)
    np.testing.assert_array_equal(ids >= 0, inverse_depth > 0)
    v, u = np.nonzero(ids >= 0)
    points = WINDOW.backproject(u, v, 1.0 / inverse_depth[v, u])
    a, b, c = np.swapaxes(se3.transform(T, mesh.vertices)[mesh.faces[ids[v, u]]], 0, 1)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(np.sum(normal * (points - a), axis=1), 0.0, atol=1e-9)
