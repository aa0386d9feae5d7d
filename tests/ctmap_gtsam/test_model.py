"""Laws of existence: what a track is believed to be, beside what no mesh explains."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.scenes import model_of

MODEL = model_of("mug", "soup_can", "cereal_box")
UNFOUND = MODEL.config.detector.unfound
SEEN = np.array([30.0, 2.0])
"""views that found and that missed it: no look-alike"""
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
    alike = MODEL.config.detector.lookalike * np.exp(-MODEL.told(SEEN))
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


views = st.floats(0.0, 50.0)


@given(st.floats(10.0, 1e5), views, views)
def test_between_a_thing_and_its_look_alike_the_detector_decides_however_well_a_pose_explains(evidence, found, missed):
    """Depth can't tell them apart, so no amount of it makes what the detector never finds exist."""
    counts = np.array([found, missed])
    exists, _ = MODEL.existence(np.array([evidence, 0.0, 0.0]), np.zeros(3), -100.0, counts, -100.0)
    alike = MODEL.config.detector.lookalike * np.exp(-MODEL.told(counts))
    assert exists == pytest.approx(1.0 / (1.0 + alike), rel=1e-3)


@given(views, views, st.floats(0.1, 5.0))
def test_to_be_found_speaks_for_a_known_thing_and_to_be_missed_for_a_look_alike(found, missed, more):
    here = MODEL.told([found, missed])
    assert MODEL.told([found + more, missed]) > here > MODEL.told([found, missed + more])
    assert MODEL.told([0.0, 0.0]) == 0.0


def test_what_the_detector_tells_is_the_mean_over_its_rates():
    """Counts of one order of found and missed views, each rate by its Beta density: summed by the trapezoid rule."""
    d = MODEL.config.detector
    p = np.linspace(0.0, 1.0, 200001)[1:-1]

    def mean(rate, of):
        log_density = (rate * of - 1.0) * np.log(p) + ((1.0 - rate) * of - 1.0) * np.log1p(-p)
        weight = np.exp(log_density)
        return (weight * p**3 * (1.0 - p) ** 2).sum() / weight.sum()

    expected = np.log(mean(d.detection_probability, d.detection_views) / mean(d.clutter_rate, d.clutter_views))
    assert MODEL.told([3.0, 2.0]) == pytest.approx(expected, abs=0.01)


@given(st.floats(0.0, 0.1), st.floats(0.0, 0.1), st.floats(0.1, 5.0))
def test_what_views_share_grows_with_distance_by_the_cameras_turn_alone(rotation, translation, away):
    near, far = (MODEL.shared_variance(LocalisationNoise(rotation, translation), d) for d in (away, 2.0 * away))
    np.testing.assert_allclose(far[:3], near[:3])
    np.testing.assert_allclose(far[3:] - near[3:], 3.0 * (away * rotation) ** 2, atol=1e-12)
    still = MODEL.shared_variance(LocalisationNoise(0.0, 0.0), away)
    sensor = MODEL.config.sensor
    np.testing.assert_allclose(still, np.repeat([sensor.bias_rotation_rad, sensor.bias_translation_m], 3) ** 2)
