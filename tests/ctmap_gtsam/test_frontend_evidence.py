"""Laws of what counts how often, and of the frames that shapes live in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.model import Model
from factors.mixture import normalised
from factors.symmetry import residual
from sequences import se3
from sequences.types import Detection
from tests.ctmap_gtsam.scenes import config_of, looking, model_of, standing, view_of
from tests.tiny import tiny_catalogue

MODEL = model_of("mug", "banana", "cereal_box", "soup_can", "bowl")
SEEDS = st.integers(0, 2**31)


def path(rng, n):
    """n viewpoints on an arc about the object that also comes nearer, all one way."""
    angle, away = np.sort(rng.uniform(0.0, 0.05, n)), np.sort(rng.uniform(0.78, 0.8, n))[::-1]
    R = se3.so3_exp(rng.normal(size=3))
    return (away[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)) @ R.T


@given(SEEDS)
def test_news_of_a_view_is_a_rate(seed):
    """Law 3 of the model: more frames of one path bring no more evidence."""
    rng = np.random.default_rng(seed)
    points, times = path(rng, 6), np.sort(rng.uniform(0.0, 0.5, 6))
    steps = [MODEL.view_share(points[i], points[i + 1], times[i + 1] - times[i]) for i in range(5)]
    assert sum(steps) == pytest.approx(MODEL.view_share(points[0], points[-1], times[-1] - times[0]), abs=1e-6)


@given(SEEDS)
def test_news_of_a_view_lies_between_none_and_all(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3))
    assert 0.0 <= MODEL.view_share(a, b, rng.uniform(0, 5)) <= 1.0
    assert MODEL.view_share(a, a, 0.0) == pytest.approx(0.0, abs=1e-6)
    assert MODEL.view_share(a, -a, 0.0) == 1.0
    assert MODEL.view_share(a, a, 1e6) == 1.0
    R = se3.so3_exp(rng.normal(size=3))
    assert MODEL.view_share(R @ a, R @ b, 0.1) == pytest.approx(MODEL.view_share(a, b, 0.1), abs=1e-6)


def test_prediction_is_a_rate():
    one, two = MODEL.prediction_covariance(0.5), MODEL.prediction_covariance(1.5)
    np.testing.assert_allclose(one + two, MODEL.prediction_covariance(2.0))
    np.testing.assert_array_equal(np.diag(one), np.repeat(MODEL.prediction_variances(0.5), 3))


def says(score, n_classes=5, own=1, background=0.05):
    scores = np.full(n_classes + 1, (1.0 - background - score) / (n_classes - 1))
    scores[0], scores[1 + own] = background, score
    return Detection((0.0, 0.0, 10.0, 10.0), scores)


def test_a_detectors_word_is_worth_no_more_the_thousandth_time():
    p = MODEL.config.detector.confusion
    bound = np.log((1.0 - p) / (p / 4))
    per_frame = MODEL.class_scores(says(0.6))
    gains = []
    for n in (1, 3, 10, 1000):
        evidence = MODEL.class_evidence(n * per_frame)
        gains.append(evidence[1] - evidence[0])
    assert (np.diff(gains) >= -1e-9).all()
    assert gains[0] < 0.9 * bound
    assert gains[-1] == pytest.approx(bound, abs=1e-6)


@given(SEEDS)
def test_class_evidence_is_bounded_whatever_the_detector_says(seed):
    rng = np.random.default_rng(seed)
    p = MODEL.config.detector.confusion
    summed = sum(MODEL.class_scores(Detection((0, 0, 1, 1), s)) for s in rng.dirichlet(np.full(6, 0.3), 20))
    evidence = MODEL.class_evidence(summed)
    assert np.ptp(evidence) <= np.log((1.0 - p) / (p / 4)) + 1e-9


def test_a_detector_without_opinion_says_nothing_of_the_class():
    evidence = MODEL.class_evidence(30 * MODEL.class_scores(Detection((0, 0, 1, 1), np.full(6, 1 / 6))))
    np.testing.assert_allclose(evidence, evidence[0], atol=1e-12)


def test_out_of_view_is_no_evidence_but_for_a_box_of_its_own():
    """Which then has nothing to do with it."""
    shape = MODEL.shapes[0]
    observation = view_of(MODEL, [(shape, standing(shape))], looking())
    detection = observation.frame.detections[0]
    proposer = Proposer(MODEL)
    far = se3.make(np.eye(3), np.array([5.0, 0.0, 1.0]))[None]
    for seen, nats in ((None, 0.0), (detection, np.log(MODEL.config.detector.box_outlier))):
        view = proposer.view(observation, np.array(detection.box), seen)
        assert proposer.score(shape, view, far)[0][0] == pytest.approx(nats, abs=1e-12)


def test_a_box_far_off_costs_no_more_than_one_that_has_nothing_to_do_with_it():
    detected = np.array([50.0, 50.0, 40.0, 40.0])
    shifts = np.array([[d, 0.0, 0.0, 0.0] for d in (0, 2, 5, 20, 100, 250)])
    said = MODEL.box(detected, detected + shifts, (320, 240))
    assert (np.diff(said) <= 0).all()
    assert said[-1] >= np.log(MODEL.config.detector.box_outlier) - 1e-9
    assert MODEL.box(detected, np.zeros((1, 4)), (320, 240))[0] == pytest.approx(
        np.log(MODEL.config.detector.box_outlier)
    )


TINY = Model(tiny_catalogue(), config_of())  # symmetries about lines and points that are not the origin


@pytest.mark.parametrize("row", range(3))
@settings(max_examples=15)
@given(SEEDS)
def test_poses_and_covariances_leave_the_centre_frame_and_come_back(row, seed):
    shape, rng = TINY.shapes[row], np.random.default_rng(seed)
    T, xi = se3.exp(rng.normal(size=6)), 1e-4 * rng.normal(size=6)
    np.testing.assert_allclose(shape.to_centre(shape.to_object(T)), T, atol=1e-12)
    # a motion in one frame's tangent is the adjoint's in the other's: what covariances are moved by
    A = rng.normal(size=(6, 6))
    moved = se3.local(shape.to_object(T), shape.to_object(se3.retract(T, xi)))
    spread = shape.covariance_to_object(A @ np.outer(xi, xi) @ A.T)
    there = se3.local(shape.to_object(T), shape.to_object(se3.retract(T, A @ xi)))
    np.testing.assert_allclose(spread, np.outer(there, there), atol=1e-9)
    np.testing.assert_allclose(np.outer(moved, moved), shape.covariance_to_object(np.outer(xi, xi)), atol=1e-11)


@pytest.mark.parametrize("row", range(3))
def test_symmetries_of_the_centre_frame_are_those_of_the_catalogue(row):
    shape = TINY.shapes[row]
    rng = np.random.default_rng(0)
    T_object = se3.exp(rng.normal(size=6))
    for g in shape.source.symmetries_discrete:
        r = residual(shape.to_centre(T_object), shape.to_centre(T_object @ g), shape.symmetry)
        np.testing.assert_allclose(r, 0.0, atol=1e-9)
    for line in shape.source.symmetries_continuous:
        about = se3.make(np.eye(3), line.offset)
        g = about @ se3.exp(np.r_[1.3 * line.axis, 0, 0, 0]) @ se3.inverse(about)
        r = residual(shape.to_centre(T_object), shape.to_centre(T_object @ g), shape.symmetry)
        np.testing.assert_allclose(shape.symmetry.projection @ r, 0.0, atol=1e-9)
        free = shape.free_axes_to_object(shape.symmetry.free_axes)
        generator = np.r_[line.axis, np.cross(line.offset, line.axis)]
        np.testing.assert_allclose(free @ free.T @ generator, generator, atol=1e-9)


@pytest.mark.parametrize("row", range(3))
def test_the_centre_is_a_fixed_point_of_all_symmetries(row):
    shape = TINY.shapes[row]
    np.testing.assert_allclose(shape.symmetry.discrete[:, :3, 3], 0.0, atol=1e-9)
    if shape.symmetry.free:
        np.testing.assert_allclose(np.cross(shape.symmetry.offsets, shape.symmetry.axes), 0.0, atol=1e-9)


@pytest.mark.parametrize("shape", MODEL.shapes, ids=lambda s: s.source.name)
def test_a_coarse_mesh_is_the_fine_one_to_a_millimetre_or_two(shape):
    assert np.abs(shape.distance.at(shape.mesh.vertices)).max() < shape.distance.spacing_m
    fine = se3.transform(se3.inverse(shape.T_object_centre), shape.source.mesh.vertices)
    assert np.abs(shape.distance.at(fine)).max() < shape.distance.spacing_m + 0.002
    assert shape.reach_m >= np.linalg.norm(shape.mesh.vertices, axis=-1).max() - 1e-12
    np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=-1), 1.0)
    assert 5 < len(shape.surface_points(20)) <= 20


def test_a_uniform_pose_is_a_density_over_what_can_be_told_apart():
    radius = MODEL.config.prediction.region_radius_m
    ball = 4.0 / 3.0 * np.pi * radius**3
    for shape in TINY.shapes[:2]:
        volume = np.exp(-TINY.log_uniform(shape))
        turns = 4.0 * np.pi if shape.symmetry.free else 8.0 * np.pi**2 / shape.symmetry.order
        assert volume == pytest.approx(turns * ball)


def test_a_sure_detector_wins_where_depth_is_equal():
    evidence = MODEL.class_evidence(5 * MODEL.class_scores(says(0.7, own=3)))
    assert np.argmax(normalised(evidence)) == 3
