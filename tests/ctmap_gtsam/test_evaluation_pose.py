"""Laws of the pose errors: zero at the truth and at its symmetric twins, known at known disturbances."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.evaluation import pose
from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import ContinuousSymmetry, Mesh, ObjectClass

HALF_TURN = se3.make(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
QUARTER_TURNS = np.stack([se3.exp(np.array([0, 0, a, 0, 0, 0.0])) for a in np.arange(4) * np.pi / 2])


def box(size=(0.2, 0.1, 0.06), centre=(0.01, -0.02, 0.03), obj_id=1, discrete=None, continuous=()):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    vertices = 0.5 * corners * size + centre
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4]], dtype=np.int32)
    mesh = Mesh(vertices, faces, np.full((8, 3), 128, np.uint8))
    discrete = np.eye(4)[None] if discrete is None else discrete
    return pose.Shape(ObjectClass(obj_id, "box", "test", 1.0, False, True, mesh, 0.25, discrete, continuous))


def about(point, R):
    """The turn R about a line through `point`."""
    return se3.make(R, np.asarray(point) - R @ np.asarray(point))


SYMMETRIC = box(discrete=np.stack([np.eye(4), about((0.01, -0.02, 0.03), HALF_TURN[:3, :3])]))
ROUND = box(
    size=(0.1, 0.1, 0.2),
    continuous=(ContinuousSymmetry(np.array([0.0, 0.0, 1.0]), np.array([0.01, -0.02, 0.03])),),
)
ERRORS = {"mssd": pose.mssd, "adds": pose.adds, "rotation": pose.rotation_error}

seeds = st.integers(0, 2**32 - 1)


def random_poses(seed, n):
    rng = np.random.default_rng(seed)
    return se3.make(se3.uniform_rotations(rng.random((n, 3))), rng.normal(size=(n, 3)))


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_truth_and_its_symmetric_twins_have_no_error(seed):
    T = random_poses(seed, 3)
    for shape in (box(), SYMMETRIC):
        twins = T[:, None] @ shape.symmetries
        for error in (pose.mssd, pose.rotation_error):
            np.testing.assert_allclose(error(shape, twins, np.broadcast_to(T[:, None], twins.shape)), 0, atol=1e-7)
        moved = pose.translation_error(shape, twins, shape, np.broadcast_to(T[:, None], twins.shape))
        np.testing.assert_allclose(moved, 0, atol=1e-9)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_no_error_depends_on_where_the_camera_stands(seed):
    A, B, camera = random_poses(seed, 3)
    for error in (pose.mssd, pose.add, pose.adds, pose.rotation_error):
        np.testing.assert_allclose(error(SYMMETRIC, camera @ A, camera @ B), error(SYMMETRIC, A, B), atol=1e-9)


@given(seeds, st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None)
def test_pure_translation_is_measured_exactly(seed, metres):
    T = random_poses(seed, 1)[0]
    direction = random_poses(seed + 1, 1)[0][:3, 0]
    moved = T.copy()
    moved[:3, 3] += metres * direction
    assert pose.translation_error(box(), moved, box(), T) == pytest.approx(metres, abs=1e-9)
    assert pose.mssd(box(), moved, T) == pytest.approx(metres, abs=1e-9)
    assert pose.add(box(), moved, T) == pytest.approx(metres, abs=1e-9)
    assert pose.rotation_error(box(), moved, T) == pytest.approx(0, abs=1e-7)
    assert pose.adds(box(), moved, T) <= metres + 1e-9


@given(seeds, st.floats(0.0, 3.1))
@settings(max_examples=20, deadline=None)
def test_pure_rotation_is_measured_exactly(seed, angle):
    T = random_poses(seed, 1)[0]
    axis = random_poses(seed + 1, 1)[0][:3, 0]
    turned = T @ se3.exp(np.concatenate([angle * axis, np.zeros(3)]))
    assert pose.rotation_error(box(), turned, T) == pytest.approx(angle, abs=1e-6)


@given(seeds, st.floats(-3.0, 3.0), st.floats(0.0, 1.5))
@settings(max_examples=20, deadline=None)
def test_turns_about_a_symmetry_axis_count_for_nothing(seed, turn, tilt):
    T = random_poses(seed, 1)[0]
    spin = about((0.01, -0.02, 0.03), se3.so3_exp(np.array([0, 0, turn])))
    assert pose.rotation_error(ROUND, T @ spin, T) == pytest.approx(0, abs=1e-7)
    assert pose.translation_error(ROUND, T @ spin, ROUND, T) == pytest.approx(0, abs=1e-9)  # the line meets the centre
    # a full turn is cut into steps, so half a step is what may be left: the corners' radius times 0.01 rad
    assert pose.mssd(ROUND, T @ spin, T) < np.hypot(0.05, 0.05) * np.pi / pose.CONTINUOUS_STEPS + 1e-9
    tilted = T @ spin @ se3.exp(np.array([tilt, 0, 0, 0, 0, 0]))
    assert pose.rotation_error(ROUND, tilted, T) == pytest.approx(tilt, abs=1e-7)


def test_a_discrete_flip_of_a_round_object_is_told_from_a_tilt():
    flip = about((0.01, -0.02, 0.03), np.diag([1.0, -1.0, -1.0]))
    drum = pose.Shape(replace(ROUND.of, symmetries_discrete=np.stack([np.eye(4), flip])))
    assert pose.rotation_error(drum, flip, np.eye(4)) == pytest.approx(0, abs=1e-7)
    assert pose.rotation_error(ROUND, flip, np.eye(4)) == pytest.approx(np.pi)


def test_a_sphere_has_no_orientation():
    lines = tuple(ContinuousSymmetry(axis, np.zeros(3)) for axis in np.eye(3))
    ball = box(centre=(0, 0, 0), continuous=lines)
    A, B = random_poses(3, 2)
    assert pose.rotation_error(ball, A, B) == 0


def test_mssd_by_hand():
    """A box turned half about z through its centre: the far corners swap places, unless that is a symmetry."""
    plain = box(centre=(0, 0, 0))
    diagonal = np.hypot(0.2, 0.1)
    assert pose.mssd(plain, HALF_TURN, np.eye(4)) == pytest.approx(diagonal)
    assert pose.add(plain, HALF_TURN, np.eye(4)) == pytest.approx(diagonal)
    assert pose.adds(plain, HALF_TURN, np.eye(4)) == pytest.approx(0, abs=1e-12)
    assert pose.mssd(SYMMETRIC, SYMMETRIC.symmetries[1], np.eye(4)) == pytest.approx(0, abs=1e-12)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_mssd_equals_its_definition_over_all_vertices(seed):
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(300, 3)) * 0.05
    base = box(discrete=QUARTER_TURNS)
    mesh = Mesh(cloud, np.array([[0, 1, 2]], np.int32), np.full((300, 3), 128, np.uint8))
    shape = pose.Shape(replace(base.of, mesh=mesh))
    assert len(shape.extreme_points) < 300
    A, B = random_poses(seed, 4), random_poses(seed + 1, 4)
    x = se3.transform(A, cloud)
    expected = [
        min(np.linalg.norm(x[k] - se3.transform(B[k] @ S, cloud), axis=-1).max() for S in QUARTER_TURNS)
        for k in range(4)
    ]
    np.testing.assert_allclose(pose.mssd(shape, A, B), expected, rtol=1e-12)


CAMERA = Camera(500.0, 450.0, 300.0, 200.0, 640, 480)


def before_camera(seed, n):
    rng = np.random.default_rng(seed)
    return se3.make(se3.uniform_rotations(rng.random((n, 3))), rng.normal(size=(n, 3)) * 0.1 + [0, 0, 1.5])


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_mspd_equals_its_definition(seed):
    shape = box(discrete=QUARTER_TURNS)
    A, B = before_camera(seed, 4), before_camera(seed + 1, 4)
    vertices = shape.of.mesh.vertices
    x = CAMERA.project(se3.transform(A, vertices))
    expected = [
        min(np.linalg.norm(x[k] - CAMERA.project(se3.transform(B[k] @ S, vertices)), axis=-1).max()
            for S in QUARTER_TURNS)
        for k in range(4)
    ]  # fmt: skip
    np.testing.assert_allclose(pose.mspd(shape, A, B, CAMERA), expected, rtol=1e-9)
    np.testing.assert_allclose(pose.mspd(shape, B @ QUARTER_TURNS[2], B, CAMERA), 0, atol=1e-9)


def test_mspd_by_hand():
    """A centimetre to the side: the nearest vertex moves most, f dx / z; along the axis, the outermost one."""
    shape, T = box(size=(0.2, 0.1, 0.06), centre=(0, 0, 0)), se3.make(np.eye(3), np.array([0, 0, 1.03]))
    aside, further = T.copy(), T.copy()
    aside[0, 3] += 0.01
    assert pose.mspd(shape, aside, T, CAMERA) == pytest.approx(500.0 * 0.01 / 1.0)
    further[2, 3] += 0.25
    corner = np.hypot(500.0 * 0.1, 450.0 * 0.05)
    assert pose.mspd(shape, further, T, CAMERA) == pytest.approx(corner / 1.0 - corner / 1.25)


def test_what_lies_behind_the_camera_has_no_image():
    shape, T = box(centre=(0, 0, 0)), se3.make(np.eye(3), np.array([0, 0, 1.0]))
    behind = se3.make(np.eye(3), np.array([0, 0, -1.0]))
    assert pose.mspd(shape, behind, T, CAMERA) == np.inf
    reaching = se3.make(np.eye(3), np.array([0, 0, 0.02]))  # some corners are behind, and don't count
    assert pose.mspd(shape, reaching, reaching, CAMERA) == 0


def test_adds_equals_its_definition():
    A, B = random_poses(1, 2)
    B[:3, 3] = A[:3, 3] + 0.01
    shape = box()
    a, b = se3.transform(A, shape.of.mesh.vertices), se3.transform(B, shape.of.mesh.vertices)
    expected = np.linalg.norm(a[None] - b[:, None], axis=-1).min(axis=1).mean()
    assert pose.adds(shape, A, B) == pytest.approx(expected)


def test_a_wrong_class_is_compared_at_the_centres():
    other = box(size=(0.3, 0.3, 0.3), centre=(0.5, 0, 0), obj_id=2)
    T = random_poses(5, 1)[0]
    T_other = T @ se3.make(np.eye(3), box().centre - other.centre)
    assert pose.translation_error(other, T_other, box(), T) == pytest.approx(0, abs=1e-12)


def test_a_flat_mesh_keeps_all_its_points():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    flat = Mesh(corners, np.array([[0, 1, 2]], np.int32), np.zeros((4, 3), np.uint8))
    assert len(pose.Shape(replace(box().of, mesh=flat)).extreme_points) == 4
