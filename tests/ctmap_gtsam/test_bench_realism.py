import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from typer.testing import CliRunner

from ctmap_gtsam.bench import realism
from ctmap_gtsam.bench.realism import planes
from ctmap_gtsam.bench.realism.planes import Patches
from ctmap_gtsam.bench.realism.residuals import figures, glances, picture
from ctmap_gtsam.bench.realism.twin import Twin
from ctmap_gtsam.cli.app import app
from ctmap_gtsam.config import Config
from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.camera import Camera
from sequences.catalogue import Catalogue
from sequences.simulation import SensorConfig
from sequences.simulation.config import FOCAL_PX
from sequences.simulation.sensor import BASELINE_M
from sequences.types import Run, Truth
from sequences.writing import FrameTruth, RunWriter, Sighting
from tests.sequences.simulation.conftest import TINY
from tests.tiny import tiny_catalogue

CAMERA = Camera(FOCAL_PX, FOCAL_PX, 159.5, 119.5, width=320, height=240)
FRAMES = 6


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> tuple[Run, Truth]:
    """A box and a can 0.5 m away, seen from a camera that moves a little; nothing was measured."""
    folder = tmp_path_factory.mktemp("scene") / "run"
    classes = Catalogue(tiny_catalogue().classes[:2])
    box = se3.make(se3.so3_exp(np.array([0.5, 0.6, 0.2])), np.array([-0.06, 0.0, 0.5]))
    can = se3.make(se3.so3_exp(np.array([1.2, 0.3, 0.0])), np.array([0.08, 0.0, 0.55]))
    with RunWriter(folder, classes, source="tests") as writer:
        visit = writer.add_visit(1)
        for k in range(FRAMES):
            T = se3.exp(np.array([0.01 * k, -0.02 * k, 0.01, 0.01 * k, 0.0, 0.0]))
            truth = FrameTruth(T, (Sighting(1, 1, box, 1.0), Sighting(2, 5, can, 1.0)))
            visit.add_frame(k + 1, 10**9 * k, CAMERA, T, np.full((240, 320), 0.8, np.float32), truth=truth)
    run = load_run(folder)
    found = load_truth(run)
    assert found is not None
    return run, found


def measured(scene: tuple[Run, Truth], error: Callable) -> dict[str, float]:
    """Figures of depth that is true but for `error(frame, images)`, metres; NaN is a hole."""

    def measure(frame, items, images):
        depth = images.depth + np.where(images.item >= 0, error(frame, images), 0.0)
        return np.nan_to_num(depth, nan=0.0).astype(np.float32)

    return figures(list(glances(*scene, 1, measure)))


def test_true_depth_has_no_residual(scene):
    found = measured(scene, lambda frame, images: 0.0)
    for name in ("spread_mm", "spread_before_refit_mm", "bias_mm", "bias_within_mm", "beyond_5_mm", "flying_edge"):
        assert found[name] == pytest.approx(0.0, abs=1e-3), name
    assert found["holes_interior"] == found["holes_edge"] == 0.0


def test_noise_of_known_size_and_length_is_found(scene):
    def error(frame, images):
        white = np.random.default_rng(frame.index).normal(size=images.depth.shape)
        smooth = gaussian_filter(white, 2.0)
        return 0.001 * smooth / smooth.std()

    found = measured(scene, error)
    assert found["spread_mm"] == pytest.approx(1.0, rel=0.15)
    assert found["spread_px"] == pytest.approx(1e-3 * FOCAL_PX * BASELINE_M / found["z_m"] ** 2, rel=0.2)
    for lag in (1, 2, 4):
        assert found[f"correlation_{lag}"] == pytest.approx(np.exp(-(lag**2) / 16.0), abs=0.12)
    assert abs(found["correlation_16"]) < 0.15
    assert found["beyond_3_sigma"] < 0.01
    assert found["kurtosis"] == pytest.approx(3.0, abs=0.5)
    assert found["lasting_mm"] < 0.35  # fresh in each frame


def test_a_wrong_pose_is_refitted_and_shows_as_bias(scene):
    run, truth = scene
    shifted = replace(
        truth,
        objects=tuple(
            replace(o, T_world_object=o.T_world_object @ se3.exp(np.array([0.01, -0.02, 0.01, 0.001, 0.001, 0.002])))
            for o in truth.objects
        ),
    )
    true = {frame.index: None for frame in run.frames}

    def remember(frame, items, images):
        true[frame.index] = images.depth
        return images.depth

    list(glances(run, truth, 1, remember))
    found = figures(list(glances(run, shifted, 1, lambda frame, items, images: true[frame.index])))
    assert found["spread_before_refit_mm"] > 0.5
    assert found["spread_mm"] < 0.1 * found["spread_before_refit_mm"]
    assert found["bias_mm"] > 0.5
    assert found["bias_within_mm"] < 0.3 * found["bias_mm"]


def test_heavy_tails_show(scene):
    def error(frame, images):
        rng = np.random.default_rng(frame.index)
        wild = rng.random(images.depth.shape) < 0.04
        return rng.normal(scale=np.where(wild, 0.008, 0.001))

    found = measured(scene, error)
    assert found["beyond_3_sigma"] == pytest.approx(0.0027 + 0.04 * 0.7, abs=0.008)
    assert found["kurtosis"] > 8.0
    assert found["beyond_5_mm"] == pytest.approx(0.04 * 0.53, abs=0.008)


def test_holes_and_flying_pixels_are_shares_of_the_silhouette(scene):
    def error(frame, images):
        u = np.random.default_rng(frame.index).random(images.depth.shape)
        return np.where(u < 0.1, np.nan, np.where(u < 0.3, 0.015, 0.0))

    found = measured(scene, error)
    assert found["holes_interior"] == pytest.approx(0.1, abs=0.02)
    assert found["holes_edge"] == pytest.approx(0.1, abs=0.02)
    assert found["flying_edge"] == pytest.approx(0.2 / 0.9, abs=0.03)


def test_what_stands_before_a_thing_is_not_its_residual(scene):
    found = measured(scene, lambda frame, images: np.where(np.arange(320) < 80, -0.1, 0.0))
    assert found["bias_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["beyond_5_mm"] == 0.0


def test_an_error_of_the_surface_lasts(scene):
    _, truth = scene

    def error(frame, images):
        T_world_camera = truth.T_world_camera[frame.index]
        points = se3.transform(T_world_camera, frame.camera.points(images.depth).reshape(-1, 3))
        return (0.001 * np.sin(points @ [400.0, 300.0, 200.0])).reshape(images.depth.shape)

    found = measured(scene, error)
    assert found["lasting_mm"] == pytest.approx(0.001 / np.sqrt(2.0) * 1e3, rel=0.25)


def test_the_twin_of_a_perfect_sensor_is_the_truth(scene):
    run, truth = scene
    twin = Twin(run, truth, SensorConfig(depth_noise=0.0), 0)
    found = figures(list(glances(run, truth, 1, twin.measure)))
    assert found["spread_before_refit_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["holes_interior"] == found["holes_edge"] == 0.0
    noisy = figures(list(glances(run, truth, 1, Twin(run, truth, SensorConfig(), 0).measure)))
    assert noisy["spread_mm"] > 0.5
    assert noisy["holes_edge"] > 0.05


def test_a_picture_shows_every_object(scene):
    shown = picture(*scene, lambda frame, items, images: images.depth)
    assert shown.ours.sum() > 2000
    assert np.isfinite(shown.residual[shown.ours]).all()
    assert np.isnan(shown.residual[~shown.ours]).all()


def test_planes_at_any_slant_give_the_noise_of_disparity():
    rng = np.random.default_rng(0)
    v, u = np.mgrid[0:480, 0:640]
    camera = Camera(FOCAL_PX, FOCAL_PX, 319.5, 239.5, width=640, height=480)
    disparity = 25.0 + 0.01 * u - 0.02 * v
    noise = gaussian_filter(rng.normal(size=disparity.shape), 1.0)
    depth = FOCAL_PX * BASELINE_M / (disparity + 0.1 * noise / noise.std())
    found = planes.figures(Patches([(depth.astype(np.float32), camera)]))
    assert found["planes_px_1.4_1.8"] == pytest.approx(0.1, rel=0.15)  # the best quarter is a little better
    assert found["planes_correlation_1"] == pytest.approx(np.exp(-0.25), abs=0.06)
    assert abs(found["planes_correlation_8"]) < 0.1
    assert np.isnan(found["planes_px_0.4_0.7"])


@pytest.fixture
def quick(monkeypatch) -> Config:
    """Settings of a small place, and a measurement of few frames."""
    monkeypatch.setattr(realism, "PLACE_SEEDS", (0,))
    monkeypatch.setattr(realism, "PLACE_FRAMES", 4)
    monkeypatch.setattr(realism, "RECORDINGS", {"ycb_desk": 5, "visp_rbt": 33})
    monkeypatch.setattr(realism, "TWIN_SEEDS", 2)
    monkeypatch.setattr(realism, "KINECT_EVERY", 30)
    return replace(Config(), simulation=replace(TINY, sensor=SensorConfig()))


def test_without_recordings_the_reason_is_given(quick, tmp_path, monkeypatch):
    monkeypatch.delenv("CTMAP_DATA", raising=False)
    options = ["--json", str(tmp_path / "r.json"), "--set", "simulation.trajectory.frames=4", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, ["bench", "realism", *options])
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "r.json").read_text())["figures"]
    assert "--data" in found["ycb_desk.skipped"]
    assert "--data" in found["tum_cabinet.skipped"]
    assert found["places.spread_mm"] > 0.5
    for name in ("realism.png", "realism-pictures.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_simulated_depth_is_not_easier_than_real_depth(quick, data: Path):
    found = realism.run(quick, data=data)
    names = ("spread_mm", "correlation_1", "correlation_4", "holes_interior", "holes_edge", "bias_mm")
    for recording in ("ycb_desk", "visp_rbt"):
        for name in names:
            assert found[f"{recording}_twin.over_real.{name}"] > 0.85, (recording, name)
    for bins in ("1_1.4", "1.4_1.8", "1.8_2.3"):
        if found[f"places.planes_px_{bins}"] is not None:
            assert found[f"places.planes_px_{bins}"] > 0.9 * found[f"tum_cabinet.planes_px_{bins}"]
    assert not any(key.endswith("skipped") for key in found)
