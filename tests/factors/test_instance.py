"""Laws of the instance level of the context: a Student t on the quotient by both objects' symmetries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_t, qmc

from factors.instance import (
    InstancePrior,
    among_log_ratio,
    instance_log_ratio,
    instance_log_ratio_jacobians,
    instance_relation,
    instance_residual_jacobians,
)
from factors.symmetry import Symmetry
from sequences import se3
from tests.factors.strategies import SEEDS, SYMMETRIES, numerical_jacobian, random_image, random_pose, random_tangent

FIRST = st.sampled_from([name for name in SYMMETRIES if name != "ball"])
SECOND = st.sampled_from(list(SYMMETRIES))
UP = np.array([0.0, 0.0, 1.0])


def visits(rng, n, spread=0.1):
    """Poses of a and b in n visits: the place turned anyhow, b a little elsewhere each time."""
    T_a = np.stack([random_pose(rng) for _ in range(n)])
    apart = random_pose(rng)
    apart[:3, 3] += np.sign(apart[:3, 3]) * 0.5
    noise = np.stack([random_tangent(rng, spread) for _ in range(n)])
    return T_a, T_a @ apart @ se3.exp(noise)


def pair(rng, first, second, n=3):
    a, b = SYMMETRIES[first], SYMMETRIES[second]
    T_a, T_b = visits(rng, n)
    return T_a, T_b, instance_relation(T_a, T_b, a, b, UP), a, b


@given(SEEDS, FIRST, SECOND)
@settings(max_examples=30, deadline=None)
def test_symmetries_change_nothing(seed, first, second):
    rng = np.random.default_rng(seed)
    T_a, T_b, relation, a, b = pair(rng, first, second)
    ratio = instance_log_ratio(T_a, T_b, relation, a, b)
    images = instance_log_ratio(T_a @ random_image(rng, a), T_b @ random_image(rng, b), relation, a, b)
    np.testing.assert_allclose(images, ratio, atol=1e-6)
    world = random_pose(rng)
    np.testing.assert_allclose(instance_log_ratio(world @ T_a, world @ T_b, relation, a, b), ratio, atol=1e-6)


@given(SEEDS, FIRST, SECOND)
@settings(max_examples=30, deadline=None)
def test_jacobians_are_the_derivatives(seed, first, second):
    rng = np.random.default_rng(seed)
    T_a, T_b, relation, a, b = pair(rng, first, second)
    x, J_a, J_b = instance_residual_jacobians(T_a[0], T_b[0], relation, a, b)
    value, by_a, by_b = instance_log_ratio_jacobians(T_a[0], T_b[0], relation, a, b)
    residuals = {
        "a": lambda T: instance_residual_jacobians(T, T_b[0], relation, a, b)[0],
        "b": lambda T: instance_residual_jacobians(T_a[0], T, relation, a, b)[0],
    }
    for J, name, T in ((J_a, "a", T_a[0]), (J_b, "b", T_b[0])):
        np.testing.assert_allclose(J, numerical_jacobian(residuals[name], T), atol=2e-5)
    ratios = (
        lambda T: instance_log_ratio(T, T_b[0], relation, a, b),
        lambda T: instance_log_ratio(T_a[0], T, relation, a, b),
    )
    for gradient, ratio, T in zip((by_a, by_b), ratios, (T_a[0], T_b[0]), strict=True):
        np.testing.assert_allclose(gradient, numerical_jacobian(ratio, T)[0], rtol=1e-4, atol=1e-4)
    assert x.shape == (len(relation.precision),)
    assert value.shape == ()


@pytest.mark.parametrize("first", ["none", "half turn", "axis"])
@pytest.mark.parametrize("second", ["none", "axis", "ball"])
def test_dimensions_without_meaning_are_left_out(first, second):
    *_, relation, a, b = pair(np.random.default_rng(0), first, second)
    assert len(relation.precision) == 6 - a.free - b.free


def test_batches_are_scored_one_by_one():
    rng = np.random.default_rng(1)
    T_a, T_b, relation, a, b = pair(rng, "box", "cylinder", n=5)
    whole = instance_log_ratio(T_a[:, None], T_b, relation, a, b)
    assert whole.shape == (5, 5)
    assert whole[2, 3] == pytest.approx(instance_log_ratio(T_a[2], T_b[3], relation, a, b))


def test_it_is_the_predictive_of_the_normal_inverse_wishart():
    """One dimension at a time it must be scipy's t, and averaging the Gaussian over the posterior must give it."""
    rng = np.random.default_rng(2)
    T_a, T_b = visits(rng, 4, spread=0.02)
    relation = instance_relation(T_a, T_b, Symmetry(), Symmetry(), UP)
    x = instance_residual_jacobians(T_a[0], T_b[0], relation, Symmetry(), Symmetry())[0]
    density = multivariate_t(np.zeros(6), np.linalg.inv(relation.precision), df=relation.freedom).logpdf(x)
    ratio = instance_log_ratio(T_a[0], T_b[0], relation, Symmetry(), Symmetry())
    assert ratio == pytest.approx(density - relation.log_background)


def test_more_visits_sharpen_what_is_predicted():
    rng = np.random.default_rng(3)
    T_a, T_b = visits(rng, 60, spread=0.01)
    peaks = [instance_relation(T_a[:n], T_b[:n], Symmetry(), Symmetry(), UP).log_peak for n in (1, 2, 5, 20, 60)]
    assert peaks == sorted(peaks)


def test_the_mean_is_found_from_any_image():
    rng = np.random.default_rng(4)
    a, b = SYMMETRIES["box"], SYMMETRIES["cylinder"]
    T_a, T_b = visits(rng, 6, spread=0.05)
    turned_a = np.stack([T @ random_image(rng, a) for T in T_a])
    turned_b = np.stack([T @ random_image(rng, b) for T in T_b])
    plain, turned = instance_relation(T_a, T_b, a, b, UP), instance_relation(turned_a, turned_b, a, b, UP)
    at = random_pose(rng)
    where = at @ plain.T_a_b
    for relation in (plain, turned):
        # up is taken from the first visit, whose spin about b's axis the mean keeps to first order
        assert instance_log_ratio(at, where, relation, a, b) == pytest.approx(plain.log_peak, abs=1e-4)


def upright(symmetry):
    """The pose (4, 4) of a thing whose symmetry axis is vertical and whose centre is the origin."""
    R = np.eye(3)
    if symmetry.free == 1:
        axis = symmetry.generators[:3, 0]
        across = np.cross(axis, UP)
        sine = np.linalg.norm(across)
        R = se3.so3_exp(across / max(sine, 1e-12) * np.arctan2(sine, axis @ UP))
    return se3.make(R, -R @ symmetry.centre)


STANDING = [("none", "none"), ("none", "axis"), ("axis", "none"), ("axis", "axis"), ("none", "ball"), ("axis", "ball")]


@pytest.mark.parametrize(("first", "second"), STANDING)
def test_what_is_put_down_anywhere_gains_nothing_on_average(first, second):
    """phi_ins is a density: over b anywhere in the plane and with any yaw, phi_ins / phi_background averages to 1."""
    a, b = SYMMETRIES[first], SYMMETRIES[second]
    half = 1.5
    prior = InstancePrior(area_m2=(2.0 * half) ** 2, translation_m=0.08, rotation_rad=0.3, visits=10.0)

    def at(x, y, yaw):
        x, y, yaw = np.broadcast_arrays(x, y, yaw)
        R = se3.so3_exp(yaw[..., None] * UP)
        return se3.make(R, np.stack([x, y, np.zeros_like(x)], axis=-1)) @ upright(b)

    T_a = upright(a)
    relation = instance_relation(T_a[None], at(0.7, 0.1, 0.3)[None], a, b, UP, prior)
    # evenly spread, so that few suffice
    spread = 2.0 * qmc.Sobol(3, seed=5).random_base2(15) - 1.0
    T_b = at(half * spread[:, 0], half * spread[:, 1], np.pi * spread[:, 2])
    ratio = np.exp(instance_log_ratio(T_a, T_b, relation, a, b))
    # tails beyond the area, and a ring that isn't straight
    assert ratio.mean() == pytest.approx(1.0, abs=0.08)


@given(SEEDS, FIRST, SECOND)
@settings(max_examples=20, deadline=None)
def test_up_turns_with_the_world(seed, first, second):
    rng = np.random.default_rng(seed)
    T_a, T_b, relation, a, b = pair(rng, first, second)
    world = random_pose(rng)
    turned = instance_relation(world @ T_a, world @ T_b, a, b, world[:3, :3] @ UP)
    assert turned.log_peak == pytest.approx(relation.log_peak, abs=1e-6)


@given(st.floats(-8.0, 12.0), st.integers(1, 20))
def test_among_many_the_partner_is_one(ratio, n):
    """However many were moved as well: no more than one of them gains, and the more there were the less."""
    said = among_log_ratio(ratio, n)
    assert said == pytest.approx(np.log((np.exp(ratio) + n - 1.0) / n))
    assert min(ratio, 0.0) - 1e-9 <= said <= max(ratio, 0.0) + 1e-9
    assert among_log_ratio(ratio, 1) == pytest.approx(ratio)


def test_what_has_no_orientation_is_second():
    with pytest.raises(ValueError, match="first"):
        instance_relation(np.eye(4)[None], np.eye(4)[None], SYMMETRIES["ball"], Symmetry(), UP)
