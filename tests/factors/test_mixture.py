"""Laws of Gaussians and their mixtures."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors import mixture
from sequences import se3
from tests.factors.strategies import SEEDS, random_pose, random_spd


def random_mixture(rng, modes, size):
    means = rng.normal(0, 2, (modes, size))
    informations = np.stack([random_spd(rng, size) for _ in range(modes)])
    return means, informations, np.log(rng.dirichlet(np.ones(modes)))


@pytest.mark.parametrize("size", [1, 2])
@given(SEEDS)
@settings(max_examples=6)
def test_a_mixture_integrates_to_one(size, seed):
    means, informations, log_weights = random_mixture(np.random.default_rng(seed), 3, size)
    axis = np.linspace(-14, 14, 401)
    points = np.stack(np.meshgrid(*[axis] * size, indexing="ij"), axis=-1)
    density = np.exp(mixture.mixture_log_density(points[..., None, :] - means, informations, log_weights))
    assert density.sum() * (axis[1] - axis[0]) ** size == pytest.approx(1.0, abs=1e-6)


@given(SEEDS, st.integers(1, 6))
def test_constants_are_gtsams(seed, size):
    information = random_spd(np.random.default_rng(seed), size)
    noise = gtsam.noiseModel.Gaussian.Information(information)
    assert -mixture.log_constant(information) == pytest.approx(noise.negLogConstant())


@given(SEEDS)
@settings(max_examples=30)
def test_modes_in_another_order_change_nothing(seed):
    rng = np.random.default_rng(seed)
    means, informations, log_weights = random_mixture(rng, 4, 3)
    order = rng.permutation(4)
    index, energy = mixture.select_mode(means, informations, log_weights)
    index_2, energy_2 = mixture.select_mode(means[order], informations[order], log_weights[order])
    assert order[index_2] == index
    assert energy_2 == pytest.approx(energy)
    density = mixture.mixture_log_density(means, informations, log_weights)
    assert mixture.mixture_log_density(means[order], informations[order], log_weights[order]) == pytest.approx(density)
    assert -energy <= density <= -energy + np.log(4)


def test_the_wide_mode_does_not_win_where_the_narrow_one_fits():
    residuals, informations = np.full((2, 1), 0.01), np.array([[[1e4]], [[1.0]]])
    assert mixture.select_mode(residuals, informations, np.log([0.5, 0.5]))[0] == 0
    assert mixture.select_mode(residuals + 1.0, informations, np.log([0.5, 0.5]))[0] == 1


@given(SEEDS, st.integers(1, 6))
@settings(max_examples=50)
def test_a_product_of_gaussians_is_the_kalman_update(seed, size):
    rng = np.random.default_rng(seed)
    P, R = (np.linalg.inv(random_spd(rng, size)) for _ in range(2))
    x, z = rng.normal(size=(2, size))
    gain = P @ np.linalg.inv(P + R)
    mean, information, log_evidence = mixture.product(np.stack([x, z]), np.linalg.inv(np.stack([P, R])))
    assert np.allclose(mean, x + gain @ (z - x), atol=1e-9)
    assert np.allclose(np.linalg.inv(information), (np.eye(size) - gain) @ P, atol=1e-9)
    assert log_evidence == pytest.approx(mixture.gaussian_log_density(z - x, np.linalg.inv(P + R)))


def test_log_sums_and_weights_at_the_edges():
    assert mixture.log_sum(np.zeros((2, 0))).tolist() == [-np.inf, -np.inf]
    assert mixture.log_sum([-np.inf, -np.inf]) == -np.inf
    assert mixture.log_sum([1000.0, 1000.0]) == pytest.approx(1000 + np.log(2))
    assert np.allclose(mixture.normalised([[0.0, -np.inf], [-np.inf, -np.inf]]), [[0, -np.inf], np.log([0.5, 0.5])])
    assert mixture.log_constant(np.diag([1.0, 0.0])) == -np.inf


@given(SEEDS)
@settings(max_examples=10)
def test_moments_of_a_mixture_of_poses(seed):
    """Modes drawn from a Gaussian around a pose have its mean and covariance, and each mode's spread adds to it."""
    rng = np.random.default_rng(seed)
    T, within = random_pose(rng), np.diag(np.repeat([1e-4, 4e-4], 3))
    tangents = 0.02 * rng.standard_normal((200, 6))
    tangents -= tangents.mean(axis=0)
    modes = se3.retract(T, tangents)
    mean, covariance = mixture.moment_match(modes, np.broadcast_to(within, (200, 6, 6)), np.zeros(200))
    assert np.allclose(se3.local(T, mean), 0, atol=1e-4)
    assert np.allclose(covariance, within + tangents.T @ tangents / 200, atol=2e-6)
    alone, same = mixture.moment_match(modes[:1], within[None], np.zeros(1))
    assert np.allclose(alone, modes[0], atol=1e-12)
    assert np.allclose(same, within, atol=1e-12)


@given(SEEDS, st.integers(1, 6))
def test_the_square_root_keeps_the_rank(seed, rank):
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((rank, 6))
    information = np.stack([half.T @ half, np.eye(6), np.zeros((6, 6))])
    root = mixture.square_root(information, relative_floor=1e-9)
    assert root.any(axis=-1).sum(axis=-1).tolist() == [rank, 6, 0]
    assert np.allclose(np.swapaxes(root, -1, -2) @ root, information, atol=1e-9)


def test_the_null_mode_is_broad():
    assert np.allclose(np.linalg.inv(mixture.null_information(2.0, 0.5)), np.diag([4, 4, 4, 0.25, 0.25, 0.25]))
