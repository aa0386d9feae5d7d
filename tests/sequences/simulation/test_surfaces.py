from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sequences import se3
from sequences.camera import Camera
from sequences.rendering.scene import render_scene
from sequences.simulation import SensorConfig
from sequences.simulation.surfaces import EXACT, Surfaces, albedo, surface_error
from tests.tiny import box_mesh

CONFIG = SensorConfig()
CAMERA = Camera(150.0, 150.0, 79.5, 59.5, width=160, height=120)
BOX = box_mesh(0.4, 0.3, 0.2)


def robust_sigma(values: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def test_the_field_is_as_large_and_as_smooth_as_asked():
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (20000, 3))
    config = replace(CONFIG, object_bias_m=0.0, surface_sigma_m=0.002, surface_length=0.1)
    error = surface_error(3, 0.2, config, 0, 0)
    here = error.at(points)
    assert robust_sigma(here) == pytest.approx(0.002, rel=0.2)
    near, far = (error.at(points + np.array([x, 0.0, 0.0])) for x in (0.004, 0.2))
    assert np.corrcoef(here, near)[0, 1] > 0.9
    assert abs(np.corrcoef(here, far)[0, 1]) < 0.2


def test_the_field_is_the_things_and_the_bias_the_visits():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
    first, second = (surface_error(3, 0.2, CONFIG, 0, visit) for visit in (0, 1))
    other, reseeded = surface_error(4, 0.2, CONFIG, 0, 0), surface_error(3, 0.2, CONFIG, 1, 0)
    change = second.at(points) - first.at(points)
    assert np.ptp(change) < 1e-12
    assert abs(change[0]) > 1e-6
    for unlike in (other, reseeded):
        assert np.ptp(unlike.at(points) - first.at(points)) > 1e-4
    biases = [surface_error(k, 0.2, CONFIG, 0, 0).bias_m for k in range(400)]
    assert np.std(biases) == pytest.approx(CONFIG.object_bias_m, rel=0.1)


@given(angle=st.floats(-3.0, 3.0), x=st.floats(-0.2, 0.2), y=st.floats(-0.2, 0.2))
def test_an_error_travels_with_the_thing(angle, x, y):
    """Thing and camera moved together show the same view."""
    config = replace(CONFIG, object_bias_m=0.0)
    error = surface_error(1, 0.5, config, 0, 0)
    T_world_camera = se3.exp(np.array([0.1, angle, 0.2, x, y, 0.3]))
    T_camera_object = se3.exp(np.array([0.4, 0.2, 0.1, 0.05, 0.0, 1.0]))
    images = render_scene([(BOX, T_camera_object)], CAMERA)
    still = Surfaces([(BOX, T_camera_object)], [0.3], [error]).view(images, CAMERA, np.eye(4))
    moved = Surfaces([(BOX, T_world_camera @ T_camera_object)], [0.3], [error]).view(images, CAMERA, T_world_camera)
    np.testing.assert_allclose(moved.error_m, still.error_m, atol=1e-7)
    np.testing.assert_allclose(moved.normal, still.normal, atol=1e-5)


def test_a_view_holds_what_each_pixel_sees():
    plate = box_mesh(0.4, 0.3, 0.2)
    items = [(BOX, se3.make(np.eye(3), np.array([-0.3, 0.0, 1.0]))), (plate, se3.make(np.eye(3), [0.3, 0.0, 1.2]))]
    images = render_scene(items, CAMERA)
    view = Surfaces(items, [0.0, 0.7], [surface_error(1, 0.5, CONFIG, 0, 0), EXACT]).view(images, CAMERA, np.eye(4))
    np.testing.assert_array_equal(view.depth, images.depth)
    nothing, first, second = (images.item == k for k in (-1, 0, 1))
    assert (view.gloss[first] == 0.0).all()
    np.testing.assert_allclose(view.gloss[second], 0.7)
    assert np.abs(view.error_m[first]).max() > 0.0
    for quiet in (second, nothing):
        assert (view.error_m[quiet] == 0.0).all()
    front = first & (np.abs(images.depth - 0.9) < 1e-4)
    np.testing.assert_allclose(view.normal[front], np.broadcast_to([0.0, 0.0, -1.0], (front.sum(), 3)), atol=1e-6)
    assert (view.albedo[nothing] == 0.0).all()


def test_white_scatters_more_than_black_and_black_still_something():
    black, grey, white = (albedo(np.full(3, level, dtype=np.uint8)) for level in (0, 128, 255))
    assert 0.05 < black < grey < white == pytest.approx(1.0)
