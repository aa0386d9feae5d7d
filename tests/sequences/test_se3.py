"""The laws of SE(3), far from the identity, 1e-7 from it, and 1e-7 from a half-turn, where formulas lose digits."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from sequences import se3

EYE = np.eye(4)


@st.composite
def rotation_vectors(draw, largest=np.pi - 1e-7):
    """Rotation vectors (3,) in the regimes that formulas tell apart."""
    axis = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 3)))
    if np.linalg.norm(axis) < 1e-3:
        axis = np.array([0.0, 0.0, 1.0])
    regimes = st.one_of(
        st.sampled_from([0.0, 1e-9, 1e-7, 1e-4, 1.0001e-4, 1e-2, 1.0001e-2, np.pi - 1e-5, np.pi - 1e-7]),
        st.floats(0, largest),
    )
    return axis / np.linalg.norm(axis) * min(draw(regimes), largest)


@st.composite
def tangents(draw, largest=np.pi - 1e-7):
    scale = draw(st.sampled_from([0.0, 1e-7, 1.0, 10.0]))
    return np.concatenate([draw(rotation_vectors(largest)), scale * np.array(draw(st.tuples(*[st.floats(-1, 1)] * 3)))])


def motions():
    return tangents().map(se3.exp)


def hat6(xi):
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.hat(xi[:3]), xi[3:]
    return out


@given(tangents())
def test_exp_is_the_matrix_exponential(xi):
    np.testing.assert_allclose(se3.exp(xi), scipy.linalg.expm(hat6(xi)), atol=1e-12)


@given(motions())
def test_exp_gives_rigid_motions(T):
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(T[:3, :3]) > 0
    assert (T[3] == [0, 0, 0, 1]).all()


@given(tangents())
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-8, rtol=1e-9)


@given(st.sampled_from([1e-7, 1e-9, 1e-12]), st.tuples(*[st.floats(-1, 1)] * 6))
def test_log_keeps_the_digits_of_small_motions(scale, direction):
    xi = scale * np.array(direction)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-6 * scale + 1e-20)


@given(motions())
def test_exp_undoes_log(T):
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-12)


@given(st.tuples(*[st.floats(-1, 1)] * 3))
def test_log_of_a_half_turn_has_angle_pi(axis):
    axis = np.add(axis, [0.0, 0.0, 2.0])
    axis /= np.linalg.norm(axis)
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    w = se3.so3_log(R)
    assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-12)
    np.testing.assert_allclose(se3.so3_exp(w), R, atol=1e-12)


@given(motions(), motions(), motions())
def test_group_axioms(A, B, C):
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    np.testing.assert_allclose(A @ se3.inverse(A), EYE, atol=1e-13)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-12)
    np.testing.assert_array_equal(se3.exp(np.zeros(6)), EYE)


@given(motions(), tangents())
def test_retract_and_local_are_inverse(T, xi):
    np.testing.assert_allclose(se3.local(T, se3.retract(T, xi)), xi, atol=2e-7)


@given(motions(), tangents())
def test_adjoint_carries_a_tangent_through_a_motion(T, xi):
    np.testing.assert_allclose(
        T @ se3.exp(xi) @ se3.inverse(T), scipy.linalg.expm(hat6(se3.adjoint(T) @ xi)), atol=1e-10
    )


@given(tangents(largest=2.5))
def test_right_jacobian_is_the_derivative_of_exp(xi):
    h = 1e-6
    steps = h * np.eye(6)
    E_inverse = se3.inverse(se3.exp(xi))
    numerical = (se3.log(E_inverse @ se3.exp(xi + steps)) - se3.log(E_inverse @ se3.exp(xi - steps))).T / (2 * h)
    np.testing.assert_allclose(se3.right_jacobian(xi), numerical, atol=2e-8)


@given(tangents())
def test_right_jacobian_inverse_is_its_inverse(xi):
    np.testing.assert_allclose(se3.right_jacobian_inverse(xi) @ se3.right_jacobian(xi), np.eye(6), atol=1e-9)


@given(rotation_vectors())
def test_left_jacobian_of_rotations_integrates_the_rotation(w):
    # J_l(w) = integral over s in [0, 1] of exp(s w), by Gauss-Legendre
    nodes, weights = np.polynomial.legendre.leggauss(24)
    R = se3.so3_exp(0.5 * (nodes[:, None] + 1.0) * w)
    np.testing.assert_allclose(se3.so3_left_jacobian(w), np.einsum("n,nij->ij", 0.5 * weights, R), atol=1e-13)


@given(motions(), tangents())
def test_conventions_are_those_of_gtsam(T, xi):
    gtsam = pytest.importorskip("gtsam")
    pose = gtsam.Pose3(T)
    np.testing.assert_allclose(gtsam.Pose3.Expmap(xi).matrix(), se3.exp(xi), atol=1e-9)
    np.testing.assert_allclose(pose.retract(xi).matrix(), se3.retract(T, xi), atol=1e-8)
    np.testing.assert_allclose(pose.AdjointMap(), se3.adjoint(T), atol=1e-12)


@given(motions())
def test_quaternions_go_there_and_back(T):
    q = se3.quaternion(T[:3, :3])
    assert q[3] >= 0
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(se3.rotation_from_quaternion(q), T[:3, :3], atol=1e-14)
    np.testing.assert_allclose(se3.rotation_from_quaternion(-3.0 * q), T[:3, :3], atol=1e-14)


@given(st.lists(tangents(), min_size=1, max_size=5), motions())
def test_batches_are_stacks_of_single_results(xis, T):
    xi = np.stack(xis)
    for f in (se3.exp, se3.right_jacobian, se3.right_jacobian_inverse, lambda x: se3.log(se3.exp(x))):
        np.testing.assert_allclose(f(xi[:, None])[:, 0], np.stack([f(one) for one in xis]), atol=1e-13)
    poses = se3.exp(xi)
    for f in (se3.inverse, se3.adjoint, lambda x: se3.local(T, x)):
        np.testing.assert_allclose(f(poses), np.stack([f(one) for one in poses]), atol=1e-13)


@given(motions(), motions(), st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=1, max_size=4))
def test_transform_acts_as_the_group_does(A, B, points):
    p = np.array(points)
    np.testing.assert_allclose(se3.transform(A @ B, p), se3.transform(A, se3.transform(B, p)), atol=1e-12)
    homogeneous = np.column_stack([p, np.ones(len(p))]) @ A.T
    np.testing.assert_allclose(se3.transform(A, p), homogeneous[:, :3], atol=1e-13)


def test_uniform_rotations_are_uniform():
    n = 40_000
    R = se3.uniform_rotations(np.random.default_rng(0).random((n, 3)))
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-13)
    # under the Haar measure each entry has mean 0 and variance 1/3, and the angle mean pi/2 + 2/pi
    assert np.abs(R.mean(axis=0)).max() < 5 / np.sqrt(3 * n)
    assert np.abs(R.var(axis=0) - 1 / 3).max() < 5 / np.sqrt(n)
    angle = np.linalg.norm(se3.so3_log(R), axis=-1)
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=5 / np.sqrt(n))
