"""Laws of the prediction potential in view."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors import prediction
from factors.mixture import gaussian_log_density, product
from sequences import se3
from tests.factors.strategies import (
    SCALES,
    SEEDS,
    SYMMETRIES,
    numerical_jacobian,
    random_image,
    random_pose,
    random_spd,
    random_tangent,
)

each_symmetry = pytest.mark.parametrize("symmetry", SYMMETRIES.values(), ids=SYMMETRIES.keys())


@each_symmetry
@given(SEEDS, SCALES)
@settings(max_examples=15)
def test_the_potential_does_not_depend_on_the_images(symmetry, seed, scale):
    """Of either pose: the object before may be written in another image than the object after."""
    rng = np.random.default_rng(seed)
    T_a = random_pose(rng)
    T_b = T_a @ se3.exp(random_tangent(rng, scale, 0.7))
    sigma = prediction.covariance(1.0, 0.5, 0.1, symmetry)
    value = prediction.log_potential(T_a, T_b, sigma, symmetry)
    images = random_image(rng, symmetry), random_image(rng, symmetry)
    assert prediction.log_potential(T_a @ images[0], T_b @ images[1], sigma, symmetry) == pytest.approx(value, abs=1e-8)


@each_symmetry
@given(SEEDS, SCALES)
@settings(max_examples=15)
def test_gradients_are_derivatives(symmetry, seed, scale):
    rng = np.random.default_rng(seed)
    T_a = random_pose(rng)
    T_b = T_a @ se3.exp(random_tangent(rng, scale, 3.0 if symmetry.order == 1 else 0.7))
    sigma = prediction.covariance(1.0, 0.5, 2.0, symmetry)
    value, by_a, by_b = prediction.log_potential_jacobians(T_a, T_b, sigma, symmetry)
    assert value == pytest.approx(prediction.log_potential(T_a, T_b, sigma, symmetry))
    numerical_a = numerical_jacobian(lambda T: prediction.log_potential(T, T_b, sigma, symmetry), T_a)[0]
    numerical_b = numerical_jacobian(lambda T: prediction.log_potential(T_a, T, sigma, symmetry), T_b)[0]
    assert np.allclose(by_a, numerical_a, atol=1e-5)
    assert np.allclose(by_b, numerical_b, atol=1e-5)


@given(SEEDS)
@settings(max_examples=10)
def test_it_is_the_density_of_its_samples(seed):
    rng = np.random.default_rng(seed)
    T, sigma = random_pose(rng), 1e-3 * np.linalg.inv(random_spd(rng))
    normals = rng.standard_normal((2000, 6))
    values = prediction.log_potential(T, prediction.sample(T, sigma, normals), sigma)
    expected = gaussian_log_density(np.zeros(6), np.linalg.inv(sigma)) - 0.5 * (normals**2).sum(axis=1)
    assert np.allclose(values, expected, atol=1e-6)


@given(st.floats(0.01, 100), st.integers(1, 20))
def test_uncertainty_grows_with_time_not_with_steps(dt, steps):
    whole = prediction.covariance(1e-3, 1e-5, dt)
    assert np.allclose(prediction.covariance(1e-3, 1e-5, np.full(steps, dt / steps)).sum(axis=0), whole)
    assert np.allclose(np.diag(whole), np.repeat([1e-3 * dt, 1e-5 * dt], 3))


@given(SEEDS)
@settings(max_examples=20)
def test_the_papers_form_has_half_the_variance_in_its_exponent(seed):
    rng = np.random.default_rng(seed)
    T_a, T_b, sigma = random_pose(rng), random_pose(rng), np.linalg.inv(random_spd(rng))
    ours = prediction.log_potential(T_a, T_b, sigma) - prediction.log_potential(T_a, T_a, sigma)
    assert prediction.paper_log_potential(T_a, T_b, 2.0 * sigma) == pytest.approx(ours)


@given(SEEDS)
@settings(max_examples=20)
def test_integrated_over_both_poses_it_is_exact_where_all_is_linear(seed):
    """Without rotation the three Gaussians are over a vector space, where the integral has a closed form."""
    rng = np.random.default_rng(seed)
    R = random_pose(rng)[:3, :3]
    positions = rng.normal(size=(2, 3))
    T_a, T_b = se3.make(R, positions[0]), se3.make(R, positions[1])
    spreads = [np.diag(np.r_[1e-12, 1e-12, 1e-12, rng.uniform(0.1, 2, 3)]) for _ in range(3)]
    value = prediction.integrated_log_potential(T_a, spreads[0], T_b, spreads[1], spreads[2])
    apart = R.T @ (positions[1] - positions[0])
    translation = [S[3:, 3:] for S in spreads]
    _, _, evidence = product(
        np.stack([np.zeros(3), apart]), np.linalg.inv(np.stack([translation[0] + translation[2], translation[1]]))
    )
    rotation = gaussian_log_density(np.zeros(3), np.eye(3) / 3e-12)
    assert value == pytest.approx(evidence + rotation, abs=1e-3)


@pytest.mark.parametrize("name", ["axis", "cylinder"])
def test_what_a_free_axis_does_not_know_costs_nothing(name):
    symmetry, rng = SYMMETRIES[name], np.random.default_rng(2)
    T_a = random_pose(rng)
    T_b = T_a @ se3.exp(random_tangent(rng, 0.02))
    sigma = prediction.covariance(1e-3, 1e-4, 1.0, symmetry)
    known = np.eye(6) * 1e-6
    unknown = known + 1e3 * symmetry.generators @ symmetry.generators.T
    value = prediction.integrated_log_potential(T_a, known, T_b, known, sigma, symmetry)
    assert prediction.integrated_log_potential(T_a, unknown, T_b, unknown, sigma, symmetry) == pytest.approx(value)


@pytest.mark.parametrize("off", [0.0, 1e-12, 1e-9, 1e-6])
def test_opposite_free_axes_are_far_apart_and_no_more(off):
    """Every turn about the axis is as near as any other there: the derivative has no bound, the potential has."""
    symmetry = SYMMETRIES["axis"]
    across = np.linalg.svd(symmetry.axes[:1])[2][1]
    T_a = random_pose(np.random.default_rng(3))
    T_b = T_a @ se3.exp(np.concatenate([(np.pi - off) * across, np.zeros(3)]))
    sigma = prediction.covariance(1e-3, 1e-4, 1.0, symmetry)
    spread = 1e-4 * np.eye(6)
    value = prediction.integrated_log_potential(T_a, spread, T_b, spread, sigma, symmetry)
    assert np.isfinite(value)
    assert value < prediction.integrated_log_potential(T_a, spread, T_a, spread, sigma, symmetry) - 10.0


def test_batches_broadcast():
    rng = np.random.default_rng(0)
    T_a, T_b = random_pose(rng), np.stack([random_pose(rng) for _ in range(5)])
    sigma = prediction.covariance(1.0, 1.0, [[1.0], [2.0]])
    assert sigma.shape == (2, 1, 6, 6)
    assert prediction.log_potential(T_a, T_b, sigma[0, 0]).shape == (5,)
    assert np.allclose(prediction.log_potential(T_a, T_b, sigma[1]), prediction.log_potential(T_a, T_b, sigma[1, 0]))
