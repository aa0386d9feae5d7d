"""BOP and COCO results say what the estimate says."""

import csv
import io

import numpy as np
import pytest

from ctmap_gtsam.evaluation.views import views
from ctmap_gtsam.export import bop_csv, coco_detections, coco_results
from sequences import se3
from sequences.bop import load_run, load_truth
from tests.ctmap_gtsam import synthetic


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    run = load_run(synthetic.write_run(tmp_path_factory.mktemp("run") / "small", visits=2))
    return run, load_truth(run)


def lines(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_csv_holds_the_poses_in_the_camera(small):
    run, truth = small
    found = lines(bop_csv(views(run, synthetic.estimate_of(run, truth)), seconds_per_image=0.25))
    assert len(found) == len(run.frames) * len(truth.objects)
    frames = {(f.scene_id, f.im_id): f for f in run.frames}
    for k, line in enumerate(found):
        frame, thing = frames[int(line["scene_id"]), int(line["im_id"])], truth.objects[k % len(truth.objects)]
        T = se3.inverse(truth.T_world_camera[frame.index]) @ thing.T_world_object[frame.index]
        np.testing.assert_allclose(np.array(line["R"].split(), float), T[:3, :3].ravel(), atol=1e-8)
        np.testing.assert_allclose(np.array(line["t"].split(), float), 1e3 * T[:3, 3], atol=1e-5)
        assert int(line["obj_id"]) == thing.obj_id
        assert float(line["score"]) == pytest.approx(synthetic.RIGHT)
        assert float(line["time"]) == 0.25


def test_csv_has_what_exists_and_is_in_view_alone(small):
    run, truth = small
    far = se3.make(np.eye(3), np.array([5.0, 0, 0]))
    map_ = synthetic.estimate_of(
        run,
        truth,
        disturb=lambda n, f, T: far @ T if n == 0 else T,
        existence=lambda n, f: 0.4 if n == 1 and f % 2 else 0.8,
    )
    found = lines(bop_csv(views(run, map_)))
    assert len(found) == len(run.frames) * 3 // 2
    assert {line["score"] for line in found} == {"0.72"}
    assert {line["time"] for line in found} == {"-1"}


def test_an_empty_map_gives_a_header(small):
    run, truth = small
    empty = views(run, synthetic.unplaced(synthetic.estimate_of(run, truth), [0, 1, 2]))
    assert bop_csv(empty) == "scene_id,im_id,obj_id,score,R,t,time\n"
    assert coco_results(empty) == []


def test_boxes_of_the_true_map_are_those_of_its_visible_pixels(small):
    """The run's detections were made from the same pixels, so the two agree."""
    run, truth = small
    found = coco_results(views(run, synthetic.estimate_of(run, truth)))
    detected = coco_detections(run)
    assert [r["bbox"] for r in found] == [r["bbox"] for r in detected]
    assert [(r["scene_id"], r["image_id"]) for r in found] == [(r["scene_id"], r["image_id"]) for r in detected]
    assert [r["category_id"] for r in found[:3]] == [3, 5, 3]
    assert [r["category_id"] for r in detected[:3]] == [9, 5, 3]


def test_what_others_hide_has_no_box(small):
    run, truth = small
    carton = truth.objects[0].T_world_object
    upright = se3.exp(np.array([0, np.pi / 2, 0, 0, 0, 0]))

    def swallow(n, f, T):
        return carton[f] @ upright if n == 1 else T

    seen = views(run, synthetic.estimate_of(run, truth, disturb=swallow))
    assert all((view.class_id == 5).sum() == 1 for view in seen)  # it is in view all the same
    assert [r["category_id"] for r in coco_results(seen)] == [3, 3] * len(run.frames)


def test_coco_reads_the_results(small, tmp_path):
    """pycocotools takes them as they are, image by image."""
    import json

    coco = pytest.importorskip("pycocotools.coco")
    run, truth = small
    found = [r for r in coco_results(views(run, synthetic.estimate_of(run, truth))) if r["scene_id"] == 1]
    truth_file, results = tmp_path / "truth.json", tmp_path / "results.json"
    annotations = [
        {"id": k + 1, "image_id": r["image_id"], "category_id": r["category_id"], "bbox": r["bbox"], "iscrowd": 0}
        | {"area": r["bbox"][2] * r["bbox"][3]}
        for k, r in enumerate(found)
    ]
    images = [{"id": f.im_id, "width": 160, "height": 120} for f in run.visits[0].frames]
    categories = [{"id": c} for c in run.catalogue.obj_ids]
    truth_file.write_text(
        json.dumps({"info": {}, "images": images, "annotations": annotations, "categories": categories})
    )
    results.write_text(json.dumps(found))
    from pycocotools.cocoeval import COCOeval

    gt = coco.COCO(str(truth_file))
    evaluation = COCOeval(gt, gt.loadRes(str(results)), "bbox")
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    assert evaluation.stats[0] == pytest.approx(1.0)
