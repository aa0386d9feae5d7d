from dataclasses import replace

import numpy as np
import pytest

from sequences.simulation.config import FOCAL_PX, SensorConfig
from sequences.simulation.sensor import (
    BASELINE_M,
    lit_by_projector,
    measure_colour,
    measure_depth,
)

CONFIG = SensorConfig()


def wall(z: float, config: SensorConfig = CONFIG, cosine: float = 1.0, seed: int = 0) -> np.ndarray:
    """A measured image of a wall at one depth, metres."""
    camera = config.camera
    exact = np.full((camera.height, camera.width), z, dtype=np.float32)
    zero = np.zeros(exact.shape)
    return measure_depth(exact, zero + cosine, zero, config, np.random.default_rng(seed))


def error(z: float, config: SensorConfig = CONFIG, **how: float) -> np.ndarray:
    measured = wall(z, config, **how)
    return (measured.astype(float) - z)[measured > 0]


def test_noise_grows_with_depth_squared():
    sigma = [error(z).std() for z in (0.9, 1.8, 3.6)]
    np.testing.assert_allclose([sigma[1] / sigma[0], sigma[2] / sigma[1]], 4.0, rtol=0.08)
    fine = replace(CONFIG, quantisation_px=0.0)
    expected = [CONFIG.disparity_sigma_px * z**2 / (FOCAL_PX * BASELINE_M) for z in (0.9, 1.8, 3.6)]
    np.testing.assert_allclose([error(z, fine).std() for z in (0.9, 1.8, 3.6)], expected, rtol=0.06)


def test_a_knob_scales_the_noise():
    fine = replace(CONFIG, quantisation_px=0.0)
    assert error(1.0, replace(fine, depth_noise=3.0)).std() == pytest.approx(3 * error(1.0, fine).std(), rel=0.05)


def test_noise_has_no_bias_to_speak_of():
    for z in (1.02, 1.37, 2.11):
        e = error(z)
        assert abs(e.mean()) < 0.1 * e.std()


def test_disparity_comes_in_eighths_of_a_pixel():
    measured = wall(1.3)
    disparity = FOCAL_PX * BASELINE_M / measured[measured > 0]
    np.testing.assert_allclose(disparity * 8, np.rint(disparity * 8), atol=1e-4)
    assert len(np.unique(np.rint(disparity * 8))) >= 4


def test_neighbouring_pixels_err_alike_and_distant_ones_do_not():
    e = wall(2.0).astype(float) - 2.0
    e[np.abs(e) > 0.1] = 0.0  # holes
    variance = (e**2).mean()
    assert (e[:, 1:] * e[:, :-1]).mean() > 0.4 * variance
    assert (e[1:] * e[:-1]).mean() > 0.4 * variance
    assert abs((e[:, 12:] * e[:, :-12]).mean()) < 0.03 * variance


def test_a_small_image_has_the_noise_of_the_sensor_it_is_read_from():
    small = replace(CONFIG, width=320, correlation_px=0.0)
    assert error(1.5, small).std() == pytest.approx(error(1.5, replace(CONFIG, correlation_px=0.0)).std(), rel=0.03)
    assert small.camera.fx / small.camera.width == CONFIG.camera.fx / CONFIG.camera.width


def test_grazing_surfaces_are_noisy_and_full_of_holes():
    facing, oblique, grazing = (wall(1.5, cosine=float(np.cos(np.radians(a)))) for a in (0, 60, 80))
    assert (facing == 0).mean() < 0.01
    assert (grazing == 0).mean() > 0.1
    assert grazing[grazing > 0].std() > 1.5 * facing[facing > 0].std()
    assert oblique[oblique > 0].std() > facing[facing > 0].std()


def test_without_noise_depth_is_exact():
    exact = np.random.default_rng(0).uniform(0.0, 9.0, (24, 32)).astype(np.float32)
    cosine = np.random.default_rng(1).uniform(0.0, 1.0, exact.shape)
    measured = measure_depth(exact, cosine, cosine, replace(CONFIG, depth_noise=0.0), np.random.default_rng(2))
    np.testing.assert_array_equal(measured, exact)


def test_the_bias_of_what_is_seen_is_added():
    exact = np.full((480, 640), 1.5, dtype=np.float32)
    bias = np.where(np.arange(640) < 320, 0.0, 0.01) + np.zeros((480, 1))
    measured = measure_depth(exact, np.ones(exact.shape), bias, CONFIG, np.random.default_rng(0))
    left, right = measured[:, :318], measured[:, 322:]
    assert right[right > 0].mean() - left[left > 0].mean() == pytest.approx(0.01, abs=5e-4)


@pytest.mark.parametrize("near", [0.6, 1.0])
def test_the_projectors_shadow_falls_left_of_near_things_as_wide_as_disparities_differ(near):
    depth = np.full((10, 640), 1.6, dtype=np.float32)
    depth[:, 300:400] = near
    lit = lit_by_projector(depth)
    shadow = FOCAL_PX * BASELINE_M * (1 / near - 1 / 1.6)
    columns = np.flatnonzero(~lit[0])
    assert columns.max() == 299
    assert len(columns) == pytest.approx(shadow, abs=1.5)
    assert len(columns) == columns.max() - columns.min() + 1
    assert (lit == lit[0]).all()


def test_holes_open_at_depth_edges():
    depth = np.full((480, 640), 1.6, dtype=np.float32)
    depth[:, :320] = 1.2  # the near half is on the left: no shadow
    measured = measure_depth(depth, np.ones(depth.shape), np.zeros(depth.shape), CONFIG, np.random.default_rng(0))
    assert (measured[:, 319:321] == 0).mean() > 0.1
    assert (measured[:, 400:] == 0).mean() < 0.01


def test_out_of_range_is_not_measured():
    assert (wall(0.2) == 0).all()
    assert (wall(6.0) == 0).all()


def test_the_generator_alone_decides():
    np.testing.assert_array_equal(wall(1.0, seed=5), wall(1.0, seed=5))
    assert (wall(1.0, seed=5) != wall(1.0, seed=6)).any()


def test_colour_noise_is_as_stated():
    exact = np.full((120, 160, 3), 120, dtype=np.uint8)
    noisy = measure_colour(exact, CONFIG, np.random.default_rng(0)).astype(float)
    assert noisy.std() == pytest.approx(np.hypot(CONFIG.colour_sigma, 12**-0.5), rel=0.03)
    np.testing.assert_array_equal(
        measure_colour(exact, replace(CONFIG, colour_sigma=0.0), np.random.default_rng(0)), exact
    )
