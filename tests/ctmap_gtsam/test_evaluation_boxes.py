"""Average precision is COCO's: held to faster-coco-eval and to pycocotools, pooled or not, and by hand."""

import contextlib
import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.evaluation import boxes as b
from ctmap_gtsam.evaluation import record
from ctmap_gtsam.evaluation.boxes import TrueBoxes, average_precision, judge_boxes, mean_average_precision, pooled_boxes
from ctmap_gtsam.evaluation.matching import from_truth
from ctmap_gtsam.evaluation.record import pooled
from ctmap_gtsam.evaluation.silhouettes import silhouettes
from ctmap_gtsam.evaluation.views import final_views, views
from sequences.bop import load_run, load_truth
from tests.ctmap_gtsam import synthetic

OBJ_IDS = (2, 3, 7)
FRAMES = 4


def true(*rows):
    """Rows of frame, obj_id, box, ignore."""
    return TrueBoxes(
        np.array([r[0] for r in rows], dtype=np.int64),
        np.arange(len(rows)),
        np.array([r[1] for r in rows], dtype=np.int64),
        np.array([r[2] for r in rows], dtype=float).reshape(-1, 4),
        np.array([r[3] for r in rows], dtype=bool),
    )


corners = st.integers(0, 6).map(lambda v: 5.0 * v)
sides = st.integers(1, 4).map(lambda v: 5.0 * v)
some_boxes = st.tuples(corners, corners, sides, sides)
frames = st.integers(0, FRAMES - 1)
classes = st.sampled_from(OBJ_IDS)
truths = st.lists(st.tuples(frames, classes, some_boxes, st.booleans()), max_size=12).map(lambda rows: true(*rows))
scores = st.integers(1, 5).map(lambda v: v / 5)  # few values: ties are what implementations differ in
answers = st.lists(st.lists(st.tuples(classes, scores, some_boxes), max_size=5), min_size=FRAMES, max_size=FRAMES)


def results_of(said):
    return [
        {"image_id": f, "category_id": obj_id, "bbox": list(box), "score": score}
        for f, found in enumerate(said)
        for obj_id, score, box in found
    ]


def precision_of(evaluated):
    """(C,) as COCO has it, -1 where there is no true box."""
    return np.where((p := evaluated.eval["precision"][0, :, :, 0, -1]).min(axis=0) < 0, np.nan, p.mean(axis=0))


def by_pycocotools(truth, results):
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    annotations = [
        {"id": k + 1, "image_id": int(f), "category_id": int(c), "bbox": box.tolist(), "iscrowd": int(ignore)}
        | {"area": float(box[2] * box[3])}
        for k, (f, c, box, ignore) in enumerate(zip(truth.frame, truth.class_id, truth.box, truth.ignore, strict=True))
    ]
    with contextlib.redirect_stdout(io.StringIO()):
        dataset = COCO()
        dataset.dataset = {
            "info": {},
            "images": [{"id": f} for f in range(FRAMES)],
            "annotations": annotations,
            "categories": [{"id": o} for o in OBJ_IDS],
        }
        dataset.createIndex()
        found = COCOeval(dataset, dataset.loadRes(results), "bbox")
        found.params.iouThrs = np.array([0.5])
        found.params.areaRng, found.params.areaRngLbl = [[0, 1e10]], ["all"]
        found.params.maxDets = [100]
        found.evaluate()
        found.accumulate()
    return precision_of(found)


@given(truths, answers)
@settings(max_examples=60)
def test_average_precision_is_that_of_both_implementations(truth, said):
    ours = average_precision(judge_boxes(truth, said, OBJ_IDS))
    results = results_of(said)
    if not results or not len(truth.frame):
        assert np.isin(ours[np.isfinite(ours)], 0).all()
        return
    np.testing.assert_allclose(ours, by_pycocotools(truth, results), atol=1e-9)
    np.testing.assert_allclose(ours, precision_of(b.evaluation(truth, results, FRAMES, OBJ_IDS)), atol=1e-9)


@given(truths, answers, st.integers(1, FRAMES - 1))
@settings(max_examples=30)
def test_images_judged_apart_and_pooled_are_images_judged_together(truth, said, cut):
    together = judge_boxes(truth, said, OBJ_IDS)
    early = truth.frame < cut
    parts = []
    for w, start, some in ((early, 0, said[:cut]), (~early, cut, said[cut:])):
        part = TrueBoxes(truth.frame[w] - start, truth.object[w], truth.class_id[w], truth.box[w], truth.ignore[w])
        parts.append(judge_boxes(part, some, OBJ_IDS))
    pool = pooled_boxes(parts, [("x", "y", "z")] * 2)
    for name, value in vars(together).items():
        np.testing.assert_array_equal(getattr(pool, name), value, err_msg=name)


def test_classes_are_pooled_by_name():
    box = (0.0, 0.0, 10.0, 10.0)
    one = judge_boxes(true((0, 2, box, False), (0, 3, box, False)), [[(2, 0.9, box)]], (2, 3))
    other = judge_boxes(true((0, 1, box, False)), [[(1, 0.8, box)]], (1,))
    pool = pooled_boxes([one, other], [("mug", "bowl"), ("bowl",)])
    assert pool.positives.tolist() == [2, 1]  # bowl, mug
    np.testing.assert_allclose(average_precision(pool), [51 / 101, 1])


def test_average_precision_by_hand():
    """Two true boxes; the surest estimate is right, the next wrong, the last right: precision 1 up to recall 1/2, then
    2/3. COCO reads 51 recalls up to 1/2 and 50 above."""
    box, other = (0.0, 0.0, 10.0, 10.0), (50.0, 50.0, 10.0, 10.0)
    truth = true((0, 2, box, False), (1, 2, box, False))
    said = [[(2, 0.9, box), (2, 0.8, other)], [(2, 0.7, box)], [], []]
    ap = average_precision(judge_boxes(truth, said, OBJ_IDS))
    assert ap[0] == pytest.approx((51 * 1 + 50 * 2 / 3) / 101)
    assert np.isnan(ap[1:]).all()


def test_overlap_has_to_be_half():
    truth = true((0, 2, (0.0, 0.0, 10.0, 10.0), False))
    for height, right in ((5.0, True), (4.9, False)):
        judged = judge_boxes(truth, [[(2, 0.5, (0.0, 0.0, 10.0, height))]], OBJ_IDS)
        assert judged.true_positive.tolist() == [right]


def test_what_lies_in_an_ignore_region_counts_for_nothing():
    region, inside, outside = (0.0, 0.0, 40.0, 40.0), (5.0, 5.0, 10.0, 10.0), (35.0, 35.0, 10.0, 10.0)
    truth = true((0, 2, region, True), (0, 2, (60.0, 60.0, 10.0, 10.0), False))
    said = [
        [(2, 0.9, inside), (2, 0.8, inside), (2, 0.7, outside), (2, 0.6, (60.0, 60.0, 10.0, 10.0)), (3, 0.5, inside)]
    ]
    judged = judge_boxes(truth, said, OBJ_IDS)
    assert judged.ignored.tolist() == [True, True, False, False, False]
    assert judged.true_positive.tolist() == [False, False, False, True, False]
    assert judged.positives.tolist() == [1, 0, 0]
    assert average_precision(judged)[0] == pytest.approx(0.5)


def test_a_second_box_on_one_thing_is_wrong():
    box = (0.0, 0.0, 10.0, 10.0)
    judged = judge_boxes(true((0, 2, box, False)), [[(2, 0.5, box), (2, 0.9, box)]], OBJ_IDS)
    assert judged.score.tolist() == [0.9, 0.5]
    assert judged.true_positive.tolist() == [True, False]


def test_nothing_said_and_nothing_there():
    box = (0.0, 0.0, 10.0, 10.0)
    assert mean_average_precision(judge_boxes(true((0, 2, box, False)), [[]], OBJ_IDS)) == 0
    assert mean_average_precision(judge_boxes(true(), [[(2, 0.5, box)]], OBJ_IDS)) is None
    assert mean_average_precision(judge_boxes(true(), [[]], OBJ_IDS)) is None


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    run = load_run(synthetic.write_run(tmp_path_factory.mktemp("run") / "small", frames=6, visits=2))
    return run, load_truth(run)


def test_the_detector_names_one_of_two_cartons_wrong(small):
    """Cartons: half of them found, all surely: AP 51/101. The brick: 1. No true crate: its boxes don't count."""
    metrics = pooled([record(*small, "detector", None)])
    assert metrics["map_50"] == metrics["map_50_paper"] == pytest.approx((51 / 101 + 1) / 2)


def test_the_papers_protocol_shows_the_last_map_of_each_visit_in_all_of_its_frames(small):
    """An object that is found at the end alone; one that is right at first and moves away at the end."""
    run, truth = small
    aside = synthetic.shifted(0.5)
    last = {visit.frames[-1].index for visit in run.visits}
    late = synthetic.estimate_of(run, truth, existence=lambda n, f: float(n != 1 or f in last))
    lost = synthetic.estimate_of(run, truth, disturb=lambda n, f, T: aside(n, f, T) if n == 1 and f in last else T)
    found = {name: pooled([record(run, truth, name, e)]) for name, e in (("late", late), ("lost", lost))}
    assert found["late"]["map_50_paper"] == pytest.approx(1)
    assert found["late"]["map_50"] < 0.7  # the brick is there in two of twelve frames
    assert found["lost"]["map_50_paper"] == pytest.approx(0.5)
    assert found["lost"]["map_50"] > 0.85


def test_final_views_use_the_cameras_of_each_frame(small):
    run, truth = small
    estimate = synthetic.estimate_of(run, truth)
    for own, final in zip(views(run, estimate), final_views(run, estimate), strict=True):
        np.testing.assert_allclose(own.T_camera_object, final.T_camera_object, atol=1e-12)


def test_what_may_not_be_there_counts_by_its_score_and_hides_nothing(small):
    """A doubtful object stands among the detections, ranked low; what is behind it keeps its box."""
    run, truth = small
    sure = synthetic.estimate_of(run, truth)
    doubtful = synthetic.estimate_of(run, truth, existence=lambda n, f: 0.3 if n == 1 else 1.0)
    alone = synthetic.estimate_of(run, truth, existence=lambda n, f: 0.0 if n == 1 else 1.0)
    assert pooled([record(run, truth, "doubtful", doubtful)])["map_50"] == pytest.approx(
        pooled([record(run, truth, "sure", sure)])["map_50"]
    )
    for with_it, without in zip(views(run, doubtful, least=0.05), views(run, alone, least=0.05), strict=True):
        boxes = [b for b in with_it.boxes() if b[1] > 0.5]
        assert boxes == without.boxes()
    assert all(len(view.objects) < 3 for view in views(run, doubtful))


def test_a_coarse_silhouette_has_nearly_the_same_box(small):
    """Within a step on each side, and on the whole neither larger nor to one side."""
    run, truth = small
    objects, differences = from_truth(run, truth), []
    for f, frame in enumerate(run.frames[:6]):
        for n in range(3):
            only = run.catalogue, objects.class_id[[n], f], objects.T_camera_object[[n], f], frame.camera
            (fine,), (coarse,) = silhouettes(*only), silhouettes(*only, step=3)
            differences.append(np.array(coarse.box) - fine.box)
            assert coarse.pixels == pytest.approx(fine.pixels, rel=0.1)
    assert np.abs(differences).max() <= 4
    assert np.abs(np.mean(differences, axis=0)).max() < 0.7


def test_the_truths_own_boxes_come_before_drawn_ones(small):
    """What hides an object without being in the truth itself is in the truth's boxes alone."""
    run, truth = small
    objects = from_truth(run, truth)
    drawn = b.true_boxes(run, truth, objects)
    thing = truth.objects[1]
    narrow = np.array(thing.visible_box)
    narrow[3] = [50.0, 40.0, 6.0, 5.0]
    marked = type(truth)((truth.objects[0], type(thing)(**{**vars(thing), "visible_box": narrow}), truth.objects[2]),
                         truth.T_world_camera)  # fmt: skip
    known = b.true_boxes(run, marked, objects)
    differs = (drawn.box != known.box).any(axis=1)
    assert known.frame[differs].tolist() == [3]
    assert known.object[differs].tolist() == [1]
    assert known.box[differs].tolist() == [[50.0, 40.0, 6.0, 5.0]]


def test_a_hidden_object_is_a_region_to_ignore(small):
    run, truth = small
    objects = from_truth(run, truth)
    objects.visible[1, 3] = False
    found = b.true_boxes(run, truth, objects)
    (row,) = np.flatnonzero(found.ignore)
    assert (found.frame[row], found.object[row]) == (3, 1)
    whole = silhouettes(run.catalogue, objects.class_id[:, 3], objects.T_camera_object[:, 3], run.frames[3].camera)[1]
    assert found.box[row].tolist() == list(whole.box)
