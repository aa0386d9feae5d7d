"""Laws of the prediction potential out of view."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors import persistence
from factors.symmetry import Symmetry
from sequences import se3

MU = st.floats(1.0, 1e7)
R = st.tuples(st.floats(0.05, 0.6), st.floats(0.0, 0.4))


@given(MU, R, st.lists(st.floats(1e-3, 1e4), min_size=1, max_size=30))
def test_the_product_over_any_partition_of_a_gap_is_the_whole(mu, r, steps):
    times = np.concatenate([[0.0], np.cumsum(steps)])
    product = np.prod(persistence.stay_step(times[:-1], times[1:], mu, *r))
    assert product == pytest.approx(persistence.stay_probability(times[-1], mu, *r))


@given(MU, R, st.floats(0, 1e5), st.floats(1e-6, 1e5))
def test_staying_and_moving_are_all_there_is(mu, r, before, step):
    stay, move = (f(before, before + step, mu, *r) for f in (persistence.stay_step, persistence.move_step))
    assert stay + move == pytest.approx(1.0)
    assert 0 <= move <= 1
    whole = persistence.stay_probability(step, mu, *r) + persistence.move_probability(step, mu, *r)
    assert whole == pytest.approx(1.0)


def test_the_papers_limits():
    assert persistence.stay_probability(0.0, 60.0) == 1.0
    assert persistence.stay_probability(1e9, 60.0) == 0.5
    assert persistence.stay_probability(60.0, 60.0) == pytest.approx(0.5 + 0.5 / np.e)


def test_short_steps_keep_their_digits():
    assert persistence.move_step(100.0, 100.0 + 1e-6, 1e9) == pytest.approx(0.5e-15, rel=1e-3)
    assert persistence.move_probability(1e-9, 1e9) == pytest.approx(0.5e-18, rel=1e-9)


def fibonacci(n):
    """Directions (n, 3) spread evenly over the sphere."""
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
    turn = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(n)
    return np.stack([np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z], axis=-1)


def turns_about_z(n):
    """Motions (n, 4, 4): the n-fold symmetry about z."""
    angle = 2.0 * np.pi * np.arange(n) / n
    return se3.make(se3.so3_exp(angle[:, None] * [0.0, 0.0, 1.0]), np.zeros(3))


UPSIDE_DOWN = se3.make(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
AXIS = {"axes": np.array([[0.0, 0.0, 1.0]]), "offsets": np.zeros((1, 3))}
SYMMETRIES = {
    "none": Symmetry(),
    "four-fold": Symmetry(discrete=turns_about_z(4)),
    "axis": Symmetry(**AXIS),
    "axis, either end": Symmetry(discrete=np.stack([np.eye(4), UPSIDE_DOWN]), **AXIS),
    "ball": Symmetry(axes=np.eye(3), offsets=np.zeros((3, 3))),
}
SPHERE = fibonacci(20000)


def faces(rng, n=4):
    """What is up on n faces, and the log probabilities of resting on each."""
    up = rng.normal(size=(n, 3))
    return up / np.linalg.norm(up, axis=-1, keepdims=True), np.log(rng.dirichlet(np.ones(n)))


@pytest.mark.parametrize("name", SYMMETRIES)
@given(st.integers(0, 2**31), st.floats(0.05, 1.5))
@settings(max_examples=10)
def test_some_face_is_up_with_certainty(name, seed, sigma):
    up, log_face = faces(np.random.default_rng(seed))
    density = persistence.facing_log_density(SPHERE, up, log_face, tilt_sigma_rad=sigma, symmetry=SYMMETRIES[name])
    assert np.exp(density).mean() * 4.0 * np.pi == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("name", SYMMETRIES)
@given(st.integers(0, 2**31), st.floats(-3.0, 3.0))
@settings(max_examples=10)
def test_which_of_the_poses_that_look_the_same_is_all_the_same(name, seed, angle):
    symmetry, rng = SYMMETRIES[name], np.random.default_rng(seed)
    up, log_face = faces(rng)
    direction = SPHERE[rng.integers(len(SPHERE), size=20)]
    images = direction @ symmetry.discrete[rng.integers(symmetry.order), :3, :3]
    if symmetry.free:
        images = images @ se3.so3_exp(angle * symmetry.free_rotations[:, -1])
    a, b = (
        persistence.facing_log_density(u, up, log_face, tilt_sigma_rad=0.3, symmetry=symmetry)
        for u in (direction, images)
    )
    np.testing.assert_allclose(a, b, atol=1e-9)


def test_an_axis_is_a_symmetry_of_very_many_turns():
    up, log_face = faces(np.random.default_rng(1))
    many = Symmetry(discrete=turns_about_z(400))
    a, b = (
        persistence.facing_log_density(SPHERE[::50], up, log_face, tilt_sigma_rad=0.2, symmetry=s)
        for s in (SYMMETRIES["axis"], many)
    )
    np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("name", SYMMETRIES)
@given(st.integers(1, 9), st.floats(0.1, 3))
@settings(max_examples=5)
def test_the_landing_density_integrates_to_one_over_a_supporter(name, others, area):
    """Over position and the turn about the vertical it is uniform; N - 1 supporters share it."""
    symmetry, height = SYMMETRIES[name], np.linspace(-0.1, 0.1, 61)
    up, log_face = faces(np.random.default_rng(others))
    facing = persistence.facing_log_density(SPHERE, up, log_face, tilt_sigma_rad=0.3, symmetry=symmetry)
    log_density = persistence.landing_log_density(
        others, area, facing[:, None], height, height_sigma_m=0.01, symmetry=symmetry
    )
    rotations = np.exp(symmetry.log_quotient_rotations)
    total = np.exp(log_density).mean(axis=0).sum() * rotations * (height[1] - height[0]) * area * others
    assert total == pytest.approx(1.0, abs=1e-3)


def test_the_landing_density_is_the_papers_uniform_supporter_with_what_a_pose_has_beside_its_place():
    """1/(N-1) . 1/Area . 1/2 pi . p(face) . N(height) . N(tilt)."""
    up, p, tilt, height = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), np.array([0.7, 0.3]), 0.02, 0.004
    direction = np.array([0.0, np.sin(tilt), np.cos(tilt)])
    facing = persistence.facing_log_density(direction, up, np.log(p), tilt_sigma_rad=0.05)
    found = persistence.landing_log_density(3, 0.8, facing, height, height_sigma_m=0.01)
    at_height = np.exp(-0.5 * (height / 0.01) ** 2) / (np.sqrt(2.0 * np.pi) * 0.01)
    at_tilt = np.exp(-0.5 * (tilt / 0.05) ** 2) / (2.0 * np.pi * 0.05**2)
    assert np.exp(found) == pytest.approx(0.7 * at_height * at_tilt / (3 * 0.8 * 2.0 * np.pi), rel=1e-4)


def test_outside_a_supporter_there_is_no_landing():
    assert persistence.landing_log_density(3, np.inf, 0.0, 0.0, height_sigma_m=0.01) == -np.inf
