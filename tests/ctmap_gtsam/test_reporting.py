"""The report is one page that needs nothing else, and the overlays are where the objects are."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from ctmap_gtsam.evaluation import compare
from ctmap_gtsam.evaluation.outcome import Outcome
from ctmap_gtsam.reporting import plot, tables
from ctmap_gtsam.reporting.colours import CLASSES, class_colours
from ctmap_gtsam.reporting.report import headline, render, shown_methods, telling_frames
from sequences.bop import load_run, load_truth
from sequences.rendering.scene import render_scene
from tests.ctmap_gtsam import synthetic

VOID = {"meta", "img", "br", "link", "hr", "input", "path", "use", "rect"}


def with_diagnostics(estimate):
    """As the particle filter says how it did; the first keyframe has no belief yet."""
    shape = estimate.existence.shape
    tables = {
        "effective_sample_size": np.full(shape, 40.0).tolist(),
        "class_entropy": np.full(shape, 0.1).tolist(),
        "hypotheses_scored": np.full(shape, 900).tolist(),
    }
    for name in ("effective_sample_size", "class_entropy"):
        for row in tables[name]:
            row[0] = None
    return replace(estimate, meta={**estimate.meta, "diagnostics": {"hypotheses_scored": 900, "objects": tables}})


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    run = load_run(synthetic.write_run(tmp_path_factory.mktemp("run") / "small", visits=2))
    return run, load_truth(run)


@pytest.fixture(scope="module")
def outcomes(small):
    run, truth = small
    wrong = synthetic.estimate_of(
        run, truth, disturb=synthetic.shifted(0.004), class_of=lambda n, f: 9 if n == 0 and f < 5 else None
    )
    stages = {"filter-ct: images": 1.0, "filter-ct: objects": 2.0, "filter-ct": 3.2}
    return {
        "detector": Outcome("ok", 0.0),
        "icp": Outcome("skipped", reason="Open3D can't be loaded.", remedy="Install libgl1 & <libgomp1>."),
        "filter-ct": Outcome("ok", 3.25, with_diagnostics(wrong), stages=stages),
        "smooth-ct": Outcome("ok", 12.5, synthetic.estimate_of(run, truth)),
    }


def page_of(run, outcomes):
    maps = {name: o.estimate for name, o in outcomes.items() if o.estimate is not None}
    comparison = compare(run, maps, detector="detector" in outcomes)
    return render(run, comparison, outcomes, seed=7, versions={"numpy": "2"})


class Balance(HTMLParser):
    """Every element that is opened is closed, in order."""

    def __init__(self):
        super().__init__()
        self.open, self.text = [], []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def page(small, outcomes):
    return page_of(small[0], outcomes)


def test_the_page_is_well_formed_and_needs_no_network(page):
    parser = Balance()
    parser.feed(page)
    assert parser.open == []
    references = re.findall(r'(?:src|href)="([^"]*)"', page) + re.findall(r"url\(([^)]*)\)", page)
    assert references
    assert all(r.startswith(("data:", "#")) for r in references)
    assert "<script" not in page


def test_the_page_says_what_was_compared(page):
    parser = Balance()
    parser.feed(page)
    text = " ".join(" ".join(parser.text).split())
    for words in ("detector", "filter-ct", "smooth-ct", "12.5", "carton#1", "clay brick", "What hindsight changed"):
        assert words in text, words
    assert "skipped: Open3D can't be loaded. Install libgl1 & <libgomp1>." in text
    assert "nan" not in re.findall(r"[a-z]+", text.lower())
    assert "smooth-ct calls objects what they are in 100 % of the views" in text


def test_the_second_table_has_a_row_for_all_that_ran(small, outcomes, page):
    comparison = compare(small[0], {n: o.estimate for n, o in outcomes.items() if o.estimate is not None})
    columns = tables.known_columns(comparison, tables.MORE_COLUMNS)
    rows = {row.name: row.cells for row in tables.more_rows(comparison, outcomes, columns)}
    assert list(rows) == ["detector", "filter-ct", "smooth-ct"]
    auc = [c.key for c in columns].index("adds_auc")
    assert rows["smooth-ct"][auc] == tables.Cell("100.0", best=True)
    assert not rows["filter-ct"][auc].best
    assert rows["detector"][auc].text == tables.NOTHING
    assert rows["detector"][-1].text != tables.NOTHING  # a log score it has
    assert all(f"<b>{column.title}</b>" in page for column in columns)
    assert "moves_recall" not in [c.key for c in columns]  # nothing was moved


def test_the_same_comparison_gives_the_same_page(small, outcomes, page):
    assert page_of(small[0], outcomes) == page


def test_pictures_are_images_of_the_run(page):
    found = re.findall(r"data:image/jpeg;base64,([A-Za-z0-9+/=]+)", page)
    assert len(found) == 6
    for data in found:
        image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (120, 160, 3)


@pytest.mark.parametrize("kept", [["detector"], ["icp"], ["filter-ct"], ["smooth-ct", "detector"], []])
def test_any_selection_of_methods_makes_a_page(small, outcomes, kept):
    Balance().feed(page_of(small[0], {name: outcomes[name] for name in outcomes if name in kept}))


def test_an_empty_map_makes_a_page(small, outcomes):
    run, truth = small
    empty = synthetic.unplaced(synthetic.estimate_of(run, truth), [0, 1, 2])
    page_of(run, {**outcomes, "smooth-ct": Outcome("ok", 1.0, empty)})
    page_of(run, {"filter-ct": Outcome("ok", 1.0, empty), "smooth-ct": Outcome("ok", 1.0, empty)})


def test_a_run_without_truth_makes_a_page(small, outcomes, tmp_path):
    path = synthetic.write_run(tmp_path / "untrue", visits=2)
    for file in path.glob("test/*/scene_gt*.json"):
        file.unlink()
    page = page_of(load_run(path), outcomes)
    assert "methods are held to each other" in page
    assert "How far the maps are apart" in page
    assert "MSSD" not in page


def test_overlays_paint_the_objects_and_nothing_else(small):
    run, truth = small
    frame = run.frames[2]
    estimate = synthetic.estimate_of(run, truth)
    image = plot.overlay(run, frame, estimate.at(frame.time_ns, frame.T_world_camera), labels=False)
    items = [(run.catalogue[t.obj_id].mesh, frame.T_camera_world @ t.T_world_object[2]) for t in truth.objects]
    scene = render_scene(items, frame.camera)
    untouched = cv2.dilate((scene.item >= 0).astype(np.uint8), np.ones((11, 11))) == 0
    np.testing.assert_array_equal(image[untouched], frame.read_colour()[untouched])
    inner = cv2.erode((scene.item == 1).astype(np.uint8), np.ones((7, 7))) > 0
    painted = image[inner].mean(axis=0)
    colour = np.array(class_colours(run.catalogue)[5], float)
    assert np.dot(painted, colour) / np.linalg.norm(painted) / np.linalg.norm(colour) > 0.95


def test_an_empty_map_leaves_the_picture(small):
    run, truth = small
    frame = run.frames[0]
    empty = synthetic.unplaced(synthetic.estimate_of(run, truth), [0, 1, 2])
    np.testing.assert_array_equal(plot.overlay(run, frame, empty.at(frame.time_ns)), frame.read_colour())


def test_an_object_behind_something_is_faint(small):
    """Moved away from the camera, behind the surface that was measured, the brick hardly colours the picture."""
    run, truth = small
    frame = run.frames[2]

    def strength(offset):
        away = frame.T_world_camera[:3, 2] * offset

        def moved(n, f, T):
            out = T.copy()
            out[:3, 3] += away
            return out

        only = synthetic.unplaced(synthetic.estimate_of(run, truth, disturb=moved), [0, 2])
        image = plot.overlay(run, frame, only.at(frame.time_ns, frame.T_world_camera), labels=False)
        scene = render_scene([(run.catalogue[5].mesh, frame.T_camera_world @ only.pose[0, 2])], frame.camera)
        inner = cv2.erode((scene.item == 0).astype(np.uint8), np.ones((7, 7))) > 0
        return np.abs(image[inner].astype(float) - frame.read_colour()[inner]).mean()

    assert strength(0.05) < 0.5 * strength(0.0)


def test_colours_of_neighbouring_classes_differ():
    assert len(set(CLASSES)) == len(CLASSES)


def test_the_best_is_marked_among_methods_with_poses(small, outcomes):
    run, _ = small
    comparison = compare(run, {n: o.estimate for n, o in outcomes.items() if o.estimate is not None})
    columns = tables.known_columns(comparison)
    rows = {row.name: row for row in tables.method_rows(comparison, outcomes, columns)}
    mssd = [c.key for c in columns].index("mssd_mm_median")
    assert rows["smooth-ct"].cells[mssd].best
    assert not rows["filter-ct"].cells[mssd].best
    assert not any(cell.best for cell in rows["detector"].cells)
    assert rows["filter-ct"].cells[mssd].text == "4.0"


def test_changes_are_told_in_words(small, outcomes):
    run, _ = small
    comparison = compare(run, {n: o.estimate for n, o in outcomes.items() if o.estimate is not None})
    first, second, _ = tables.changes(comparison, comparison.agreement["filter-ct"])
    assert first.changed
    assert first.before == "5 of 16 frames differ: crate (5); settles at frame 5"
    assert not second.changed


def test_telling_frames_are_apart_and_hold_the_difference(small, outcomes):
    run, _ = small
    comparison = compare(run, {n: o.estimate for n, o in outcomes.items() if o.estimate is not None})
    frames = telling_frames(comparison, comparison.agreement["filter-ct"])
    assert frames == sorted(set(frames))
    assert len(frames) == 3
    assert frames[0] < 5
    assert frames[-1] == len(run.frames) - 1


def test_the_pair_shown_is_filter_and_smoother(outcomes):
    assert shown_methods(outcomes) == ["filter-ct", "smooth-ct"]
    assert shown_methods({"smooth-t": outcomes["smooth-ct"], "detector": outcomes["detector"]}) == ["smooth-t"]
    assert shown_methods({"detector": outcomes["detector"]}) == []


def test_figures_draw_the_objects_asked_for(small, outcomes):
    run, _ = small
    comparison = compare(run, {n: o.estimate for n, o in outcomes.items() if o.estimate is not None})
    one = comparison.labels[-1:]
    for draw in (plot.error_over_time, plot.belief_over_time):
        assert len(draw(comparison, ["smooth-ct"]).axes) == len(comparison.labels) > 1
        (panel,) = draw(comparison, ["smooth-ct"], objects=one).axes
        assert panel.get_title(loc="left") == one[0].replace("_", " ")


def test_how_the_filter_did_is_drawn_where_it_says_so(small, outcomes, page):
    figure = plot.filter_over_time(outcomes["filter-ct"].estimate)
    assert [len(ax.lines) for ax in figure.axes] == [3 + 1] * 3  # an object each, and where the second visit begins
    assert plot.filter_over_time(outcomes["smooth-ct"].estimate) is None
    assert "How the filter did" in page
    without = {name: o for name, o in outcomes.items() if name != "filter-ct"}
    assert "How the filter did" not in page_of(small[0], without)


def test_the_time_is_told_by_stage_and_part(outcomes, page):
    assert tables.stage_rows(outcomes) == [("filter-ct", "filter-ct 3.2 (images 1.0, objects 2.0)")]
    assert "images 1.0, objects 2.0" in page


def test_figures_are_the_same_bytes_twice(small, outcomes):
    run, _ = small
    comparison = compare(run, {n: o.estimate for n, o in outcomes.items() if o.estimate is not None})
    for error in plot.ERRORS:
        figures = [plot.svg(plot.error_over_time(comparison, ["filter-ct", "smooth-ct"], error)) for _ in range(2)]
        assert figures[0] == figures[1]
    assert headline(comparison, ["filter-ct"]).startswith("filter-ct")
