"""Laws of the fixed-lag smoother: nothing later leaks back, and with hindsight enough it is the batch."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.smoothing.graph import build, smooth
from ctmap_gtsam.smoothing.lagged import lagged_run
from ctmap_gtsam.smoothing.window import Window
from factors.symmetry import Symmetry, residual
from sequences import se3
from tests.ctmap_gtsam.scenes import CHEAP, config_of, cut, rows_of, small_run
from tests.ctmap_gtsam.test_smoother_graph import MODEL, MUG, Problem, rauch_tung_striebel, solved, some_problem
from tests.ctmap_gtsam.test_smoother_run import row_of

QUICK = config_of(
    *CHEAP,
    "frontend.start_after=2",
    "frontend.angular_step_rad=0.01",
    "frontend.mesh_faces=200",
    "frontend.fresh_poses=200",
)
TIGHT = replace(QUICK, smoother=replace(QUICK.smoother, window=2, remembered=2))
"""so that keyframes of a short run leave the window, and looks are forgotten"""


@cache
def turned_over():
    """Two visits; the mug is found late, and moved in between."""
    run, truth = small_run(frames=6, visits=2, seen=lambda k, name: name != "mug" or k > 1, moved={"mug": (0.02, 0.2)})
    return run, truth


@cache
def part_of(n: int | None):
    """The run, or its first n frames, and what the filter says of them."""
    run, _ = turned_over()
    run = run if n is None else cut(run, n)
    return run, filter_run(run, QUICK)


@cache
def estimate_of(lag: int, n: int | None = None, config: Config = TIGHT) -> Estimate:
    return lagged_run(*part_of(n), config, lag=lag)


def up_to(problem: Problem, n: int) -> Problem:
    measured = {k: z for k, z in problem.measured.items() if k < n}
    return Problem(problem.times[:n], problem.visits[:n], measured, problem.noise)


@settings(max_examples=6)
@given(st.integers(0, 2**31), st.sampled_from([0.0, 0.002]), st.sampled_from([1, 3]))
def test_a_window_that_slides_is_the_rauch_tung_striebel_smoother_given_what_was_seen(seed, noise, length):
    """Law 7 of the model: of all that leaves the window, nothing is lost where all is linear and Gaussian."""
    problem, window = some_problem(seed, noise), Window(length)
    for n in range(1, len(problem.times) + 1):
        seen = up_to(problem, n)
        first = window.first
        assert first == max(0, n - length)
        smoothed, window = window.solve(MODEL, seen.cameras(), seen.noise, {0: (MUG, seen.modes())})
        for k, (m, P) in list(enumerate(rauch_tung_striebel(seen)))[first:]:
            np.testing.assert_allclose(smoothed.T_world_camera[k - first][:3, 3], m[3:6], atol=1e-8)
            if k in seen.measured:
                T, covariance = smoothed.objects[0][k]
                np.testing.assert_allclose(T[:3, 3], m[:3], atol=1e-8)
                np.testing.assert_allclose(covariance[3:, 3:], P[:3, :3], atol=1e-6 * P[:3, :3].max())


def test_with_a_lag_as_long_as_the_run_the_window_is_the_batch():
    """Law 7 of the model: fixed lag with L >= T = batch."""
    problem, window = some_problem(5, 0.002), Window(100)
    batch = solved(problem)[1]
    for n in range(1, len(problem.times) + 1):
        seen = up_to(problem, n)
        smoothed, window = window.solve(MODEL, seen.cameras(), seen.noise, {0: (MUG, seen.modes())})
    np.testing.assert_array_equal(smoothed.T_world_camera, batch.T_world_camera)
    for k, (T, covariance) in batch.objects[0].items():
        np.testing.assert_array_equal(smoothed.objects[0][k][0], T)
        np.testing.assert_array_equal(smoothed.objects[0][k][1], covariance)


def test_what_was_carried_of_an_object_is_another_objects_where_the_trellis_changes_its_mind():
    """Then its measurements before the window are left to the cameras alone, as if they were of something else."""
    problem, window = some_problem(7, 0.002), Window(3)
    modes = problem.modes()
    for n in range(1, len(problem.times)):
        both = up_to(problem, n).modes()
        _, window = window.solve(MODEL, problem.cameras()[:n], problem.noise, {0: (MUG, both), 1: (MUG, both)})
    _, left = window.left[0]
    elsewhere = replace(left, T_camera_centre=se3.make(np.eye(3), np.ones(3)))
    changed = [elsewhere if m.keyframe == left.keyframe else m for m in modes]
    old = [m for m in modes if m.keyframe < window.first]
    late = modes[len(old) :]
    assert old
    assert late
    smoothed, _ = window.solve(MODEL, problem.cameras(), problem.noise, {0: (MUG, changed), 1: (MUG, modes)})
    objects = {0: (MUG, late), 1: (MUG, modes), 2: (MUG, old)}
    batch = smooth(build(MODEL, problem.cameras(), problem.noise, objects), MODEL, len(problem.times))
    for i in (0, 1):
        for m in late:
            (T, covariance), (T_batch, covariance_batch) = (s.objects[i][m.keyframe] for s in (smoothed, batch))
            np.testing.assert_allclose(T, T_batch, atol=1e-8)
            np.testing.assert_allclose(covariance, covariance_batch, atol=1e-6 * covariance_batch.max())


@pytest.mark.parametrize("lag", [0, 2])
def test_what_is_said_of_a_keyframe_hangs_on_the_lag_after_it_and_on_nothing_later(lag):
    """Law 2 of the model, to the byte."""
    whole = estimate_of(lag)
    for n in (4, 9):
        part = estimate_of(lag, n)
        assert list(part.keyframe_frame) == list(whole.keyframe_frame[:n])
        for k in range(n - lag):
            all_, cut_ = rows_of(whole, k), rows_of(part, k)
            assert all_.keys() == cut_.keys()
            np.testing.assert_array_equal(whole.T_world_camera[k], part.T_world_camera[k])
            np.testing.assert_array_equal(whole.camera_covariance[k], part.camera_covariance[k])
            for i, said in all_.items():
                for a, b in zip(said[:3] + said[4:], cut_[i][:3] + cut_[i][4:], strict=True):
                    np.testing.assert_array_equal(a, b)
                for name, value in said[3].items():
                    np.testing.assert_array_equal(value, cut_[i][3][name])


def test_moves_are_those_believed_the_lag_after_the_gap():
    """Law 2 of the model for what happened between keyframes."""
    lag, n = 2, 9
    whole, part = estimate_of(lag), estimate_of(lag, n)

    def said(estimate):
        due = estimate.moves.gap[:, 1] < n - lag
        return {
            (int(estimate.object_id[row]), *gap): p
            for row, gap, p in zip(
                estimate.moves.object[due],
                estimate.moves.gap[due].tolist(),
                estimate.moves.probability[due],
                strict=True,
            )
            for gap in [tuple(gap)]
        }

    assert said(whole)
    assert said(whole) == said(part)


def test_hindsight_of_two_keyframes_knows_what_the_past_does_not():
    """The detector finds the mug from the third frame on, and a track starts with its second box."""
    _, truth = turned_over()
    known = {lag: estimate_of(lag).existence[row_of(estimate_of(lag), truth, "mug", 5)] > 0.5 for lag in (0, 2)}
    assert list(known[0][:4]) == [False, False, False, True]
    assert list(known[2][:4]) == [False, True, True, True]


@pytest.mark.parametrize("lag", [0, 2])
def test_what_stands_there_is_found_where_it_stands_though_the_window_has_slid_on(lag):
    run, truth = turned_over()
    estimate = estimate_of(lag)
    for name, T in truth.items():
        source = next(c for c in run.catalogue.classes if c.name == name)
        row = row_of(estimate, truth, name, 5)
        assert (estimate.best_class[row, 3:6] == source.obj_id).all()
        assert (estimate.existence[row, 3:6] > 0.9).all()
        r = residual(estimate.pose[row, 3:6], T, Symmetry.of(source))
        assert np.linalg.norm(r[:, 3:], axis=-1).max() < 0.004


def test_a_thing_that_was_moved_between_visits_is_the_same_object_in_the_end():
    _, truth = turned_over()
    estimate = estimate_of(2)
    mug = row_of(estimate, truth, "mug", 5)
    assert estimate.existence[mug, -1] > 0.9
    step = estimate.pose[mug, -1, :3, 3] - estimate.pose[mug, 5, :3, 3]
    assert np.linalg.norm(step[:2] - [0.1, 0.2]) < 0.05


def test_how_each_window_ended_is_told():
    estimate = estimate_of(2)
    told = estimate.meta["diagnostics"]
    assert told["lag"] == 2
    assert told["windows"] == {"converged": len(estimate.keyframe_frame)}
    assert told["solver"]["end"] == "converged"
    assert (np.diff(told["solver"]["trace"]) <= 0).all()


def test_a_forward_pass_of_another_run_is_refused():
    run, forward = part_of(None)
    with pytest.raises(ValueError, match="another run"):
        lagged_run(replace(run, fingerprint="other"), forward, TIGHT)


def test_looks_beyond_what_is_remembered_lend_their_evidence():
    """What is said of classes and existence hardly depends on how much is kept."""
    roomy, tight = estimate_of(0, config=QUICK), estimate_of(0)
    assert list(roomy.object_id) == list(tight.object_id)
    np.testing.assert_array_equal(roomy.best_class[:, :6], tight.best_class[:, :6])
    np.testing.assert_allclose(roomy.existence[:, :6], tight.existence[:, :6], atol=0.05)
