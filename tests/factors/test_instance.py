"""Laws of the instance level of the context: a Student t on the quotient by both objects' symmetries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_t

from factors.instance import (
    InstancePrior,
    InstanceRelation,
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
    return T_a, T_b, instance_relation(T_a, T_b, a, b), a, b


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
    relation = instance_relation(T_a, T_b, Symmetry(), Symmetry())
    x = instance_residual_jacobians(T_a[0], T_b[0], relation, Symmetry(), Symmetry())[0]
    density = multivariate_t(np.zeros(6), np.linalg.inv(relation.precision), df=relation.freedom).logpdf(x)
    ratio = instance_log_ratio(T_a[0], T_b[0], relation, Symmetry(), Symmetry())
    assert ratio == pytest.approx(density - relation.log_background)


def test_more_visits_sharpen_what_is_predicted():
    rng = np.random.default_rng(3)
    T_a, T_b = visits(rng, 60, spread=0.01)
    peaks = [instance_relation(T_a[:n], T_b[:n], Symmetry(), Symmetry()).log_peak for n in (1, 2, 5, 20, 60)]
    assert peaks == sorted(peaks)


def test_the_mean_is_found_from_any_image():
    rng = np.random.default_rng(4)
    a, b = SYMMETRIES["box"], SYMMETRIES["cylinder"]
    T_a, T_b = visits(rng, 6, spread=0.05)
    turned_a = np.stack([T @ random_image(rng, a) for T in T_a])
    turned_b = np.stack([T @ random_image(rng, b) for T in T_b])
    plain, turned = instance_relation(T_a, T_b, a, b), instance_relation(turned_a, turned_b, a, b)
    at = random_pose(rng)
    where = at @ plain.T_a_b
    for relation in (plain, turned):
        assert instance_log_ratio(at, where, relation, a, b) == pytest.approx(plain.log_peak, abs=1e-6)


@pytest.mark.parametrize(("first", "second"), [("none", "none"), ("half turn", "axis"), ("axis", "half turn")])
def test_strangers_have_a_mean_ratio_of_one(first, second):
    """phi_ins is a density over the quotient: over b anywhere and anyhow, phi_ins / phi_background averages to 1."""
    rng = np.random.default_rng(5)
    a, b = SYMMETRIES[first], SYMMETRIES[second]
    radius, height, n = 0.8, 0.8, 60_000
    prior = InstancePrior(area_m2=np.pi * radius**2, height_m=height)
    out = se3.make(np.eye(3), np.zeros(3))
    axis = a.generators[:3, 0] if a.free else np.array([0.0, 0.0, 1.0])
    side = np.cross(axis, [1.0, 0.0, 0.0])
    out[:3, 3] = a.centre - b.centre + 0.4 * side / np.linalg.norm(side)
    around = instance_relation(np.eye(4)[None], out[None], a, b, prior)
    d = len(around.basis)
    spread = around.basis @ np.diag(np.repeat([0.4, 0.12], 3) ** 2) @ around.basis.T
    narrow = InstanceRelation(around.T_a_b, around.basis, np.linalg.inv(spread), 60.0, around.log_background)
    q = rng.standard_normal((n, 4))
    R = se3.so3_exp(_rotation_vectors(q / np.linalg.norm(q, axis=-1, keepdims=True)))
    disc = radius * np.sqrt(rng.random(n))
    angle = rng.uniform(-np.pi, np.pi, n)
    e1 = side / np.linalg.norm(side)
    e2 = np.cross(axis, e1)
    at = a.centre + disc[:, None] * (np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2)
    at = at + rng.uniform(-height / 2, height / 2, n)[:, None] * axis
    T_b = se3.make(R, at - (R @ b.centre[:, None])[..., 0])
    ratio = np.exp(instance_log_ratio(np.eye(4), T_b, narrow, a, b))
    error = ratio.std() / np.sqrt(n)
    assert error < 0.15
    assert d == 6 - a.free - b.free
    assert ratio.mean() == pytest.approx(1.0, abs=0.05 + 3.0 * error)


def _rotation_vectors(q):
    """(n, 4) unit quaternions, w first -> (n, 3)."""
    q = q * np.sign(q[:, :1])
    sine = np.linalg.norm(q[:, 1:], axis=-1, keepdims=True)
    return 2.0 * np.arctan2(sine, q[:, :1]) * q[:, 1:] / sine


def test_what_has_no_orientation_is_second():
    with pytest.raises(ValueError, match="first"):
        instance_relation(np.eye(4)[None], np.eye(4)[None], SYMMETRIES["ball"], Symmetry())
