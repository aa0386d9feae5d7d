"""Projection, back-projection and windows of a pinhole camera agree with each other."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sequences.camera import Camera

cameras = st.builds(
    Camera,
    fx=st.floats(50, 2000),
    fy=st.floats(50, 2000),
    cx=st.floats(0, 640),
    cy=st.floats(0, 480),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
)
pixel = st.floats(-100, 800)
depth = st.floats(0.01, 100)
point = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.05, 20)).map(np.array)


@given(cameras, pixel, pixel, depth)
def test_projection_undoes_backprojection(camera, u, v, z):
    p = camera.backproject(np.float64(u), np.float64(v), np.float64(z))
    assert p[2] == z
    np.testing.assert_allclose(camera.project(p), [u, v], atol=1e-9)


@given(cameras, point)
def test_projection_is_K_in_homogeneous_coordinates(camera, p):
    h = camera.K @ p
    np.testing.assert_allclose(camera.project(p), h[:2] / h[2], rtol=1e-12, atol=1e-9)


@given(cameras, point, st.floats(0.1, 10))
def test_projection_depends_on_the_ray_alone(camera, p, scale):
    np.testing.assert_allclose(camera.project(p * scale), camera.project(p), rtol=1e-9, atol=1e-9)


@given(cameras, point, st.integers(-50, 600), st.integers(-50, 400), st.integers(1, 8))
def test_a_window_sees_the_same_points(camera, p, x, y, step):
    window = camera.window(x, y, 7, 5, step)
    assert (window.width, window.height) == (7, 5)
    np.testing.assert_allclose(window.project(p) * step + [x, y], camera.project(p), rtol=1e-9, atol=1e-8)


@given(cameras, st.floats(-5, 0))
def test_points_behind_the_camera_have_no_pixel(camera, z):
    assert np.isnan(camera.project(np.array([[0.1, 0.2, z]]))).all()


@given(cameras, st.integers(0, 2**32))
def test_points_of_a_depth_image_project_to_their_pixels(camera, seed):
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.3, 4.0, (camera.height, camera.width)).astype(np.float32)
    image[rng.random(image.shape) < 0.3] = 0.0
    points = camera.points(image)
    assert points.shape == (camera.height, camera.width, 3)
    assert (points[image == 0] == 0).all()
    v, u = np.nonzero(image)
    np.testing.assert_allclose(camera.project(points[v, u]), np.stack([u, v], axis=-1), atol=1e-6)
    np.testing.assert_array_equal(points[..., 2], image.astype(np.float64))
