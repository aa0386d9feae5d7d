import numpy as np
import pytest

from sequences import se3
from sequences.simulation import MotionConfig, PlaceConfig, SensorConfig, SimulationConfig, TrajectoryConfig
from sequences.simulation.localisation import recorded_poses
from sequences.simulation.motion import arrange
from sequences.simulation.place import Place, furnish
from sequences.simulation.standing import separation
from sequences.simulation.trajectory import camera_path
from sequences.types import LocalisationNoise

CONFIG = TrajectoryConfig(frames=40)
NOISE = LocalisationNoise(rotation_rad=0.01, translation_m=0.02, correlation_time_s=4.0)
SEEDS = range(8)


@pytest.fixture(scope="module")
def places() -> list[Place]:
    return [furnish(PlaceConfig(), seed) for seed in SEEDS]


@pytest.mark.parametrize("visit", [0, 1])
def test_a_head_camera_drives_level_and_smoothly(places, visit):
    for seed, place in zip(SEEDS, places, strict=True):
        times, poses = camera_path(place, CONFIG, seed, visit)
        assert (np.diff(times) == 500_000_000).all()
        R = poses[:, :3, :3]
        np.testing.assert_allclose(R @ R.swapaxes(-1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
        assert (np.linalg.det(R) > 0).all()
        np.testing.assert_allclose(R[:, 2, 0], 0.0, atol=1e-12)  # the image's x axis is level
        assert (R[:, 2, 1] < 0).all()  # and its y axis points down
        assert (np.abs(poses[:, 2, 3] - 1.2) < 0.01).all()
        steps = se3.local(poses[:-1], poses[1:])
        assert np.linalg.norm(steps[:, :3], axis=1).max() < np.radians(30)
        assert 0.02 < np.linalg.norm(steps[:, 3:], axis=1).max() < 0.35


def test_the_robot_keeps_clear_of_furniture_and_walls(places):
    for seed, place in zip(SEEDS, places, strict=True):
        xy = camera_path(place, CONFIG, seed, 0)[1][:, :2, 3]
        assert (xy > 0.4).all()
        assert (xy < place.layout.size - 0.4).all()
        for at in xy:
            head = at + 0.01 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            assert all(separation(head, piece.outline) > 0.4 for piece in place.furniture)


def test_each_surface_is_looked_at_from_near(places):
    camera = SensorConfig().camera
    for seed, place in zip(SEEDS, places, strict=True):
        poses = camera_path(place, CONFIG, seed, 0)[1]
        for surface in place.surfaces:
            centre = se3.transform(se3.inverse(poses), surface.T_world_area[None, :3, 3])[:, 0]
            pixels = camera.project(centre)
            shows = ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=-1)
            assert shows.any()
            assert 0.6 < np.linalg.norm(centre[shows], axis=-1).min() < 2.1


def test_things_leave_the_view_and_come_back(places):
    shares = []
    for seed, place in zip(SEEDS, places, strict=True):
        config = SimulationConfig(motion=MotionConfig(visits=1), trajectory=CONFIG)
        (visit,) = arrange(place, config, seed)
        camera = config.sensor.camera
        centres = np.stack([t.T_world_object[:3, 3] for t in visit.arrangements[0].things])
        pixels = camera.project(se3.transform(se3.inverse(visit.T_world_camera), centres))
        in_view = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=-1)
        assert in_view.any(axis=0).mean() > 0.7
        assert (~in_view).any(axis=0).all()
        came_back = (np.diff(in_view.astype(int), axis=0) == 1).sum(axis=0) + in_view[0]
        assert (came_back >= 2).any()
        shares.append(in_view.mean())
    assert 0.25 < np.mean(shares) < 0.8


def test_visits_take_ways_of_their_own(places):
    first, second = (camera_path(places[0], CONFIG, 0, visit)[1] for visit in (0, 1))
    assert np.abs(first - second).max() > 0.1


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_few_frames_are_a_path_too(places, frames):
    times, poses = camera_path(places[0], TrajectoryConfig(frames=frames), 0, 0)
    assert times.shape == (frames,)
    assert np.isfinite(poses).all()


def test_recorded_poses_err_as_the_run_states():
    rng = np.random.default_rng(1)
    times = (np.arange(40000) * 2e9).astype(np.int64)
    truth = se3.exp(rng.normal(size=(len(times), 6)))
    errors = se3.local(truth, recorded_poses(truth, times, NOISE, rng))
    np.testing.assert_allclose(errors.std(axis=0), [0.01] * 3 + [0.02] * 3, rtol=0.03)
    np.testing.assert_allclose(errors.mean(axis=0) / errors.std(axis=0), 0.0, atol=0.03)
    for lag in (1, 3):
        correlation = (errors[lag:] * errors[:-lag]).mean(axis=0) / errors.var(axis=0)
        np.testing.assert_allclose(correlation, np.exp(-lag * 2.0 / 4.0), atol=0.04)


def test_without_noise_the_recorded_poses_are_the_true_ones():
    truth = se3.exp(np.random.default_rng(2).normal(size=(5, 6)))
    times = np.arange(5) * 10**9
    recorded = recorded_poses(truth, times, LocalisationNoise(), np.random.default_rng(3))
    np.testing.assert_allclose(recorded, truth, atol=1e-15)
