"""Laws of the backward pass: where all is Gaussian it is Rauch, Tung and Striebel's, and the end is the filter's."""

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.backward import Tracer, _Line, _Link, backward_run, last_there, leaving, step_back
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.filtering.history import Kept, Past, Stage, one_past
from ctmap_gtsam.filtering.particles import Particles, Spread, Transition
from ctmap_gtsam.filtering.tasks import with_past, without_past
from ctmap_gtsam.filtering.updating import Updater
from ctmap_gtsam.frontend.association import Track
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from factors import mixture, prediction
from sequences import se3
from sequences.types import Detection, LocalisationNoise
from tests.ctmap_gtsam.gaussian import (
    MISSING,
    TIMES,
    GaussianProposer,
    begun,
    coordinates,
    measurements,
    observation_at,
)
from tests.ctmap_gtsam.scenes import CHEAP, assert_the_seed_decides, classes, config_of, model_of, small_run

CONFIG = config_of(*CHEAP, "filter.particles=150", "frontend.fresh_poses=400", "frontend.refined_poses=24")
MODEL = model_of("mug", "soup_can")
MUG = MODEL.shapes[0]
SPREAD = Spread(0.05, 0.005)


def smoothed_by_rts(measured, covariance, model):
    """Means (K, 6) and covariances (K, 6, 6): of Kalman's filter, and of Rauch, Tung and Striebel's smoother."""
    means, spreads, steps = [coordinates(measured[0])], [covariance[0]], []
    for k in range(1, len(TIMES)):
        Q = model.prediction_covariance(TIMES[k] - TIMES[k - 1])
        m, P = means[-1], spreads[-1] + Q
        steps.append(Q)
        if k not in MISSING:
            gain = P @ np.linalg.inv(P + covariance[k])
            m, P = m + gain @ (coordinates(measured[k]) - m), P - gain @ P
        means.append(m)
        spreads.append(P)
    back, wide = [means[-1]], [spreads[-1]]
    for k in range(len(TIMES) - 2, -1, -1):
        ahead = spreads[k] + steps[k]
        G = spreads[k] @ np.linalg.inv(ahead)
        back.insert(0, means[k] + G @ (back[0] - means[k]))
        wide.insert(0, spreads[k] + G @ (wide[0] - ahead) @ G.T)
    return np.array(means), np.array(spreads), np.array(back), np.array(wide)


def test_where_all_is_gaussian_the_smoother_is_that_of_rauch_tung_and_striebel():
    """Law 7 of the model: means and covariances, irregular times, missing measurements, random covariances."""
    config = config_of(
        "filter.particles=2000",
        "filter.trajectories=400",
        "prediction.rotation_rate=0.02",
        "prediction.translation_rate=0.002",
        "prediction.jump_probability=1e-12",
    )
    model = Model(classes("mug"), config, context=False)
    measured, covariance = measurements(np.random.default_rng(5))
    updater = Updater(model, GaussianProposer(measured, covariance), LocalisationNoise(), keep_past=True)
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    belief = begun(updater, Track(0, (0,), (detection,), 0), observation_at(0, detection))
    for k in range(1, len(TIMES)):
        belief = updater.step(belief, detection, observation_at(k, detection), Surroundings((), ()))
    assert [stage.keyframe for stage in belief.past.stages] == list(range(len(TIMES)))
    traced = Tracer(model, LocalisationNoise()).trace(0, belief.past.stages, 0, np.eye(len(TIMES))[-1])
    filtered, _, mean, P = smoothed_by_rts(measured, covariance, model)
    few, farthest = np.inf, 0.0
    for k in reversed(range(len(TIMES))):
        x, w = coordinates(traced.at(k).T_world_centre), np.exp(traced.at(k).log_weight)
        few = min(few, np.sqrt(traced.at(k).effective))  # what was once lost stays lost
        sigma = np.sqrt(np.diag(P[k]))
        found = w @ x
        spread = (w[:, None] * (x - found)).T @ (x - found)
        np.testing.assert_allclose((found - mean[k]) / sigma, 0.0, atol=4.0 / few)
        np.testing.assert_allclose(spread / np.outer(sigma, sigma), P[k] / np.outer(sigma, sigma), atol=5.0 / few)
        farthest = max(farthest, few * np.abs((filtered[k] - mean[k]) / sigma).max())
    assert farthest > 8.0  # the filter is no smoother
    np.testing.assert_allclose(list(traced.elsewhere.values()), 0.0, atol=1e-9)


def kept_cloud(rng, n=7, at=(0.0, 0.0, 0.0), spread=SPREAD, jump=False, sigma=(0.05, 0.005)):
    centre = se3.make(np.eye(3), np.array(at))
    T = se3.retract(centre, rng.normal(size=(n, 6)) * np.repeat(sigma, 3))
    transition = None if spread is None else Transition(spread, np.full(n, -20.0 if jump else -np.inf))
    return Kept.of(Particles(T, mixture.normalised(rng.normal(size=n))), transition)


def line_of(kept, picks, may_jump=False):
    T = kept.particles().T_world_centre[picks]
    return _Line(T, np.full(len(picks), -20.0 if may_jump else -np.inf), np.zeros(len(picks), dtype=bool))


def link_of(spread=SPREAD, joins=False):
    return _Link(spread, -20.0 if joins else None, np.repeat([0.01, 0.001], 3))


def test_what_is_kept_is_what_was_believed():
    rng = np.random.default_rng(0)
    T = se3.exp(rng.normal(size=(50, 6)))
    kept = Kept.of(Particles(T, mixture.normalised(rng.normal(size=50))), None)
    np.testing.assert_allclose(kept.particles().T_world_centre, T, atol=1e-6)
    assert kept.spread is None


def test_a_step_back_goes_by_weight_and_prediction():
    """Each particle before gets the mean over trajectories of w_j p(x | x_j), normalised; the draws follow it."""
    rng = np.random.default_rng(3)
    before, after = kept_cloud(rng), kept_cloud(rng)
    picks = np.repeat(np.arange(7), 600)
    line, seen, jumped = step_back(line_of(after, picks), before, link_of(), MUG, np.random.default_rng(4))
    old, new = before.particles(), after.particles()
    sigma = prediction.covariance(SPREAD.rotation_rad**2, SPREAD.translation_m**2, 1.0)
    density = prediction.log_potential(old.T_world_centre[None], new.T_world_centre[:, None], sigma, MUG.symmetry)
    expected = np.exp(mixture.normalised(old.log_weight + density)).mean(axis=0)
    found = np.array(
        [np.exp(seen.log_weight[(seen.T_world_centre == T).all((1, 2))].sum()) for T in old.T_world_centre]
    )
    np.testing.assert_allclose(found, expected, atol=0.02)
    drawn = [(line.T_world_centre == T).all((1, 2)).mean() for T in old.T_world_centre]
    np.testing.assert_allclose(drawn, found, atol=0.03)
    assert jumped == 0.0
    assert not line.carried.any()


def test_a_thing_that_may_have_jumped_comes_from_anywhere_and_one_that_may_not_from_the_nearest():
    rng = np.random.default_rng(5)
    before, after = kept_cloud(rng), kept_cloud(rng, at=(0.1, 0.0, 0.0))
    picks = np.repeat(np.arange(7), 100)
    _, seen, jumped = step_back(line_of(after, picks, True), before, link_of(), MUG, np.random.default_rng(6))
    assert jumped > 0.99
    np.testing.assert_allclose(np.exp(seen.log_weight), np.exp(before.particles().log_weight), atol=1e-6)
    line, _, jumped = step_back(line_of(after, picks, False), before, link_of(), MUG, np.random.default_rng(6))
    assert jumped == 0.0
    assert (line.T_world_centre[:, 0, 3] < 0.05).all()


@pytest.mark.parametrize(("away", "carried"), [(0.0, False), (0.1, True)])
def test_two_beliefs_that_are_one_object_are_joined_where_they_agree(away, carried):
    """Where they don't, the stronger one's pose is carried on: the weaker one was wrong, nothing jumped."""
    rng = np.random.default_rng(7)
    before, after = kept_cloud(rng), kept_cloud(rng, at=(away, 0.0, 0.0), spread=None)
    line, seen, _ = step_back(line_of(after, np.arange(7)), before, link_of(joins=True), MUG, np.random.default_rng(8))
    assert line.carried.all() == line.carried.any() == carried
    assert np.abs(seen.T_world_centre[:, 0, 3] - away).max() < 0.03


def test_what_has_no_past_is_carried_by_the_prediction():
    rng = np.random.default_rng(9)
    before, after = kept_cloud(rng), kept_cloud(rng, at=(0.1, 0.0, 0.0), spread=None)
    picks = np.zeros(3000, dtype=int)
    line, seen, _ = step_back(line_of(after, picks), before, link_of(spread=None), MUG, np.random.default_rng(10))
    assert line.carried.all()
    steps = se3.local(after.particles().T_world_centre[0], seen.T_world_centre)
    np.testing.assert_allclose(steps.std(axis=0), np.repeat([0.01, 0.001], 3), rtol=0.08)


def stage_of(k, evidence, other=-np.inf, clutter=0.0, witness=20.0, time_s=None, classes=None):
    time_ns = round((float(k) if time_s is None else time_s) * 1e9)
    return Stage(k, time_ns, 0.8, classes or {}, np.array([evidence, other]), clutter, witness)


def test_what_is_said_of_presence_and_class_is_all_stories_weighed_one_by_one():
    """There as a mug or a can until a stage and taken away then, there to the end, or never; or a double."""
    evidence = np.array([[3.0, 2.0], [9.0, 11.0], [14.0, 12.0], [8.0, 2.0], [-3.0, 1.0]])
    times = [0.0, 1.0, 2.0, 3.0, 100.0]
    witness = np.array([0.5, -1.0, 2.0, 1.0, -3.0])
    stages = [
        stage_of(k, *e, clutter=2.0, witness=w, time_s=t)
        for k, (e, w, t) in enumerate(zip(evidence, witness, times, strict=True))
    ]
    leave = np.full((4, 2), MODEL.config.prediction.jump_probability)
    leave[3] = [1.0 - MODEL.stay_probability(shape.source, 97.0) for shape in MODEL.shapes]
    stories = np.exp(evidence[:4]) * leave
    never = np.exp(2.0) * (1.0 - MODEL.config.detector.unfound) + 1.0
    deceived = MODEL.config.detector.deceived
    double = MODEL.config.detector.lookalike * ((1.0 - deceived) * np.exp(-witness) + deceived)
    never += double[:4] @ stories.sum(axis=1) + double[4] * np.exp(evidence[4]).sum()
    end = np.array([0.05, 0.15])
    last = last_there(end, leaving(stages, None, MODEL), stages, MODEL)
    np.testing.assert_allclose(last[:4], 0.8 * stories / (stories.sum() + never))
    np.testing.assert_allclose(last[4], end)


def test_what_is_known_to_be_elsewhere_was_there_until_it_was_taken():
    stages = [stage_of(k, e) for k, e in enumerate((20.0, 40.0, 60.0))]
    last = last_there(np.zeros(2), leaving(stages, round(3600e9), MODEL), stages, MODEL)
    # or it was a look-alike, which none is known to have found elsewhere
    assert last.sum() > 0.7
    assert last[-1, 0] > 0.99 * last.sum()


def test_trajectories_begin_where_the_thing_was_last_there():
    """What the filter believed of a place after the thing had gone says nothing of where it was."""
    rng = np.random.default_rng(11)
    clouds = [kept_cloud(rng, n=30, at=(0.001 * k + 0.2 * (k > 2), 0.0, 0.0), jump=True) for k in range(5)]
    stages = [stage_of(k, 1.0, classes={0: cloud}) for k, cloud in enumerate(clouds)]
    tracer = Tracer(MODEL, LocalisationNoise())
    gone = tracer.trace(0, stages, 0, np.array([0.0, 0.0, 1.0, 0.0, 0.0]))
    assert sorted(gone.particles) == [0, 1, 2]
    np.testing.assert_array_equal(gone.at(4).T_world_centre, clouds[2].particles().T_world_centre)
    assert tracer.trace(0, stages, 1, np.ones(5)) is None
    half = tracer.trace(0, stages, 0, np.array([0.0, 0.0, 0.5, 0.0, 0.5]))
    assert sorted(half.particles) == [0, 1, 2, 3, 4]
    far = np.exp(half.at(3).log_weight)[half.at(3).T_world_centre[:, 0, 3] > 0.1].sum()
    assert far == pytest.approx(1.0)


def test_one_past_of_two_beliefs_begins_with_the_earlier():
    old = Past(0).joined(stage_of(2, 1.0)).joined(stage_of(3, 1.0)).joined(stage_of(6, 1.0))
    young = Past(4).joined(stage_of(5, 1.0)).joined(stage_of(6, 2.0))
    both = one_past(young, old)
    assert both.begin == 0
    assert [(stage.keyframe, stage.joins) for stage in both.stages] == [(2, False), (3, False), (5, True), (6, False)]
    assert [stage.keyframe for stage in one_past(old, young).stages] == [2, 3, 6]
    assert one_past(None, None) is None


# over whole runs


@pytest.fixture(scope="module")
def scene():
    return small_run()


@pytest.fixture(scope="module")
def both(scene) -> tuple[Estimate, Estimate]:
    return filter_run(scene[0], CONFIG), backward_run(scene[0], CONFIG)


def test_at_the_last_keyframe_the_smoothed_map_is_the_filtered(both):
    filtered, smoothed = both
    np.testing.assert_array_equal(smoothed.object_id, filtered.object_id)
    for name in ("class_probability", "existence", "in_view"):
        np.testing.assert_array_equal(getattr(smoothed, name)[:, -1], getattr(filtered, name)[:, -1])
    np.testing.assert_array_equal(smoothed.pose[:, -1], filtered.pose[:, -1])
    np.testing.assert_array_equal(smoothed.pose_covariance[:, -1], filtered.pose_covariance[:, -1])


def test_a_thing_is_carried_back_to_the_first_frame_and_its_class_is_the_last_ones(both):
    filtered, smoothed = both
    assert (filtered.existence[:, 0] == 0.0).all()
    assert smoothed.exists.all()
    last = filtered.class_probability[:, -1:].repeat(6, axis=1)
    # but for the little chance that it is not there in the end, and was of another class
    np.testing.assert_allclose(smoothed.class_probability, last, atol=0.01)
    for before, after in pairwise(range(6)):
        step = smoothed.pose[:, after, :3, 3] - smoothed.pose[:, before, :3, 3]
        assert np.linalg.norm(step, axis=-1).max() < 0.006
    assert (np.linalg.eigvalsh(smoothed.modes.covariance)[:, 0] > 0).all()
    early = smoothed.pose_covariance[:, 0, range(6), range(6)]
    assert (early > smoothed.pose_covariance[:, 2, range(6), range(6)]).any()


def test_the_seed_decides(scene, tmp_path):
    assert_the_seed_decides(lambda seed: backward_run(scene[0], replace(CONFIG, seed=seed)), tmp_path)


def test_what_was_taken_away_was_there_before():
    """Its place is seen empty from the fifth frame on, which the filter can't know before."""
    run, truth = small_run(frames=10, there=lambda k, name: name != "mug" or k < 5)
    smoothed = backward_run(run, CONFIG)
    mug = int(np.argmin(np.linalg.norm(smoothed.pose[:, 4, :3, 3] - truth["mug"][:3, 3], axis=-1)))
    assert (smoothed.existence[mug, :5] > 0.9).all()
    assert smoothed.existence[mug, -1] < 0.5
    assert (smoothed.existence[1 - mug] > 0.9).all()


def test_what_moved_between_visits_is_one_thing_in_two_places():
    run, truth = small_run(frames=5, visits=2, moved={"mug": (0.05, 0.2)})
    smoothed = backward_run(run, CONFIG)
    assert len(smoothed.object_id) == len(truth)
    old, new = truth["mug"][:2, 3], np.array([0.05, 0.2])
    mug = int(np.argmin(np.linalg.norm(smoothed.pose[:, 0, :2, 3] - old, axis=-1)))
    assert np.linalg.norm(smoothed.pose[mug, :5, :2, 3] - old, axis=-1).max() < 0.03
    assert np.linalg.norm(smoothed.pose[mug, 5:, :2, 3] - new, axis=-1).max() < 0.03
    assert smoothed.exists[mug].all()
    moves = smoothed.moves
    assert moves.probability[moves.object == mug].max() > 0.5
    assert (moves.probability[moves.object != mug] < 0.5).all()


def test_what_was_first_seen_in_a_later_visit_is_not_claimed_for_an_earlier_one():
    run, truth = small_run(frames=4, visits=2, seen=lambda k, name: name != "mug" or k >= 5)
    smoothed = backward_run(run, CONFIG)
    mug = int(np.argmin(np.linalg.norm(smoothed.pose[:, -1, :3, 3] - truth["mug"][:3, 3], axis=-1)))
    assert (smoothed.existence[mug, :4] == 0.0).all()
    assert (smoothed.existence[mug, 4:] > 0.9).all()


def test_a_past_that_stayed_behind_is_joined_again():
    """A belief is sent to another process without it: what comes back has one keyframe more."""
    model = Model(classes("mug"), config_of(), context=False)
    measured, covariance = measurements(np.random.default_rng(5))
    updater = Updater(model, GaussianProposer(measured, covariance), LocalisationNoise(), keep_past=True)
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    whole = begun(updater, Track(0, (0,), (detection,), 0), observation_at(0, detection))
    for k in range(1, 4):
        sent = pickle.loads(pickle.dumps(without_past(whole)))
        assert sent.past.stages == ()
        apart = with_past(updater.step(sent, detection, observation_at(k, detection), Surroundings((), ())), whole)
        whole = updater.step(whole, detection, observation_at(k, detection), Surroundings((), ()))
        assert apart.past.begin == whole.past.begin
        assert [stage.keyframe for stage in apart.past.stages] == list(range(k + 1))
        for own, other in zip(apart.past.stages, whole.past.stages, strict=True):
            np.testing.assert_array_equal(own.classes[0].pose, other.classes[0].pose)
            np.testing.assert_array_equal(own.classes[0].log_weight, other.classes[0].log_weight)
