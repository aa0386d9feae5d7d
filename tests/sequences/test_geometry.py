"""Laws of planes: those that were rendered are found, and drawn again they give the depth they were found in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sequences import se3
from sequences.camera import Camera
from sequences.geometry import Plane, _most_supported, find_planes, plane_depth, up_from_planes
from sequences.rendering.scene import render_scene
from tests.tiny import box_mesh

CAMERA = Camera(280.0, 285.0, 159.5, 119.5, 320, 240)
TABLE_TOP, FLOOR = 0.7, 0.0


def looking(height, pitch, yaw=0.0, roll=0.0):
    """T_world_camera (4, 4) of a camera so high over the origin, turned down by a pitch; world z is up."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # camera axes in the world: looks along y
    R = se3.so3_exp(np.array([0, 0, yaw])) @ level @ se3.so3_exp(np.array([-pitch, 0, 0]))
    return se3.make(R @ se3.so3_exp(np.array([0, 0, roll])), np.array([0.0, 0.0, height]))


def room(T_world_camera, seed=None):
    """Depth (h, w) of a table top before a wall on a floor; with sensor noise where a seed is given."""
    floor = box_mesh(6.0, 6.0, 0.1), se3.make(np.eye(3), np.array([0.0, 1.0, -0.05]))
    table = box_mesh(1.6, 0.9, 0.04), se3.make(np.eye(3), np.array([0.0, 1.15, TABLE_TOP - 0.02]))
    wall = box_mesh(6.0, 0.1, 4.0), se3.make(np.eye(3), np.array([0.0, 2.5, 2.0]))
    T = se3.inverse(T_world_camera)
    depth = render_scene([(mesh, T @ pose) for mesh, pose in (floor, table, wall)], CAMERA).depth
    if seed is not None:
        rng = np.random.default_rng(seed)
        depth = (depth + 0.002 * depth**2 * rng.normal(size=depth.shape)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.05] = 0.0
    return depth


def angle(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0)))


@settings(max_examples=12)
@given(
    st.floats(1.2, 1.6), st.floats(0.5, 0.8), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.sampled_from([None, 0, 1])
)
def test_the_top_of_a_table_is_found_to_a_degree_and_four_millimetres(height, pitch, yaw, roll, noise):
    T = looking(height, pitch, yaw, roll)
    planes = find_planes(CAMERA, room(T, noise), np.random.default_rng(0))
    found = [p.moved(T) for p in planes]
    level = [p for p in found if angle(p.normal, np.array([0, 0, 1.0])) < 1.0]
    assert min(abs(p.offset - TABLE_TOP) for p in level) < 0.004
    shares = [p.share for p in planes]
    assert sum(shares) <= 1.0 + 1e-9
    for plane in planes:
        np.testing.assert_allclose(np.linalg.norm(plane.normal), 1.0)
        assert plane.offset < 0.0  # the normal points to the camera, where the origin is
        np.testing.assert_allclose(plane.normal @ plane.T_frame_plane[:3, 3], plane.offset)
        np.testing.assert_allclose(plane.T_frame_plane[:3, 2], plane.normal)
        np.testing.assert_allclose(np.linalg.det(plane.T_frame_plane[:3, :3]), 1.0)


def test_wall_table_and_floor_are_each_found_once():
    T = looking(1.3, 0.45, 0.25)
    found = [p.moved(T) for p in find_planes(CAMERA, room(T, 2), np.random.default_rng(1))]
    table = [p for p in found if abs(p.normal[2]) > 0.99 and abs(p.offset - TABLE_TOP) < 0.02]
    wall = [p for p in found if p.normal[1] < -0.99]
    assert len(table) == 1
    assert len(wall) == 1
    assert wall[0].offset == pytest.approx(-2.45, abs=0.01)
    assert angle(wall[0].normal, np.array([0, -1.0, 0])) < 1.0


def test_the_outline_is_that_of_what_was_seen():
    T = looking(1.5, 0.75)
    found = [p.moved(T) for p in find_planes(CAMERA, room(T), np.random.default_rng(1))]
    top = min(found, key=lambda p: abs(p.offset - TABLE_TOP))
    inside = np.array([[0.0, 1.2, TABLE_TOP], [0.3, 1.3, TABLE_TOP + 0.2], [-0.3, 1.0, TABLE_TOP - 0.2]])
    outside = np.array([[1.2, 1.2, TABLE_TOP], [0.0, 1.8, TABLE_TOP], [0.0, 0.3, TABLE_TOP]])
    assert top.contains(inside).all()
    assert not top.contains(outside).any()
    assert top.area <= (1.6 + 0.1) * (0.9 + 0.1)


@settings(max_examples=8)
@given(st.floats(1.2, 1.6), st.floats(0.5, 0.8), st.floats(-0.3, 0.3))
def test_drawing_the_planes_found_gives_the_depth_they_were_found_in(height, pitch, yaw):
    T = looking(height, pitch, yaw)
    depth = room(T)
    drawn = plane_depth(find_planes(CAMERA, depth, np.random.default_rng(0)), CAMERA)
    both = (drawn > 0) & (depth > 0)
    assert both.mean() > 0.8
    # a plane's outline is convex and goes a little too far: what it hides there is nearer than what was measured
    error = np.abs(drawn - depth)[both]
    assert np.quantile(error, 0.85) < 0.004


def unit_plane(T, half=1.0):
    """A square of 2 x half metres in the x-y plane of a frame T_frame_plane."""
    hull = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return Plane(T[:3, 2], float(T[:3, 2] @ T[:3, 3]), T, hull, 1.0)


@given(st.integers(0, 2**31), st.booleans())
def test_contains_asks_for_the_foot_of_a_point_whatever_the_outlines_direction(seed, reverse):
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    plane = unit_plane(T)
    hull = plane.hull[::-1] if reverse else plane.hull
    plane = Plane(plane.normal, plane.offset, T, hull, 1.0)
    local = rng.uniform(-2, 2, (3, 50, 3))
    expected = (np.abs(local[..., :2]) <= 1.0).all(-1)
    np.testing.assert_array_equal(plane.contains(se3.transform(T, local)), expected)


@given(st.integers(0, 2**31))
def test_a_moved_plane_holds_the_moved_points(seed):
    rng = np.random.default_rng(seed)
    T, motion = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6))
    plane = unit_plane(T)
    moved = plane.moved(motion)
    on_it = se3.transform(motion @ T, np.c_[rng.uniform(-1, 1, (20, 2)), np.zeros(20)])
    np.testing.assert_allclose(on_it @ moved.normal, moved.offset, atol=1e-12)
    points = rng.normal(size=(30, 3))
    np.testing.assert_array_equal(moved.contains(se3.transform(motion, points)), plane.contains(points))
    back = moved.moved(se3.inverse(motion))
    np.testing.assert_allclose(back.normal, plane.normal, atol=1e-12)
    np.testing.assert_allclose(back.offset, plane.offset, atol=1e-12)


@given(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(0.4, 3.0))
def test_plane_depth_lies_on_the_plane(pitch, yaw, away):
    facing = se3.make(se3.so3_exp(np.array([np.pi, 0, 0])), np.array([0, 0, away]))
    plane = unit_plane(facing @ se3.exp(np.array([pitch, yaw, 0, 0, 0, 0])), half=20.0)
    depth = plane_depth((plane,), CAMERA).astype(np.float64)
    points = CAMERA.points(depth)[depth > 0]
    assert len(points) > 1000
    np.testing.assert_allclose(points @ plane.normal, plane.offset, atol=1e-5)


def test_of_planes_behind_each_other_the_nearest_is_seen_and_nothing_outside_of_outlines():
    far = unit_plane(se3.make(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 2.0])), half=0.5)
    near = unit_plane(se3.make(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 1.0])), half=0.1)
    for planes in ((near, far), (far, near)):
        depth = plane_depth(planes, CAMERA)
        assert depth[120, 160] == np.float32(1.0)
        assert depth[120, 160 + 40] == np.float32(2.0)  # x = 0.14 at 1 m, 0.29 at 2 m
        assert depth[120, 160 + 100] == 0.0  # x = 0.71 at 2 m
    assert (plane_depth((), CAMERA) == 0.0).all()


def test_a_plane_behind_the_camera_is_not_seen():
    behind = unit_plane(se3.make(np.eye(3), np.array([0, 0, -1.0])), half=5.0)
    assert (plane_depth((behind,), CAMERA) == 0.0).all()


@settings(max_examples=10)
@given(st.floats(0.35, 0.9), st.floats(-0.3, 0.3))
def test_up_is_up_though_a_wall_fills_more_of_the_view(pitch, roll):
    T = looking(1.4, pitch, 0.0, roll)
    planes = find_planes(CAMERA, room(T), np.random.default_rng(0))
    up = up_from_planes(planes, np.array([0.0, -1.0, 0.0]))
    assert angle(T[:3, :3] @ up, np.array([0, 0, 1.0])) < 1.0


def test_without_a_level_plane_nothing_says_what_is_up():
    wall = unit_plane(se3.make(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 2.0])))
    assert up_from_planes((wall,), np.array([0.0, -1.0, 0.0])) is None
    assert up_from_planes((), np.array([0.0, -1.0, 0.0])) is None


def test_an_image_without_depth_has_no_planes():
    assert find_planes(CAMERA, np.zeros((240, 320), dtype=np.float32), np.random.default_rng(0)) == ()


def test_clutter_alone_makes_no_plane():
    depth = np.random.default_rng(0).uniform(0.5, 3.0, (240, 320)).astype(np.float32)
    assert find_planes(CAMERA, depth, np.random.default_rng(0)) == ()


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31))
def test_the_plane_is_that_of_the_candidate_which_most_points_support(seed):
    rng = np.random.default_rng(seed)
    points, normals = rng.uniform(-1.0, 1.0, size=(200, 3)), rng.normal(size=(200, 3)) * [0.1, 0.1, 1.0]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    picks, tolerance = rng.integers(200, size=12), rng.uniform(0.01, 0.3, size=200)
    away = np.abs(((points[:, None] - points[picks]) * normals[picks]).sum(axis=-1))
    near = (away < tolerance[:, None]) & (normals @ normals[picks].T > 0.97)
    found = _most_supported(points, normals, picks, tolerance, 0.97)
    np.testing.assert_array_equal(found, near[:, np.argmax(near.sum(axis=0))])
