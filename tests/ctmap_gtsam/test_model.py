"""Laws of existence: what a track is believed to be, beside what no mesh explains."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from ctmap_gtsam.config import Config
from ctmap_gtsam.frontend.scoring import Scores
from ctmap_gtsam.parameters import Sensor
from sequences import se3
from sequences.types import Detection, LocalisationNoise
from tests.ctmap_gtsam.scenes import model_of

MODEL = model_of("mug", "soup_can", "cereal_box")
UNFOUND = MODEL.config.detector.unfound
SEEN = 60.0
"""nats: found in most views, so that it is no look-alike"""
nats = st.floats(-500.0, 500.0)
three = st.lists(nats, min_size=3, max_size=3).map(np.array)


@given(three, three, nats, nats)
def test_existence_and_classes_are_probabilities(evidence, scores, clutter, rival):
    exists, classes = MODEL.existence(evidence, scores, clutter, SEEN, rival)
    assert 0.0 <= exists <= 1.0 + 1e-12
    assert classes.sum() == pytest.approx(1.0)
    assert (classes >= 0.0).all()


@given(three, three, nats, nats, st.permutations(range(3)))
def test_classes_have_no_order(evidence, scores, clutter, rival, order):
    exists, classes = MODEL.existence(evidence, scores, clutter, SEEN, rival)
    again, permuted = MODEL.existence(evidence[order], scores[order], clutter, SEEN, rival)
    assert again == pytest.approx(exists)
    np.testing.assert_allclose(permuted, classes[order], atol=1e-9)


@given(three, nats)
def test_what_poses_explain_well_exists_whatever_the_scores_say(scores, clutter):
    evidence = clutter + np.array([0.0, 60.0, 20.0])
    exists, classes = MODEL.existence(evidence, scores, clutter, SEEN, clutter)
    alike = MODEL.config.detector.lookalike * MODEL.config.detector.deceived
    assert exists == pytest.approx(1.0 / (1.0 + alike))
    assert np.argmax(classes) == 1


@given(three)
def test_what_no_pose_explains_may_still_be_what_the_detector_says(evidence):
    scores = np.array([1.0, 3.0, -2.0])
    exists, classes = MODEL.existence(evidence, scores, evidence.max() + 60.0, SEEN, 0.0)
    odds = UNFOUND / (1.0 - UNFOUND) * np.exp(MODEL.told(SEEN))
    assert exists == pytest.approx(odds / (1.0 + odds), abs=1e-9) or evidence.max() + 60.0 < 30.0
    np.testing.assert_allclose(classes, np.exp(scores) / np.exp(scores).sum(), atol=1e-6)


def test_where_nothing_is_nothing_exists_and_without_poses_neither():
    exists, _ = MODEL.existence(np.full(3, -80.0), np.zeros(3), -50.0, SEEN, 0.0)
    assert exists < 1e-12
    nowhere = np.full(3, -np.inf)
    exists, classes = MODEL.existence(nowhere, nowhere, 50.0, SEEN, 0.0)
    assert exists == 0.0
    assert classes.sum() == pytest.approx(1.0)


def test_anywhere_has_the_moments_of_any_turn_and_any_place_in_the_neighbourhood():
    rng = np.random.default_rng(0)
    turns = se3.so3_log(se3.uniform_rotations(rng.random((40000, 3))))
    places = rng.normal(size=(40000, 3))
    radius = MODEL.config.prediction.region_radius_m * rng.random(40000) ** (1.0 / 3.0)
    places *= (radius / np.linalg.norm(places, axis=-1))[:, None]
    np.testing.assert_allclose(np.concatenate([turns, places], axis=-1).var(axis=0), MODEL.anywhere, rtol=0.03)


@given(st.floats(10.0, 1e5), st.floats(-30.0, 30.0))
def test_between_a_thing_and_its_look_alike_the_detector_decides_however_well_a_pose_explains(evidence, witness):
    """Depth can't tell them apart, so no amount of it makes what the detector never finds exist."""
    exists, _ = MODEL.existence(np.array([evidence, 0.0, 0.0]), np.zeros(3), -100.0, witness, -100.0)
    alike = MODEL.config.detector.lookalike * np.exp(-MODEL.told(witness))
    assert exists == pytest.approx(1.0 / (1.0 + alike), rel=1e-3)


def test_what_the_detector_tells_is_bounded_by_how_often_it_is_deceived():
    assert MODEL.told(0.0) == pytest.approx(0.0)
    assert (np.diff(MODEL.told(np.linspace(-50.0, 50.0, 20))) >= 0.0).all()
    assert MODEL.told(500.0) == pytest.approx(-np.log(MODEL.config.detector.deceived))
    assert MODEL.told(-30.0) == pytest.approx(-30.0 - np.log1p(-MODEL.config.detector.deceived), abs=1e-6)


@given(st.floats(-500.0, 0.0), st.floats(-500.0, 500.0))
def test_a_visit_in_which_all_views_miss_a_thing_says_no_more_than_that_it_was_overlooked(less, more):
    assert MODEL.seen_in_visit(0.0) == pytest.approx(0.0)
    least = np.log(MODEL.config.detector.overlooked)
    assert least <= MODEL.seen_in_visit(less) <= 0.0
    assert MODEL.seen_in_visit(less) <= MODEL.seen_in_visit(max(less, more)) <= max(less, more, 0.0)
    # found in another visit, it exists all the same
    witness = MODEL.seen_in_visit(less) + MODEL.seen_in_visit(8.0)
    assert MODEL.existence(np.array([1e4, 0.0, 0.0]), np.zeros(3), -100.0, witness, -100.0)[0] > 0.95


@given(st.floats(0.05, 1.0))
def test_being_missed_in_view_speaks_for_a_look_alike_and_being_out_of_sight_for_neither(visible):
    unseen, seen = (
        Scores(np.zeros(1), np.full(1, 100.0), np.full(1, 100.0 * v), np.array([[10.0, 10.0, 50.0, 60.0]]))
        for v in (0.0, visible)
    )
    assert MODEL.witness(unseen, False)[0] == MODEL.witness(unseen, True)[0] == 0.0
    assert MODEL.witness(seen, False)[0] < 0.0 < MODEL.witness(seen, True)[0]


@given(st.floats(0.0, 0.1), st.floats(0.0, 0.1), st.floats(0.1, 5.0))
def test_what_views_share_grows_with_distance_by_the_cameras_turn_alone(rotation, translation, away):
    mug = MODEL.shapes[0]
    near, far = (MODEL.shared_variance(mug, LocalisationNoise(rotation, translation), d) for d in (away, 2.0 * away))
    np.testing.assert_allclose(far[:3], near[:3])
    np.testing.assert_allclose(far[3:] - near[3:], 3.0 * (away * rotation) ** 2, atol=1e-12)
    still = MODEL.shared_variance(mug, LocalisationNoise(0.0, 0.0), away)
    np.testing.assert_allclose(still, MODEL.bias_sigmas(mug) ** 2)


def test_a_surfaces_error_turns_a_small_thing_more_than_a_large_one_and_moves_it_less():
    """By an angle that moves either's surface by as much; no thing is turned or moved by less than any is."""
    model = model_of("mug", "sofa")
    sensor = model.config.sensor
    for shape in model.shapes:
        turned = model.bias_sigmas(shape)[:3]
        assert (turned > sensor.bias_rotation_rad).all()
        np.testing.assert_allclose(
            turned**2 - sensor.bias_rotation_rad**2, (sensor.bias_surface_m / shape.radius_m) ** 2
        )
        moved = model.bias_sigmas(shape)[3:]
        np.testing.assert_allclose(moved**2 - sensor.bias_translation_m**2, (sensor.bias_size * shape.radius_m) ** 2)


def said_of_a_box(shift, visible, found=True):
    """log phi_m of a silhouette of 100 samples at 10, 10 of which some are seen, and a box so many pixels beside it."""
    scores = Scores(np.zeros(1), np.full(1, 100.0), np.full(1, visible), np.array([[10.0, 10.0, 50.0, 60.0]]))
    box = Detection((10.0 + shift, 10.0, 40.0, 50.0), np.array([0.1, 0.3, 0.3, 0.3]))
    return float(MODEL.log_likelihood(scores, box if found else None, (320, 240))[0])


@given(st.floats(0.0, 200.0), st.floats(0.0, 100.0), st.floats(0.0, 100.0))
def test_a_box_of_its_own_does_not_speak_for_what_hides(shift, some, more):
    """A track's box came from elsewhere as rarely when its thing is hidden as when it shows."""
    outlier = np.log(MODEL.config.detector.box_outlier)
    fit = float(MODEL.box(np.array([10.0 + shift, 10, 40, 50]), np.array([[10.0, 10, 40, 50]]), (320, 240))[0])
    assert said_of_a_box(shift, 0.0) == pytest.approx(outlier)
    assert min(outlier, fit) - 0.11 <= said_of_a_box(shift, more) <= max(outlier, fit) + 1e-9
    less, no_less = (said_of_a_box(shift, visible) for visible in sorted((some, more)))
    assert (no_less >= less - 1e-9) == (fit >= outlier - 1e-9) or less == pytest.approx(no_less)
    # and without a box being hidden says nothing
    assert said_of_a_box(shift, 0.0, found=False) == 0.0


def test_a_missed_detection_costs_what_the_visible_share_makes_of_it():
    said = [said_of_a_box(0.0, visible, found=False) for visible in np.linspace(0.0, 100.0, 5)]
    assert said[-1] == pytest.approx(np.log1p(-MODEL.config.detector.detection_probability))
    assert (np.diff(said) < 0).all()


SHARE = MODEL.config.sensor.mesh_share
TRUE = model_of("mug", "soup_can", "cereal_box", config=replace(Config(), sensor=Sensor(mesh_share=1e-6)))
explained = st.lists(st.floats(0.0, 3000.0) | st.just(-np.inf), min_size=3, max_size=3).map(np.array)


@given(explained, st.permutations(range(3)))
def test_what_meshes_are_off_by_leaves_classes_in_their_order(evidence, order):
    bounded = MODEL.between_classes(evidence)
    assert bounded.max() == evidence.max()
    assert (bounded >= evidence).all()
    np.testing.assert_array_equal(np.sort(bounded), bounded[np.argsort(evidence)])
    np.testing.assert_array_equal(MODEL.between_classes(evidence[order]), bounded[order])


@given(st.floats(0.0, 5.0), st.floats(100.0, 1e5))
def test_more_views_are_no_surer_of_the_class_than_the_mesh_is_true(z, explained):
    _, behind = MODEL.between_classes(explained * np.array([1.0, 1.0 - z * SHARE]))
    log_odds = norm.logcdf(-z) - norm.logcdf(z)
    assert behind - explained >= log_odds - 1e-6
    if z * SHARE * explained >= -log_odds:  # else the views themselves say less
        assert behind - explained == pytest.approx(log_odds, abs=1e-6)


@given(st.floats(1e-3, 50.0), st.floats(1.0, 3000.0))
def test_a_mesh_that_is_true_tells_classes_apart_by_all_that_depth_says(gap, explained):
    evidence = np.array([explained, explained - gap, -np.inf])
    np.testing.assert_allclose(TRUE.between_classes(evidence), evidence, atol=1e-6)


def test_what_explains_nothing_is_no_part_of_it():
    for evidence in (np.array([-3.0, -1.0, -40.0]), np.full(3, -np.inf)):
        np.testing.assert_array_equal(MODEL.between_classes(evidence), evidence)
