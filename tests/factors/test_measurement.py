"""Laws of the measurement potential."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors.measurement import DepthModel, depth_log_ratio

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
