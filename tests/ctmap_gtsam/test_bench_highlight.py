import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from ctmap_gtsam.bench import highlight
from ctmap_gtsam.bench.highlight import Played, figures
from ctmap_gtsam.bench.highlight.answers import Case
from ctmap_gtsam.bench.highlight.plots import label_place
from ctmap_gtsam.bench.highlight.stories import FOUND_SHARE, STAGED, STORIES, Staging, stage
from ctmap_gtsam.cli.app import app
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation import truth_estimate
from sequences.bop import load_run
from sequences.simulation import simulate_place
from sequences.truth import load_truth
from sequences.types import Run
from tests.sequences.simulation.conftest import TINY

SMALL = replace(
    TINY,
    sensor=replace(TINY.sensor, width=160),
    trajectory=replace(TINY.trajectory, frames=6, period_s=0.5),
    detector=replace(TINY.detector, noise=0.4),  # it seldom misses a thing in all of so few images
)
SEEDS = {"bowl": 3, "shampoo": 7, "table": 0}  # their places are soon found
HELD = ("bowl", "table")  # one of each kind of error is held to what the simulator says


@pytest.fixture(scope="module")
def stagings() -> dict[str, Staging]:
    return {story.name: stage(story, SMALL, SEEDS[story.name]) for story in STORIES}


@pytest.fixture(scope="module")
def runs(stagings, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("stories")
    for name, staging in stagings.items():
        staging.write(folder / name)
    return {name: folder / name for name in stagings}


@pytest.fixture(scope="module")
def plain(stagings, tmp_path_factory) -> dict[str, Path]:
    """The same places before anything is set."""
    folder = tmp_path_factory.mktemp("plain")
    for name in HELD:
        staging = stagings[name]
        simulate_place(folder / name, staging.simulation, staging.seed, shapes=staging.story.shapes)
    return {name: folder / name for name in HELD}


@pytest.fixture(scope="module")
def played(stagings, runs) -> list[Played]:
    """The stories as a method that knows the truth would tell them, and one that knows nothing."""
    out = []
    for name, staging in stagings.items():
        run = load_run(runs[name])
        truth = load_truth(run)
        assert truth is not None
        case = Case(run, truth, staging.inst_id, staging.story.called)
        best = truth_estimate(run, truth)
        answers = {
            "detector": case.detector(),
            "filter-t": case.estimate("filter-t", without(best, best.object_id)),
            "filter-ct": case.estimate("filter-ct", best),
        }
        out.append(Played(staging, case, answers))
    return out


def without(estimate: Estimate, names) -> Estimate:
    """The same with some objects not there."""
    gone = np.isin(estimate.object_id, names)
    return replace(estimate, existence=np.where(gone[:, None], 0.0, estimate.existence))


def files(folder) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def said(folder) -> list[dict]:
    (file,) = folder.rglob("scene_detections.json")
    return json.loads(file.read_text())


def boxes_of(inst_id: int, run: Run) -> dict[int, np.ndarray]:
    """Image -> the true box of a thing."""
    truth = load_truth(run)
    assert truth is not None
    (thing,) = (t for t in truth.objects if t.inst_id == inst_id)
    return {run.frames[f].im_id: box for f, box in zip(thing.frames, thing.visible_box, strict=True)}


def overlaps(a, b) -> bool:
    return all(a[k] < b[k] + b[k + 2] and b[k] < a[k] + a[k + 2] for k in (0, 1))


@pytest.mark.parametrize("name", HELD)
def test_nothing_is_set_but_what_the_detector_says_of_one_thing(runs, plain, stagings, name):
    """All other files are the simulator's to the byte, and so is each detection of another thing."""
    staged, before = files(runs[name]), files(plain[name])
    assert staged.keys() == before.keys()
    assert [f for f in staged if staged[f] != before[f]] == [f for f in staged if f.endswith("scene_detections.json")]
    kept = [json.dumps(d) for d in said(runs[name]) if d["source"] != STAGED]
    simulated = [json.dumps(d) for d in said(plain[name])]
    assert kept == [d for d in simulated if d in kept]  # in their order
    boxes = boxes_of(stagings[name].inst_id, load_run(plain[name]))
    removed = [json.loads(d) for d in simulated if d not in kept]
    assert all(overlaps(d["bbox"], boxes[d["image_id"]]) for d in removed)
    assert len(kept) > 10


def test_what_is_taken_for_something_is_so_in_all_images_and_as_surely(runs, plain):
    run = load_run(runs["bowl"])
    before = {(d["image_id"], tuple(d["bbox"])): d["class_scores"] for d in said(plain["bowl"])}
    staged = [d for d in said(runs["bowl"]) if d["source"] == STAGED]
    assert len({d["image_id"] for d in staged}) >= 2
    assert len(said(runs["bowl"])) == len(before)
    for d in staged:
        assert run.catalogue[d["category_id"]].name == "loofah"
        assert sorted(d["class_scores"]) == sorted(before[d["image_id"], tuple(d["bbox"])])


def test_what_is_missed_is_found_in_the_first_few_images(played):
    (table,) = (one for one in played if one.story.called is None)
    staged = [d["image_id"] for d in said(table.run.path) if d["source"] == STAGED]
    shows, right = table.case.frames
    assert 0 < right <= len(set(staged)) <= FOUND_SHARE * len(table.run.frames) + 0.5 < shows
    assert table.frame.im_id > max(staged)
    assert table.answers["detector"].word.name is None


def test_one_seed_one_staging(stagings, runs, tmp_path):
    again = stage(STORIES[0], SMALL, SEEDS[STORIES[0].name])
    assert again == stagings[STORIES[0].name]
    again.write(tmp_path / "again")
    assert files(tmp_path / "again") == files(runs[STORIES[0].name])
    assert stage(STORIES[0], SMALL, 6).seed != again.seed


def test_the_story_keeps_the_settings_that_it_doesn_t_need():
    for story in STORIES:
        simulation = story.settings(SMALL)
        assert (simulation.sensor, simulation.detector) == (SMALL.sensor, SMALL.detector)
        assert simulation.localisation == SMALL.localisation


def test_the_truth_is_right_and_nothing_is_missed(played):
    for one in played:
        found = figures(one)
        name = one.story.name
        assert found[f"{name}.filter-ct.class"] == found[f"{name}.true_class"] == one.story.thing
        assert found[f"{name}.filter-ct.probability"] == pytest.approx(1.0)
        for error in ("position_mm", "rotation_deg", "mssd_mm"):
            assert found[f"{name}.filter-ct.{error}"] == pytest.approx(0.0, abs=1e-2)
        assert found[f"{name}.filter-ct.iou"] > 0.8
        assert found[f"{name}.filter-t.class"] is None
        assert found[f"{name}.filter-t.probability"] == 0.0
        assert found[f"{name}.detector.class"] == one.story.called
        assert found[f"{name}.detector_right_in"] < 0.5 * found[f"{name}.images_with_it"]
        boxes = one.answers["filter-ct"].boxes  # clutter hides what the map doesn't know to be hidden
        assert [box.right for box in boxes if box.subject] == [True]
        assert sum(box.right for box in boxes) > 0.7 * len(boxes)
        assert any(missed.subject for missed in one.answers["filter-t"].missed)
        assert not one.answers["filter-t"].boxes


def test_labels_keep_out_of_each_other_s_way():
    window, taken = (0.0, 0.0, 400.0, 300.0), []
    for _ in range(6):
        taken.append(label_place((180.0, 140.0, 40.0, 30.0), (60.0, 12.0), window, taken))
    for k, (x, y, width, height) in enumerate(taken):
        assert 0.0 <= x <= 400.0 - width
        assert 0.0 <= y <= 300.0 - height
        assert not any(overlaps((x, y, width, height), other) for other in taken[:k])


def test_the_command_writes_figure_and_json(monkeypatch, tmp_path, played):
    """Without the estimators, which take minutes."""
    by_name = {one.story.name: one for one in played}
    monkeypatch.setattr(highlight, "play", lambda story, *_: by_name[story.name])
    options = ["--out", str(tmp_path / "figure"), "--json", str(tmp_path / "h.json"), "--seed", "0"]
    done = CliRunner().invoke(app, ["bench", "highlight", *options])
    assert done.exit_code == 0, done.output
    assert [p.name for p in (tmp_path / "figure").iterdir()] == ["highlight.png"]
    with Image.open(tmp_path / "figure" / "highlight.png") as image:
        assert image.width > image.height > 900
    result = json.loads((tmp_path / "h.json").read_text())
    assert (result["schema"], result["name"]) == (1, "highlight")
    words = {"class", "probability", "probability_of_truth", "iou", "position_mm", "rotation_deg", "mssd_mm"}
    for story in STORIES:
        assert result["figures"][f"{story.name}.true_class"] == story.thing
        for method in ("detector", "filter-t", "filter-ct"):
            for word in words:
                assert f"{story.name}.{method}.{word}" in result["figures"]


def test_a_setting_reaches_the_places():
    config = replace(Config(), simulation=SMALL)
    assert STORIES[0].settings(config.simulation).trajectory.frames == 6
