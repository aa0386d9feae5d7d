"""Laws of the context potential."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors import context
from factors.context import CategoryRelations, Relation, pair_mixture
from sequences import se3
from tests.factors.strategies import SEEDS, numerical_jacobian, random_pose

RELATIONS = st.builds(Relation, st.floats(0.0, 1.0), st.floats(0.0, 0.6), st.floats(0.03, 0.5))
PAIRS = st.builds(pair_mixture, RELATIONS, st.floats(0.5, 20.0), st.floats(0.1, 0.9))


@given(RELATIONS, st.floats(0.05, 1.0))
def test_the_category_density_integrates_to_one(relation, weight):
    """phi_background is 1 / A over the place; what is placed together is a density over the plane."""
    area = 400.0
    pair = pair_mixture(relation, area, category_weight=weight)
    distance = np.linspace(0, np.sqrt(area / np.pi), 40001)
    density = np.exp(context.context_log_ratio(distance, pair)) / area
    assert np.trapezoid(density * 2 * np.pi * distance, distance) == pytest.approx(1.0, abs=1e-4)


@given(st.floats(0, 5), st.floats(0.1, 10), st.floats(0, 1))
def test_strangers_say_nothing(distance, area, weight):
    pair = pair_mixture(Relation(strength=0.0), area, weight)
    assert context.context_log_ratio(distance, pair) == pytest.approx(0.0, abs=1e-12)
    e, slope, peak = context.context_residual(distance, pair)
    assert (e, slope) == (0, 0)
    assert peak == pytest.approx(0.0, abs=1e-12)


@given(st.floats(0.0, 4.0), PAIRS, st.floats(-3, 3))
def test_the_residual_is_the_ratio_but_for_its_peak(distance, pair, instance):
    e, _, peak = context.context_residual(distance, pair, instance)
    assert peak - 0.5 * e**2 == pytest.approx(context.context_log_ratio(distance, pair, instance), abs=1e-9)
    assert np.sign(e) in (0, np.sign(distance - pair.usual_m))


@given(st.floats(1e-3, 3.0), PAIRS, st.floats(-3, 3))
def test_the_slope_is_the_derivative(distance, pair, instance):
    step = 1e-5 * float(pair.sigma_m)
    ahead, behind = (context.context_residual(distance + d, pair, instance)[0] for d in (step, -step))
    slope = context.context_residual(distance, pair, instance)[1]
    assert slope == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-4)


def test_the_slope_at_the_usual_distance_is_that_beside_it():
    pair = pair_mixture(Relation(0.5, 0.3, 0.1), 4.0)
    at, beside = (context.context_residual(0.3 + d, pair)[1] for d in (0.0, 1e-5))
    assert at == pytest.approx(beside, rel=1e-3)
    assert at > 1


def test_instance_knowledge_mixes_in():
    pair = pair_mixture(Relation(0.5, 0.0, 0.2), 4.0, category_weight=0.5)
    category = context.context_log_ratio(0.1, pair_mixture(Relation(0.5, 0.0, 0.2), 4.0, category_weight=1.0))
    for instance in (-4.0, 0.0, 2.0):
        expected = np.log(0.5 * np.exp(category) + 0.5 * np.exp(instance))
        assert context.context_log_ratio(0.1, pair, instance) == pytest.approx(expected)


@given(SEEDS, st.sampled_from([1e-3, 0.3, 2.0]))
@settings(max_examples=40)
def test_distance_gradients_are_derivatives(seed, apart):
    rng = np.random.default_rng(seed)
    T_a, T_b = random_pose(rng), random_pose(rng)
    a, b = rng.normal(0, 0.1, (2, 3))
    direction = rng.standard_normal(3)
    T_b[:3, 3] = se3.transform(T_a, a[None])[0] - T_b[:3, :3] @ b + apart * direction / np.linalg.norm(direction)
    distance, by_a, by_b = context.pair_distance_jacobians(T_a, T_b, a, b)
    assert distance == pytest.approx(apart)
    step = 1e-4 * apart
    assert np.allclose(by_a, numerical_jacobian(lambda T: context.pair_distance(T, T_b, a, b), T_a, step), atol=1e-6)
    assert np.allclose(by_b, numerical_jacobian(lambda T: context.pair_distance(T_a, T, a, b), T_b, step), atol=1e-6)


@given(SEEDS)
@settings(max_examples=20)
def test_a_pair_has_no_order(seed):
    rng = np.random.default_rng(seed)
    T_a, T_b, a, b = random_pose(rng), random_pose(rng), rng.normal(size=3), rng.normal(size=3)
    assert context.pair_distance(T_a, T_b, a, b) == pytest.approx(context.pair_distance(T_b, T_a, b, a))


def test_the_table_knows_categories_and_named_pairs():
    beside, on = Relation(0.8, 0.3, 0.1), Relation(0.6, 0.4, 0.2)
    relations = CategoryRelations(pairs=(("keyboard", "mouse", beside), ("drinkware", "table", on)))
    names, categories = ["mouse", "keyboard", "cup", "table", "glass"], ["", "", "drinkware", "", "drinkware"]
    table = context.relation_table(names, categories, relations)
    assert np.array_equal(table.together, table.together.T)
    expected = {(0, 1): beside, (2, 3): on, (4, 3): on, (2, 4): relations.same_category, (0, 2): Relation(strength=0)}
    for (i, j), relation in expected.items():
        one = pair_mixture(relation, relations.area_m2, relations.category_weight)
        ratio = context.context_log_ratio(0.25, one)
        assert context.context_log_ratio(0.25, table[i, j]) == pytest.approx(ratio)
    i, j = np.array([0, 2]), np.array([1, 4])
    assert context.context_log_ratio([0.25, 0.25], table[i, j]).shape == (2,)
    near, far = context.context_log_ratio([0.1, 1.5], table[2, 4])
    assert near > 0 > far


@given(st.floats(-0.1, 0.1), st.floats(0.001, 0.05))
def test_hinges_cost_only_what_is_too_much(excess, sigma):
    value = context.hinge_log_potential(excess, sigma)
    residual, slope = context.hinge_residual(excess, sigma)
    assert value == pytest.approx(-0.5 * residual**2)
    if excess < 0:
        assert value == 0
        assert slope == 0
    if abs(excess) > 1e-6:
        numerical = (context.hinge_residual(excess + 1e-8, sigma)[0] - residual) / 1e-8
        assert slope == pytest.approx(numerical, rel=1e-4, abs=1e-4)


@given(st.floats(-5, 5), st.integers(1, 500))
def test_a_pair_counts_once_however_many_keyframes_it_stands(log_ratio, keyframes):
    shares = np.full(keyframes, context.per_keyframe(log_ratio, keyframes))
    assert shares.sum() == pytest.approx(log_ratio, abs=1e-9)


@given(st.floats(-1e5, 50.0), st.floats(1e-9, 0.5))
def test_what_contradicts_a_doubtful_premise_is_charged_the_doubt_at_most(log_potential, doubt):
    said = context.doubted(log_potential, doubt)
    assert said >= np.log(doubt) - 1e-9
    assert said == pytest.approx(np.log((1.0 - doubt) * np.exp(log_potential) + doubt), abs=1e-9)
    assert context.doubted(0.0, doubt) == pytest.approx(0.0, abs=1e-9)  # nor does doubt cost what fits
