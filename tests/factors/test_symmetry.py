"""Laws of residuals modulo symmetry."""

import numpy as np
import pytest
from hypothesis import given, settings

from factors import symmetry as sym
from factors.symmetry import Symmetry
from sequences import se3
from sequences.catalogue import ContinuousSymmetry, Mesh, ObjectClass
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


def pair(seed, scale, symmetry):
    """Two poses some way apart, the second written as some other image of itself; away from ties between images."""
    rng = np.random.default_rng(seed)
    T_a = random_pose(rng)
    max_angle = 3.0 if symmetry.order == 1 else 0.7
    return rng, T_a, T_a @ se3.exp(random_tangent(rng, scale, max_angle)) @ random_image(rng, symmetry)


@given(SEEDS, SCALES)
@settings(max_examples=40)
def test_without_symmetry_the_residual_is_the_tangent_between_poses(seed, scale):
    _rng, T_a, T_b = pair(seed, scale, sym.NONE)
    r, J_a, J_b = sym.residual_jacobians(T_a, T_b)
    expected = se3.local(T_a, T_b)
    assert np.allclose(r, expected, atol=1e-12)
    assert np.allclose(J_b, se3.right_jacobian_inverse(expected), atol=1e-10)
    assert np.allclose(J_a, -se3.right_jacobian_inverse(-expected), atol=1e-10)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), [[0.6, 0.0, -0.8], [-0.6, 0.48, 0.64]]]))
@pytest.mark.parametrize("angle", [0.0, 1e-10, 9e-3, 1.1e-2, np.pi - 1e-7, np.pi])
def test_the_compiled_logarithm_is_that_of_se3(axis, angle):
    T = se3.exp(np.r_[angle * axis, 0.4, -1.0, 2.0])
    assert np.allclose(se3.exp(sym.residual(np.eye(4), T)), T, atol=1e-9)
    assert np.allclose(sym.residual_jacobians(np.eye(4), T)[2], se3.right_jacobian_inverse(se3.log(T)), atol=1e-6)


@each_symmetry
@given(SEEDS, SCALES)
@settings(max_examples=15)
def test_jacobians_are_derivatives(symmetry, seed, scale):
    _rng, T_a, T_b = pair(seed, scale, symmetry)
    _, J_a, J_b = sym.residual_jacobians(T_a, T_b, symmetry)
    assert np.allclose(J_a, numerical_jacobian(lambda T: sym.residual(T, T_b, symmetry), T_a), atol=2e-6)
    assert np.allclose(J_b, numerical_jacobian(lambda T: sym.residual(T_a, T, symmetry), T_b), atol=2e-6)


@each_symmetry
@given(SEEDS, SCALES)
@settings(max_examples=15)
def test_the_residual_does_not_depend_on_the_image(symmetry, seed, scale):
    rng, T_a, T_b = pair(seed, scale, symmetry)
    information = random_spd(rng)
    information = np.diag([4.0, 4, 4, 9, 9, 9]) if symmetry.free else information
    g = random_image(rng, symmetry)
    assert np.allclose(sym.residual(T_a, T_b @ g, symmetry), sym.residual(T_a, T_b, symmetry), atol=1e-9)
    chosen = sym.residual(T_a, T_b, symmetry, information)
    assert np.allclose(sym.residual(T_a, T_b @ g, symmetry, information), chosen, atol=1e-9)


@each_symmetry
@given(SEEDS)
@settings(max_examples=10)
def test_free_directions_are_gone_from_residual_and_jacobians(symmetry, seed):
    _rng, T_a, T_b = pair(seed, 0.3, symmetry)
    r, J_a, J_b = sym.residual_jacobians(T_a, T_b, symmetry)
    for values in (r, J_a, J_b, J_b @ symmetry.generators):
        assert np.allclose(symmetry.reader @ values, 0, atol=1e-10)
    assert np.allclose(J_b @ symmetry.generators, 0, atol=1e-9)
    assert symmetry.projection.shape == (6 - symmetry.free, 6)
    assert np.allclose(symmetry.projection @ symmetry.lift, np.eye(6 - symmetry.free), atol=1e-12)
    assert np.allclose(symmetry.lift @ symmetry.projection @ r, r, atol=1e-12)
    assert np.linalg.matrix_rank(J_b, tol=1e-9) == 6 - symmetry.free


@each_symmetry
def test_the_centre_stays_where_it_is(symmetry):
    rng = np.random.default_rng(3)
    for _ in range(5):
        moved = se3.transform(random_image(rng, symmetry), symmetry.centre[None])[0]
        assert np.allclose(moved, symmetry.centre, atol=1e-9)


@given(SEEDS)
@settings(max_examples=20)
def test_the_residual_is_the_shortest(seed):
    rng = np.random.default_rng(seed)
    T_a, T_b, information = random_pose(rng), random_pose(rng), random_spd(rng)
    box, cylinder = SYMMETRIES["box"], SYMMETRIES["cylinder"]
    candidates = se3.local(T_a, T_b @ box.discrete)
    energies = np.einsum("si,ij,sj->s", candidates, information, candidates)
    r = sym.residual(T_a, T_b, box, information)
    assert r @ information @ r == pytest.approx(energies.min())
    assert sym.best_symmetry(T_a, T_b, box.discrete, information) == energies.argmin()
    angles = np.linalg.norm(candidates[:, :3], axis=-1)
    assert np.linalg.norm(sym.residual(T_a, T_b, box)[:3]) == pytest.approx(angles.min())
    swing = np.linalg.norm(sym.residual(T_a, T_b, cylinder)[:3])
    turned = np.stack([T_b @ random_image(rng, cylinder) for _ in range(50)])
    assert np.all(np.linalg.norm(se3.local(T_a, turned)[:, :3], axis=-1) >= swing - 1e-9)


@each_symmetry
def test_batches_are_their_elements(symmetry):
    rng = np.random.default_rng(11)
    T_a = np.stack([random_pose(rng) for _ in range(3)])[:, None]
    T_b = np.stack([random_pose(rng) for _ in range(4)])
    informations = np.stack([random_spd(rng) for _ in range(12)]).reshape(3, 4, 6, 6)
    together = sym.residual_jacobians(T_a, T_b, symmetry, informations)
    assert together[0].shape == (3, 4, 6)
    for i, j in np.ndindex(3, 4):
        alone = sym.residual_jacobians(T_a[i, 0], T_b[j], symmetry, informations[i, j])
        for whole, part in zip(together, alone, strict=True):
            assert np.array_equal(whole[i, j], part)


@given(SEEDS)
@settings(max_examples=20)
def test_the_nearest_image_looks_the_same_and_is_near(seed):
    symmetry = SYMMETRIES["box"]
    _rng, T_a, T_b = pair(seed, 0.3, symmetry)
    image = sym.nearest_image(T_a, T_b, symmetry)
    assert np.allclose(se3.local(T_a, image), sym.residual(T_a, T_b, symmetry))
    assert min(np.abs(image - T_b @ g).max() for g in symmetry.discrete) < 1e-12


@given(SEEDS)
@settings(max_examples=20)
@each_symmetry
def test_moments_are_those_of_the_nearest_images(symmetry, seed):
    rng = np.random.default_rng(seed)
    start = random_pose(rng)
    poses = se3.retract(start, rng.normal(size=(30, 6)) * np.repeat([0.1, 0.02], 3))
    poses = np.stack([T @ random_image(rng, symmetry) for T in poses])
    log_weights = rng.normal(size=30)
    r = sym.residual(start, poses, symmetry)
    mean, covariance = sym.moments(start, poses, log_weights, symmetry, r, 10)
    expected, weights = start, np.exp(log_weights) / np.exp(log_weights).sum()
    for _ in range(10):
        expected = se3.retract(expected, weights @ sym.residual(expected, poses, symmetry))
    away = sym.residual(expected, poses, symmetry)
    np.testing.assert_allclose(mean, expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(r, away, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(covariance, (weights[:, None] * away).T @ away, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["axis", "ball"])
def test_the_gauge_holds_what_the_residual_leaves_free(name):
    symmetry = SYMMETRIES[name]
    _rng, T_a, T_b = pair(5, 0.3, symmetry)
    r, J = sym.gauge_residual(T_a, T_b, symmetry)
    assert r.shape == (symmetry.free,)
    assert np.allclose(J, numerical_jacobian(lambda T: sym.gauge_residual(T_a, T, symmetry)[0], T_b), atol=1e-6)
    constrained = sym.residual_jacobians(T_a, T_b, symmetry)[2]
    assert np.linalg.matrix_rank(np.vstack([constrained, J]), tol=1e-9) == 6
    assert np.allclose(symmetry.free_axes.T @ symmetry.free_axes, np.eye(symmetry.free), atol=1e-12)


def test_volumes_of_rotations():
    volumes = {name: np.exp(symmetry.log_quotient_rotations) for name, symmetry in SYMMETRIES.items()}
    expected = {"none": 8 * np.pi**2, "half turn": 4 * np.pi**2, "box": 2 * np.pi**2}
    expected |= {"axis": 4 * np.pi, "cylinder": 2 * np.pi, "ball": 1.0}
    assert volumes == pytest.approx(expected)


def test_a_class_of_the_catalogue_brings_its_symmetries():
    mesh = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    line = ContinuousSymmetry(np.array([0.0, 0, 1]), np.array([0.1, 0.2, 0.3]))
    can = ObjectClass(1, "can", "food", 60.0, False, True, mesh, 0.1, np.eye(4)[None], (line,))
    symmetry = Symmetry.of(can)
    assert symmetry.free == 1
    assert np.allclose(symmetry.centre, [0.1, 0.2, 0.0])
    assert np.allclose(symmetry.generators[:, 0], [0, 0, 1, 0.2, -0.1, 0])
