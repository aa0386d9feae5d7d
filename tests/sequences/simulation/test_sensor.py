from dataclasses import replace

import numpy as np
import pytest

from sequences.camera import Camera
from sequences.simulation.config import FOCAL_PX, SensorConfig
from sequences.simulation.sensor import BASELINE_M, DepthSensor, View, lit_by_projector, measure_colour

CONFIG = SensorConfig()
FINE = replace(CONFIG, quantisation_px=0.0, distortion_px=0.0, unevenness=0.0)


def view(depth: np.ndarray, camera: Camera = CONFIG.camera, cosine: float = 1.0, **other: float | np.ndarray) -> View:
    """White, dull surfaces that the line of sight meets at one angle, unless told otherwise."""
    depth = np.asarray(depth, dtype=np.float32)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    ray = camera.backproject(u, v, np.ones(depth.shape))
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    up = np.cross(ray, [1.0, 0.0, 0.0])
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    fields = {"albedo": 1.0, "gloss": 0.0, "error_m": 0.0} | other
    planes = {name: np.broadcast_to(np.float32(value), depth.shape) for name, value in fields.items()}
    normal = -cosine * ray + np.sqrt(1.0 - cosine**2) * up
    return View(camera=camera, depth=depth, normal=normal.astype(np.float32), **planes)


def measure(seen: View, config: SensorConfig = CONFIG, seed: int = 0) -> np.ndarray:
    return DepthSensor(seen.camera, config, seed).measure(seen, np.random.default_rng(seed))


def wall(z: float, config: SensorConfig = CONFIG, cosine: float = 1.0, seed: int = 0, **other: float) -> np.ndarray:
    """A measured image of a wall at one depth, metres."""
    camera = config.camera
    return measure(view(np.full((camera.height, camera.width), z), camera, cosine, **other), config, seed)


def error(z: float, config: SensorConfig = CONFIG, **how: float) -> np.ndarray:
    measured = wall(z, config, **how)
    return (measured.astype(float) - z)[measured > 0]


def spread(errors: np.ndarray) -> float:
    """Robust standard deviation."""
    return float(1.4826 * np.median(np.abs(errors - np.median(errors))))


def test_noise_grows_with_depth_squared():
    sigma = [spread(error(z, FINE)) for z in (0.7, 1.0, 1.4)]
    np.testing.assert_allclose([sigma[1] / sigma[0], sigma[2] / sigma[1]], [1 / 0.49, 1.96], rtol=0.08)
    expected = [CONFIG.disparity_sigma_px * z**2 / (FOCAL_PX * BASELINE_M) for z in (0.7, 1.0, 1.4)]
    np.testing.assert_allclose(sigma, expected, rtol=0.1)
    # far away little light comes back, which is harder still
    assert spread(error(3.6, FINE)) > 9.2 * spread(error(1.2, FINE))


def test_a_knob_scales_the_noise():
    assert spread(error(1.0, replace(FINE, depth_noise=2.0))) == pytest.approx(2 * spread(error(1.0, FINE)), rel=0.08)


def test_noise_has_no_bias_to_speak_of():
    for z in (1.02, 1.37, 2.11):
        e = error(z, replace(CONFIG, distortion_px=0.0))
        assert abs(e.mean()) < 0.1 * e.std()


def test_disparity_comes_in_eighths_of_a_pixel():
    measured = wall(1.3)
    disparity = FOCAL_PX * BASELINE_M / measured[measured > 0]
    np.testing.assert_allclose(disparity * 8, np.rint(disparity * 8), atol=1e-4)
    assert len(np.unique(np.rint(disparity * 8))) >= 4


def test_neighbouring_pixels_err_alike_and_distant_ones_do_not():
    e = wall(2.0, FINE).astype(float) - 2.0
    e[np.abs(e) > 4 * spread(e)] = 0.0  # holes and what is beside them
    variance = (e**2).mean()
    for lag in (2, 4):  # white noise behind a Gaussian of s pixels is correlated as one of sqrt(2) s
        expected = np.exp(-(lag**2) / (4 * CONFIG.correlation_px**2))
        assert (e[:, lag:] * e[:, :-lag]).mean() / variance == pytest.approx(expected, abs=0.1)
        assert (e[lag:] * e[:-lag]).mean() / variance == pytest.approx(expected, abs=0.1)
    assert abs((e[:, 16:] * e[:, :-16]).mean()) < 0.05 * variance


def test_uneven_noise_has_heavy_tails():
    def share_beyond_three_sigma(config: SensorConfig) -> float:
        e = error(1.0, config)
        return float((np.abs(e) > 3 * 1.4826 * np.median(np.abs(e))).mean())

    even, uneven = share_beyond_three_sigma(FINE), share_beyond_three_sigma(replace(FINE, unevenness=1.0))
    assert 0.0027 < even < 0.02  # of normal noise, and of that beside holes
    assert uneven > even + 0.01


def test_the_distortion_is_the_cameras_own_smooth_and_grows_with_depth_squared():
    quiet = replace(FINE, disparity_sigma_px=0.0, lateral_sigma_px=0.0, distortion_px=0.2)

    def mean_error(z: float, seed: int, draw: int) -> np.ndarray:
        depth = np.full((480, 640), z)
        measured = DepthSensor(CONFIG.camera, quiet, seed).measure(view(depth), np.random.default_rng(draw))
        return np.where(measured > 0, measured - z, np.nan)

    one, again, other = mean_error(1.0, 0, 0), mean_error(1.0, 0, 1), mean_error(1.0, 1, 0)
    np.testing.assert_allclose(np.nan_to_num(one - again), 0.0, atol=1e-6)
    assert np.nanstd(one - other) > np.nanstd(one)
    assert np.nanstd(one) == pytest.approx(0.2 / (FOCAL_PX * BASELINE_M), rel=0.4)
    assert np.nanstd(mean_error(2.0, 0, 0)) == pytest.approx(4 * np.nanstd(one), rel=0.05)
    assert np.nanmax(np.abs(np.diff(one, axis=1))) < 0.1 * np.nanstd(one)


def test_a_small_image_has_the_noise_and_distortion_of_the_sensor_it_is_read_from():
    small = replace(FINE, width=320, distortion_px=0.1)
    assert spread(error(1.2, small)) == pytest.approx(spread(error(1.2, replace(small, width=640))), rel=0.06)
    assert small.camera.fx / small.camera.width == CONFIG.camera.fx / CONFIG.camera.width
    quiet = replace(small, disparity_sigma_px=0.0, lateral_sigma_px=0.0)
    half, whole = wall(1.2, quiet), wall(1.2, replace(quiet, width=640))
    both = (half > 0) & (whole[::2, ::2] > 0)
    # pixel u of the small image sees where 2 u + 0.5 of the large one does
    np.testing.assert_allclose(half[both], whole[::2, ::2][both], atol=2e-4)


def test_grazing_surfaces_are_noisy_and_full_of_holes():
    facing, oblique, grazing = (wall(1.5, FINE, cosine=float(np.cos(np.radians(a)))) for a in (0, 60, 80))
    assert (facing == 0).mean() < 0.01
    assert (grazing == 0).mean() > 0.1
    assert spread(grazing[grazing > 0]) > 1.5 * spread(facing[facing > 0])
    assert spread(oblique[oblique > 0]) > spread(facing[facing > 0])


def test_dark_surfaces_are_lost_in_patches_and_the_more_the_further_away():
    lost = [(wall(z, albedo=0.05) == 0) for z in (0.8, 1.6, 3.0)]
    shares = [hole.mean() for hole in lost]
    assert shares[0] < 0.02 < shares[1] < shares[2]
    assert (wall(1.6, albedo=0.8) == 0).mean() < 0.005
    # beside a hole there is mostly another
    assert lost[1][:, 1:][lost[1][:, :-1]].mean() > 3 * shares[1]
    assert spread(error(1.6, FINE, albedo=0.05)) > 1.1 * spread(error(1.6, FINE, albedo=0.8))


def test_glossy_surfaces_dazzle_where_they_mirror_the_projector():
    shares = {
        (gloss, a): (wall(1.0, cosine=float(np.cos(np.radians(a))), gloss=gloss) == 0).mean()
        for gloss in (0.0, 0.9)
        for a in (0, 30, 65)
    }
    assert shares[0.9, 0] > 0.9  # seen straight on, the mirror direction is the projector's
    assert shares[0.9, 30] < 0.02
    assert max(shares[0.0, a] for a in (0, 30)) < 0.01
    assert spread(error(1.0, FINE, cosine=0.4, gloss=0.9)) > 1.05 * spread(error(1.0, FINE, cosine=0.4))


def test_without_noise_depth_is_exact():
    exact = np.random.default_rng(0).uniform(0.0, 9.0, (480, 640)).astype(np.float32)
    measured = measure(view(exact, albedo=0.02, gloss=1.0, error_m=0.1), replace(CONFIG, depth_noise=0.0))
    np.testing.assert_array_equal(measured, exact)


def test_the_error_of_what_is_seen_is_added():
    left_right = np.where(np.arange(640) < 320, 0.0, 0.01) + np.zeros((480, 1))
    measured = measure(view(np.full((480, 640), 1.5), error_m=left_right), replace(CONFIG, distortion_px=0.0))
    left, right = measured[:, :310], measured[:, 330:]
    assert right[right > 0].mean() - left[left > 0].mean() == pytest.approx(0.01, abs=5e-4)


def test_edges_are_rounded_and_planes_are_not():
    quiet = replace(FINE, disparity_sigma_px=0.0, lateral_sigma_px=0.0)
    slope = 0.5 * np.abs(np.arange(640) - 320)  # of depth, mm a pixel: a convex edge that points at the camera
    exact = 0.6 + 1e-3 * slope + np.zeros((480, 1))
    change = measure(view(exact), quiet) - exact
    edge, plane = change[:, 319:322], change[:, 340:620]
    assert (edge > 5e-4).mean() > 0.95
    assert np.median(np.abs(plane)) < 2e-5


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


def test_holes_open_at_depth_edges_and_silhouettes_are_frayed():
    depth = np.full((480, 640), 1.6)
    depth[:, :320] = 1.2  # the near half is on the left: no shadow
    measured = measure(view(depth))
    assert (measured[:, 319:321] == 0).mean() > 0.1
    assert (measured[:, 400:] == 0).mean() < 0.01
    near = (measured > 1.1) & (measured < 1.3)
    for columns in (slice(316, 320), slice(320, 324)):  # now and then either side reaches over
        assert 0.0 < near[:, columns].mean() < 1.0
    ends = 640 - np.argmax(near[:, ::-1], axis=1)
    assert ends.std() > 0.5
    assert np.abs(np.diff(ends)).mean() < ends.std()  # neighbouring rows alike


def test_out_of_range_is_not_measured():
    assert (wall(0.2) == 0).all()
    assert (wall(6.0) == 0).mean() > 0.99  # what is far off may come out nearer
    assert (wall(0.0) == 0).all()


def test_colour_noise_is_as_large_as_asked():
    grey = np.full((480, 640, 3), 128, dtype=np.uint8)
    noisy = measure_colour(grey, replace(CONFIG, colour_sigma=4.0), np.random.default_rng(0)).astype(float)
    assert noisy.std() == pytest.approx(4.0, rel=0.03)
    np.testing.assert_array_equal(measure_colour(grey, replace(CONFIG, colour_sigma=0.0), None), grey)
