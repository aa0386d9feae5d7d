"""Laws of the prediction potential out of view."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors import persistence
from factors.mixture import LOG_ROTATIONS

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


@given(st.integers(1, 9), st.floats(0.1, 3), st.sampled_from([1, 2, 4]))
@settings(max_examples=10)
def test_the_landing_density_integrates_to_one_over_a_supporter(others, area, order):
    """Over position and yaw it is uniform; over height and tilt it is a Gaussian; N - 1 supporters share it."""
    height, tilt = np.linspace(-0.1, 0.1, 61), np.linspace(-0.4, 0.4, 51)
    h, a, b = np.meshgrid(height, tilt, tilt, indexing="ij")
    log_density = persistence.move_log_density(
        others, area, 0.0, h, np.stack([a, b], axis=-1), height_sigma_m=0.01, tilt_sigma_rad=0.05, yaw_order=order
    )
    cell = (height[1] - height[0]) * (tilt[1] - tilt[0]) ** 2
    total = np.exp(log_density).sum() * cell * area * (2 * np.pi / order) * others
    assert total == pytest.approx(1.0, abs=1e-6)


def test_outside_a_supporter_there_is_no_landing_and_free_yaw_has_no_density():
    at = {"height_sigma_m": 0.01, "tilt_sigma_rad": 0.05}
    assert persistence.move_log_density(3, np.inf, 0.0, 0.0, np.zeros(2), **at) == -np.inf
    yaw = persistence.move_log_density(3, 1.0, 0.0, 0.0, np.zeros(2), yaw_order=[1, 0], **at)
    assert yaw[1] - yaw[0] == pytest.approx(np.log(2 * np.pi))


@given(st.floats(-0.1, 0.1), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_landing_gradients_are_derivatives(height, tilt_x, tilt_y):
    at = {"height_sigma_m": 0.02, "tilt_sigma_rad": 0.1}
    tilt, step = np.array([tilt_x, tilt_y]), 1e-5

    def value(h, t):
        return persistence.move_log_density(2, 0.5, 0.0, h, t, **at)

    by_height, by_tilt = persistence.move_log_density_gradients(height, tilt, **at)
    assert by_height == pytest.approx((value(height + step, tilt) - value(height - step, tilt)) / (2 * step), abs=1e-4)
    numerical = [(value(height, tilt + step * e) - value(height, tilt - step * e)) / (2 * step) for e in np.eye(2)]
    assert by_tilt == pytest.approx(numerical, abs=1e-4)


def test_a_move_without_supports_integrates_to_one():
    axis = np.linspace(-5, 5, 81)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    density = np.exp(persistence.unsupported_move_log_density(points, sigma_m=0.8) + LOG_ROTATIONS)
    assert density.sum() * (axis[1] - axis[0]) ** 3 == pytest.approx(1.0, abs=1e-6)
