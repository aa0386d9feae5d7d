import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.errors import InputError
from sequences.rendering.scene import render_scene
from sequences.simulation import DetectorConfig, LocalisationConfig, MotionConfig, SensorConfig, simulate_place
from sequences.simulation.motion import arrange
from sequences.simulation.place import furnish
from sequences.types import LocalisationNoise
from sequences.validation import inspect_run


def contents(run: Path) -> dict[str, bytes]:
    return {str(p.relative_to(run)): p.read_bytes() for p in sorted(run.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def exact(tiny):
    """Without any noise."""
    return replace(
        tiny,
        sensor=replace(tiny.sensor, depth_noise=0.0, colour_sigma=0.0),
        localisation=LocalisationConfig(rotation_rad=0.0, translation_m=0.0),
        detector=DetectorConfig(noise=0.0),
    )


def test_one_seed_gives_the_same_bytes_and_another_others(tiny, simulated, tmp_path):
    simulate_place(tmp_path / "again", tiny, 3)
    assert contents(simulated(tiny, 3)) == contents(tmp_path / "again")
    other = contents(simulated(tiny, 4))
    assert set(other) >= {"ctmap.json", "test/000001/scene_gt.json", "test/000002/depth/000006.png"}
    for name in ("test/000001/scene_gt.json", "test/000001/depth/000001.png", "test/000001/scene_detections.json"):
        assert other[name] != contents(simulated(tiny, 3))[name]


def test_the_run_is_whole(tiny, simulated):
    inspection = inspect_run(simulated(tiny, 3))
    assert inspection.problems == ()
    run = load_run(simulated(tiny, 3))
    assert run.notes == ()
    assert [len(v.frames) for v in run.visits] == [6, 6]
    assert run.visits[1].frames[0].time_ns - run.visits[0].frames[-1].time_ns == 4 * 3600 * 10**9
    np.testing.assert_array_equal(run.up_world, [0.0, 0.0, 1.0])
    assert run.localisation == LocalisationNoise(0.003, 0.005, 10.0)
    assert (run.frames[0].camera.width, run.frames[0].camera.height) == (320, 240)
    assert len(run.catalogue) == 3 + 1 + len(furnish(tiny.place, 3).furniture)
    for frame in run.frames:
        assert 0.6 < (frame.read_depth() > 0).mean() < 1.0
        assert frame.read_colour().std() > 20
    assert sum(len(f.detections) for f in run.frames) > 12


def test_the_truth_knows_everything_in_every_frame(tiny, simulated):
    run = load_run(simulated(tiny, 3))
    truth = load_truth(run)
    assert truth is not None
    place = furnish(tiny.place, 3)
    furniture = {piece.inst_id for piece in place.furniture}
    assert [o.inst_id for o in truth.objects] == list(range(1, 5 + len(furniture)))
    for o in truth.objects:
        np.testing.assert_array_equal(o.frames, np.arange(12))
        assert ((o.visible_fraction >= 0) & (o.visible_fraction <= 1)).all()
        assert (set(o.support.tolist()) == {-1}) if o.inst_id in furniture else (set(o.support.tolist()) <= furniture)
        changes = [m.time_ns for m in truth.moves if m.inst_id == o.inst_id]
        for a, b in pairwise(range(12)):
            still = not any(run.frames[a].time_ns < time < run.frames[b].time_ns for time in changes)
            assert np.allclose(o.T_world_object[a], o.T_world_object[b], atol=1e-6) == still
    assert any((o.visible_fraction == 0).any() and (o.visible_fraction > 0.9).any() for o in truth.objects)


def test_the_moves_are_those_of_the_simulator(tiny, simulated):
    visits = arrange(furnish(tiny.place, 3), tiny, 3)
    truth = load_truth(load_run(simulated(tiny, 3)))
    assert truth is not None
    assert [m.kind for m in truth.moves] == ["nudged", "moved", "nudged"]
    assert truth.moves == tuple(move for visit in visits for move in visit.moves)


def test_furniture_that_nobody_modelled_supports_nothing_by_name(tiny, tmp_path):
    place = replace(tiny.place, known_furniture=False)
    config = replace(tiny, place=place, sensor=SensorConfig(width=80, antialias=1))
    simulate_place(tmp_path / "run", config, 3)
    run = load_run(tmp_path / "run")
    truth = load_truth(run)
    assert truth is not None
    assert [o.inst_id for o in truth.objects] == [1, 2, 3, 4]
    assert all((o.support == -1).all() for o in truth.objects)
    assert {(m.from_support, m.to_support) for m in truth.moves} == {(None, None)}
    assert all(c.movable for c in run.catalogue.classes)


def test_what_looks_like_nothing_in_the_catalogue_is_never_detected(exact, tmp_path):
    """A table under its cloth is there and in view, but the detector misses it; what is not covered, it finds."""
    place = replace(exact.place, kind="kitchen", objects=2, twins=0, clutter=0, cloth=1.0)
    config = replace(exact, place=place, motion=MotionConfig(visits=1, moves=0), sensor=SensorConfig(width=160))
    simulate_place(tmp_path / "run", config, 1)
    run = load_run(tmp_path / "run")
    truth = load_truth(run)
    assert truth is not None
    found = {run.catalogue.obj_ids[int(np.argmax(d.class_scores[1:]))] for f in run.frames for d in f.detections}
    (table,) = (o for o in truth.objects if run.catalogue[o.obj_id].name == "table")
    assert table.visible_fraction.max() > 0.3
    assert table.obj_id not in found
    assert any(run.catalogue[obj_id].movable for obj_id in found)


def test_exact_depth_is_what_the_true_poses_render(exact, simulated):
    run = load_run(simulated(exact, 5))
    truth = load_truth(run)
    assert truth is not None
    covered = agreeing = 0
    for frame in run.frames:
        T_camera_world = se3.inverse(truth.T_world_camera[frame.index])
        np.testing.assert_allclose(frame.T_world_camera, truth.T_world_camera[frame.index], atol=1e-9)
        items = [(run.catalogue[o.obj_id].mesh, T_camera_world @ o.T_world_object[frame.index]) for o in truth.objects]
        rendered = render_scene(items, frame.camera).depth
        seen, there = frame.read_depth(), rendered > 0
        # the room may stand in front of a thing, never behind it; depth on disk comes in steps of 0.1 mm
        assert (seen[there] < rendered[there] + 1e-4).all()
        covered += there.sum()
        agreeing += (np.abs(seen - rendered)[there] < 1e-4).sum()
    assert covered > 50_000
    assert 0.9 < agreeing / covered < 1.0  # clutter stands before some of it


def test_exact_detections_are_the_boxes_of_visible_pixels(exact, simulated):
    run = load_run(simulated(exact, 5))
    truth = load_truth(run)
    assert truth is not None
    checked = 0
    for frame in run.frames:
        T_camera_world = se3.inverse(truth.T_world_camera[frame.index])
        for o in truth.objects:
            if o.visible_fraction[frame.index] < 0.999 or not run.catalogue[o.obj_id].movable:
                continue
            item = (run.catalogue[o.obj_id].mesh, T_camera_world @ o.T_world_object[frame.index])
            rows, columns = np.nonzero(render_scene([item], frame.camera).item >= 0)
            box = (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)
            alike = [d for d in frame.detections if run.catalogue.obj_ids[np.argmax(d.class_scores[1:])] == o.obj_id]
            # a pixel at the rim may go to what lies behind
            assert min(np.abs(np.subtract(d.box, box)).max() for d in alike) < 1.01
            checked += 1
    assert checked > 10


def test_noise_moves_depth_and_poses_by_what_it_should(tiny, exact, simulated):
    noisy, clean = load_run(simulated(tiny, 5)), load_run(simulated(exact, 5))
    errors = []
    for a, b in zip(noisy.frames, clean.frames, strict=True):
        measured, true = a.read_depth().astype(float), b.read_depth().astype(float)
        both = (measured > 0) & (true > 0.5) & (true < 1.5)
        errors.append((measured - true)[both] / true[both] ** 2)
    spread = np.diff(np.quantile(np.concatenate(errors), [0.16, 0.84]))[0] / 2
    assert 0.0015 < spread < 0.006  # metres at one metre
    truth = load_truth(noisy)
    assert truth is not None
    error = se3.local(truth.T_world_camera, np.stack([f.T_world_camera for f in noisy.frames]))
    assert 0.0003 < np.abs(error[:, :3]).mean() < 0.01
    assert 0.0005 < np.abs(error[:, 3:]).mean() < 0.02


def test_what_happens_to_one_thing_does_not_depend_on_later_visits(tiny, simulated, tmp_path):
    once = replace(tiny, motion=replace(tiny.motion, visits=1))
    simulate_place(tmp_path / "once", once, 3)
    both, alone = contents(simulated(tiny, 3)), contents(tmp_path / "once")
    for name, data in alone.items():
        assert name == "ctmap.json" or both[name] == data


def test_progress_is_told_of_every_frame(tiny, tmp_path):
    from contextlib import contextmanager

    told = []

    class Listener:
        @contextmanager
        def stage(self, name, total=None):
            told.append((name, total))
            yield self

        def advance(self, n=1):
            told.append(n)

    config = replace(tiny, sensor=SensorConfig(width=80, antialias=1))
    simulate_place(tmp_path / "run", config, 0, Listener())
    assert told[0] == ("simulate", 12)
    assert sum(told[1:]) == 12


def test_a_folder_that_holds_something_else_is_left_alone(tiny, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("precious")
    with pytest.raises(InputError):
        simulate_place(tmp_path / "mine", tiny, 0)
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "precious"


def test_a_simulated_run_may_be_replaced(tiny, tmp_path):
    config = replace(tiny, sensor=SensorConfig(width=80, antialias=1), motion=MotionConfig(visits=1))
    simulate_place(tmp_path / "run", config, 0)
    simulate_place(tmp_path / "run", config, 1)
    assert json.loads((tmp_path / "run" / "ctmap.json").read_text())["source"] == "simulation"
