"""Laws of the Levenberg-Marquardt loop: GTSAM's answer, energies that never rise, and honest ends."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.smoothing.solver import optimise
from factors.custom import custom_factor
from sequences import se3


def noisy_chain(seed, n=12, scale=0.3):
    """A pose chain with loops, measured with noise, and a bad start."""
    rng = np.random.default_rng(seed)
    truth = [np.eye(4)]
    for _ in range(n - 1):
        truth.append(truth[-1] @ se3.exp(rng.normal(size=6) * 0.4))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas = np.repeat([0.02, 0.01], 3)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(truth[0]), gtsam.noiseModel.Diagonal.Sigmas(1e-3 * sigmas)))
    for i, j in [*pairwise(range(n)), (0, n // 2), (1, n - 1)]:
        seen = se3.inverse(truth[i]) @ truth[j] @ se3.exp(rng.normal(size=6) * sigmas)
        graph.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(seen), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    for k, T in enumerate(truth):
        values.insert(k, gtsam.Pose3(T @ se3.exp(scale * rng.normal(size=6))))
    return graph, values


def residual_factor(function, jacobian, key=0):
    """A factor of one 6-vector."""
    model = gtsam.noiseModel.Unit.Create(6)
    return custom_factor("test", (key,), model, lambda v, _need: (function(v[0]), (jacobian(v[0]),)))


def vector_problem(function, jacobian, start):
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(residual_factor(function, jacobian))
    values.insert(0, np.asarray(start, dtype=np.float64))
    return graph, values


@settings(max_examples=15)
@given(st.integers(0, 2**31), st.sampled_from([0.01, 0.3, 0.8]))
def test_it_finds_what_gtsam_finds(seed, scale):
    graph, values = noisy_chain(seed, scale=scale)
    ours = optimise(graph, values, max_iterations=100, tolerance=1e-10)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    assert ours.end == "converged"
    assert ours.energy <= graph.error(theirs) * (1 + 1e-6) + 1e-9
    if ours.energy > graph.error(theirs) * (1 - 1e-6):  # both in one valley
        for k in range(values.size()):
            np.testing.assert_allclose(ours.values.atPose3(k).matrix(), theirs.atPose3(k).matrix(), atol=1e-4)


@settings(max_examples=15)
@given(st.integers(0, 2**31), st.sampled_from([0.3, 1.5, 3.0]), st.integers(1, 6))
def test_energies_never_rise_and_the_last_is_the_solutions(seed, scale, cap):
    graph, values = noisy_chain(seed, scale=scale)
    before = [values.atPose3(k).matrix() for k in range(values.size())]
    solution = optimise(graph, values, max_iterations=cap, tolerance=1e-9)
    assert (np.diff(solution.trace) <= 0).all()
    assert solution.trace[0] == graph.error(values)
    assert solution.trace[-1] == solution.energy == graph.error(solution.values)
    assert len(solution.trace) <= cap + 1
    assert solution.end in ("converged", "cap", "stalled")
    assert (solution.end == "cap") <= (len(solution.trace) == cap + 1)
    for k, T in enumerate(before):
        np.testing.assert_array_equal(values.atPose3(k).matrix(), T)


def test_out_of_iterations_is_called_that():
    graph, values = noisy_chain(0, scale=0.8)
    assert optimise(graph, values, max_iterations=1, tolerance=1e-12).end == "cap"


def test_a_start_at_the_minimum_has_converged():
    graph, values = noisy_chain(0)
    found = optimise(graph, values, max_iterations=100, tolerance=1e-10)
    again = optimise(graph, found.values, max_iterations=100, tolerance=1e-6)
    assert again.end == "converged"
    assert len(again.trace) <= 2


def test_a_linear_problem_takes_one_undamped_step():
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(6, 6)) + 6 * np.eye(6), rng.normal(size=6)
    graph, values = vector_problem(lambda x: A @ x - b, lambda x: A, np.zeros(6))
    solution = optimise(graph, values, max_iterations=5, tolerance=1e-9)
    assert solution.trace[1] == pytest.approx(0.0, abs=1e-20)
    np.testing.assert_allclose(solution.values.atVector(0), np.linalg.solve(A, b), atol=1e-10)


def test_where_undamped_steps_overshoot_damping_finds_the_way():
    """Gauss-Newton diverges on arctan from 3; the loop must not."""

    def bent(x):
        return np.arctan(x)

    def slope(x):
        return np.diag(1.0 / (1.0 + x**2))

    graph, values = vector_problem(bent, slope, np.full(6, 3.0))
    solution = optimise(graph, values, max_iterations=200, tolerance=1e-12)
    assert solution.end == "converged"
    np.testing.assert_allclose(solution.values.atVector(0), 0.0, atol=1e-5)
    assert (np.diff(solution.trace) <= 0).all()


def test_a_direction_that_nothing_holds_is_survived():
    """A singular system is damped, not fatal."""
    P = np.diag([1.0, 1, 1, 0, 0, 0])
    graph, values = vector_problem(lambda x: P @ (x - 1.0), lambda x: P, np.zeros(6))
    solution = optimise(graph, values, max_iterations=50, tolerance=1e-12)
    assert solution.end == "converged"
    np.testing.assert_allclose(solution.values.atVector(0), [1, 1, 1, 0, 0, 0], atol=1e-4)


def test_a_wrong_derivative_is_a_stall_and_says_so():
    """Every step the linearisation offers goes uphill."""
    graph, values = vector_problem(lambda x: x - 1.0, lambda x: -np.eye(6), np.zeros(6))
    solution = optimise(graph, values, max_iterations=50, tolerance=1e-9)
    assert solution.end == "stalled"
    assert solution.energy == graph.error(values)
    np.testing.assert_array_equal(solution.values.atVector(0), 0.0)


@settings(max_examples=15)
@given(st.floats(-3, 3), st.floats(-3, 3))
def test_a_narrow_curved_valley_is_followed_to_its_end_or_not_called_converged(x, y):
    """Rosenbrock's function."""

    def function(v):
        return np.array([10.0 * (v[1] - v[0] ** 2), 1.0 - v[0], *v[2:]])

    def jacobian(v):
        J = np.eye(6)
        J[0, :2], J[1, :2] = [-20.0 * v[0], 10.0], [-1.0, 0.0]
        return J

    graph, values = vector_problem(function, jacobian, [x, y, 0, 0, 0, 0])
    solution = optimise(graph, values, max_iterations=300, tolerance=1e-6)
    assert solution.end in ("converged", "cap")
    if solution.end == "converged":
        assert solution.energy < 1e-4


def test_a_step_that_changes_nothing_though_much_is_promised_is_not_convergence():
    """Newton's method on the root of |x| jumps from x to -x for ever."""

    def function(x):
        return np.sqrt(np.abs(x))

    def jacobian(x):
        return np.diag(np.sign(x) / (2.0 * np.sqrt(np.abs(x))))

    graph, values = vector_problem(function, jacobian, np.full(6, 2.0))
    solution = optimise(graph, values, max_iterations=60, tolerance=1e-6)
    assert solution.end in ("cap", "stalled") or solution.energy < 1e-3
    assert optimise(graph, values, max_iterations=1, tolerance=1e-6).end == "cap"


@settings(max_examples=15)
@given(st.integers(0, 2**31), st.sampled_from([0.3, 1.5, 3.0]))
def test_where_it_converged_the_linearisation_promises_no_more(seed, scale):
    graph, values = noisy_chain(seed, scale=scale)
    solution = optimise(graph, values, max_iterations=60, tolerance=1e-6)
    if solution.end == "converged":
        linear = graph.linearize(solution.values)
        promised = solution.energy - linear.error(linear.optimize())
        assert promised <= 1e-4 * max(solution.energy, 1.0)
