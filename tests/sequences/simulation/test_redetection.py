import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sequences import se3
from sequences.atomic import write_together
from sequences.bop import load_run, load_truth
from sequences.camera import Camera
from sequences.catalogue import Catalogue
from sequences.errors import InputError
from sequences.simulation import DetectorConfig
from sequences.simulation.redetection import simulate_detections
from sequences.writing import FrameTruth, RunWriter, Sighting
from tests.tiny import edit, tiny_catalogue

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, width=160, height=120)
PERFECT = DetectorConfig(noise=0.0)


def write_run(target: Path, source: str = "tests", occluder_m: float = 0.0, visits: int = 2) -> Path:
    """Two visits of three frames of a box 1 m away, before a wall; something nearer may hide the image's left half."""
    classes = Catalogue(tiny_catalogue().classes[:2])
    depth = np.full((120, 160), 1.0, np.float32)
    if occluder_m:
        depth[:, :80] = occluder_m
    with RunWriter(target, classes, source=source) as writer:
        for v in range(visits):
            visit = writer.add_visit(v + 1)
            for k in range(3):
                T = se3.make(np.eye(3), np.array([0.02 * k, 0.0, 0.0]))
                sighting = Sighting(7, 1, se3.make(np.eye(3), np.array([0.0, 0.0, 1.02])), 1.0)
                visit.add_frame(k + 1, 10**9 * (10 * v + k), CAMERA, T, depth, truth=FrameTruth(T, (sighting,)))
    return target


def contents(run: Path) -> dict[str, bytes]:
    return {str(p.relative_to(run)): p.read_bytes() for p in sorted(run.rglob("*")) if p.is_file()}


def test_only_the_detections_change_and_one_seed_gives_the_same_bytes(tmp_path):
    run = write_run(tmp_path / "run")
    before = contents(run)
    noisy = DetectorConfig(noise=1.5)
    simulate_detections(run, noisy, 4)
    after = contents(run)
    changed = {name for name in after if after[name] != before.get(name)}
    assert changed == {"test/000001/scene_detections.json", "test/000002/scene_detections.json"}
    assert after.keys() == before.keys()
    simulate_detections(run, noisy, 4)
    assert contents(run) == after
    simulate_detections(run, noisy, 5)
    assert contents(run) != after


def test_a_perfect_detector_boxes_what_the_truth_draws(tmp_path):
    run = write_run(tmp_path / "run")
    assert simulate_detections(run, PERFECT, 0) == 6
    for frame in load_run(run).frames:
        (found,) = frame.detections
        assert np.argmax(found.class_scores[1:]) == 0
        middle = 79.5 - 150.0 * frame.T_world_camera[0, 3]
        np.testing.assert_allclose(found.box, (middle - 7.5, 55.0, 15.0, 9.0), atol=1.6)


def test_what_the_recorded_depth_has_nearer_hides_things(tmp_path):
    whole, half = (write_run(tmp_path / str(near), occluder_m=near) for near in (0.0, 0.8))
    for run in (whole, half):
        simulate_detections(run, PERFECT, 0)
    a, b = (load_run(run).frames[0].detections[0].box for run in (whole, half))
    assert b[0] == 80.0
    assert a[0] + a[2] == b[0] + b[2]
    nearly = write_run(tmp_path / "noise", occluder_m=0.985)  # no nearer than noise may be
    simulate_detections(nearly, PERFECT, 0)
    assert load_run(nearly).frames[0].detections[0].box == a


def test_detections_of_others_are_kept_unless_forced(tmp_path):
    run = write_run(tmp_path / "run", source="simulation")
    simulate_detections(run, PERFECT, 0)
    file = run / "test/000002/scene_detections.json"
    edit(file, lambda entries: entries[0].update(source="rcnn"))
    before = contents(run)
    with pytest.raises(InputError, match="'rcnn'") as error:
        simulate_detections(run, PERFECT, 0)
    assert error.value.file == file
    edit(file, lambda entries: entries[0].pop("source"))
    with pytest.raises(InputError, match="doesn't say"):
        simulate_detections(run, PERFECT, 0)
    assert contents(run).keys() == before.keys()
    simulate_detections(run, PERFECT, 0, force=True)
    assert {entry["source"] for entry in json.loads(file.read_text())} == {"simulation"}


def test_without_truth_there_is_nothing_to_detect(tmp_path):
    run = write_run(tmp_path / "run")
    for file in run.rglob("scene_gt.json"):
        file.unlink()
    with pytest.raises(InputError, match="no truth"):
        simulate_detections(run, PERFECT, 0)


def test_all_files_or_none(tmp_path):
    first, second = tmp_path / "a" / "one.json", tmp_path / "b"
    first.parent.mkdir()
    first.write_text("old")
    second.write_text("a file where a folder is needed")
    with pytest.raises(OSError, match=r"exists|directory"):
        write_together({first: b"new", second / "two.json": b"new"})
    assert first.read_text() == "old"
    assert sorted(p.name for p in first.parent.iterdir()) == ["one.json"]


def test_a_simulated_runs_detections_can_be_made_again_as_they_were(tiny, simulated, tmp_path):
    """The truth's drawing sees what the simulator saw, but for clutter and the depth's noise."""
    clean = replace(tiny, detector=PERFECT, sensor=replace(tiny.sensor, depth_noise=0.0))
    run = tmp_path / "run"
    shutil.copytree(simulated(clean, 3), run)
    first = [frame.detections for frame in load_run(run).frames]
    simulate_detections(run, PERFECT, 0)
    again = [frame.detections for frame in load_run(run).frames]
    pairs = agreed = 0
    for a, b in zip(first, again, strict=True):
        pairs += max(len(a), len(b))
        agreed += sum(any(np.abs(np.subtract(d.box, e.box)).max() < 8 for e in b) for d in a)
    assert pairs > 12
    assert agreed > 0.8 * pairs


@pytest.mark.parametrize("name", ["ycb_desk", "visp_rbt"])
def test_real_recordings_with_truth_get_detections_too(data, tmp_path, name):
    run = tmp_path / name
    shutil.copytree(data / name, run)
    with pytest.raises(InputError, match="--force"):
        simulate_detections(run, PERFECT, 0)
    simulate_detections(run, PERFECT, 0, force=True)
    loaded = load_run(run)
    truth = load_truth(loaded)
    assert truth is not None
    counts = [len(frame.detections) for frame in loaded.frames]
    assert np.mean(np.array(counts) == len(truth.objects)) > 0.8
    simulate_detections(run, DetectorConfig(), 1)
