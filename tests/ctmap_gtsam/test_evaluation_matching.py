"""The one matching: hand-made cases, and what it must not depend on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.evaluation.matching import REACH_M, ObjectFrames, match, shapes_of
from sequences import se3
from tests.ctmap_gtsam import synthetic

SHAPES = shapes_of(synthetic.catalogue())
REACH = 0.5 * SHAPES[3].of.diameter_m


def objects(*paths, class_id=3, visible=None):
    """One object a path, (F, 3) positions; NaN where it is absent."""
    places = np.array(paths, dtype=float)
    absent = np.isnan(places[..., 0])
    poses = se3.make(np.eye(3), places)
    poses[absent] = np.nan
    classes = np.where(absent, -1, np.broadcast_to(class_id, absent.shape))
    seen = ~absent if visible is None else np.array(visible)
    return ObjectFrames(np.arange(1, len(places) + 1), classes, poses, seen)


def still(x, frames=4):
    return np.tile([x, 0.0, 1.0], (frames, 1))


GONE = np.full((4, 3), np.nan)


def test_each_object_is_matched_to_the_one_at_its_place():
    matching = match(objects(still(0), still(1)), objects(still(1.01), still(0.01)), SHAPES)
    assert matching.row.tolist() == [1, 0]
    assert matching.unmatched.tolist() == []


def test_what_is_out_of_reach_is_no_pair():
    matching = match(objects(still(0)), objects(still(REACH * 1.01)), SHAPES)
    assert matching.row.tolist() == [-1]
    assert matching.unmatched.tolist() == [0]
    assert match(objects(still(0)), objects(still(REACH * 0.99)), SHAPES).row.tolist() == [0]


def test_a_small_thing_in_a_large_ones_reach_is_not_the_large_one():
    """Seen for longer, the table would else take the estimate of the mug that stands on it."""
    small, *_, large = sorted(SHAPES, key=lambda c: SHAPES[c].of.diameter_m)
    between, frames = 0.9 * 0.5 * SHAPES[large].of.diameter_m, 20
    assert between > max(REACH_M, 0.5 * SHAPES[small].of.diameter_m)
    classes, seen = [[large] * frames, [small] * frames], [[True] * frames, [True] + [False] * (frames - 1)]
    truth = objects(still(0, frames), still(between, frames), class_id=classes, visible=seen)
    assert match(truth, objects(still(between, frames), class_id=small), SHAPES).row.tolist() == [-1, 0]


def test_a_wrong_class_at_the_right_place_is_matched():
    assert match(objects(still(0)), objects(still(0), class_id=5), SHAPES).row.tolist() == [0]


def test_an_object_that_is_never_in_the_map_is_not_a_false_one():
    matching = match(objects(still(0)), objects(GONE, still(0)), SHAPES)
    assert matching.row.tolist() == [1]
    assert matching.unmatched.tolist() == []


def test_one_object_of_the_map_serves_one_true_object():
    matching = match(objects(still(0), still(0.02)), objects(still(0.015)), SHAPES)
    assert matching.row.tolist() == [-1, 0]


def test_there_is_one_assignment_for_all_frames():
    """Identities that are swapped half-way aren't swapped back; the pairing that is near for longer wins."""
    crossing = np.concatenate([still(0)[:3], still(1)[:1]])
    other = np.concatenate([still(1)[:3], still(0)[:1]])
    assert match(objects(still(0), still(1)), objects(other, crossing), SHAPES).row.tolist() == [1, 0]


def test_hidden_frames_decide_nothing_but_ties():
    near_when_hidden = np.concatenate([still(0.5)[:2], still(0)[:2]])
    near_when_seen = np.concatenate([still(0.04)[:2], still(0.5)[:2]])
    truth = objects(still(0), visible=[[True, True, False, False]])
    assert match(truth, objects(near_when_hidden, near_when_seen), SHAPES).row.tolist() == [1]
    never_seen = objects(still(0), visible=[[False] * 4])
    assert match(never_seen, objects(still(0.01)), SHAPES).unmatched.tolist() == []


@pytest.mark.parametrize("nothing", [0, 1])
def test_an_empty_side_matches_nothing(nothing):
    empty = ObjectFrames(np.zeros(0, int), np.zeros((0, 4), int), np.zeros((0, 4, 4, 4)), np.zeros((0, 4), bool))
    sides = [objects(still(0)), objects(still(0))]
    sides[nothing] = empty
    matching = match(*sides, SHAPES)
    assert (matching.row < 0).all()
    assert len(matching.unmatched) == len(sides[1].name)


def take(some, order):
    return ObjectFrames(some.name[order], some.class_id[order], some.T_camera_object[order], some.visible[order])


@given(st.integers(0, 2**32 - 1), st.permutations(range(5)), st.permutations(range(4)))
def test_the_order_of_lists_changes_no_pair(seed, order, other):
    rng = np.random.default_rng(seed)
    reference = objects(*(rng.normal(size=(5, 4, 3)) * 0.05))
    candidates = objects(*(rng.normal(size=(4, 4, 3)) * 0.05))
    pairs = match(reference, candidates, SHAPES).row
    shuffled = match(take(reference, order), take(candidates, other), SHAPES).row
    assert [other[m] if m >= 0 else -1 for m in shuffled] == pairs[order].tolist()


@given(st.integers(0, 2**32 - 1))
def test_a_motion_of_everything_changes_no_pair(seed):
    rng = np.random.default_rng(seed)
    reference = objects(*(rng.normal(size=(3, 4, 3)) * 0.05))
    candidates = objects(*(rng.normal(size=(3, 4, 3)) * 0.05))
    T = se3.exp(rng.normal(size=6))
    moved = [ObjectFrames(o.name, o.class_id, T @ o.T_camera_object, o.visible) for o in (reference, candidates)]
    assert match(*moved, SHAPES).row.tolist() == match(reference, candidates, SHAPES).row.tolist()
