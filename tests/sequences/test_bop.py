"""A run on disk: what is written is what is read, and only what an estimator may see is seen."""

import pickle
import shutil
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sequences import se3
from sequences.bop import load_catalogue, load_run, load_truth
from sequences.camera import Camera
from sequences.catalogue import Catalogue, ContinuousSymmetry, ObjectClass
from sequences.errors import InputError
from sequences.types import Detection, LocalisationNoise, Run
from sequences.writing import FrameTruth, RunWriter, Sighting
from tests.tiny import CAMERA, NOISE, SECOND, box_mesh, edit, make_plain, tiny_catalogue, write_tiny_run

ROOT = Path(__file__).parents[2]


def motion(rng: np.random.Generator) -> np.ndarray:
    return se3.exp(rng.normal(size=6) * [1.2, 1.2, 1.2, 3, 3, 3])


def random_catalogue(rng: np.random.Generator, classes: int) -> Catalogue:
    obj_ids = np.sort(rng.choice(np.arange(1, 1000), classes, replace=False)).tolist()
    made = []
    for obj_id in obj_ids:
        mesh = box_mesh(*rng.uniform(0.01, 0.5, 3))
        axis = rng.normal(size=3)
        made.append(
            ObjectClass(
                obj_id=obj_id,
                name=f"name {obj_id}",
                category=str(rng.choice(["food", "tool"])),
                persistence_s=float(rng.uniform(1, 1e6)),
                supports=bool(rng.integers(2)),
                movable=bool(rng.integers(2)),
                mesh=mesh,
                diameter_m=float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))),
                symmetries_discrete=np.stack([np.eye(4)] + [motion(rng) for _ in range(rng.integers(3))]),
                symmetries_continuous=tuple(
                    ContinuousSymmetry(axis / np.linalg.norm(axis), rng.normal(size=3)) for _ in range(rng.integers(2))
                ),
            )
        )
    return Catalogue(tuple(made))


def assert_same(a, b, path="run"):
    """Equal to the rounding of the formats: 1e-9 for numbers, float32 for mesh vertices."""
    if isinstance(a, np.ndarray):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9, err_msg=path)
    elif isinstance(a, tuple):
        assert len(a) == len(b), path
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{path}[{k}]")
    elif hasattr(a, "__dataclass_fields__"):
        for f in fields(a):
            if f.name not in ("read_depth", "read_colour", "path", "depth_path", "colour_path", "fingerprint", "notes"):
                assert_same(getattr(a, f.name), getattr(b, f.name), f"{path}.{f.name}")
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-12), path
    else:
        assert a == b, path


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    classes=st.integers(1, 3),
    frames=st.lists(st.integers(1, 3), min_size=1, max_size=3),
    colour=st.booleans(),
    up=st.booleans(),
    depth_scale=st.sampled_from([0.1, 1.0, 0.125]),
)
def test_what_is_written_is_what_is_read(tmp_path_factory, seed, classes, frames, colour, up, depth_scale):
    rng = np.random.default_rng(seed)
    catalogue = random_catalogue(rng, classes)
    camera = Camera(*rng.uniform(20, 900, 2), *rng.uniform(0, 30, 2), width=int(rng.integers(4, 30)), height=9)
    noise = LocalisationNoise(*rng.uniform(0.01, 2.0, 3))
    up_world = None if not up else se3.uniform_rotations(rng.random(3))[0]
    target = tmp_path_factory.mktemp("place") / "run"
    expected = []
    with RunWriter(
        target, catalogue, source="test", up_world=up_world, localisation=noise, depth_scale=depth_scale
    ) as writer:
        for v, n in enumerate(frames):
            T_world_visit = motion(rng)
            visit = writer.add_visit(10 * v + 3, T_world_visit)
            for k in range(n):
                detections = [
                    Detection(tuple(rng.uniform(1, 20, 4).tolist()), rng.dirichlet(np.ones(classes + 1)))
                    for _ in range(rng.integers(3))
                ]
                sightings = tuple(
                    Sighting(100 + c, catalogue.obj_ids[c], motion(rng), float(rng.random())) for c in range(classes)
                )
                depth = rng.uniform(0.2, 5, (9, camera.width)).astype(np.float32)
                depth[rng.random(depth.shape) < 0.2] = 0
                image = rng.integers(0, 255, (9, camera.width, 3), dtype=np.uint8) if colour else None
                time_ns = 1_700_000_000_123_456_789 + (1000 * v + k) * SECOND
                pose, truth = motion(rng), FrameTruth(motion(rng), sightings)
                visit.add_frame(5 * k + 1, time_ns, camera, pose, depth, image, detections, truth)
                expected.append((10 * v + 3, 5 * k + 1, time_ns, pose, depth, image, detections, truth, T_world_visit))

    run = load_run(target)
    truth = load_truth(run)
    assert_same(run.catalogue, catalogue)
    assert_same(run.localisation, noise)
    assert (run.up_world is None) == (up_world is None)
    if up_world is not None:
        assert_same(run.up_world, up_world)
    assert [len(visit.frames) for visit in run.visits] == frames
    assert len(run.frames) == len(expected)
    assert truth is not None
    for k, (frame, wanted) in enumerate(zip(run.frames, expected, strict=True)):
        scene_id, im_id, time_ns, pose, depth, image, detections, frame_truth, T_world_visit = wanted
        assert (frame.index, frame.scene_id, frame.im_id, frame.time_ns) == (k, scene_id, im_id, time_ns)
        assert run.visits[frame.visit].scene_id == scene_id
        assert frame.camera == camera
        assert_same(run.visits[frame.visit].T_world_visit, T_world_visit)
        assert_same(frame.T_world_camera, pose)
        assert_same(frame.detections, tuple(sorted(detections, key=lambda d: d.box)))
        np.testing.assert_allclose(frame.read_depth(), depth, atol=0.5001e-3 * depth_scale)
        np.testing.assert_array_equal(frame.read_depth() == 0, depth == 0)
        np.testing.assert_array_equal(frame.read_colour(), 128 if image is None else image)
        assert_same(truth.T_world_camera[k], frame_truth.T_world_camera)
        for sighting in frame_truth.sightings:
            (one,) = [o for o in truth.objects if o.inst_id == sighting.inst_id]
            row = list(one.frames).index(k)
            assert one.obj_id == sighting.obj_id
            assert_same(one.T_world_object[row], sighting.T_world_object)
            assert one.visible_fraction[row] == sighting.visible_fraction


# --- what may be seen ---


def test_without_the_truth_everything_but_the_truth_is_the_same(tiny_run):
    before = load_run(tiny_run)
    assert load_truth(before) is not None
    for file in [*tiny_run.rglob("scene_gt*"), *tiny_run.rglob("scene_camera_gt.json")]:
        file.unlink()
    after = load_run(tiny_run)
    assert after.fingerprint == before.fingerprint
    assert after.notes == before.notes
    assert_same(after, before)
    assert load_truth(after) is None


def test_the_fingerprint_does_not_depend_on_where_the_run_is(tiny_run, tmp_path):
    shutil.copytree(tiny_run, tmp_path / "elsewhere" / "copy")
    assert load_run(tmp_path / "elsewhere" / "copy").fingerprint == load_run(tiny_run).fingerprint


@pytest.mark.parametrize(
    "name",
    [
        "camera.json",
        "catalogue.json",
        "ctmap.json",
        "models/models_info.json",
        "test/000001/scene_camera.json",
        "test/000002/scene_detections.json",
    ],
)
def test_the_fingerprint_depends_on_each_file_an_estimator_reads(tiny_run, name):
    before = load_run(tiny_run).fingerprint
    (tiny_run / name).write_text((tiny_run / name).read_text() + "\n")
    assert load_run(tiny_run).fingerprint != before


@pytest.mark.parametrize("name", ["depth/000002.png", "rgb/000002.png"])
def test_the_fingerprint_depends_on_every_pixel(tiny_run, name):
    from PIL import Image

    before = load_run(tiny_run).fingerprint
    path = tiny_run / "test" / "000002" / name
    pixels = np.array(Image.open(path))
    pixels[3, 4] += 1
    Image.fromarray(pixels).save(path)
    assert load_run(tiny_run).fingerprint != before


def test_the_order_of_detections_in_the_file_does_not_matter(tiny_run):
    before = load_run(tiny_run)
    edit(tiny_run / "test" / "000001" / "scene_detections.json", lambda detections: detections.reverse())
    assert_same(load_run(tiny_run).visits, before.visits)


# --- visits, frames, images ---


def test_visits_come_in_the_order_of_their_times(tiny_run):
    edit(tiny_run / "ctmap.json", lambda ctmap: ctmap["visits"].reverse())
    run = load_run(tiny_run)
    assert [visit.scene_id for visit in run.visits] == [1, 2]
    assert [frame.index for frame in run.frames] == list(range(6))
    assert [frame.visit for frame in run.frames] == [0, 0, 0, 1, 1, 1]


def test_a_visit_can_be_read_alone(tiny_run):
    whole, second = load_run(tiny_run), load_run(tiny_run, scene=2)
    assert [visit.scene_id for visit in second.visits] == [2]
    assert_same(
        replace(second.frames[0], index=0, visit=0),
        replace(whole.visits[1].frames[0], index=0, visit=0),
    )


def test_moving_a_visit_moves_its_cameras_and_its_true_objects(tiny_run):
    before = load_run(tiny_run)
    truth_before = load_truth(before)
    T = se3.exp(np.array([0.3, -0.2, 0.9, 1.0, 2.0, -3.0]))

    def move(ctmap):
        for visit in ctmap["visits"]:
            moved = np.array(visit["T_world_visit"]).reshape(4, 4)
            moved[:3, 3] *= 1e-3
            moved = T @ moved
            moved[:3, 3] *= 1e3
            visit["T_world_visit"] = moved.ravel().tolist()

    edit(tiny_run / "ctmap.json", move)
    after = load_run(tiny_run)
    truth_after = load_truth(after)
    for a, b in zip(after.frames, before.frames, strict=True):
        np.testing.assert_allclose(a.T_world_camera, T @ b.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(truth_after.T_world_camera, T @ truth_before.T_world_camera, atol=1e-9)
    for a, b in zip(truth_after.objects, truth_before.objects, strict=True):
        np.testing.assert_allclose(a.T_world_object, T @ b.T_world_object, atol=1e-9)


def test_frames_go_to_other_processes(tiny_run_once):
    frame = load_run(tiny_run_once).frames[0]
    there = pickle.loads(pickle.dumps(frame))
    np.testing.assert_array_equal(there.read_depth(), frame.read_depth())
    np.testing.assert_array_equal(there.read_colour(), frame.read_colour())


def test_images_are_read_when_asked_for(tiny_run):
    run = load_run(tiny_run)
    path = run.frames[0].depth_path
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="truncated"):
        run.frames[0].read_depth()
    run.frames[1].read_depth()


def test_rounded_rotations_are_made_orthonormal(tiny_run):
    def round_all(entries):
        for entry in entries.values():
            entry["cam_R_w2c"] = [round(value, 5) for value in entry["cam_R_w2c"]]

    before = load_run(tiny_run)
    edit(tiny_run / "test" / "000001" / "scene_camera.json", round_all)
    for a, b in zip(load_run(tiny_run).frames, before.frames, strict=True):
        R = a.T_world_camera[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=1e-4)


# --- plain BOP ---


def test_plain_bop_loads_with_defaults_that_are_said(tmp_path):
    path = tmp_path / "run"
    write_tiny_run(path, visits=1)
    make_plain(path)
    run = load_run(path)
    said = " ".join(run.notes)
    assert [c.name for c in run.catalogue.classes] == ["obj_000001", "obj_000005", "obj_000012"]
    assert {(c.category, c.persistence_s, c.supports, c.movable) for c in run.catalogue.classes} == {
        ("unknown", 43200.0, False, True)
    }
    assert [frame.time_ns for frame in run.frames] == [33333333, 66666667, 100000000]
    assert not any(frame.detections for frame in run.frames)
    assert run.up_world is None
    assert run.localisation == LocalisationNoise()
    for words in ("catalogue.json", "ctmap.json", "30 Hz", "scene_detections.json"):
        assert words in said


def test_plain_bop_of_several_scenes_wants_one_named(tiny_run):
    make_plain(tiny_run)
    with pytest.raises(InputError, match=r"2 scenes.*--scene.*1, 2"):
        load_run(tiny_run)
    run = load_run(tiny_run, scene=2)
    assert [visit.scene_id for visit in run.visits] == [2]
    assert run.name == "run-2"
    with pytest.raises(InputError, match=r"no scene 7.*1, 2"):
        load_run(tiny_run, scene=7)


def test_plain_bop_without_poses_or_camera_file_loads(tmp_path):
    path = tmp_path / "run"
    write_tiny_run(path, visits=1)
    make_plain(path)
    (path / "camera.json").unlink()
    edit(
        path / "test" / "000001" / "scene_camera.json",
        lambda entries: [entry.pop(key) for entry in entries.values() for key in ("cam_R_w2c", "cam_t_w2c")],
    )
    run = load_run(path)
    assert run.frames[0].camera == CAMERA
    assert all((frame.T_world_camera == np.eye(4)).all() for frame in run.frames)
    assert any("no camera poses" in note for note in run.notes)
    assert any("camera.json" in note for note in run.notes)


def test_a_class_that_the_catalogue_does_not_list_gets_defaults_that_are_said(tiny_run):
    edit(tiny_run / "catalogue.json", lambda catalogue: catalogue.pop("5"))
    run = load_run(tiny_run)
    assert [c.category for c in run.catalogue.classes] == ["food", "unknown", "furniture"]
    assert any("lists no class 5" in note for note in run.notes)


def test_another_name_for_the_only_split_is_taken(tiny_run):
    (tiny_run / "test").rename(tiny_run / "val")
    assert len(load_run(tiny_run).frames) == 6
    shutil.copytree(tiny_run / "val", tiny_run / "train")
    with pytest.raises(InputError, match=r"train, val.*rename"):
        load_run(tiny_run)


def test_detections_with_one_score_get_class_scores(tiny_run):
    def strip(detections):
        for detection in detections:
            del detection["class_scores"]
            detection["score"], detection["category_id"] = 0.7, 5

    edit(tiny_run / "test" / "000001" / "scene_detections.json", strip)
    run = load_run(tiny_run)
    for detection in run.frames[0].detections:
        np.testing.assert_allclose(detection.class_scores, [0.1, 0.1, 0.7, 0.1])
    assert any("6 detections of scene 1 have no class_scores" in note for note in run.notes)


def test_class_scores_are_normalised(tiny_run):
    def scale(detections):
        for detection in detections:
            detection["class_scores"] = [3.0 * score for score in detection["class_scores"]]

    before = load_run(tiny_run)
    edit(tiny_run / "test" / "000001" / "scene_detections.json", scale)
    assert_same(load_run(tiny_run).visits, before.visits)


# --- symmetries ---


def test_symmetries_keep_their_offset_and_start_with_the_identity(tiny_run_once):
    box = load_catalogue(tiny_run_once)[1]
    np.testing.assert_array_equal(box.symmetries_discrete[0], np.eye(4))
    assert len(box.symmetries_discrete) == 4
    centre = np.array([[0.01, -0.02, 0.03]])
    for T in box.symmetries_discrete:
        np.testing.assert_allclose(se3.transform(T, centre), centre, atol=1e-12)


def test_an_identity_among_the_symmetries_is_not_counted_twice(tiny_run):
    edit(
        tiny_run / "models" / "models_info.json",
        lambda info: info["1"]["symmetries_discrete"].append(np.eye(4).ravel().tolist()),
    )
    assert len(load_catalogue(tiny_run)[1].symmetries_discrete) == 4


# --- writing whole or not at all ---


def write_and_fail(target: Path) -> None:
    with RunWriter(target, tiny_catalogue(), source="tests") as writer:
        writer.add_visit(1).add_frame(1, 0, CAMERA, np.eye(4), np.ones((24, 32), np.float32))
        raise RuntimeError("power cut")


def test_an_exception_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="power cut"):
        write_and_fail(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_an_exception_leaves_the_old_run(tiny_run):
    before = load_run(tiny_run).fingerprint
    with pytest.raises(RuntimeError, match="power cut"):
        write_and_fail(tiny_run)
    assert load_run(tiny_run).fingerprint == before
    assert [p.name for p in tiny_run.parent.iterdir()] == ["run"]


def test_a_run_of_the_same_source_is_replaced(tiny_run):
    before = load_run(tiny_run).fingerprint
    write_tiny_run(tiny_run, seed=1)
    assert load_run(tiny_run).fingerprint != before
    assert [p.name for p in tiny_run.parent.iterdir()] == ["run"]


@pytest.mark.parametrize("taken", ["folder", "file", "another source"])
def test_what_others_wrote_is_never_touched(tmp_path, taken):
    target = tmp_path / "run"
    if taken == "folder":
        target.mkdir()
        (target / "thesis.tex").write_text("years of work")
    elif taken == "file":
        target.write_text("years of work")
    else:
        write_tiny_run(target)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=r"did not write.*choose another folder"):
        RunWriter(target, tiny_catalogue(), source="simulation")
    assert sorted(tmp_path.rglob("*")) == before


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "run").mkdir()
    write_tiny_run(tmp_path / "run")
    assert len(load_run(tmp_path / "run").frames) == 6


KILLED = """
import sys
from pathlib import Path
from tests.tiny import write_tiny_run
for seed in range(int(sys.argv[2]), 100_000):
    write_tiny_run(Path(sys.argv[1]), seed=seed)
    print("written", flush=True)
"""


def test_a_killed_writer_leaves_the_old_run_or_the_new(tmp_path):
    target = tmp_path / "run"
    write_tiny_run(target)
    rng = np.random.default_rng(0)
    seen = set()
    for kill in range(5):
        command = [sys.executable, "-c", KILLED, str(target), str(1000 * kill)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"written\n"
            time.sleep(rng.uniform(0.0, 0.2))
            process.kill()
        run = load_run(target)
        for frame in run.frames:
            frame.read_depth()
            frame.read_colour()
        assert len(run.frames) == 6
        assert load_truth(run) is not None
        seen.add(run.fingerprint)
    assert len(seen) == 5, "each process has written a run of its own before it was killed"


# --- real recordings ---


@pytest.mark.parametrize(
    ("name", "frames", "obj_ids", "present"),
    [
        ("ycb_desk", 10, (4, 6, 8, 11, 12, 13, 14, 15, 21), {8, 14, 21}),
        ("visp_rbt", 99, (1, 2, 8, 13, 14, 15, 21), {1, 2}),
    ],
)
def test_real_recordings_load(data, name, frames, obj_ids, present):
    run = load_run(data / name)
    truth = load_truth(run)
    assert isinstance(run, Run)
    assert run.name == name
    assert len(run.frames) == frames
    assert run.catalogue.obj_ids == obj_ids
    assert all(d.class_scores.shape == (len(obj_ids) + 1,) for f in run.frames for d in f.detections)
    assert truth is not None
    assert {o.obj_id for o in truth.objects} == present
    for o in truth.objects:
        assert len(o.frames) == frames
        # nothing on the tables moves: the composition of camera and object poses must not either
        assert o.T_world_object[:, :3, 3].std(axis=0).max() < 1e-3
    depth = run.frames[0].read_depth()
    for o in truth.objects:
        centre = se3.inverse(run.frames[0].T_world_camera) @ o.T_world_object[0][:, 3]
        u, v = run.frames[0].camera.project(centre[:3])
        assert depth[round(v), round(u)] == pytest.approx(centre[2], abs=0.1)


def test_the_noise_of_the_tiny_run_is_read(tiny_run_once):
    assert_same(load_run(tiny_run_once).localisation, NOISE)
