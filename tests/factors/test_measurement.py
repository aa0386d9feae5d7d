"""Laws of the measurement potential."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import uniform_filter

from factors import measurement, mixture
from factors.measurement import DepthModel, depth_log_ratio
from factors.symmetry import nearest_image
from sequences import se3
from tests.factors.strategies import (
    SCALES,
    SEEDS,
    SYMMETRIES,
    numerical_jacobian,
    random_image,
    random_pose,
    random_spd,
    random_tangent,
)

MODEL = DepthModel()
DEPTHS = st.floats(0.3, 4.0)


def no_object_density(z, background, model=MODEL):
    """p(z | no object), written down a second time from the formula in the module's docstring."""
    clean = np.full_like(z, 1.0 / model.range_m)
    if background > 0:
        variance = model.background_sigma_m**2 + model.sigma(background) ** 2
        clean = (1 - model.occluder_weight) * np.exp(-0.5 * (z - background) ** 2 / variance)
        clean = clean / np.sqrt(2 * np.pi * variance) + model.occluder_weight * (z < background) / background
    return (1 - model.outlier_weight) * clean + model.outlier_weight / model.range_m


@pytest.mark.parametrize(
    ("rendered", "background"), [(0.8, 0), (0.8, 0.9), (0.8, 0.81), (0.9, 0.8), (3.0, 0), (2.0, 2.01)]
)
def test_depth_density_integrates_to_one(rendered, background):
    z = np.linspace(1e-6, MODEL.range_m, 1_000_001)
    reference = no_object_density(z, background)
    with_object = np.exp(depth_log_ratio(z, rendered, background)) * reference
    assert np.trapezoid(reference, z) == pytest.approx(1.0, abs=1e-4)
    assert np.trapezoid(with_object, z) == pytest.approx(1.0, abs=1e-4)


@given(DEPTHS, DEPTHS, st.sampled_from([0.0, np.nan, np.inf, 1.0, 5.0]))
def test_occluded_unmeasured_and_uncovered_pixels_say_nothing(rendered, z, background):
    in_front = rendered - 8 * MODEL.sigma(rendered) - 0.01
    pixels = depth_log_ratio([in_front, 0.0, np.nan, z, z, z], [rendered] * 3 + [0.0, np.nan, np.inf], background)
    assert np.array_equal(pixels, np.zeros(6))


@given(st.floats(0.3, 2.0), st.floats(0.2, 3.0))
def test_a_hypothesis_that_should_be_seen_and_is_not_loses(rendered, behind):
    seen_past = depth_log_ratio(rendered + behind, rendered, [0.0, rendered + behind])
    assert np.all(seen_past < -2.0)
    assert seen_past[1] < seen_past[0]  # a surface that was expected there weighs more than an unknown one
    assert np.all(depth_log_ratio(rendered, rendered, [0.0, rendered + behind]) > 1.0)


@given(DEPTHS, DEPTHS, st.floats(0, 5.0))
def test_the_loss_is_bounded(z, rendered, background):
    peak = 1.0 / (MODEL.sigma_m * np.sqrt(2 * np.pi))
    assert depth_log_ratio(z, rendered, background) > np.log(MODEL.outlier_weight / MODEL.range_m / peak) - 0.1


def test_depth_broadcasts_and_is_the_scalar_kernel():
    z, rendered = np.linspace(0.7, 0.9, 5)[:, None], np.linspace(0.75, 0.85, 3)
    ratios = depth_log_ratio(z, rendered, 0.9)
    assert ratios.shape == (5, 3)
    assert ratios[2, 1] == depth_log_ratio(0.8, 0.8, 0.9)


def test_white_noise_is_not_correlated():
    noise = np.random.default_rng(0).standard_normal((6, 60, 80))
    assert measurement.correlated_pixels(noise) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("width", [3, 5])
def test_blurred_noise_is_correlated_over_its_kernel(width):
    """The sum of a blurred image is the sum of the noise: its variance is width^2 times that of independent pixels."""
    noise = np.random.default_rng(1).standard_normal((8, 120, 120))
    blurred = np.stack([uniform_filter(image, width) for image in noise])
    blurred[:, :40] = np.nan
    assert measurement.correlated_pixels(blurred) == pytest.approx(width**2, rel=0.25)


def test_a_common_bias_makes_an_image_one_measurement():
    biased = np.full((3, 20, 30), 0.004)
    biased[:, :, 25:] = np.nan
    assert measurement.correlated_pixels(biased) == pytest.approx(20 * 25)
    assert measurement.tempered(500 * 6.0, 1 / measurement.correlated_pixels(biased)) == pytest.approx(6.0)


def test_nothing_compared_is_an_error():
    with pytest.raises(ValueError, match="finite"):
        measurement.correlated_pixels(np.full((4, 4), np.nan))


BOXES = st.tuples(st.floats(0, 500), st.floats(0, 300), st.floats(1, 200), st.floats(1, 200)).map(np.array)


@given(BOXES, BOXES)
def test_overlaps(a, b):
    iou, overlap = measurement.box_iou(a, b), measurement.box_overlap_min(a, b)
    assert 0 <= iou <= overlap + 1e-12 <= 1 + 1e-9
    assert iou == pytest.approx(measurement.box_iou(b, a))
    assert overlap == pytest.approx(measurement.box_overlap_min(b, a))
    assert measurement.box_iou(a, a) == pytest.approx(1.0)
    inside = np.r_[a[:2] + a[2:] / 4, a[2:] / 2]
    assert measurement.box_iou(a, inside) == pytest.approx(0.25)
    assert measurement.box_overlap_min(a, inside) == pytest.approx(1.0)


def test_empty_boxes_overlap_nothing():
    nothing, box = [5.0, 5, 0, 0], [0.0, 0, 10, 10]
    assert measurement.box_iou(nothing, nothing) == measurement.box_overlap_min(nothing, box) == 0
    assert measurement.box_log_ratio(box, nothing, 0.05, (640, 480)) == -np.inf


@given(SEEDS, st.sampled_from([0.0, 0.02, 0.3]))
def test_outliers_bound_what_a_box_says_against_a_thing(seed, outlier):
    rng = np.random.default_rng(seed)
    found, drawn = rng.uniform(1.0, 100.0, size=(2, 20, 4))
    drawn[:3, 2] = [0.0, -1.0, np.nan]
    matched = measurement.box_log_ratio(found, drawn, 0.05, (640, 480))
    with np.errstate(divide="ignore"):
        mixed = np.logaddexp(np.log1p(-outlier) + matched, np.log(outlier))
    np.testing.assert_allclose(measurement.box_log_ratio(found, drawn, 0.05, (640, 480), outlier), mixed, atol=1e-12)


@given(SEEDS, st.floats(0.01, 0.999), st.floats(1e-6, 0.5))
def test_a_tracks_box_is_its_things_or_has_nothing_to_do_with_it(seed, found, outlier):
    rng = np.random.default_rng(seed)
    covered = rng.integers(0, 50, size=20).astype(np.float64)
    visible = np.floor(covered * rng.random(20))
    corners = np.where(visible[:, None] > 0, rng.uniform(0, 300, (20, 4)), np.nan)
    corners[:, 2:] += corners[:, :2]
    box, image = (30.0, 40.0, 100.0, 80.0), (640, 480)
    drawn = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=-1)
    fits = measurement.box_log_ratio(box, drawn, 0.05, image, outlier)
    shares = np.divide(visible, covered, out=np.zeros(20), where=covered > 0)
    said = np.log(outlier * (1.0 - found * shares) + found * shares * np.exp(fits))
    np.testing.assert_allclose(
        measurement.detected_log_potential(box, covered, visible, corners, 0.05, image, outlier, found),
        said,
        rtol=1e-12,
        atol=1e-12,
    )


def test_the_box_density_integrates_to_one_an_edge():
    """Along one edge: the density of a box whose left edge moves, times that of the three that stay."""
    drawn, image = np.array([100.0, 80, 60, 40]), (640, 480)
    left = np.linspace(-200, 400, 60001)
    boxes = np.stack([left, np.full_like(left, 80), 160 - left, np.full_like(left, 40)], axis=-1)
    density = np.exp(measurement.box_log_ratio(boxes, drawn, 0.1, image)) * 4 / (640 * 480) ** 2
    others = 1 / (np.sqrt(2) * 6) * (1 / (np.sqrt(2) * 4)) ** 2
    assert np.trapezoid(density, left) == pytest.approx(others, rel=1e-3)


@given(SEEDS, st.integers(1, 8))
def test_uniform_scores_say_nothing_and_ratios_are_bounded(seed, classes):
    scores = np.random.default_rng(seed).dirichlet(np.full(classes + 1, 0.2), size=3)
    ratios = measurement.class_log_ratio(scores, floor=0.05)
    assert ratios.shape == (3, classes)
    assert np.all(np.abs(ratios) <= np.log((0.95 * (classes + 1) + 0.05) / 0.05) + 1e-9)
    uniform = np.full(classes + 1, 1 / (classes + 1))
    assert np.allclose(measurement.class_log_ratio(uniform), 0)
    positive = np.clip(scores, 1e-3, 1)
    assert np.allclose(measurement.class_log_ratio(positive[0], class_prior=positive[0]), 0)
    assert np.allclose(measurement.class_log_ratio(positive, floor=0.0), np.log(positive[:, 1:] / positive[:, :1]))


@given(SEEDS, st.integers(2, 6), st.floats(0.5, 0.99), st.integers(1, 2000))
def test_evidence_of_a_persistent_belief_saturates(seed, classes, p_right, frames):
    rng = np.random.default_rng(seed)
    one_frame = measurement.class_log_ratio(rng.dirichlet(np.ones(classes + 1)))
    pi = measurement.confusion(classes, p_right)
    evidence = measurement.persistent_class_log_evidence(frames * one_frame, pi)
    assert np.ptp(evidence) <= pi.max() - pi.min() + 1e-9
    assert np.allclose(np.exp(pi).sum(axis=1), 1)


@given(SEEDS, st.integers(2, 6))
def test_one_frame_is_consistent_with_a_plain_one(seed, classes):
    """A detector that is never confused gives each class its own likelihood; one that always is gives all the same."""
    likelihood = np.random.default_rng(seed).normal(0, 3, (2, classes))
    certain = measurement.persistent_class_log_evidence(likelihood, measurement.confusion(classes, 1.0))
    assert np.allclose(certain, likelihood)
    guessing = measurement.persistent_class_log_evidence(likelihood, measurement.confusion(classes, 1 / classes))
    assert np.allclose(guessing, mixture.log_sum(likelihood)[:, None] - np.log(classes))
    mixed = measurement.persistent_class_log_evidence(likelihood, measurement.confusion(classes, 0.9))
    assert np.all(np.argmax(mixed, axis=1) == np.argmax(likelihood, axis=1))


def test_the_papers_literal_forms():
    log_f = measurement.paper_log_similarity([0.0, 0.02], 50.0)
    assert log_f.tolist() == [0.0, -1.0]
    h, overlap = np.array([[0.7, 0.2], [0.1, 0.1]]), np.array([[1.0, 0.5], [0.0, 0.0]])
    value = measurement.paper_log_potential(h, overlap, log_f, [True, True], delta=0.1)
    assert value == pytest.approx([np.log(0.8), -np.inf])
    undetected = measurement.paper_log_potential(np.zeros((2, 0)), np.zeros((2, 0)), log_f, [True, False], delta=0.1)
    assert undetected == pytest.approx([0.0, np.log(0.1)])


def graph_mode(seed, scale, symmetry):
    rng = np.random.default_rng(seed)
    camera, mode = random_pose(rng), random_pose(rng)
    max_angle = 3.0 if symmetry.order == 1 else 0.7
    placed = camera @ mode @ se3.exp(random_tangent(rng, scale, max_angle)) @ random_image(rng, symmetry)
    return rng, camera, placed, mode, 0.1 * rng.standard_normal(6)


@pytest.mark.parametrize("symmetry", SYMMETRIES.values(), ids=SYMMETRIES.keys())
@given(SEEDS, SCALES)
@settings(max_examples=15)
def test_mode_jacobians_are_derivatives(symmetry, seed, scale):
    _, camera, placed, mode, bias = graph_mode(seed, scale, symmetry)
    r, J_camera, J_object = measurement.mode_residual_jacobians(camera, placed, mode, bias, symmetry)
    residual = measurement.mode_residual
    assert np.allclose(r, residual(camera, placed, mode, bias, symmetry))
    numerical = numerical_jacobian(lambda T: residual(T, placed, mode, bias, symmetry), camera)
    assert np.allclose(J_camera, numerical, atol=5e-6)
    numerical = numerical_jacobian(lambda T: residual(camera, T, mode, bias, symmetry), placed)
    assert np.allclose(J_object, numerical, atol=5e-6)
    assert np.allclose(residual(camera, placed, mode, None, symmetry) - bias, r)


@pytest.mark.parametrize("symmetry", SYMMETRIES.values(), ids=SYMMETRIES.keys())
@given(SEEDS, SCALES)
@settings(max_examples=15)
def test_a_mode_sees_neither_the_image_nor_the_world(symmetry, seed, scale):
    rng, camera, placed, mode, bias = graph_mode(seed, scale, symmetry)
    value = measurement.mode_residual(camera, placed, mode, bias, symmetry)
    world, g = random_pose(rng), random_image(rng, symmetry)
    assert np.allclose(
        measurement.mode_residual(world @ camera, world @ placed, mode, bias, symmetry), value, atol=1e-8
    )
    assert np.allclose(measurement.mode_residual(camera, placed @ g, mode, bias, symmetry), value, atol=1e-8)
    aligned = nearest_image(camera @ mode, placed, symmetry)
    assert np.allclose(measurement.mode_residual(camera, aligned, mode, bias), value, atol=1e-8)


@given(SEEDS)
@settings(max_examples=20)
def test_modes_are_weighed_as_the_mixture_weighs_them(seed):
    rng, camera, placed, _, _ = graph_mode(seed, 0.3, SYMMETRIES["none"])
    modes = np.stack([random_pose(rng) for _ in range(3)])
    informations = np.stack([random_spd(rng) for _ in range(3)])
    values = measurement.mode_log_potential(camera, placed, modes, informations)
    residuals = measurement.mode_residual(camera, placed, modes)
    assert np.allclose(values, mixture.mode_log_densities(residuals, informations, np.zeros(3)))
    best, energy = mixture.select_mode(residuals, informations, np.zeros(3))
    assert best == np.argmax(values)
    assert energy == pytest.approx(-values.max())
