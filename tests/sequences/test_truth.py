"""The truth: which physical object was where."""

import numpy as np
import pytest

from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.errors import InputError
from sequences.types import TrueMove
from sequences.validation import inspect_run
from tests.tiny import SECOND, edit

SCENE = "test/000001"
MOVES = "test/000002/scene_gt_moves.json"


def strip_inst_ids(entries):
    for sightings in entries.values():
        for sighting in sightings:
            del sighting["inst_id"]
            sighting.pop("support", None)


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
    (tiny_run / MOVES).unlink()
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


def on_nothing(entries):
    entries["2"][0]["support"] = 77


def on_itself(entries):
    entries["2"][1]["support"] = 105


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        (repeat, "2[1].inst_id", "two objects"),
        (unknown, "2[1].obj_id", "unknown obj_id 77"),
        (another_class, "inst_id", "classes"),
        (partly_named, "2", "others none"),
        (skewed, "2[0].cam_R_m2c", "not a rotation"),
        (on_nothing, "2[0].support", "no other object has inst_id 77"),
        (on_itself, "2[1].support", "no other object has inst_id 105"),
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


def test_boxes_of_visible_pixels_are_known_where_the_file_has_them(tiny_run):
    def boxed(entries):
        entries["2"][0]["bbox_visib"] = [3, 4, 10, 8]
        entries["3"][0]["bbox_visib"] = [-1, -1, -1, -1]

    edit(tiny_run / SCENE / "scene_gt_info.json", boxed)
    box, can = load_truth(load_run(tiny_run)).objects
    assert box.visible_box[1].tolist() == [3, 4, 10, 8]
    assert np.isnan(np.delete(box.visible_box, 1, axis=0)).all()
    assert np.isnan(can.visible_box).all()


def test_what_things_stand_on_is_known_frame_by_frame(tiny_run):
    def lifted(entries):
        del entries["2"][0]["support"]

    edit(tiny_run / SCENE / "scene_gt.json", lifted)
    box, can = load_truth(load_run(tiny_run)).objects
    assert box.support.tolist() == [105, -1, 105, 105, 105, 105]
    assert can.support.tolist() == [-1] * 6


def test_moves_are_told_by_time_and_visit(tiny_run):
    edit(
        tiny_run / MOVES,
        lambda moves: moves.append({"inst_id": 105, "time_ns": 999 * SECOND, "kind": "appeared", "to_support": 101}),
    )
    (tiny_run / SCENE / "scene_gt_moves.json").write_text(
        f'[{{"inst_id": 101, "time_ns": {SECOND}, "kind": "nudged", "from_support": 105, "to_support": 105}}]'
    )
    assert load_truth(load_run(tiny_run)).moves == (
        TrueMove(101, 0, SECOND, "nudged", 105, 105),
        TrueMove(101, 1, 500 * SECOND, "moved", None, 105),
        TrueMove(105, 1, 999 * SECOND, "appeared", None, 101),
    )


def test_what_vanished_is_there_no_more(tiny_run):
    def vanish(moves):
        moves[:] = [{"inst_id": 101, "time_ns": 1001 * SECOND, "kind": "vanished", "from_support": 105}]

    def gone(entries):
        for image in ("2", "3"):
            del entries[image][0]

    edit(tiny_run / MOVES, vanish)
    edit(tiny_run / "test/000002/scene_gt.json", gone)
    edit(tiny_run / "test/000002/scene_gt_info.json", gone)
    truth = load_truth(load_run(tiny_run))
    assert truth.moves == (TrueMove(101, 1, 1001 * SECOND, "vanished", 105, None),)
    assert truth.objects[0].frames.tolist() == [0, 1, 2, 3]


def test_without_the_file_no_moves_are_known(tiny_run):
    (tiny_run / MOVES).unlink()
    assert load_truth(load_run(tiny_run)).moves == ()


def test_a_visit_alone_knows_nothing_of_what_stood_elsewhere_before(tiny_run):
    edit(tiny_run / MOVES, lambda moves: moves[0].update(from_support=42))
    with pytest.raises(InputError, match="no object has inst_id 42"):
        load_truth(load_run(tiny_run))
    assert load_truth(load_run(tiny_run, scene=2)).moves == (TrueMove(101, 0, 500 * SECOND, "moved", None, 105),)


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        ({"kind": "eaten"}, "[0].kind", "unknown kind eaten"),
        ({"time_ns": 2 * SECOND}, "[0].time_ns", "not of visit 2"),
        ({"time_ns": 1003 * SECOND}, "[0].time_ns", "not of visit 2"),
        ({"kind": "nudged"}, "[0].time_ns", "not of visit 2"),
        ({"inst_id": 77}, "[0].inst_id", "is not in"),
        ({"kind": "vanished"}, "[0].inst_id", "still in"),
        ({"to_support": 77}, "[0].to_support", "no object has inst_id 77"),
    ],
)
def test_a_broken_move_is_refused(tiny_run, change, field, message):
    edit(tiny_run / MOVES, lambda moves: moves[0].update(change))
    run = load_run(tiny_run)
    with pytest.raises(InputError, match=message) as caught:
        load_truth(run)
    assert caught.value.file == tiny_run / MOVES
    assert caught.value.field == field
    assert caught.value.remedy
    assert [(p.file, p.field) for p in inspect_run(tiny_run).problems] == [(tiny_run / MOVES, field)]
