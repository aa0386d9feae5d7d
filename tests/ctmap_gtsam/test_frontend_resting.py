"""Laws of the proposals that rest on a surface."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.resting import UNIFORMS, resting_poses
from sequences import se3
from sequences.geometry import Plane
from tests.ctmap_gtsam.scenes import CAMERA, UP, looking, model_of, shape_named, standing

NAMES = ("mug", "cereal_box", "hammer")
MODEL = model_of(*NAMES)


def level(height):
    """A level surface about the origin, world frame."""
    hull = 0.6 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return Plane(UP, height, se3.make(np.eye(3), height * UP), hull, 0.5)


def wall(yaw):
    """An upright plane, world frame."""
    normal = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    x = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return Plane(normal, 0.0, se3.make(np.stack([x, np.cross(normal, x), normal], -1), np.zeros(3)), np.eye(2), 0.5)


def drawn(name, T_world_camera, surfaces, walls=(), n=200, seed=0, at=(0.0, 0.0, 0.0)):
    """T_world_centre of poses drawn for a box about where a point of the world is seen."""
    rng = np.random.default_rng(seed)
    T = se3.inverse(T_world_camera)
    middle = CAMERA.project(se3.transform(T, np.array(at)[None])[0])
    pixels = middle + rng.uniform(-20, 20, (n, 2))
    rays = CAMERA.backproject(pixels[:, 0], pixels[:, 1], np.ones(n))
    planes = tuple(p.moved(T) for p in (*surfaces, *walls))
    poses = resting_poses(
        shape_named(MODEL, name), rays, planes[: len(surfaces)], planes, T[:3, :3] @ UP, rng.random((n, UNIFORMS))
    )
    return T_world_camera @ poses


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(NAMES), st.floats(-3.0, 3.0), st.floats(0.5, 1.2), st.floats(-0.1, 0.1))
def test_every_pose_touches_a_surface_and_sinks_into_none_that_it_rests_on(name, yaw, pitch, height):
    poses = drawn(name, looking(yaw, 0.8, pitch), (level(height), level(height - 0.2)))
    assert len(poses) == 200
    lowest = se3.transform(poses, shape_named(MODEL, name).hull_points)[..., 2].min(axis=-1)
    apart = np.abs(lowest[:, None] - [height, height - 0.2])
    assert apart.min(axis=1).max() < 1e-9
    assert (apart < 1e-9).any(axis=0).all()  # both are tried


@pytest.mark.parametrize("name", NAMES)
def test_a_standing_thing_is_among_them(name):
    shape = shape_named(MODEL, name)
    truth = standing(shape)
    poses = drawn(name, looking(0.3, 0.8, 0.8), (level(0.0),), n=4000, at=truth[:3, 3])
    upright = np.abs(poses[:, 2, 2] * 1.0) > 0.99
    assert upright.mean() > 0.02
    near = np.linalg.norm(poses[:, :3, 3] - truth[:3, 3], axis=-1) < 0.03
    assert (upright & near).any()


def test_half_of_the_yaws_turn_a_face_to_a_wall():
    shape = shape_named(MODEL, "cereal_box")
    poses = drawn("cereal_box", looking(0.3, 0.8, 0.8), (level(0.0),), (wall(0.7),), n=1000)
    facing = poses[:, :3, :3] @ shape.main_normal
    level_faces = np.abs(facing[:, 2]) < 0.1
    angle = np.arctan2(facing[level_faces, 1], facing[level_faces, 0]) - 0.7
    off = np.abs(np.angle(np.exp(4j * angle))) / 4.0
    assert 0.4 < (off < 1e-6).mean() < 0.6


@pytest.mark.parametrize("name", NAMES)
def test_rests_are_rotations_in_which_a_face_of_the_hull_lies_level(name):
    shape = shape_named(MODEL, name)
    R = shape.rests
    np.testing.assert_allclose(R @ R.swapaxes(-1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    heights = shape.hull_points @ R[:, 2, :].T
    # three corners at least touch the surface
    assert ((heights - heights.min(axis=0) < 1e-6).sum(axis=0) >= 3).all()
    assert shape.rest_weights.sum() == pytest.approx(1.0)


def test_poses_behind_the_camera_are_left_out():
    up = looking(0.0, 0.8, -0.9)  # looks up: the surface is below and behind
    assert len(drawn("mug", up, (level(-5.0),))) == 0
