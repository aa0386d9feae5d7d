"""Laws of factors evaluated together: each is what it is alone."""

import numpy as np
import pytest
from hypothesis import given, settings

from factors import context, prediction
from factors.instance import among_log_ratio, instance_log_ratio, instance_relation
from factors.terms import Contexts, Drifts, Gauges, Modes, Partners, Predictions, Standings
from sequences import se3
from tests.factors.strategies import SEEDS, SYMMETRIES, numerical_jacobian, random_image, random_pose, random_spd

N = 7
each_symmetry = pytest.mark.parametrize("symmetry", SYMMETRIES.values(), ids=SYMMETRIES.keys())


def some(rng, make, *arguments):
    return np.stack([make(rng, *arguments) for _ in range(N)])


def assert_one_by_one(terms, values):
    r, jacobians = terms.linearised(values)
    assert r.shape == (N, terms.rows)
    assert len(jacobians) == len(values)
    for i in range(N):
        alone, alone_jacobians = terms[i].linearised([value[i] for value in values])
        np.testing.assert_allclose(r[i], alone, rtol=1e-10, atol=1e-12)
        for J, alone_J in zip(jacobians, alone_jacobians, strict=True):
            assert J[i].shape == (terms.rows, 6)
            np.testing.assert_allclose(J[i], alone_J, rtol=1e-9, atol=1e-10 * max(1.0, np.abs(alone_J).max()))


def near(rng, T, scale=0.3):
    return se3.retract(T, scale * rng.uniform(-1, 1, (len(T), 6)))


@each_symmetry
@given(SEEDS)
@settings(max_examples=3)
def test_modes_predictions_and_gauges(symmetry, seed):
    rng = np.random.default_rng(seed)
    cameras, modes = some(rng, random_pose), some(rng, random_pose)
    placed = near(rng, cameras @ modes) @ some(rng, random_image, symmetry)
    information, bias = some(rng, random_spd), 0.1 * rng.normal(size=(N, 6))
    assert_one_by_one(Modes(modes, information, symmetry), [cameras, placed, bias])
    assert_one_by_one(Modes(modes, information, symmetry), [cameras, placed])
    sigma = prediction.covariance(0.2, 0.1, rng.uniform(0.1, 3.0, N), symmetry)
    assert_one_by_one(Predictions(sigma, symmetry), [placed, near(rng, placed)])
    assert_one_by_one(Predictions(sigma, symmetry, near(rng, placed)), [placed, near(rng, placed)])
    if symmetry.free:
        assert_one_by_one(Gauges(placed, symmetry), [near(rng, placed)])


@given(SEEDS)
def test_standing_is_the_sine_of_the_tilt_and_no_turn_about_up_changes_it(seed):
    rng = np.random.default_rng(seed)
    placed, yaw = some(rng, random_pose), rng.uniform(-3, 3)
    face, up = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.linalg.qr(rng.normal(size=(3, 3)))[0][0]
    terms = Standings(face[:2], up, rng.uniform(0.01, 0.1, N), rng.integers(1, 9, N))
    assert_one_by_one(terms, [placed])
    r, (J,) = terms.linearised([placed])
    sine = np.linalg.norm(np.cross(placed[:, :3, :3] @ face[2], up), axis=-1)
    np.testing.assert_allclose((r**2).sum(axis=-1), sine**2 / terms.sigma_rad**2 / terms.keyframes, rtol=1e-9)
    turned = se3.make(se3.so3_exp(yaw * up), rng.normal(size=3)) @ placed
    np.testing.assert_allclose(terms.linearised([turned])[0], r, atol=1e-9)

    def alone(T):
        return terms[2].linearised([T])[0] if T.ndim == 2 else np.stack([terms[2].linearised([t])[0] for t in T])

    np.testing.assert_allclose(J[2], numerical_jacobian(alone, placed[2]), rtol=1e-5, atol=1e-5)


@each_symmetry
@given(SEEDS)
@settings(max_examples=5)
def test_a_prediction_with_a_reference_has_the_same_energy_and_doesnt_turn_with_free_axes(symmetry, seed):
    rng = np.random.default_rng(seed)
    reference = random_pose(rng)
    before = se3.retract(reference, 0.3 * rng.uniform(-1, 1, 6))
    after = se3.retract(before, 0.3 * rng.uniform(-1, 1, 6))
    sigma = prediction.covariance(0.2, 0.1, 0.7, symmetry)
    plain, terms = Predictions(sigma, symmetry), Predictions(sigma, symmetry, reference)
    r, jacobians = terms.linearised([before, after])
    assert (r**2).sum() == pytest.approx((plain.linearised([before, after])[0] ** 2).sum(), rel=1e-9)
    for image in (random_image(rng, symmetry), random_image(rng, symmetry)):
        np.testing.assert_allclose(terms.linearised([before @ image, after])[0], r, atol=1e-9)
    for j in range(2):
        np.testing.assert_allclose(jacobians[j] @ symmetry.generators, 0.0, atol=1e-8)

        def alone(T, j=j):
            values = [T if i == j else np.broadcast_to(value, T.shape) for i, value in enumerate((before, after))]
            return terms.linearised(values)[0]

        numerical = numerical_jacobian(alone, (before, after)[j])
        np.testing.assert_allclose(jacobians[j], numerical, atol=1e-5 * max(1.0, np.abs(numerical).max()))


@given(SEEDS)
@settings(max_examples=5)
def test_drifts(seed):
    rng = np.random.default_rng(seed)
    recorded = some(rng, random_pose), some(rng, random_pose)
    terms = Drifts(*recorded, rng.uniform(0, 1, N), rng.uniform(0.1, 1.0, (N, 6)))
    values = [near(rng, T) for T in recorded]
    assert_one_by_one(terms, values)
    e = [se3.local(T, value) for T, value in zip(recorded, values, strict=True)]
    expected = (e[1] - terms.rho[:, None] * e[0]) / terms.sigma
    r, jacobians = terms.linearised(values)
    np.testing.assert_allclose(r, expected, atol=1e-10)
    for j in range(2):

        def alone(T, j=j):
            some_values = [T if i == j else np.broadcast_to(value[0], T.shape) for i, value in enumerate(values)]
            return terms[0].linearised(some_values)[0]

        np.testing.assert_allclose(jacobians[j][0], numerical_jacobian(alone, values[j][0]), atol=1e-6)


@given(SEEDS)
@settings(max_examples=5)
def test_contexts_of_different_pairs(seed):
    rng = np.random.default_rng(seed)
    relations = [context.pair_mixture(context.Relation(p, 0.5, 0.8), 6.0) for p in rng.uniform(0.1, 0.9, N)]
    parts = np.array([(p.strangers, p.together, p.usual_m, p.sigma_m) for p in relations]).T
    pairs = context.PairMixture(*parts, relations[0].instance_weight)
    terms = Contexts(rng.normal(0, 0.1, (N, 2, 3)), pairs, rng.normal(size=N), rng.integers(1, 9, N))
    assert_one_by_one(terms, [some(rng, random_pose), some(rng, random_pose)])


@pytest.mark.parametrize("first", ["none", "box", "axis"])
@pytest.mark.parametrize("second", ["none", "cylinder", "ball"])
@given(SEEDS)
@settings(max_examples=4, deadline=None)
def test_partners_have_the_energy_of_the_context(first, second, seed):
    """The residual's energy is peak - log(w1 phi_cat + w2 phi_ins) to the last digit, and its Jacobians are true."""
    rng = np.random.default_rng(seed)
    a, b = SYMMETRIES[first], SYMMETRIES[second]
    A = some(rng, random_pose)
    apart = random_pose(rng)
    apart[:3, 3] += 0.4 * np.sign(apart[:3, 3])
    relation = instance_relation(A[:2], near(rng, A[:2] @ apart, 0.1), a, b, np.array([0.0, 0.0, 1.0]))
    values = [A, near(rng, A @ relation.T_a_b, 0.2)]
    values[1][0] = A[0] @ relation.T_a_b  # at the peak
    relations = [context.pair_mixture(context.Relation(p, 0.5, 0.8), 6.0) for p in rng.uniform(0.0, 0.9, N)]
    parts = np.array([(p.strangers, p.together, p.usual_m, p.sigma_m) for p in relations]).T
    pairs = context.PairMixture(*parts, relations[0].instance_weight)
    candidates, keyframes = rng.integers(1, 9, N).astype(float), rng.integers(1, 9, N).astype(float)
    terms = Partners(pairs, relation, (a, b), candidates, keyframes)
    assert_one_by_one(terms, values)
    r, jacobians = terms.linearised(values)
    distance = context.pair_distance(*values, np.zeros(3), np.zeros(3))
    instance = among_log_ratio(instance_log_ratio(*values, relation, a, b), candidates)
    *_, peak = context.context_residual(distance, pairs, among_log_ratio(relation.log_peak, candidates))
    energy = (peak - context.context_log_ratio(distance, pairs, instance)) / keyframes
    np.testing.assert_allclose(0.5 * (r**2).sum(axis=-1), energy, atol=1e-12)
    for i in (0, 1):
        for j in range(2):

            def alone(T, i=i, j=j):
                there = [np.broadcast_to(value[i], T.shape) for value in values]
                return terms[i].linearised([T, there[1]] if j == 0 else [there[0], T])[0]

            np.testing.assert_allclose(jacobians[j][i], numerical_jacobian(alone, values[j][i]), atol=2e-5)
