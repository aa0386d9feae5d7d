"""Each way to break a run: loading refuses it, inspecting lists it, both with file, field and remedy."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sequences.bop import load_run
from sequences.errors import InputError
from sequences.validation import inspect_run
from tests.tiny import edit, make_plain, write_tiny_run

SCENE = "test/000001"
CAMERAS = f"{SCENE}/scene_camera.json"
DETECTIONS = f"{SCENE}/scene_detections.json"


@dataclass(frozen=True)
class Breakage:
    """One thing done to a run, and what must be said about it."""

    name: str
    do: Callable[[Path], Any]
    file: str
    field: str
    message: str


def change(file: str, how: Callable[[Any], Any]) -> Callable[[Path], None]:
    return lambda run: edit(run / file, how)


def put(*keys: Any, value: Any) -> Callable[[Any], None]:
    """Set a value deep in a JSON file."""

    def how(root: Any) -> None:
        for key in keys[:-1]:
            root = root[key]
        root[keys[-1]] = value

    return how


def drop(*keys: Any) -> Callable[[Any], None]:
    def how(root: Any) -> None:
        for key in keys[:-1]:
            root = root[key]
        del root[keys[-1]]

    return how


def remove(file: str) -> Callable[[Path], None]:
    return lambda run: (run / file).unlink()


def overwrite(file: str, text: str) -> Callable[[Path], None]:
    return lambda run: (run / file).write_text(text)


def image(file: str, pixels: np.ndarray) -> Callable[[Path], None]:
    return lambda run: Image.fromarray(pixels).save(run / file)


def truncate(file: str) -> Callable[[Path], None]:
    return lambda run: (run / file).write_bytes((run / file).read_bytes()[:20])


REFLECTION = [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
SHEAR = [1.0, 0.2, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
SCALED_MOTION = (2.0 * np.eye(4)).ravel().tolist()

BREAKAGES = [
    # images
    Breakage(
        "missing depth file", remove(f"{SCENE}/depth/000002.png"), f"{SCENE}/depth/000002.png", "2", "no depth image"
    ),
    Breakage("missing colour file", remove(f"{SCENE}/rgb/000002.png"), CAMERAS, "2", "no colour image"),
    Breakage(
        "depth of another size",
        image(f"{SCENE}/depth/000002.png", np.ones((24, 30), np.uint16)),
        f"{SCENE}/depth/000002.png",
        "size",
        "is 30 x 24 pixels, camera.json says 32 x 24",
    ),
    Breakage(
        "colour of another size",
        image(f"{SCENE}/rgb/000002.png", np.ones((20, 32, 3), np.uint8)),
        f"{SCENE}/rgb/000002.png",
        "size",
        "is 32 x 20 pixels",
    ),
    Breakage(
        "8-bit depth",
        image(f"{SCENE}/depth/000002.png", np.ones((24, 32), np.uint8)),
        f"{SCENE}/depth/000002.png",
        "pixel type",
        "expected 16 bits",
    ),
    Breakage(
        "depth cut in its header",
        truncate(f"{SCENE}/depth/000002.png"),
        f"{SCENE}/depth/000002.png",
        "pixels",
        "truncated",
    ),
    # cameras, poses, times
    Breakage("no camera.json", remove("camera.json"), "camera.json", "(whole file)", "missing"),
    Breakage(
        "zero focal length", change(CAMERAS, put("2", "cam_K", 0, value=0.0)), CAMERAS, "2.cam_K", "focal length 0"
    ),
    Breakage(
        "negative focal length", change(CAMERAS, put("2", "cam_K", 4, value=-5)), CAMERAS, "2.cam_K", "focal length -5"
    ),
    Breakage(
        "zero focal length of all", change("camera.json", put("fx", value=0)), "camera.json", "fx", "not above zero"
    ),
    Breakage("skew", change(CAMERAS, put("2", "cam_K", 1, value=3.0)), CAMERAS, "2.cam_K", "not fx 0 cx"),
    Breakage(
        "short K", change(CAMERAS, put("2", "cam_K", value=[1, 0, 0])), CAMERAS, "2.cam_K", "has 3 numbers, expected 9"
    ),
    Breakage(
        "zero depth scale", change(CAMERAS, put("3", "depth_scale", value=0)), CAMERAS, "3.depth_scale", "above zero"
    ),
    Breakage(
        "reflection", change(CAMERAS, put("2", "cam_R_w2c", value=REFLECTION)), CAMERAS, "2.cam_R_w2c", "not a rotation"
    ),
    Breakage("shear", change(CAMERAS, put("2", "cam_R_w2c", value=SHEAR)), CAMERAS, "2.cam_R_w2c", "not a rotation"),
    Breakage("short R", change(CAMERAS, put("2", "cam_R_w2c", value=[1.0])), CAMERAS, "2.cam_R_w2c", "expected 9"),
    Breakage("half a pose", change(CAMERAS, drop("2", "cam_t_w2c")), CAMERAS, "2.cam_t_w2c", "missing"),
    Breakage(
        "NaN in t",
        change(CAMERAS, put("2", "cam_t_w2c", value=[0, float("nan"), 0])),
        CAMERAS,
        "2.cam_t_w2c",
        "numeric",
    ),
    Breakage(
        "time backwards",
        change(CAMERAS, put("2", "timestamp_ns", value=-1)),
        CAMERAS,
        "2.timestamp_ns",
        "runs backwards",
    ),
    Breakage(
        "time stands",
        change(CAMERAS, put("2", "timestamp_ns", value=0)),
        CAMERAS,
        "2.timestamp_ns",
        "not after image 1",
    ),
    Breakage(
        "time in seconds",
        change(CAMERAS, put("2", "timestamp_ns", value=1.5)),
        CAMERAS,
        "2.timestamp_ns",
        "whole number",
    ),
    Breakage("time missing", change(CAMERAS, drop("2", "timestamp_ns")), CAMERAS, "2", "no timestamp_ns"),
    Breakage(
        "visits overlap",
        change("test/000002/scene_camera.json", put("1", "timestamp_ns", value=1_500_000_000)),
        "test/000002/scene_camera.json",
        "1.timestamp_ns",
        "visit 2 starts before visit 1 ends",
    ),
    Breakage("empty scene", overwrite(CAMERAS, "{}"), CAMERAS, "(whole file)", "no frames"),
    Breakage("no scene_camera.json", remove(CAMERAS), CAMERAS, "(whole file)", "missing"),
    Breakage("broken JSON", overwrite(CAMERAS, '{"1": {'), CAMERAS, "line 1, column 8", "not valid JSON"),
    Breakage("a list for an object", overwrite(CAMERAS, "[1, 2]"), CAMERAS, "(whole file)", "not an object"),
    Breakage("a key that is no number", change(CAMERAS, put("two", value={})), CAMERAS, "two", "not an image number"),
    # detections
    Breakage(
        "short score vector",
        change(DETECTIONS, lambda d: d[3]["class_scores"].pop()),
        DETECTIONS,
        "[3].class_scores",
        "has 3 numbers, expected 4",
    ),
    Breakage(
        "unknown obj_id",
        change(DETECTIONS, put(3, "category_id", value=99)),
        DETECTIONS,
        "[3].category_id",
        "obj_id 99",
    ),
    Breakage("unknown image", change(DETECTIONS, put(3, "image_id", value=99)), DETECTIONS, "[3].image_id", "image 99"),
    Breakage(
        "another scene",
        change(DETECTIONS, put(3, "scene_id", value=2)),
        DETECTIONS,
        "[3].scene_id",
        "scene 2 in scene 1",
    ),
    Breakage("empty box", change(DETECTIONS, put(3, "bbox", 2, value=0)), DETECTIONS, "[3].bbox", "no area"),
    Breakage("short box", change(DETECTIONS, put(3, "bbox", value=[1, 2, 3])), DETECTIONS, "[3].bbox", "expected 4"),
    Breakage(
        "negative score",
        change(DETECTIONS, put(3, "class_scores", value=[0.5, 0.6, -0.1, 0])),
        DETECTIONS,
        "[3].class_scores",
        "below zero",
    ),
    Breakage(
        "words for scores",
        change(DETECTIONS, put(3, "class_scores", value=["0.5", 0.1, 0.1, 0.3])),
        DETECTIONS,
        "[3].class_scores",
        "not numeric",
    ),
    Breakage(
        "detections cut off",
        overwrite(DETECTIONS, '[{"image_id": 1'),
        DETECTIONS,
        "line 1, column 16",
        "not valid JSON",
    ),
    # models
    Breakage(
        "no models", lambda run: shutil.rmtree(run / "models"), "models/models_info.json", "(whole file)", "missing"
    ),
    Breakage("missing mesh", remove("models/obj_000005.ply"), "models/obj_000005.ply", "(whole file)", "missing"),
    Breakage("not a mesh", overwrite("models/obj_000005.ply", "hello"), "models/obj_000005.ply", "header", "not a PLY"),
    Breakage(
        "no diameter",
        change("models/models_info.json", drop("5", "diameter")),
        "models/models_info.json",
        "5.diameter",
        "missing",
    ),
    Breakage(
        "symmetry that isn't rigid",
        change("models/models_info.json", put("1", "symmetries_discrete", 1, value=SCALED_MOTION)),
        "models/models_info.json",
        "1.symmetries_discrete[1]",
        "last row",
    ),
    Breakage(
        "axis without direction",
        change("models/models_info.json", put("5", "symmetries_continuous", 0, "axis", value=[0, 0, 0])),
        "models/models_info.json",
        "5.symmetries_continuous[0].axis",
        "no direction",
    ),
    Breakage(
        "persistence of nothing",
        change("catalogue.json", put("5", "persistence_s", value=0)),
        "catalogue.json",
        "5.persistence_s",
        "not above zero",
    ),
    Breakage(
        "supports in words",
        change("catalogue.json", put("5", "supports", value="yes")),
        "catalogue.json",
        "5.supports",
        "not true or false",
    ),
    # ctmap.json
    Breakage("another schema", change("ctmap.json", put("schema", value=2)), "ctmap.json", "schema", "schema 2"),
    Breakage(
        "another order of scores",
        change("ctmap.json", put("score_order", value=["background", 5, 1, 12])),
        "ctmap.json",
        "score_order",
        "not the background and then",
    ),
    Breakage(
        "a visit without its scene",
        change("ctmap.json", lambda c: c["visits"].append({"scene_id": 9, "T_world_visit": None})),
        "ctmap.json",
        "visits",
        "lists scene 9",
    ),
    Breakage(
        "a visit twice",
        change("ctmap.json", lambda c: c["visits"].append(c["visits"][0])),
        "ctmap.json",
        "visits[2].scene_id",
        "listed twice",
    ),
    Breakage("no visits", change("ctmap.json", put("visits", value=[])), "ctmap.json", "visits", "no visit"),
    Breakage(
        "a visit's pose that isn't rigid",
        change("ctmap.json", put("visits", 1, "T_world_visit", value=SCALED_MOTION)),
        "ctmap.json",
        "visits[1].T_world_visit",
        "last row",
    ),
    Breakage(
        "up without direction",
        change("ctmap.json", put("up_world", value=[0, 0, 0])),
        "ctmap.json",
        "up_world",
        "direction",
    ),
    Breakage(
        "negative noise",
        change("ctmap.json", put("localisation", "rotation_rad", value=-1)),
        "ctmap.json",
        "localisation.rotation_rad",
        "below zero",
    ),
]


@pytest.mark.parametrize("breakage", BREAKAGES, ids=lambda b: b.name)
def test_what_is_broken_is_named(tiny_run, breakage):
    breakage.do(tiny_run)
    with pytest.raises(InputError) as caught:
        load_run(tiny_run)
    assert caught.value.file == tiny_run / breakage.file
    assert caught.value.field == breakage.field
    assert breakage.message in caught.value.message
    assert caught.value.remedy
    problems = inspect_run(tiny_run).errors
    first = (caught.value.file, caught.value.field, caught.value.message, caught.value.remedy)
    assert first in [(p.file, p.field, p.message, p.remedy) for p in problems]


def test_all_problems_are_listed_at_once_and_nothing_that_follows_from_them(tiny_run):
    (tiny_run / SCENE / "depth" / "000002.png").unlink()
    edit(tiny_run / CAMERAS, put("3", "cam_R_w2c", value=REFLECTION))
    for file, how in (
        (DETECTIONS, put(3, "class_scores", value=[1.0])),
        (DETECTIONS, put(4, "image_id", value=99)),
        ("ctmap.json", put("localisation", "rotation_rad", value=-1)),
        ("ctmap.json", put("up_world", value=[0, 0, 0])),
    ):
        edit(tiny_run / file, how)
    (tiny_run / "models" / "obj_000005.ply").unlink()
    found = {(p.file.relative_to(tiny_run).as_posix(), p.field) for p in inspect_run(tiny_run).problems}
    assert found == {
        (f"{SCENE}/depth/000002.png", "2"),
        (CAMERAS, "3.cam_R_w2c"),
        (DETECTIONS, "[3].class_scores"),
        (DETECTIONS, "[4].image_id"),
        ("ctmap.json", "localisation.rotation_rad"),
        ("ctmap.json", "up_world"),
        ("models/obj_000005.ply", "(whole file)"),
    }


def test_each_broken_frame_is_listed(tiny_run):
    edit(tiny_run / CAMERAS, put("1", "cam_K", 0, value=0))
    edit(tiny_run / CAMERAS, put("3", "cam_K", 0, value=0))
    edit(tiny_run / DETECTIONS, put(0, "category_id", value=99))
    edit(tiny_run / DETECTIONS, put(5, "bbox", value=[]))
    inspection = inspect_run(tiny_run)
    assert [p.field for p in inspection.errors] == ["[0].category_id", "[5].bbox", "1.cam_K", "3.cam_K"]
    assert inspection.facts.frames == 4


def test_pixels_are_judged_when_inspecting(tiny_run):
    path = tiny_run / SCENE / "depth" / "000002.png"
    path.write_bytes(path.read_bytes()[:-30])
    load_run(tiny_run)
    (problem,) = inspect_run(tiny_run).problems
    assert (problem.file, problem.field, problem.severity) == (path, "pixels", "error")
    assert problem.remedy


def test_the_truth_is_judged_when_inspecting(tiny_run):
    edit(tiny_run / SCENE / "scene_gt.json", put("2", 0, "obj_id", value=77))
    edit(tiny_run / "test/000002/scene_gt.json", put("3", 1, "cam_t_m2c", value=[1]))
    assert [p.field for p in inspect_run(tiny_run).errors] == ["2[0].obj_id", "3[1].cam_t_m2c"]


@pytest.mark.parametrize(
    ("do", "file", "field", "message"),
    [
        (
            change("models/models_info.json", put("5", "diameter", value=0.15)),
            "models/models_info.json",
            "5.diameter",
            "mesh",
        ),
        (
            image(f"{SCENE}/depth/000002.png", np.zeros((24, 32), np.uint16)),
            f"{SCENE}/depth/000002.png",
            "pixels",
            "no pixel",
        ),
        (change(CAMERAS, put("2", "depth_scale", value=1000)), CAMERAS, "2.depth_scale", "median depth"),
        (change(CAMERAS, drop("3")), CAMERAS, "3", "not listed"),
    ],
)
def test_oddities_are_warnings(tiny_run, do, file, field, message):
    for scene in ("000001", "000002"):
        (tiny_run / "test" / scene / "scene_detections.json").unlink()
    do(tiny_run)
    load_run(tiny_run)
    (problem,) = inspect_run(tiny_run).problems
    assert (problem.file, problem.field, problem.severity) == (tiny_run / file, field, "warning")
    assert message in problem.message


# --- what is no run at all ---


def test_a_folder_that_is_not_there(tmp_path):
    inspection = inspect_run(tmp_path / "nowhere")
    assert inspection.facts is None
    assert [(p.file, p.message) for p in inspection.problems] == [(tmp_path / "nowhere", "no such folder")]


@pytest.mark.parametrize("deeper", [SCENE, "test"])
def test_a_folder_inside_the_run(tiny_run, deeper):
    with pytest.raises(InputError, match=r"models/ and test/|NNNNNN"):
        load_run(tiny_run / deeper)


def test_an_empty_folder(tmp_path):
    with pytest.raises(InputError, match=r"holds no scene.*test/NNNNNN"):
        load_run(tmp_path)


def test_a_tum_recording_is_recognised(data):
    inspection = inspect_run(data / "tum_cabinet")
    (problem,) = inspection.problems
    assert "TUM RGB-D layout, not a BOP dataset" in problem.message
    assert "docs/run-layout.md" in problem.remedy


# --- what is there ---


def test_facts_of_a_run(tiny_run_once):
    inspection = inspect_run(tiny_run_once)
    facts = inspection.facts
    assert inspection.problems == ()
    assert (facts.name, facts.frames, facts.detections_per_frame) == ("run", 6, 2.0)
    assert facts.duration_s == pytest.approx(1002.0)
    assert [(v.scene_id, v.frames, v.duration_s, v.width, v.height, v.detections) for v in facts.visits] == [
        (1, 3, 2.0, 32, 24, 6),
        (2, 3, 2.0, 32, 24, 6),
    ]
    assert [(c.name, c.faces, c.symmetries) for c in facts.classes] == [
        ("box", 12, "4 discrete"),
        ("can", 12, "1 continuous"),
        ("table", 12, "none"),
    ]
    assert facts.categories == ("food", "furniture", "kitchen")
    assert all(facts.files.values())
    assert [[name for name, there in visit.files.items() if not there] for visit in facts.visits] == [
        ["scene_gt_moves.json"],
        [],
    ]
    assert (facts.has_truth, facts.true_objects, facts.true_moves) == (True, 2, 1)
    assert facts.derived == ()


def test_derived_defaults_are_facts(tmp_path):
    write_tiny_run(tmp_path / "run", visits=1, truth=False)
    make_plain(tmp_path / "run")
    inspection = inspect_run(tmp_path / "run")
    assert inspection.problems == ()
    assert not inspection.facts.has_truth
    assert inspection.facts.derived == load_run(tmp_path / "run").notes
    assert len(inspection.facts.derived) == 4


def test_an_inspection_goes_to_json_and_back(tiny_run):
    edit(tiny_run / CAMERAS, put("1", "cam_K", 0, value=0))
    inspection = inspect_run(tiny_run)
    there = json.loads(json.dumps(inspection.to_json(), allow_nan=False))
    assert there["problems"][0]["field"] == "1.cam_K"
    assert there["problems"][0]["file"].endswith(CAMERAS)
    assert there["facts"]["frames"] == 5
    assert there["facts"]["fingerprint"] == inspection.facts.fingerprint


@pytest.mark.parametrize("name", ["ycb_desk", "visp_rbt"])
def test_real_recordings_have_no_problems(data, name):
    inspection = inspect_run(data / name)
    assert inspection.problems == ()
    assert inspection.facts.has_truth
