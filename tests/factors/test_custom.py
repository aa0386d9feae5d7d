"""Laws of the potentials as GTSAM factors, and what happens where a function misbehaves."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings

from factors import context, custom, measurement, mixture, prediction
from factors.terms import Contexts, Gauges, Modes, Predictions
from sequences import se3
from tests.factors.strategies import SEEDS, SYMMETRIES, random_image, random_pose, random_spd, random_tangent

each_symmetry = pytest.mark.parametrize("symmetry", SYMMETRIES.values(), ids=SYMMETRIES.keys())
A, B, BIAS = gtsam.symbol("o", 0), gtsam.symbol("o", 1), gtsam.symbol("b", 0)


def values_of(arrays):
    values = gtsam.Values()
    for key, array in arrays.items():
        values.insert(key, gtsam.Pose3(array) if np.ndim(array) == 2 else np.asarray(array, dtype=np.float64))
    return values


def assert_linearised(factor, values):
    """The factor's linearisation is the derivative of its whitened error by GTSAM's own perturbations."""
    columns = []
    for key in list(factor.keys()):
        for step in 1e-6 * np.eye(values.zeroVectors().at(key).size):
            ahead, behind = gtsam.VectorValues(), gtsam.VectorValues()
            ahead.insert(key, step)
            behind.insert(key, -step)
            ends = [factor.whitenedError(values.retract(delta)) for delta in (ahead, behind)]
            columns.append((ends[0] - ends[1]) / 2e-6)
    analytic, right = factor.linearize(values).jacobian()
    assert np.allclose(analytic, np.stack(columns, axis=1), atol=1e-4 * max(1.0, np.abs(analytic).max()))
    assert np.allclose(right, -factor.whitenedError(values))


@each_symmetry
@given(SEEDS)
@settings(max_examples=5)
def test_prediction_factor(symmetry, seed):
    rng = np.random.default_rng(seed)
    T_a = random_pose(rng)
    T_b = T_a @ se3.exp(random_tangent(rng, 0.5, 1.0)) @ random_image(rng, symmetry)
    sigma = prediction.covariance(0.2, 0.1, 0.5, symmetry)
    factor = custom.terms_factor("prediction", (A, B), Predictions(sigma, symmetry))
    values = values_of({A: T_a, B: T_b})
    log_potential = prediction.log_potential(T_a, T_b, sigma, symmetry)
    constant = mixture.log_constant(np.linalg.inv(symmetry.reduced_covariance(sigma)))
    assert constant - factor.error(values) == pytest.approx(log_potential)
    assert_linearised(factor, values)


@given(SEEDS)
@settings(max_examples=10)
def test_gtsams_between_factor_says_what_a_prediction_without_symmetry_says(seed):
    rng = np.random.default_rng(seed)
    T_a = random_pose(rng)
    values = values_of({A: T_a, B: T_a @ se3.exp(random_tangent(rng, 1.0, 2.5))})
    sigma = np.linalg.inv(random_spd(rng))
    ours, theirs = custom.terms_factor("stays", (A, B), Predictions(sigma)), custom.stay_factor(A, B, sigma)
    assert ours.error(values) == pytest.approx(theirs.error(values), rel=1e-9)
    information = [factor.linearize(values).augmentedInformation() for factor in (ours, theirs)]
    assert np.allclose(information[0], information[1], rtol=1e-9, atol=1e-9 * np.abs(information[0]).max())


@each_symmetry
@pytest.mark.parametrize("with_bias", [False, True])
@given(SEEDS)
@settings(max_examples=4)
def test_mode_factor(symmetry, with_bias, seed):
    rng = np.random.default_rng(seed)
    camera, mode, information = random_pose(rng), random_pose(rng), np.diag([9.0, 9, 9, 25, 25, 25])
    placed = camera @ mode @ se3.exp(random_tangent(rng, 0.3, 1.0)) @ random_image(rng, symmetry)
    bias = 0.1 * rng.standard_normal(6) if with_bias else None
    factor = custom.terms_factor("mode", (A, B, BIAS) if with_bias else (A, B), Modes(mode, information, symmetry))
    values = values_of({A: camera, B: placed} | ({BIAS: bias} if with_bias else {}))
    log_potential = measurement.mode_log_potential(camera, placed, mode, information, bias, symmetry)
    constant = mixture.log_constant(symmetry.reduced_information(information))
    assert constant - factor.error(values) == pytest.approx(log_potential)
    assert_linearised(factor, values)


def test_a_flat_direction_of_a_mode_stays_free():
    rng = np.random.default_rng(0)
    camera, mode = random_pose(rng), random_pose(rng)
    factor = custom.terms_factor("flat", (A, B), Modes(mode, np.diag([0.0, 4, 4, 9, 9, 9])))
    turned = values_of({A: camera, B: camera @ mode @ se3.exp(np.r_[0.7, np.zeros(5)])})
    assert factor.error(turned) == pytest.approx(0.0, abs=1e-12)


@given(SEEDS)
@settings(max_examples=15)
def test_context_factor(seed):
    rng = np.random.default_rng(seed)
    T_a, T_b, centres = random_pose(rng), random_pose(rng), rng.normal(0, 0.1, (2, 3))
    pair = context.pair_mixture(context.Relation(0.4, 0.5, 0.8), 6.0)
    instance, keyframes = 0.3, 7
    terms = Contexts(centres, pair, np.array(instance), np.array(keyframes))
    factor = custom.terms_factor("context", (A, B), terms)
    values = values_of({A: T_a, B: T_b})
    distance = context.pair_distance(T_a, T_b, *centres)
    peak = context.context_residual(distance, pair, instance)[2]
    share = context.per_keyframe(peak - context.context_log_ratio(distance, pair, instance), keyframes)
    assert factor.error(values) == pytest.approx(share, abs=1e-12)
    assert_linearised(factor, values)


def test_the_gauge_lets_elimination_through_and_holds_nothing_else():
    symmetry, rng = SYMMETRIES["axis"], np.random.default_rng(4)
    camera, mode = random_pose(rng), random_pose(rng)
    placed = camera @ mode @ se3.exp(random_tangent(rng, 0.1))
    graph, values = gtsam.NonlinearFactorGraph(), values_of({A: camera, B: placed})
    graph.add(gtsam.PriorFactorPose3(A, gtsam.Pose3(camera), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    graph.add(custom.terms_factor("mode", (A, B), Modes(mode, 1e4 * np.eye(6), symmetry)))
    with pytest.raises(RuntimeError, match=r"Indeterminate"):
        gtsam.Marginals(graph, values).marginalCovariance(B)
    graph.add(custom.terms_factor("gauge", (B,), Gauges(placed, symmetry)))
    assert_linearised(graph.at(2), values)
    covariance = gtsam.Marginals(graph, values).marginalCovariance(B)
    free = symmetry.reader @ covariance @ symmetry.reader.T
    assert free[0, 0] == pytest.approx(np.pi**2, rel=1e-2)
    assert np.all(np.diag(symmetry.reduced_covariance(covariance)) < 1e-3)


def test_a_chain_of_modes_and_predictions_finds_its_object():
    """Noise-free: GTSAM's own optimiser brings an object from 20 degrees and 5 cm away to where all modes see it."""
    rng, symmetry = np.random.default_rng(1), SYMMETRIES["box"]
    truth = random_pose(rng)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(4):
        camera, key, object_key = random_pose(rng), gtsam.symbol("x", k), gtsam.symbol("o", k)
        graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(camera), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        seen = se3.inverse(camera) @ truth @ random_image(rng, symmetry)
        modes = Modes(seen, random_spd(rng) * 1e3, symmetry)
        graph.add(custom.terms_factor(f"mode {k}", (key, object_key), modes))
        if k:
            sigma = prediction.covariance(1e-4, 1e-6, 1.0, symmetry)
            keys = (gtsam.symbol("o", k - 1), object_key)
            graph.add(custom.terms_factor("still", keys, Predictions(sigma, symmetry)))
        values.insert(key, gtsam.Pose3(camera))
        start = truth @ se3.exp(np.r_[np.radians(20) * se3.so3_log(random_pose(rng)[:3, :3]) / 3, 0.03, -0.03, 0.03])
        values.insert(object_key, gtsam.Pose3(start))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    for k in range(4):
        found = result.atPose3(gtsam.symbol("o", k)).matrix()
        assert min(np.abs(se3.local(truth, found @ g)).max() for g in symmetry.discrete) < 1e-6


def two_value_factor(function, rows=2):
    factor = custom.custom_factor("odd one", [A, BIAS], gtsam.noiseModel.Unit.Create(rows), function)
    return factor, values_of({A: np.eye(4), BIAS: np.array([1.0, 2.0, 3.0])})


def test_values_arrive_as_arrays_and_any_memory_order_leaves_as_meant():
    J_pose, J_vector = np.arange(12.0).reshape(2, 6), -np.arange(6.0).reshape(2, 3)
    seen = []

    def function(values, need):
        seen.append((values[0].shape, values[1].tolist(), need))
        return np.array([1, 2], dtype=np.int32), [np.asfortranarray(J_pose), np.repeat(J_vector, 2, axis=1)[:, ::2]]

    factor, values = two_value_factor(function)
    assert factor.error(values) == pytest.approx(2.5)
    assert seen == [((4, 4), [1.0, 2.0, 3.0], False)]
    matrix, right = factor.linearize(values).jacobian()
    assert seen[-1][2]
    assert np.array_equal(matrix, np.hstack([J_pose, J_vector]))
    assert np.array_equal(right, [-1.0, -2.0])


GOOD = (np.zeros(2), (np.zeros((2, 6)), np.zeros((2, 3))))


@pytest.mark.parametrize(
    ("residual", "jacobians", "expected", "got"),
    [
        (np.zeros(3), GOOD[1], (2,), (3,)),
        (np.zeros((2, 1)), GOOD[1], (2,), (2, 1)),
        (GOOD[0], (np.zeros((2, 3)), np.zeros((2, 6))), (2, 6), (2, 3)),
        (GOOD[0], (np.zeros((2, 6)), np.zeros((2, 4))), (2, 3), (2, 4)),
        (GOOD[0], (np.zeros((6, 2)), np.zeros((2, 3))), (2, 6), (6, 2)),
        (GOOD[0], (np.zeros((2, 6)),), (2,), (1,)),
        (GOOD[0], (), (2,), (0,)),
    ],
)
def test_a_wrong_shape_is_an_error_that_names_the_factor(residual, jacobians, expected, got):
    factor, values = two_value_factor(lambda *_: (residual, jacobians))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    with pytest.raises(custom.FactorShapeError, match="odd one") as caught:
        graph.linearize(values)
    assert (caught.value.expected, caught.value.got) == (expected, got)
    assert str(expected) in str(caught.value)
    assert str(got) in str(caught.value)


@pytest.mark.parametrize(
    ("residual", "jacobians"),
    [
        (np.array([0.0, np.nan]), GOOD[1]),
        (GOOD[0], (np.full((2, 6), np.inf), GOOD[1][1])),
        (None, GOOD[1]),
        (np.array(["a", "b"]), GOOD[1]),
        (GOOD[0], (GOOD[1][0], [[1, 2], [3]])),
        (GOOD[0] + 1j, GOOD[1]),
    ],
)
def test_what_is_not_a_finite_number_is_an_error_that_names_the_factor(residual, jacobians):
    factor, values = two_value_factor(lambda *_: (residual, jacobians))
    with pytest.raises(custom.FactorError, match="odd one"):
        factor.linearize(values)


@pytest.mark.parametrize(
    "use",
    [
        gtsam.NonlinearFactorGraph.error,
        gtsam.NonlinearFactorGraph.linearize,
        lambda *problem: gtsam.LevenbergMarquardtOptimizer(*problem).optimize(),
        lambda *problem: gtsam.ISAM2().update(*problem),
        gtsam.Marginals,
    ],
)
def test_an_exception_in_a_function_passes_through_gtsam(use):
    class OwnError(Exception):
        pass

    def function(values, need):
        raise OwnError("from within")

    factor, values = two_value_factor(function)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    graph.add(gtsam.PriorFactorPose3(A, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    with pytest.raises(OwnError, match="from within"):
        use(graph, values)
