"""Laws of `compare`: the truth is perfect, known mistakes have known figures, and the order of objects is nothing."""

import time

import numpy as np
import pytest

from ctmap_gtsam.evaluation import compare
from ctmap_gtsam.evaluation.detection import iou, match_boxes
from ctmap_gtsam.evaluation.silhouettes import silhouettes
from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.rendering.scene import render_scene
from tests.ctmap_gtsam import synthetic


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    run = load_run(synthetic.write_run(tmp_path_factory.mktemp("run") / "small"))
    return run, load_truth(run)


@pytest.fixture(scope="module", params=["small", "ycb_desk"])
def recorded(request):
    if request.param == "small":
        return request.getfixturevalue("small")
    run = load_run(request.getfixturevalue("data") / request.param)
    return run, load_truth(run)


def metrics(run, estimate):
    return compare(run, {"m": estimate}).methods["m"].metrics


def test_the_true_map_is_perfect(recorded):
    run, truth = recorded
    found = metrics(run, synthetic.estimate_of(run, truth))
    for name in ("mssd_mm_median", "adds_mm_median", "add_mm_median", "translation_mm_median", "rotation_deg_median"):
        assert found[name] == pytest.approx(0, abs=1e-6), name
    for name in ("posed_share", "class_accuracy", "class_accuracy_last_half"):
        assert found[name] == 1, name
    assert found["missed_objects"] == found["false_positive_objects"] == 0
    assert found["existing_objects_final"] == len(truth.objects) == len(found["objects"])


def test_a_known_shift_is_measured(recorded):
    run, truth = recorded
    found = metrics(run, synthetic.estimate_of(run, truth, disturb=synthetic.shifted(0.003)))
    assert found["mssd_mm_median"] == pytest.approx(3.0, abs=1e-6)
    assert found["translation_mm_median"] == pytest.approx(3.0, abs=1e-6)
    assert 0 < found["adds_mm_median"] <= 3.0 + 1e-6
    assert found["rotation_deg_median"] == pytest.approx(0, abs=1e-6)


def test_symmetric_twins_are_as_true(recorded):
    run, truth = recorded

    def twin(n, f, T):
        symmetries = run.catalogue[truth.objects[n].obj_id].symmetries_discrete
        return T @ symmetries[f % len(symmetries)]

    found = metrics(run, synthetic.estimate_of(run, truth, disturb=twin))
    for name in ("mssd_mm_median", "translation_mm_median", "rotation_deg_median"):
        assert found[name] == pytest.approx(0, abs=1e-5), name


def test_the_order_of_objects_is_nothing(recorded):
    run, truth = recorded
    rng = np.random.default_rng(0)
    xi = 0.01 * rng.normal(size=(len(truth.objects), len(run.frames), 6))

    def noisy(n, f, T):
        return T @ se3.exp(xi[n, f])

    order = [2, 0, 1]
    assert metrics(run, synthetic.estimate_of(run, truth, disturb=noisy)) == metrics(
        run, synthetic.estimate_of(run, truth, disturb=noisy, order=order)
    )


def test_each_side_has_its_own_camera(small):
    """A localisation error that moves camera and objects together is none; one of the camera alone is."""
    run, truth = small
    T = se3.exp(np.array([0.1, -0.2, 0.3, 0.5, 0.1, -0.4]))
    both = synthetic.estimate_of(run, truth, disturb=lambda n, f, T_wo: T @ T_wo, cameras=T @ truth.T_world_camera)
    assert metrics(run, both)["mssd_mm_median"] == pytest.approx(0, abs=1e-6)
    off = se3.make(np.eye(3), np.array([0.004, 0, 0]))
    alone = synthetic.estimate_of(run, truth, cameras=off @ truth.T_world_camera)
    assert metrics(run, alone)["mssd_mm_median"] == pytest.approx(4.0, abs=1e-6)


def test_a_wrong_class_at_the_right_place_is_wrong_and_not_missed(small):
    run, truth = small
    found = metrics(run, synthetic.estimate_of(run, truth, class_of=lambda n, f: 9 if n == 0 else None))
    assert found["class_accuracy"] == pytest.approx(2 / 3)
    assert found["missed_objects"] == found["false_positive_objects"] == 0
    carton = found["objects"]["carton#1"]
    assert carton["mssd_mm_median"] is None
    assert carton["rotation_deg_median"] is None
    assert carton["translation_mm_median"] == pytest.approx(0, abs=1e-6)
    assert found["objects"]["carton#3"]["class_accuracy"] == 1


def test_a_class_that_is_learned_late_counts_late(small):
    run, truth = small
    half = len(run.frames) // 2
    late = synthetic.estimate_of(run, truth, class_of=lambda n, f: 9 if n == 0 and f < half else None)
    found = metrics(run, late)
    assert found["class_accuracy"] == pytest.approx(1 - 1 / 6)
    assert found["class_accuracy_last_half"] == 1
    assert found["mssd_mm_median"] == pytest.approx(0, abs=1e-6)


def test_missing_half_of_the_frames_leaves_no_median(small):
    run, truth = small
    half = len(run.frames) // 2
    found = metrics(run, synthetic.estimate_of(run, truth, existence=lambda n, f: float(f >= half)))
    assert found["mssd_mm_median"] is None
    assert found["posed_share"] == 0.5
    assert found["missed_objects"] == 0


def test_missed_and_false_objects_are_counted(small):
    run, truth = small
    perfect = synthetic.estimate_of(run, truth)
    assert metrics(run, synthetic.unplaced(perfect, [1]))["missed_objects"] == 1
    doubled = synthetic.estimate_of(run, truth, order=[0, 1, 2, 2], disturb=lambda n, f, T: T)
    found = metrics(run, doubled)
    assert found["false_positive_objects"] == 1
    assert found["existing_objects_final"] == 4
    empty = metrics(run, synthetic.unplaced(perfect, [0, 1, 2]))
    assert (empty["missed_objects"], empty["class_accuracy"], empty["mssd_mm_median"]) == (3, 0, None)


def test_objects_are_held_between_keyframes(small):
    run, truth = small
    sparse = synthetic.estimate_of(run, truth, keyframes=[0, 3, 6])
    found = metrics(run, sparse)
    assert found["mssd_mm_median"] == pytest.approx(0, abs=1e-6)
    assert found["class_accuracy"] == 1


def test_the_detector_is_asked_the_same(small):
    run, _ = small
    found = compare(run, {}).methods["detector"].metrics
    assert found["class_accuracy"] == pytest.approx(2 / 3)
    assert found["objects"]["carton#1"]["class_accuracy"] == 0
    assert found["false_positive_boxes"] == 0
    assert found["mssd_mm_median"] is None


def test_without_truth_methods_are_held_to_each_other(small, tmp_path):
    run, truth = small
    path = synthetic.write_run(tmp_path / "untrue")
    for name in ("scene_gt.json", "scene_gt_info.json", "scene_camera_gt.json"):
        (path / "test" / "000001" / name).unlink()
    blind = load_run(path)
    maps = {
        "filter-ct": synthetic.estimate_of(blind, truth, disturb=synthetic.shifted(0.002)),
        "smooth-ct": synthetic.estimate_of(blind, truth),
    }
    comparison = compare(blind, maps)
    assert comparison.truth is None
    assert comparison.methods["smooth-ct"].metrics["class_accuracy"] is None
    assert comparison.reference == "smooth-ct"
    agreement = comparison.agreement["filter-ct"].metrics()
    assert agreement["distance_mm_median"] == pytest.approx(2.0, abs=1e-6)
    assert agreement["class_agreement"] == 1
    assert compare(run, maps).agreement["filter-ct"].metrics() == pytest.approx(agreement)


def test_agreement_says_when_the_filter_settled(small):
    run, truth = small
    filtered = synthetic.estimate_of(run, truth, class_of=lambda n, f: 9 if n == 0 and f < 3 else None)
    maps = {"filter-ct": filtered, "smooth-ct": synthetic.estimate_of(run, truth)}
    first, second, _ = compare(run, maps).agreement["filter-ct"].objects
    assert first.first_agreement == 3
    assert second.first_agreement == 0
    assert first.class_agreement == pytest.approx(1 - 3 / len(run.frames))


def test_tables_have_a_row_for_everything(small):
    run, truth = small
    maps = {"a": synthetic.estimate_of(run, truth), "b": synthetic.estimate_of(run, truth)}
    comparison = compare(run, maps)
    assert comparison.table().index.tolist() == ["detector", "a", "b"]
    assert len(comparison.object_table()) == 3 * len(truth.objects)
    frames = comparison.frame_table()
    assert len(frames) == 2 * len(truth.objects) * len(run.frames)
    assert np.allclose(frames["class_probability"], synthetic.RIGHT)


def test_compare_is_fast(data):
    """A hundred frames and five methods well under ten seconds, kernels loaded."""
    run = load_run(data / "visp_rbt")
    truth = load_truth(run)
    maps = {f"m{k}": synthetic.estimate_of(run, truth, disturb=synthetic.shifted(0.002 * k)) for k in range(5)}
    start = time.process_time()
    compare(run, maps)
    assert time.process_time() - start < 8


def test_iou_by_hand():
    boxes = np.array([[0.0, 0.0, 2.0, 2.0], [1.0, 0.0, 2.0, 2.0], [5.0, 5.0, 0.0, 0.0]])
    np.testing.assert_allclose(iou(boxes, boxes), [[1, 1 / 3, 0], [1 / 3, 1, 0], [0, 0, 0]])
    assert match_boxes(boxes[:2], boxes[1:2]) == [(1, 0)]
    assert match_boxes(np.zeros((0, 4)), boxes) == []


def test_silhouettes_agree_with_the_image_of_the_whole_scene(small):
    run, truth = small
    frame = run.frames[3]
    classes = np.array([t.obj_id for t in truth.objects])
    poses = np.stack([frame.T_camera_world @ t.T_world_object[3] for t in truth.objects])
    poses[2] = poses[1] @ se3.make(np.eye(3), np.array([0.03, 0.0, 0.02]))  # partly behind the brick
    scene = render_scene([(run.catalogue[c].mesh, T) for c, T in zip(classes, poses, strict=True)], frame.camera)
    for k, seen in enumerate(silhouettes(run.catalogue, classes, poses, frame.camera)):
        rows, columns = np.nonzero(scene.item == k)
        assert seen.visible_pixels == len(rows)
        box = (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)
        assert seen.visible_box == box
        assert seen.pixels >= seen.visible_pixels


def test_what_is_behind_the_camera_has_no_silhouette(small):
    run, _ = small
    T = se3.make(np.eye(3), np.array([[0, 0, -1.0], [9.0, 0, 1.0]]))
    for seen in silhouettes(run.catalogue, [3, 3], T, run.frames[0].camera):
        assert (seen.pixels, seen.visible_box, seen.visible_fraction) == (0, None, 0.0)
