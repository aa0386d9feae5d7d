"""Laws of calibrating: what was put into depth and detections is found, at any length of run."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from typer.testing import CliRunner

from ctmap_gtsam.bench.realism.residuals import glances
from ctmap_gtsam.cli.app import app
from ctmap_gtsam.cli.show import show_calibration
from ctmap_gtsam.config import Config, load_config
from ctmap_gtsam.learning import calibration as calibration_module
from ctmap_gtsam.learning.calibration import ALL, Calibration, Fitted, described, fit_lengths
from ctmap_gtsam.learning.depth import DepthStatistics, View
from ctmap_gtsam.learning.detections import DetectorStatistics, Sight, sights_of
from ctmap_gtsam.shapes import centre_of
from factors.measurement import class_log_ratio, correlated_pixels, correlated_pixels_of, lag_products
from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.rendering.scene import render_scene
from tests.ctmap_gtsam import synthetic

CONFIG = Config()
SIGMA, QUADRATIC, WIDTH = 0.0015, 0.003, 3
BIAS_RAD, BIAS_M = 0.02, 0.002
FRAMES, VISITS, DRAWS = 8, 28, 40
SHAPE, COVERED = (14, 16), 0.95


@lru_cache(maxsize=1)
def drawn_views():
    """Boxes seen from all sides: blurred noise in each image, and a motion of its own in each object-visit."""
    rng = np.random.default_rng(0)
    views = []
    for visit in range(VISITS):
        b = rng.standard_normal(6) * np.repeat([BIAS_RAD, BIAS_M], 3)
        for k in range(FRAMES):
            z = np.full(SHAPE, rng.uniform(0.5, 1.5))
            noise = uniform_filter(rng.standard_normal((SHAPE[0] + 8, SHAPE[1] + 8)), WIDTH)[4:-4, 4:-4] * WIDTH
            J = _jacobian(rng, SHAPE)
            rows, columns = np.nonzero(rng.random(SHAPE) < COVERED)
            r = (J @ b + (SIGMA + QUADRATIC * z**2) * noise)[rows, columns]
            at = np.stack([rows, columns], axis=-1)
            views.append(View(visit, k, FRAMES, r, z[rows, columns], J[rows, columns], at))
    return views


def _jacobian(rng, shape):
    """(h, w, 6) of a plane, turned anyhow, 0.1 m across."""
    normal = rng.standard_normal(3)
    normal[2] = -1.0 - abs(normal[2])
    v, u = np.mgrid[-0.05 : 0.05 : shape[0] * 1j, -0.05 : 0.05 : shape[1] * 1j]
    points = np.stack([u, v, -(normal[0] * u + normal[1] * v) / normal[2]], axis=-1)
    R = se3.so3_exp(rng.standard_normal(3))
    along = np.concatenate([np.cross(points, np.broadcast_to(normal, points.shape)) @ R, (normal @ R) + 0 * points], -1)
    return along / normal[2]


def drawn_sights(rng, p_confused=0.2, p_found=0.8, sigma=0.08, visits=150, frames=9, classes=6):
    """A detector that holds one belief of each object-visit."""
    sights = []
    for visit in range(visits):
        truth = int(rng.integers(classes))
        others = [c for c in range(classes) if c != truth]
        believed = int(rng.choice(others)) if rng.random() < p_confused else truth
        for k in range(frames):
            scores = rng.random(1 + classes)
            scores[1 + believed] += 2.0
            visible = rng.uniform(0.3, 1.0)
            true = np.array([100.0, 80.0, 60.0, 90.0])
            edges = np.concatenate([true[:2], true[:2] + true[2:]])
            edges += rng.laplace(size=4) * sigma / np.sqrt(2.0) * np.tile(true[2:], 2)
            box = np.concatenate([edges[:2], edges[2:] - edges[:2]])
            found = rng.random() < p_found * visible
            sights.append(
                Sight(
                    visit,
                    k,
                    frames,
                    truth,
                    visible,
                    class_log_ratio(scores / scores.sum(), floor=CONFIG.detector.score_floor) if found else None,
                    np.stack([box, true]) if found else np.full((2, 4), np.nan),
                    (640, 480),
                )
            )
    return sights


def by_name(fits):
    return {f"{one.section}.{one.name}": one for one in fits}


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return fit_lengths(drawn_views(), drawn_sights(np.random.default_rng(1)), CONFIG, every=2, draws=DRAWS)


def correlated():
    """Var(sum) / sum of Var of a blurred image: width^2, less what its rim and the samples left out lack."""
    lag = np.arange(1 - WIDTH, WIDTH)
    along = [((1 - np.abs(lag) / WIDTH) * (1 - np.abs(lag) / n)).sum() for n in SHAPE]
    return 1.0 + COVERED * (np.prod(along) - 1.0)


TRUTH = {
    "sensor.kappa": 1.0 / correlated(),
    "sensor.bias_rotation_rad": BIAS_RAD,
    "sensor.bias_translation_m": BIAS_M,
    "detector.confusion": 0.2,
    "detector.detection_probability": 0.8,
    "detector.box_sigma": 0.08,
}


@pytest.mark.parametrize("name", TRUTH)
def test_what_was_drawn_is_inside_the_interval(calibration, name):
    one = by_name(calibration.fitted)[name]
    slack = 0.1 * TRUTH[name]  # 95 % of these figures would be inside without it
    assert one.interval[0] - slack <= TRUTH[name] <= one.interval[1] + slack
    assert one.value == pytest.approx(TRUTH[name], rel=0.35)


def test_the_noise_is_found_at_all_depths(calibration):
    fitted = by_name(calibration.fitted)
    a, b = fitted["sensor.sigma_m"], fitted["sensor.sigma_quadratic_per_m"]
    for z in (0.6, 1.0, 1.4):
        assert a.value + b.value * z**2 == pytest.approx(SIGMA + QUADRATIC * z**2, rel=0.1)


def test_runs_of_all_lengths_agree_where_each_fact_is_one(calibration):
    assert len(calibration.lengths) == 3
    # of 16 comparisons at 95 % hardly one is beyond
    assert len(calibration.disagreeing()) <= 1


def test_fewer_object_visits_widen_the_intervals():
    sights = drawn_sights(np.random.default_rng(1))
    few, many = (fit_lengths([], [s for s in sights if s.visit < n], CONFIG, draws=DRAWS) for n in (15, 150))
    for a, b in zip(few.fitted, many.fitted, strict=True):
        assert np.ptp(a.interval) > np.ptp(b.interval)


def test_a_belief_that_changes_is_found_to_hang_on_the_length():
    """A detector that is right at first, and wrong from the middle of each visit on."""
    right, wrong = (drawn_sights(np.random.default_rng(2), p_confused=p) for p in (0.0, 1.0))
    changing = [a if a.order < 4 else replace(b, true_class=a.true_class) for a, b in zip(right, wrong, strict=True)]
    late = fit_lengths([], changing, CONFIG, draws=DRAWS)
    assert ("confusion", "first halves") in [(one.name, length) for one, length, _ in late.disagreeing()]


def test_the_bias_of_single_frames_is_not_taken_for_certainty():
    """One frame a visit can't tell bias from noise, many can; the rest of the fit knows the difference."""
    one = DepthStatistics([v for v in drawn_views() if v.order == 0], CONFIG.sensor).fit()
    assert one.kappa < 1.5 / correlated()


def test_a_perfect_detector_has_no_point_interval():
    statistics = DetectorStatistics(drawn_sights(np.random.default_rng(3), p_confused=0.0, visits=20), CONFIG)
    middle, (low, high) = statistics.confusion_posterior(0.95)
    assert low < middle < high
    assert 0.02 < high < 0.3


def test_lags_of_two_images_add_up_to_those_of_both():
    images = np.random.default_rng(4).standard_normal((2, 12, 15))
    images[:, :3, :4] = np.nan
    both = lag_products(images[0]) + lag_products(images[1])
    np.testing.assert_allclose(lag_products(images), both, atol=1e-9)
    assert correlated_pixels_of(both, np.isfinite(images).sum() / 2) == pytest.approx(correlated_pixels(images))


# --- runs on disk ---


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    run = load_run(synthetic.write_run(tmp_path_factory.mktemp("run") / "run", frames=6, visits=2))
    return run, load_truth(run)


def test_the_jacobian_is_how_depth_moves_with_the_object(scene):
    run, truth = scene
    seen = next(glances(run, truth, 1, lambda frame, items, images: images.depth))
    (thing,) = (o for o in truth.objects if o.inst_id == seen.thing[1])
    known = run.catalogue[thing.obj_id]
    centre = se3.make(np.eye(3), centre_of(known))
    J, step = seen.jacobian(centre_of(known)), 1e-4
    camera = run.frames[seen.frame].camera
    for k in range(6):
        moved = [
            render_scene(
                [
                    (
                        known.mesh,
                        seen.T_camera_object @ centre @ se3.exp(sign * step * np.eye(6)[k]) @ se3.inverse(centre),
                    )
                ],
                camera,
            ).depth.astype(np.float64)
            for sign in (1.0, -1.0)
        ]
        numerical = (moved[0] - moved[1]) / (2.0 * step)
        rows, columns = np.nonzero(np.isfinite(seen.refitted))
        # the cut starts where the silhouette does
        v, u = (np.flatnonzero((moved[0] > 0).any(axis=axis))[0] for axis in (1, 0))
        difference = np.abs(numerical[rows + v, columns + u] - J[rows, columns, k])
        assert np.median(difference) < 0.02


def test_sights_are_those_of_visible_objects(scene):
    run, truth = scene
    sights = sights_of(run, truth, CONFIG)
    assert len(sights) == sum(len(o.frames) for o in truth.objects)
    assert {s.visit for s in sights} == set(range(6))
    # the detector takes object 1 for another class throughout
    wrong = [s for s in sights if s.scores is not None and np.argmax(s.scores) != s.true_class]
    assert len({s.visit for s in wrong}) == 2
    assert all(s.scores is not None for s in sights)


def ctmap(*arguments):
    return CliRunner().invoke(app, ["train", "calibration", *map(str, arguments)], prog_name="ctmap")


def test_what_is_fitted_is_a_configuration(tmp_path, scene, monkeypatch):
    run, _ = scene
    monkeypatch.setattr(calibration_module, "DRAWS", 5)
    done = ctmap(run.path, "--out", tmp_path / "fit.toml", "--every", 2)
    assert done.exit_code == 0, done.output
    text, config = (tmp_path / "fit.toml").read_text(), load_config(tmp_path / "fit.toml")
    assert config.sensor.kappa != CONFIG.sensor.kappa
    assert config.detector.confusion != CONFIG.detector.confusion
    assert "1 frame in 2" in text
    assert "object-visits" in text
    assert config.sensor.outlier_weight == CONFIG.sensor.outlier_weight


def test_the_file_says_what_each_length_says():
    here, there = (Fitted("sensor", "kappa", v, (v / 2, v * 2), 7) for v in (0.01, 0.9))
    calibration = Calibration({ALL: (here,), "first halves": (there,)})
    assert "first halves 0.9" in described(calibration)
    assert calibration.disagreeing() == [(here, "first halves", there)]


def test_what_disagrees_is_said_and_what_is_missing_leaves_a_gap(capsys):
    here, there = (Fitted("sensor", "kappa", v, (v / 2, v * 2), 7) for v in (0.01, 0.9))
    show_calibration(Calibration({ALL: (here,), "1 frame in 3": (), "first halves": (there,)}), CONFIG)
    shown = capsys.readouterr()
    assert "0.01 (0.005 to 0.02)" in shown.out
    assert "sensor.kappa hangs on the run's length" in shown.err


def test_bad_input_is_named(tmp_path):
    path = synthetic.write_run(tmp_path / "run", frames=2)
    out = ("--out", tmp_path / "fit.toml")
    few = ctmap(path, *out)
    assert few.exit_code == 2
    assert "visits" in few.stderr
    for file in path.rglob("scene_gt*.json"):
        file.unlink()
    blind = ctmap(path, *out)
    assert blind.exit_code == 2
    assert "truth" in blind.stderr
    assert not (tmp_path / "fit.toml").exists()
