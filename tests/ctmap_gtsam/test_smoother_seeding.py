"""Laws of what the smoother begins with: hypotheses of the forward pass, of what is there, was taken away or joined."""

from dataclasses import replace

import numpy as np
import pytest

from ctmap_gtsam.building import Tables, build_estimate
from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.seeding import believed, seeds
from sequences import se3
from tests.ctmap_gtsam.scenes import classes, config_of, small_run

CONFIG = config_of()
MODEL = Model(classes("mug", "bowl", "banana"), CONFIG)
NAMES = [s.source.name for s in MODEL.shapes]
HERE, THERE = (se3.make(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0))
KEYFRAMES = 6


@pytest.fixture(scope="module")
def run():
    return replace(small_run()[0], catalogue=MODEL.catalogue)


def forward(run, *stories):
    """An estimate of things by their stories: (class or classes, pose, existence) a keyframe; None for no belief."""
    tables = Tables(len(stories), KEYFRAMES, len(NAMES))
    for row, story in enumerate(stories):
        for k, said in enumerate(story):
            if said is None:
                continue
            names, T, existence = said
            tables.existence[row, k], tables.class_probability[row, k] = existence, 0.0
            for name, share in ({names: 1.0} if isinstance(names, str) else names).items():
                shape = MODEL.shapes[NAMES.index(name)]
                tables.class_probability[row, k, shape.index] = share
                tables.mode(row, k, shape.source.obj_id, 0.0, shape.to_object(T), np.eye(6), np.zeros((6, 0)))
    cameras = np.tile(np.eye(4), (KEYFRAMES, 1, 1))
    covariance = np.zeros((KEYFRAMES, 6, 6))
    keyframes = np.arange(KEYFRAMES, dtype=np.int64)
    ids = [10 + row for row in range(len(stories))]
    return build_estimate(run, CONFIG, "filter-ct", keyframes, ids, tables, cameras, covariance, {})


def test_what_is_gone_has_the_class_and_pose_that_it_had(run):
    """What it would be if it were there after all, hidden elsewhere, is no class that it had."""
    gone = [("mug", HERE, 0.9)] * 3 + [("banana", THERE, 0.0)] * 3
    seed = seeds(forward(run, gone), MODEL)[10]
    assert NAMES[seed.best_class] == "mug"
    for k in range(KEYFRAMES):
        np.testing.assert_allclose(seed.expected(k), HERE, atol=1e-12)
    now = believed(forward(run, gone), MODEL, KEYFRAMES - 1)[10]
    assert now.class_probability[NAMES.index("mug")] == 1.0


def test_a_class_found_late_is_the_class(run):
    found = seeds(forward(run, [("mug", HERE, 0.9)] * 3 + [("bowl", HERE, 0.9)] * 3), MODEL)
    assert [NAMES[seed.best_class] for seed in found.values()] == ["bowl"]


TWO_VISITS = np.array([0, 0, 0, 1, 1, 1])


def test_what_is_of_another_class_in_a_later_visit_may_be_another_thing(run):
    mug, bowl, gone = ("mug", HERE, 0.9), ("bowl", HERE, 0.9), ("bowl", HERE, 0.1)
    found = seeds(replace(forward(run, [mug] * 3 + [bowl] * 3), keyframe_visit=TWO_VISITS), MODEL)
    assert {i: NAMES[seed.best_class] for i, seed in found.items()} == {10: "mug", 11: "bowl"}
    assert found[10].there.tolist() == [True] * 3 + [False] * 3
    assert (found[10].there ^ found[11].there).all()
    # what it would be if it were there is nothing that came
    vanished = replace(forward(run, [mug] * 3 + [gone] * 3), keyframe_visit=TWO_VISITS)
    assert sorted(seeds(vanished, MODEL)) == [10]


@pytest.mark.parametrize(("moved_m", "things"), [(0.0, 1), (0.05, 1), (1.0, 2)])
def test_what_may_be_one_class_in_two_visits_is_one_thing_if_it_is_nearby(run, moved_m, things):
    """Two of one place would take each other's boxes and pixels."""
    there = HERE @ se3.make(np.eye(3), np.array([moved_m, 0.0, 0.0]))
    story = [({"mug": 0.95, "bowl": 0.05}, HERE, 0.9)] * 3 + [({"bowl": 0.97, "mug": 0.03}, there, 0.9)] * 3
    found = seeds(replace(forward(run, story), keyframe_visit=TWO_VISITS), MODEL)
    assert len(found) == things
    assert sum(seed.there for seed in found.values()).tolist() == [1] * KEYFRAMES


def test_what_was_another_thing_before_it_was_let_go_begins_anew(run):
    """A mug was taken away and a bowl put in its place, which the filter came to know as one that it knew."""
    mug, bowl = [("mug", HERE, 0.9)] * 3, [("bowl", HERE, 0.9)]
    stories = [*mug, *bowl, None, None], [None] * 3 + [("bowl", THERE, 0.9)] + [("bowl", HERE, 0.9)] * 2
    found = seeds(replace(forward(run, *stories), keyframe_visit=TWO_VISITS), MODEL)
    assert {i: NAMES[seed.best_class] for i, seed in found.items()} == {10: "mug", 11: "bowl"}
    assert found[10].there.tolist() == [True] * 3 + [False] * 3


def test_what_was_given_up_begins_anew_where_nothing_else_was(run):
    joined = [("mug", HERE, 0.9)] * 3 + [None] * 3
    apart = [None] * 3 + [("mug", THERE, 0.9)] * 3
    twin = [("bowl", HERE, 0.9)] * KEYFRAMES
    never = [("mug", HERE, 0.4)] * 3 + [None] * 3
    assert sorted(seeds(forward(run, joined, apart), MODEL)) == [10, 11]
    assert sorted(seeds(forward(run, joined, twin), MODEL)) == [11]
    assert sorted(seeds(forward(run, never, apart), MODEL)) == [11]


def test_what_was_found_again_was_there_from_its_own_beginning_on(run):
    """The filter holds an object to its old place until that is seen empty; the new one was begun before that."""
    old = [("mug", HERE, 0.9)] * 4 + [("mug", THERE, 0.9)] * 2
    found = [None] * 2 + [("mug", THERE, 0.9)] * 2 + [None] * 2
    for stories in ((old, found), (found, old)):
        (seed,) = seeds(forward(run, *stories), MODEL).values()
        assert seed.object_id == 10 + stories.index(old)
        for k in range(KEYFRAMES):
            np.testing.assert_allclose(seed.expected(k), HERE if k < 2 else THERE, atol=1e-12)


def test_what_was_found_again_by_way_of_another_is_the_first(run):
    old = [("mug", HERE, 0.9)] * 5 + [("mug", THERE, 0.9)]
    second = [None] * 3 + [("mug", THERE, 0.9)] * 2 + [None]
    third = [None] + [("mug", THERE, 0.9)] * 2 + [None] * 3
    (seed,) = seeds(forward(run, third, second, old), MODEL).values()
    assert seed.object_id == 12
    for k in range(KEYFRAMES):
        np.testing.assert_allclose(seed.expected(k), HERE if k < 1 else THERE, atol=1e-12)


def test_neighbours_in_the_first_round_are_those_that_were_there_then(run):
    seed = seeds(forward(run, [("mug", HERE, 0.9)] * 3 + [("mug", HERE, 0.1)] * 3), MODEL)[10]
    for k in range(KEYFRAMES):
        beside = seed.neighbour(k, 1.0, MODEL)
        assert (beside is not None) == (k < 3)
    assert seed.neighbour(0, 7.0, MODEL).claim == 7.0
