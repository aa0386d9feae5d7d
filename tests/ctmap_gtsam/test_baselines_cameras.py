"""The laws of the cameras' oracle: what it knows, what it doesn't, and that nobody who knows less does better."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ctmap_gtsam.baselines import cameras
from ctmap_gtsam.baselines.cameras import NAME, cameras_of_known_objects
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.methods import METHODS
from ctmap_gtsam.smoothing.smoother import smooth_run
from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.types import LocalisationNoise, Run
from tests.ctmap_gtsam import synthetic
from tests.ctmap_gtsam.scenes import CHEAP, config_of

CONFIG = config_of(*CHEAP, "frontend.start_after=2", "smoother.rounds=2")
NOISE = LocalisationNoise(rotation_rad=0.004, translation_m=0.006, correlation_time_s=1.0)


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> Run:
    """Two visits of four frames with exact depth, recorded with the true cameras."""
    return load_run(synthetic.write_run(tmp_path_factory.mktemp("cameras") / "run", frames=4, visits=2))


def disturbed(run: Run, seed: int) -> Run:
    """The same with recorded cameras that err as the run says."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat([NOISE.rotation_rad, NOISE.translation_m], 3)
    visits = []
    for visit in run.visits:
        e, frames = rng.normal(size=6), []
        for frame in visit.frames:
            frames.append(replace(frame, T_world_camera=se3.retract(frame.T_world_camera, sigma * e)))
            rho = np.exp(-0.1 / NOISE.correlation_time_s)
            e = rho * e + np.sqrt(1.0 - rho**2) * rng.normal(size=6)
        visits.append(replace(visit, frames=tuple(frames)))
    return replace(run, visits=tuple(visits), localisation=NOISE)


@pytest.fixture(scope="module")
def shaken(exact) -> Run:
    return disturbed(exact, 0)


@pytest.fixture(scope="module")
def known(shaken):
    return cameras_of_known_objects(shaken, CONFIG)


def seen_from(run: Run, move: Callable[[np.ndarray], np.ndarray]) -> Run:
    """The run with its recorded cameras moved."""
    visits = (
        replace(v, frames=tuple(replace(f, T_world_camera=move(f.T_world_camera)) for f in v.frames))
        for v in run.visits
    )
    return replace(run, visits=tuple(visits))


def error_m(run: Run, T_world_camera: np.ndarray) -> float:
    """Root mean square over the frames."""
    off = T_world_camera[:, :3, 3] - load_truth(run).T_world_camera[:, :3, 3]
    return float(np.sqrt((off**2).sum(axis=-1).mean()))


def recorded(run: Run) -> np.ndarray:
    return np.stack([frame.T_world_camera for frame in run.frames])


def test_exact_cameras_stay_exact(exact):
    assert error_m(exact, cameras_of_known_objects(exact, CONFIG).T_world_camera) < 1e-4


def test_exact_depth_of_known_objects_tells_where_the_cameras_were(shaken, known):
    assert error_m(shaken, recorded(shaken)) > 0.006
    assert error_m(shaken, known.T_world_camera) < 0.35 * error_m(shaken, recorded(shaken))


def test_it_is_as_sure_as_it_may_be(shaken, known):
    """The truth lies where its covariances say, and they are narrower than what was known before."""
    e = se3.log(se3.inverse(known.T_world_camera) @ load_truth(shaken).T_world_camera)
    assert np.einsum("ki,kij,kj->k", e, np.linalg.inv(known.camera_covariance), e).mean() < 2.0 * 6.0
    assert (np.trace(known.camera_covariance[:, 3:, 3:], axis1=1, axis2=2) < 3.0 * NOISE.translation_m**2).all()


def test_who_has_to_find_the_objects_knows_the_cameras_no_better(tmp_path):
    run = disturbed(load_run(synthetic.write_run(tmp_path / "run", frames=3)), 2)
    known = cameras_of_known_objects(run, CONFIG)
    smoothed = smooth_run(run, filter_run(run, CONFIG), CONFIG)
    sure = np.sqrt(np.trace(known.camera_covariance[:, 3:, 3:], axis1=1, axis2=2).mean())
    assert error_m(run, known.T_world_camera) <= error_m(run, smoothed.T_world_camera) + sure


def test_its_objects_are_the_truth(shaken, known):
    truth = load_truth(shaken)
    assert known.meta["method"] == NAME
    assert known.meta["reads_truth"]
    assert known.object_id.tolist() == [thing.inst_id for thing in truth.objects]
    assert known.exists.all()
    for n, thing in enumerate(truth.objects):
        np.testing.assert_allclose(known.pose[n], thing.T_world_object, atol=1e-9)
        assert (known.best_class[n] == thing.obj_id).all()


def test_where_the_world_has_its_origin_says_nothing(shaken, known, monkeypatch):
    """Turned about the vertical and moved, with all that is recorded and true, the answer is moved along."""
    W = se3.make(se3.so3_exp(np.array([0.0, 0.0, 0.7])), np.array([1.0, -2.0, 0.5]))
    truth = load_truth(shaken)
    objects = tuple(replace(thing, T_world_object=W @ thing.T_world_object) for thing in truth.objects)
    moved = replace(truth, objects=objects, T_world_camera=W @ truth.T_world_camera)
    monkeypatch.setattr(cameras, "load_truth", lambda run: moved)
    found = cameras_of_known_objects(seen_from(shaken, lambda T: W @ T), CONFIG)
    np.testing.assert_allclose(found.T_world_camera, W @ known.T_world_camera, atol=2e-4)
    np.testing.assert_allclose(found.camera_covariance, known.camera_covariance, rtol=0.1, atol=1e-7)


def test_it_is_marked_and_needs_the_truth(exact, tmp_path):
    method = METHODS[NAME]
    assert method.reads_truth
    assert method.skip(exact) is None
    bare = load_run(synthetic.write_run(tmp_path / "run", frames=2))
    for found in (tmp_path / "run").rglob("scene_gt*.json"):
        found.unlink()
    assert "scene_gt.json" in method.skip(bare)
