"""The truth: which physical object was where."""

import numpy as np
import pytest

from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.errors import InputError
from tests.tiny import edit

SCENE = "test/000001"


def strip_inst_ids(entries):
    for sightings in entries.values():
        for sighting in sightings:
            del sighting["inst_id"]


def test_an_inst_id_is_one_object_in_all_visits(tiny_run_once):
    truth = load_truth(load_run(tiny_run_once))
    assert [(o.inst_id, o.obj_id, o.frames.tolist()) for o in truth.objects] == [
        (101, 1, list(range(6))),
        (105, 5, list(range(6))),
    ]


def test_without_inst_id_the_kth_of_a_class_is_one_object_of_its_visit(tiny_run):
    def second_box(entries):
        strip_inst_ids(entries)
        for sightings in entries.values():
            sightings.append({**sightings[0], "cam_t_m2c": [1.0, 2.0, 3.0]})

    before = load_truth(load_run(tiny_run))
    for scene in (1, 2):
        (tiny_run / f"test/00000{scene}/scene_gt_info.json").unlink()
        edit(tiny_run / f"test/00000{scene}/scene_gt.json", second_box)
    run = load_run(tiny_run)
    truth = load_truth(run)
    assert [(o.obj_id, o.frames.tolist()) for o in truth.objects] == [
        (obj_id, frames) for frames in ([0, 1, 2], [3, 4, 5]) for obj_id in (1, 1, 5)
    ]
    assert len({o.inst_id for o in truth.objects}) == 6
    np.testing.assert_array_equal(truth.objects[0].T_world_object, before.objects[0].T_world_object[:3])
    second = se3.inverse(truth.T_world_camera[:3]) @ truth.objects[1].T_world_object
    np.testing.assert_allclose(second[:, :3, 3], [[1e-3, 2e-3, 3e-3]] * 3)
    assert (truth.objects[0].visible_fraction == 1).all()


def test_objects_without_inst_id_never_take_the_name_of_one_with(tiny_run):
    edit(tiny_run / SCENE / "scene_gt.json", strip_inst_ids)
    truth = load_truth(load_run(tiny_run))
    assert [(o.inst_id, o.obj_id, o.frames.tolist()) for o in truth.objects] == [
        (101, 1, [3, 4, 5]),
        (105, 5, [3, 4, 5]),
        (106, 1, [0, 1, 2]),
        (107, 5, [0, 1, 2]),
    ]


def test_objects_stand_where_the_true_camera_saw_them(tiny_run):
    before = load_truth(load_run(tiny_run))
    for scene in (1, 2):
        (tiny_run / f"test/00000{scene}/scene_camera_gt.json").unlink()
    run = load_run(tiny_run)
    truth = load_truth(run)
    recorded = np.stack([frame.T_world_camera for frame in run.frames])
    np.testing.assert_array_equal(truth.T_world_camera, recorded)
    for o, with_true_camera in zip(truth.objects, before.objects, strict=True):
        np.testing.assert_allclose(
            se3.inverse(recorded) @ o.T_world_object,
            se3.inverse(before.T_world_camera) @ with_true_camera.T_world_object,
            atol=1e-9,
        )


def test_a_visit_may_have_no_truth(tiny_run):
    (tiny_run / SCENE / "scene_gt.json").unlink()
    truth = load_truth(load_run(tiny_run))
    assert [o.frames.tolist() for o in truth.objects] == [[3, 4, 5], [3, 4, 5]]
    assert truth.T_world_camera.shape == (6, 4, 4)


def test_a_frame_without_objects_is_a_frame_of_the_truth(tiny_run):
    edit(tiny_run / SCENE / "scene_gt.json", lambda entries: entries["2"].clear())
    truth = load_truth(load_run(tiny_run))
    assert [o.frames.tolist() for o in truth.objects] == [[0, 2, 3, 4, 5]] * 2


def repeat(entries):
    entries["2"][1]["inst_id"] = 101


def unknown(entries):
    entries["2"][1]["obj_id"] = 77


def another_class(entries):
    entries["2"][0]["obj_id"] = 12


def partly_named(entries):
    del entries["2"][1]["inst_id"]


def skewed(entries):
    entries["2"][0]["cam_R_m2c"][0] += 0.1


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        (repeat, "2[1].inst_id", "two objects"),
        (unknown, "2[1].obj_id", "unknown obj_id 77"),
        (another_class, "inst_id", "classes"),
        (partly_named, "2", "others none"),
        (skewed, "2[0].cam_R_m2c", "not a rotation"),
    ],
)
def test_a_broken_truth_is_refused(tiny_run, change, field, message):
    edit(tiny_run / SCENE / "scene_gt.json", change)
    run = load_run(tiny_run)
    with pytest.raises(InputError, match=message) as caught:
        load_truth(run)
    assert caught.value.file.name == "scene_gt.json"
    assert caught.value.field == field
    assert caught.value.remedy


def test_visible_fractions_must_match_the_entries(tiny_run):
    edit(tiny_run / SCENE / "scene_gt_info.json", lambda entries: entries["3"].pop())
    with pytest.raises(InputError, match="no entry 1") as caught:
        load_truth(load_run(tiny_run))
    assert caught.value.file == tiny_run / SCENE / "scene_gt_info.json"
    assert caught.value.field == "3"
