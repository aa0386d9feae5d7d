"""Laws of the trellis, against all paths enumerated, GTSAM's discrete elimination, and exact integrals."""

from dataclasses import replace
from itertools import pairwise, product

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.landing import landing_log_density
from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.discrete import PRESENT_AT_FIRST, Stage, solve
from factors import mixture, prediction
from factors.mixture import LOG_2PI
from factors.persistence import stay_probability
from sequences import se3
from tests.ctmap_gtsam.scenes import classes, config_of, level

WALKING = ("prediction.rotation_rate=0.2", "prediction.translation_rate=0.05")
MODEL = Model(classes("mug"), config_of(*WALKING, "smoother.unmeasured=0.0"))
"""without the unmeasured, every state is what is known of the past: paths can be enumerated"""
MUG = MODEL.shapes[0]
USUAL = Model(classes("mug"), config_of())
STILL = np.full(6, 1e-18)
"""localisation without error"""
SMALL = 1e-8
"""variance of modes that are so precise that what is known of the past is the last mode alone: a Markov chain"""


def random_stages(rng, sizes, gaps=(0.2, 1.0, 40.0)):
    """Stages of precise modes within a decimetre."""
    time, stages = 0.0, []
    for k, n in enumerate(sizes):
        T = se3.exp(rng.normal(size=(n, 6)) * np.repeat([0.2, 0.05], 3))
        # about as likely as not being there: the modes' volume and the place's are made up for
        nats = 3.0 * rng.normal(size=n) + 49.0
        stages.append(Stage(k, time, T, np.tile(SMALL * np.eye(6), (n, 1, 1)), nats))
        time += rng.choice(gaps)
    return stages


def log_steps(stages, model, shape):
    """Start (n + 1,), emissions and transitions in the model's words, the last state being gone; and stays apart."""
    uniform = model.log_uniform(shape)
    emissions = [
        np.append(s.log_evidence + 0.5 * (np.linalg.slogdet(s.covariance)[1] + 6 * LOG_2PI), 0.0) for s in stages
    ]
    start = np.append(np.full(len(stages[0].log_evidence), np.log(PRESENT_AT_FIRST) + uniform), np.log(0.5))
    steps, stays = [], []
    p = model.config.prediction
    for a, b in pairwise(stages):
        n, m = len(a.log_evidence), len(b.log_evidence)
        dt = b.time_s - a.time_s
        stay = 1.0
        if dt > p.significant_period_s:
            stay = float(stay_probability(dt, shape.source.persistence_s, p.stay_limit, 1.0 - p.stay_limit))
        stay = min(stay, 1.0 - p.jump_probability)
        sigma = model.prediction_covariance(min(dt, p.significant_period_s))
        there = np.full((n, m), -np.inf)
        for i, j in product(range(n), range(m)):
            there[i, j] = np.log(stay) + prediction.log_potential(a.T_world_centre[i], b.T_world_centre[j], sigma)
        elsewhere = np.log((1.0 - stay) / 2.0)
        step = np.full((n + 1, m + 1), elsewhere + uniform)
        step[:n, :m] = np.logaddexp(there, elsewhere + uniform)
        step[:n, m] = elsewhere
        step[n, m] = np.log1p(-np.exp(elsewhere))
        steps.append(step)
        stays.append(there)
    return start, emissions, steps, stays


def without_unmeasured(path, stages):
    """The path with gone numbered after the modes."""
    return tuple(min(s, len(stage.log_evidence)) for s, stage in zip(path, stages, strict=True))


def all_paths(start, emissions, steps):
    """Every path with its log weight."""
    for path in product(*(range(len(e)) for e in emissions)):
        weight = start[path[0]] + sum(e[s] for e, s in zip(emissions, path, strict=True))
        yield path, weight + sum(step[a, b] for step, a, b in zip(steps, path, path[1:], strict=False))


@settings(max_examples=12)
@given(st.integers(0, 2**31), st.lists(st.integers(1, 3), min_size=1, max_size=4))
def test_the_trellis_sums_over_all_paths(seed, sizes):
    rng = np.random.default_rng(seed)
    stages = random_stages(rng, sizes)
    start, emissions, steps, stays = log_steps(stages, MODEL, MUG)
    paths, weights = zip(*all_paths(start, emissions, steps), strict=True)
    total = mixture.log_sum(np.array(weights))
    posterior = solve(stages, MODEL, MUG, STILL)
    assert posterior.log_evidence == pytest.approx(total, abs=1e-3)
    share = np.exp(np.array(weights) - total)
    for k, marginal in enumerate(posterior.modes):
        expected = np.bincount([p[k] for p in paths], share, minlength=len(marginal) - 1)
        np.testing.assert_allclose(np.delete(marginal, -2), expected, atol=1e-3)
        assert marginal[-2] == 0.0
    sizes = [len(s.log_evidence) for s in stages]
    gone = [m[-1] > 0.5 for m in posterior.modes]
    there = [all((s == n) == g for s, n, g in zip(p, sizes, gone, strict=True)) for p in paths]
    among = np.where(there, weights, -np.inf)
    ordered = np.sort(among)
    if len(ordered) == 1 or ordered[-1] - ordered[-2] > 1e-2:
        assert without_unmeasured(posterior.path, stages) == paths[int(np.argmax(among))]
    for k, (step, stay) in enumerate(zip(steps, stays, strict=True)):
        n, m = stay.shape
        either = sum(w for p, w in zip(paths, share, strict=True) if p[k] < n or p[k + 1] < m)
        stayed = sum(
            w * np.exp(stay[p[k], p[k + 1]] - step[p[k], p[k + 1]])
            for p, w in zip(paths, share, strict=True)
            if p[k] < n and p[k + 1] < m
        )
        assert posterior.moved[k] == pytest.approx(either - stayed, abs=2e-3)


def test_marginals_and_best_path_are_those_of_gtsam():
    rng = np.random.default_rng(4)
    stages = random_stages(rng, (2, 3, 1, 2, 3))
    start, emissions, steps, _ = log_steps(stages, MODEL, MUG)
    graph, keys = gtsam.DiscreteFactorGraph(), [(k, len(e)) for k, e in enumerate(emissions)]

    def table(logs):
        return list(np.exp(logs - logs.max()).ravel())

    graph.add(keys[0], table(start))
    for key, emission in zip(keys, emissions, strict=True):
        graph.add(key, table(emission))
    for a, b, step in zip(keys, keys[1:], steps, strict=False):
        graph.add([a, b], table(step))
    marginals = gtsam.DiscreteMarginals(graph)
    for key, n in keys:  # the best path is there just where that is likelier than gone
        gone = marginals.marginalProbabilities((key, n))[n - 1] > 0.5
        graph.add((key, n), [float(gone == (s == n - 1)) for s in range(n)])
    best = graph.optimize()
    posterior = solve(stages, MODEL, MUG, STILL)
    for key, marginal in zip(keys, posterior.modes, strict=True):
        expected = marginals.marginalProbabilities(key)[: len(marginal) - 1]
        np.testing.assert_allclose(np.delete(marginal, -2), expected, atol=1e-3)
    assert without_unmeasured(posterior.path, stages) == tuple(best[k] for k, _ in keys)


def vague_track(rng, n, sigma=0.004):
    """One vague mode a stage of a thing that stands still: translations with random covariances."""
    stages = []
    for k in range(n):
        A = rng.normal(size=(3, 3)) / np.sqrt(3)
        covariance = np.diag(np.full(6, 1e-10))
        covariance[3:, 3:] = sigma**2 * (A @ A.T + 0.3 * np.eye(3))
        T = se3.make(np.eye(3), rng.multivariate_normal(np.zeros(3), covariance[3:, 3:]))
        stages.append(Stage(k, 0.5 * k + 0.1 * rng.random(), T[None], covariance[None], np.array([60.0])))
    return stages


def test_evidence_of_a_track_is_the_integral_over_its_poses():
    """Law 7 of the model: with one mode a stage it is Kalman's evidence, however vague the single views are."""
    still = ("prediction.rotation_rate=1e-6", "prediction.jump_probability=1e-15", "smoother.unmeasured=0.0")
    config = config_of(*still)
    model = Model(classes("mug"), config)
    rng = np.random.default_rng(2)
    stages, shape = vague_track(rng, 9), model.shapes[0]
    # information form over all poses at once: the first anywhere, then a random walk
    n = len(stages)
    information, vector, constant = np.zeros((6 * n, 6 * n)), np.zeros(6 * n), 0.0
    for k, stage in enumerate(stages):
        here = slice(6 * k, 6 * k + 6)
        L, z = np.linalg.inv(stage.covariance[0]), se3.log(stage.T_world_centre[0])
        information[here, here] += L
        vector[here] += L @ z
        constant += stage.log_evidence[0] - 0.5 * z @ L @ z
        if k:
            Q = model.prediction_covariance(stage.time_s - stages[k - 1].time_s)
            D = np.kron(np.eye(n)[k] - np.eye(n)[k - 1], np.eye(6))
            information += D.T @ np.linalg.inv(Q) @ D
            constant -= 0.5 * (np.linalg.slogdet(Q)[1] + 6 * LOG_2PI)
    mean = np.linalg.solve(information, vector)
    integral = constant + 0.5 * vector @ mean + 0.5 * (6 * n * LOG_2PI - np.linalg.slogdet(information)[1])
    expected = np.log(PRESENT_AT_FIRST) + model.log_uniform(shape) + integral
    posterior = solve(stages, model, shape, STILL)
    assert posterior.log_evidence == pytest.approx(expected, abs=1e-4)
    assert all(m[0] > 1 - 1e-9 for m in posterior.modes)
    assert (posterior.moved < 1e-9).all()


def test_more_views_of_one_thing_are_more_evidence_for_it_and_not_less():
    rng = np.random.default_rng(3)
    stages = vague_track(rng, 12)
    grown = [solve(stages[:n], MODEL, MUG, STILL).log_evidence for n in range(1, 13)]
    assert (np.diff(grown) > 0).all()


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.integers(2, 4), st.integers(1, 4))
def test_a_hump_counts_once_however_many_modes_it_has(seed, times, views):
    """Modes found again and again in one place say no more than one: neither of the class nor of which place it is."""
    rng = np.random.default_rng(seed)
    T = se3.make(np.eye(3), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    covariance = np.tile(1e-4 * np.eye(6), (2, 1, 1))
    once = [Stage(k, 0.2 * k, T, covariance, 40.0 + rng.normal(size=2)) for k in range(views)]
    again = [0] + [1] * times
    often = [
        replace(s, T_world_centre=T[again], covariance=covariance[again], log_evidence=s.log_evidence[again])
        for s in once
    ]
    a, b = solve(once, USUAL, MUG, STILL), solve(often, USUAL, MUG, STILL)
    assert b.log_evidence == pytest.approx(a.log_evidence, abs=1e-9)
    for before, after in zip(a.modes, b.modes, strict=True):
        assert after[0] == pytest.approx(before[0], abs=1e-9)
        assert after[1 : 1 + times].sum() == pytest.approx(before[1], abs=1e-9)


def test_modes_along_a_ridge_say_no_more_than_the_ridge():
    """Of a ridge that depth leaves flat a few modes stand side by side: they count for less than their sum."""
    T = se3.make(np.eye(3), np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    covariance = np.tile(np.diag([1e-4] * 3 + [4e-4, 1e-4, 1e-4]), (3, 1, 1))
    stages = [Stage(k, 0.2 * k, T, covariance, np.full(3, 60.0)) for k in range(20)]
    shares = solve(stages, USUAL, MUG, STILL).modes[10][:3]
    assert 0.25 < shares[:2].sum() / shares[2] < 4.0  # each counted in full, it would be a million


def test_a_wide_mode_doesnt_win_for_being_wide_only():
    """Two modes of one height: the shares are those of their volumes. At equal mass they are equal."""
    covariance = np.stack([1e-4 * np.eye(6), 4e-4 * np.eye(6)])
    volumes = np.array([0.0, 6 * np.log(2.0)])
    T = se3.make(np.eye(3), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    alike = solve([Stage(0, 0.0, T, covariance, 80.0 - volumes)], MODEL, MUG, STILL).modes[0]
    high = solve([Stage(0, 0.0, T, covariance, np.full(2, 80.0))], MODEL, MUG, STILL).modes[0]
    assert alike[0] == pytest.approx(alike[1])
    assert high[1] / high[0] == pytest.approx(2.0**6)


def at(k, time, x, nats=45.0):
    return Stage(
        k,
        time,
        se3.make(np.eye(3), np.array([[x, 0.0, 0.0]])),
        np.diag(np.repeat([1e-4, 1e-6], 3))[None],
        np.array([nats]),
    )


def test_when_it_was_moved_is_told_from_when_it_was_gone():
    """Present, gone from view for a day, seen elsewhere: it was moved in the gap and at no other time."""
    day = 86400.0
    stages = [at(0, 0.0, 0.0), at(1, 1.0, 0.0), at(2, day, 0.25), at(3, day + 1.0, 0.25)]
    posterior = solve(stages, USUAL, MUG, STILL)
    assert posterior.path == (0, 0, 0, 0)
    assert posterior.moved[1] > 0.99
    assert (posterior.moved[[0, 2]] < 0.01).all()
    still = solve([at(k, t, 0.0) for k, t in enumerate((0.0, 1.0, day, day + 1.0))], USUAL, MUG, STILL)
    assert (still.moved < 0.01).all()


def test_a_place_seen_empty_says_from_when_on_it_was_gone():
    empty = -60.0  # a pose that should show and doesn't
    stages = [at(0, 0.0, 0.0), at(1, 1.0, 0.0), at(2, 86400.0, 0.0, empty), at(3, 86401.0, 0.0, empty)]
    posterior = solve(stages, USUAL, MUG, STILL)
    assert posterior.path == (0, 0, 2, 2)
    assert [m[-1] > 0.99 for m in posterior.modes] == [False, False, True, True]


def test_a_moment_hidden_is_not_an_absence():
    """A view that says nothing either way leaves it where it was."""
    flat = Stage(2, 2.0, np.eye(4)[None], np.diag(np.repeat([1e-4, 1e-6], 3))[None], np.zeros(1))
    stages = [at(0, 0.0, 0.0), at(1, 1.0, 0.0), flat, at(3, 3.0, 0.0), at(4, 4.0, 0.0)]
    posterior = solve(stages, USUAL, MUG, STILL)
    assert posterior.path == (0, 0, 0, 0, 0)
    assert posterior.modes[2][-1] < 0.01


@pytest.mark.parametrize("wrong", [0.03, 0.5])
def test_a_view_that_is_misread_is_no_move(wrong):
    """One view in the middle has its only mode elsewhere, and explains it far better than its neighbours theirs."""
    stages = [at(k, float(k), 0.0) for k in range(4)] + [at(4, 4.0, wrong, 100.0)]
    stages += [at(k, float(k), 0.0) for k in range(5, 9)]
    posterior = solve(stages, USUAL, MUG, STILL)
    assert posterior.path == (0, 0, 0, 0, 1, 0, 0, 0, 0)
    assert (posterior.moved < 0.01).all()
    assert all(m[-1] < 0.01 for m in posterior.modes)


def test_what_is_seen_elsewhere_from_some_view_on_has_moved_there():
    stages = [at(k, float(k), 0.0) for k in range(5)] + [at(k, float(k), 0.1) for k in range(5, 10)]
    posterior = solve(stages, USUAL, MUG, STILL)
    assert posterior.path == (0,) * 10
    np.testing.assert_allclose(posterior.moved, np.arange(9) == 4, atol=0.01)


def test_two_places_are_not_held_together_because_nobody_knows_when_it_left_the_first():
    """Any of four steps may be the one in which it moved, so that it more likely stayed over each; the path jumps."""
    places = np.concatenate([at(0, 0.0, x).T_world_centre for x in (0.0, 0.5)])
    either = [
        Stage(k, float(k), places, np.tile(at(0, 0.0, 0.0).covariance, (2, 1, 1)), np.full(2, 45.0))
        for k in range(3, 6)
    ]
    stages = [at(k, float(k), 0.0) for k in range(3)] + either + [at(k, float(k), 0.5) for k in range(6, 9)]
    posterior = solve(stages, USUAL, MUG, STILL)
    x = [stage.T_world_centre[state, 0, 3] for stage, state in zip(stages, posterior.path, strict=True)]
    jumps = np.flatnonzero(np.diff(x) > 0.4) + 1
    assert len(jumps) == 1
    assert (posterior.moved < 0.4).all()
    assert [i for i in range(1, 9) if not posterior.stayed(i)] == jumps.tolist()


def test_what_was_known_before_a_move_says_nothing_of_the_new_place():
    """The evidence is that of both places apart and of the move, however vague the views: 3 m away, a day later."""
    model = Model(classes("mug"), config_of("smoother.unmeasured=0.0"))
    rng, day = np.random.default_rng(6), 86400.0
    before, later = vague_track(rng, 5), vague_track(rng, 6)
    away = se3.make(np.eye(3), np.array([3.0, 0.0, 0.0]))
    after = [
        replace(s, keyframe=5 + s.keyframe, time_s=day + s.time_s, T_world_centre=away @ s.T_world_centre)
        for s in later
    ]
    whole = solve(before + after, model, MUG, STILL)
    there = np.log(PRESENT_AT_FIRST)
    gap = after[0].time_s - before[-1].time_s
    move = np.log((1.0 - model.stay_probability(MUG.source, gap)) / 2.0)
    apart = solve(before, model, MUG, STILL).log_evidence - there + solve(after, model, MUG, STILL).log_evidence + move
    assert whole.log_evidence == pytest.approx(apart, abs=1e-3)
    assert whole.moved[4] == pytest.approx(1.0)


def test_what_was_moved_in_an_absence_landed_and_what_was_pushed_in_view_is_anywhere():
    """A surface right below the new place changes the evidence by the landing density, after an absence alone."""
    model = Model(classes("mug"), config_of("smoother.unmeasured=0.0"))
    surface = (level(float(MUG.hull_points[:, 2].min())),)
    for gap, lands in ((86400.0, True), (1.0, False)):
        stages = [at(0, 0.0, 0.0), at(1, 1.0, 0.0), at(2, 1.0 + gap, 0.25), at(3, 2.0 + gap, 0.25)]
        known, unknown = (solve(stages, model, MUG, STILL, s).log_evidence for s in (surface, ()))
        landing = landing_log_density(model, MUG, stages[2].T_world_centre, surface, stages[2].covariance)[0]
        assert landing > model.log_uniform(MUG) + 2.0
        assert known - unknown == pytest.approx(landing - model.log_uniform(MUG) if lands else 0.0, abs=1e-3)


def test_a_view_without_modes_leaves_it_where_it_was():
    nothing = Stage(2, 2.0, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), np.zeros(0))
    stages = [at(0, 0.0, 0.0), at(1, 1.0, 0.0), nothing, at(3, 3.0, 0.0), at(4, 4.0, 0.0)]
    posterior = solve(stages, USUAL, MUG, STILL)
    assert posterior.path == (0, 0, 0, 0, 0)
    assert posterior.modes[2][0] == pytest.approx(1.0)
    assert (posterior.moved < 0.01).all()


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.lists(st.integers(0, 3), min_size=2, max_size=6))
def test_probabilities_sum_to_one_with_the_unmeasured_too(seed, sizes):
    posterior = solve(random_stages(np.random.default_rng(seed), sizes), USUAL, MUG, np.full(6, 1e-6))
    for marginal in posterior.modes:
        assert marginal.sum() == pytest.approx(1.0)
    assert ((posterior.moved >= 0.0) & (posterior.moved <= 1.0)).all()


def test_many_poses_that_share_what_speaks_for_them_are_not_outvoted_by_gone():
    """Eight modes each half as likely as gone: four times as likely together."""
    empty = np.array([0.5 * (np.linalg.slogdet(1e-4 * np.eye(6))[1] + 6 * LOG_2PI)])
    nats = np.full(8, -np.log(2.0)) - empty - USUAL.log_uniform(MUG)
    T = se3.make(np.eye(3), np.linspace(0.0, 0.2, 8)[:, None] * [1.0, 0.0, 0.0])
    posterior = solve([Stage(0, 0.0, T, np.tile(1e-4 * np.eye(6), (8, 1, 1)), nats)], USUAL, MUG, STILL)
    assert posterior.modes[0][-1] < 0.25
    assert posterior.path[0] < 8


def test_an_object_that_cant_be_moved_stays_however_long_nobody_looks():
    fixed = replace(MUG, source=replace(MUG.source, movable=False))
    stages = [at(0, 0.0, 0.0), at(1, 1e7, 0.2)]
    assert solve(stages, USUAL, MUG, STILL).log_evidence > solve(stages, USUAL, fixed, STILL).log_evidence + 1.0
