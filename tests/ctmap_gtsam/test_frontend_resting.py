"""Laws of the proposals that rest on a surface."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.resting import UNIFORMS, resting_poses, shifted_poses, snapped_poses
from sequences import se3
from sequences.geometry import Plane
from tests.ctmap_gtsam.scenes import CAMERA, UP, level, looking, model_of, shape_named, standing

NAMES = ("mug", "cereal_box", "hammer")
MODEL = model_of(*NAMES)
FURNITURE = model_of("shelf", "cabinet")


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


def planes_of(shape, T_camera_centre, n=4):
    """The largest flat parts of a thing that face the camera, as planes in the camera frame."""
    R, t = T_camera_centre[:3, :3], T_camera_centre[:3, 3]
    found = []
    for flat in shape.flats:
        normal = R @ flat[:3]
        offset = float(flat[3] + normal @ t)
        if offset < -0.05:  # towards the camera at the origin
            found.append(Plane(normal, offset, np.eye(4), np.eye(2), 0.1))
    return tuple(found[:n])


def apart(shape, poses, plane):
    """(n,) metres from a plane to the nearest flat part that faces as it does; inf where none does."""
    facing = np.einsum("nij,fj,i->nf", poses[:, :3, :3], shape.flats[:, :3], plane.normal) > 0.98
    away = np.abs((plane.offset - poses[:, :3, 3] @ plane.normal)[:, None] - shape.flats[:, 3])
    return np.where(facing, away, np.inf).min(axis=-1)


def test_the_flats_of_a_box_are_its_six_sides():
    shape = shape_named(MODEL, "cereal_box")
    assert len(shape.flats) == 6
    np.testing.assert_allclose(np.linalg.norm(shape.flats[:, :3], axis=-1), 1.0)
    half = np.ptp(shape.mesh.vertices, axis=0) / 2
    np.testing.assert_allclose(shape.flats[:, 3], np.abs(shape.flats[:, :3]) @ half, atol=0.005)
    # the largest first: the front and the back
    assert np.abs(shape.flats[:2, :3] @ shape.main_normal).min() > 0.99


def test_every_flat_lies_on_the_surface_and_nothing_of_it_before_a_hulls():
    for shape in FURNITURE.shapes:
        for normal, offset in zip(shape.flats[:, :3], shape.flats[:, 3], strict=True):
            assert np.abs(shape.mesh.vertices @ normal - offset).min() < 0.01
            assert offset < (shape.mesh.vertices @ normal).max() + 0.01


@pytest.mark.parametrize("name", ["shelf", "cabinet"])
def test_poses_drawn_to_planes_have_a_flat_in_them_and_come_near_the_truth(name):
    shape = shape_named(FURNITURE, name)
    T_world_camera = looking(0.4, 1.6, 0.4)
    truth = se3.inverse(T_world_camera) @ standing(shape)
    planes = planes_of(shape, truth)
    assert len(planes) >= 3
    rng = np.random.default_rng(0)
    centres = truth[:3, 3] + rng.uniform(-0.3, 0.3, (2000, 3))
    up = T_world_camera[:3, :3].T @ UP
    poses = snapped_poses(shape, centres, planes, up, rng.random((2000, UNIFORMS)), rng)
    off = np.stack([apart(shape, poses, plane) for plane in planes])
    assert (off < 1e-6).any(axis=0).mean() > 0.7
    near = np.linalg.norm(poses[:, :3, 3] - truth[:3, 3], axis=-1) < 0.02
    alike = np.einsum("nij,ij->n", poses[:, :3, :3], truth[:3, :3]) > 2.9
    assert (near & alike).any()


def test_a_shelf_taken_for_the_board_above_is_shifted_back():
    shape = shape_named(FURNITURE, "shelf")
    T_world_camera = looking(0.4, 1.6, 0.4)
    truth = se3.inverse(T_world_camera) @ standing(shape)
    boards = shape.flats[shape.flats[:, 2] > 0.99, 3]
    wrong = truth.copy()
    wrong[:3, 3] += (boards[0] - boards[1]) * (truth[:3, :3] @ [0.0, 0.0, 1.0])
    assert np.linalg.norm(wrong[:3, 3] - truth[:3, 3]) > 0.2
    shifted = shifted_poses(shape, wrong[None], planes_of(shape, truth, n=16))
    assert np.linalg.norm(shifted[:, :3, 3] - truth[:3, 3], axis=-1).min() < 0.01
    np.testing.assert_allclose(shifted[:, :3, :3], np.broadcast_to(wrong[:3, :3], (len(shifted), 3, 3)))
