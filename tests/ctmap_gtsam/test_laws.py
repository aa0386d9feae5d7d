"""The model's laws that hold for whole estimators: what they may not read, and what may not matter."""

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numba
import numpy as np
import pytest

from ctmap_gtsam.comparing import run_methods
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering import team
from ctmap_gtsam.methods import METHODS
from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.simulation import (
    DetectorConfig,
    MotionConfig,
    PlaceConfig,
    SensorConfig,
    SimulationConfig,
    TrajectoryConfig,
    simulate_place,
)
from sequences.types import Run
from tests.ctmap_gtsam.scenes import CHEAP, config_of, run_of, small_run

QUICK = (
    *CHEAP,
    "frontend.start_after=2",
    "frontend.angular_step_rad=0.01",
    "frontend.perturbed_poses=1",
    "frontend.mesh_faces=200",
)
CONFIG = config_of(*QUICK)
BOTH = ("filter-ct", "smooth-ct")
BLIND = tuple(name for name, method in METHODS.items() if method.run is not None and not method.reads_truth)
TRUTH = ("scene_gt*.json", "scene_camera_gt.json", "mask", "mask_visib")

each_estimator = pytest.mark.parametrize("method", [*BOTH, "lag-ct"])
each_of_three = pytest.mark.parametrize("method", [*BOTH, "ffbsi-ct"])


@pytest.fixture(scope="module")
def simulated(tmp_path_factory) -> Path:
    """Two visits of six frames, four things, one of them moved between."""
    target = tmp_path_factory.mktemp("laws") / "run"
    config = SimulationConfig(
        place=PlaceConfig(objects=4, distractors=1),
        motion=MotionConfig(visits=2, moves=1),
        trajectory=TrajectoryConfig(frames=6),
        sensor=SensorConfig(width=320, antialias=1),
        detector=DetectorConfig(furniture=False),
    )
    simulate_place(target, config, 3)
    return target


@pytest.fixture(scope="module")
def scene() -> Run:
    return small_run(frames=5)[0]


def estimate_of(run: Run, method: str, config: Config = CONFIG) -> Estimate:
    return estimates_of(run, (method,), config)[method]


def estimates_of(run: Run, methods: tuple[str, ...], config: Config) -> dict[str, Estimate]:
    """But for those that can't run here."""
    outcomes = run_methods(run, methods, config)
    return {name: outcome.estimate for name, outcome in outcomes.items() if outcome.estimate is not None}


@cache
def known_estimates(run: Path, methods: tuple[str, ...], config: Config) -> dict[str, Estimate]:
    """Of a run that no test alters, made once."""
    return estimates_of(load_run(run), methods, config)


def stored(estimate: Estimate, folder: Path) -> bytes:
    file = folder / "estimate.npz"
    estimate.save(file)
    return file.read_bytes()


def copy_of(run: Path, folder: Path, *leave_out: str) -> Path:
    """A run of the same name elsewhere; what isn't altered is linked to, not copied."""
    target = folder / run.name
    link = lambda source, there: Path(there).symlink_to(Path(source).resolve())  # noqa: E731
    shutil.copytree(run, target, ignore=shutil.ignore_patterns(*leave_out), copy_function=link)
    return target


def check_truth_is_not_read(run: Path, config: Config, methods: tuple[str, ...], tmp_path: Path) -> None:
    """Law 1 of the model."""
    bare = copy_of(run, tmp_path / "bare", *TRUTH)
    assert load_truth(load_run(run)) is not None
    assert load_truth(load_run(bare)) is None
    known, blind = known_estimates(run, methods, config), estimates_of(load_run(bare), methods, config)
    assert set(BOTH) <= known.keys() == blind.keys()
    for method, whole in known.items():
        assert len(whole.object_id) > 0
        assert stored(whole, tmp_path) == stored(blind[method], tmp_path)


def test_with_every_truth_file_deleted_each_estimate_is_identical_to_the_byte(simulated, tmp_path):
    check_truth_is_not_read(simulated, CONFIG, BLIND, tmp_path)


@pytest.mark.parametrize("recording", ["ycb_desk", "visp_rbt"])
def test_with_every_truth_file_of_a_recording_deleted_each_estimate_is_identical_to_the_byte(data, recording, tmp_path):
    frames = len(load_run(data / recording).frames)
    config = config_of(*QUICK, f"keyframes.every={frames // 4}")
    check_truth_is_not_read(data / recording, config, BOTH, tmp_path)


def arrays_of(estimate: Estimate, folder: Path) -> dict[str, np.ndarray]:
    """All that is stored but for the meta data."""
    stored(estimate, folder)
    with np.load(folder / "estimate.npz") as archive:
        return {name: archive[name] for name in archive.files if name != "meta"}


@each_of_three
def test_the_order_in_which_files_list_things_changes_nothing(simulated, method, tmp_path):
    """Law 3 of the model."""
    shuffled = copy_of(simulated, tmp_path)
    files = [shuffled / "catalogue.json", shuffled / "models" / "models_info.json"]
    for scene in sorted((shuffled / "test").iterdir()):
        files += [scene / "scene_detections.json", scene / "scene_camera.json"]
    for file in files:
        text = json.loads(file.read_text())
        turned = text[::-1] if isinstance(text, list) else dict(reversed(text.items()))
        assert json.dumps(turned) != json.dumps(text)
        file.unlink()  # a link to the original
        file.write_text(json.dumps(turned))
    a = arrays_of(known_estimates(simulated, BLIND, CONFIG)[method], tmp_path)
    b = arrays_of(estimate_of(load_run(shuffled), method), tmp_path)
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@each_estimator
def test_the_number_of_threads_changes_nothing(scene, method, tmp_path):
    before = numba.get_num_threads()
    answers = []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            answers.append(stored(estimate_of(scene, method), tmp_path))
    finally:
        numba.set_num_threads(before)
    assert answers[0] == answers[1]


@pytest.fixture
def always_another(monkeypatch):
    """A process beside this one from the first keyframe on, which does all that can be sent: what it was given."""
    given = []
    do = team._Beside.do

    def waiting(beside, tasks, scene, here):
        given.extend(tasks)
        beside._there.result()
        return do(beside, tasks, scene, here)

    monkeypatch.setattr(team._Beside, "do", waiting)
    monkeypatch.setattr(team._Beside, "_room", lambda beside, left: 1000)
    monkeypatch.setattr(team, "cores", lambda: 2)
    monkeypatch.setattr(team, "LEAST_OBJECTS", 1)
    monkeypatch.setattr(team, "LEAST_WORK", 0)
    return given


def test_the_number_of_processes_changes_nothing(simulated, always_another, tmp_path):
    methods = ("filter-ct", "ffbsi-ct")
    with pytest.MonkeyPatch.context() as alone:
        alone.setattr(team, "cores", lambda: 1)
        known = estimates_of(load_run(simulated), methods, CONFIG)
    assert not always_another
    beside = estimates_of(load_run(simulated), methods, CONFIG)
    assert {type(task).__name__ for task in always_another} == {"Step", "Search", "Start"}
    for method in methods:
        assert stored(beside[method], tmp_path) == stored(known[method], tmp_path)


@each_of_three
def test_moving_the_whole_world_moves_the_whole_answer(scene, method):
    """Law 4 of the model."""
    G = se3.exp(np.array([0.4, -0.3, 1.0, 2.0, -1.0, 0.5]))
    visits = tuple(
        replace(v, frames=tuple(replace(f, T_world_camera=G @ f.T_world_camera) for f in v.frames))
        for v in scene.visits
    )
    moved = replace(scene, visits=visits, up_world=G[:3, :3] @ scene.up_world)
    here, there = estimate_of(scene, method), estimate_of(moved, method)
    np.testing.assert_array_equal(there.object_id, here.object_id)
    np.testing.assert_array_equal(there.best_class, here.best_class)
    np.testing.assert_allclose(there.existence, here.existence, atol=1e-4)
    np.testing.assert_allclose(there.class_probability, here.class_probability, atol=1e-4)
    np.testing.assert_allclose(there.T_world_camera, G @ here.T_world_camera, atol=1e-6)
    known = here.best_mode >= 0
    np.testing.assert_array_equal(there.best_mode >= 0, known)
    np.testing.assert_allclose(there.pose[known], G @ here.pose[known], atol=1e-5)


def doubled(run: Run) -> Run:
    """Every frame twice, a millisecond apart."""
    frames = []
    for frame in run.frames:
        for later_ns in (0, 1_000_000):
            frames.append(replace(frame, index=len(frames), time_ns=frame.time_ns + later_ns))
    return run_of(run.catalogue, frames, run.localisation)


@each_estimator
def test_more_keyframes_of_the_same_change_no_posterior(scene, method):
    """Law 3 of the model: redundant frames at twice the rate."""
    config = replace(CONFIG, frontend=replace(CONFIG.frontend, start_after=1, fresh_poses=400, refined_poses=24))
    once, twice = estimate_of(scene, method, config), estimate_of(doubled(scene), method, config)
    assert len(twice.object_id) == len(once.object_id)
    last = (slice(None), -1)
    np.testing.assert_array_equal(twice.best_class[last], once.best_class[last])
    np.testing.assert_allclose(twice.class_probability[last], once.class_probability[last], atol=0.02)
    np.testing.assert_allclose(twice.existence[last], once.existence[last], atol=0.02)
    np.testing.assert_allclose(twice.pose[last][:, :3, 3], once.pose[last][:, :3, 3], atol=0.002)
