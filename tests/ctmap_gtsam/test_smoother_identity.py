"""Laws of which objects are one over the whole run."""

from itertools import permutations

import numpy as np
import pytest

from ctmap_gtsam.smoothing.identity import duplicates, join_moved, merge_duplicates
from tests.ctmap_gtsam.things import EMPTY, HERE, MODEL, RECORDING, SEEN, THERE, stays, thing


def test_of_two_in_one_place_the_one_with_more_evidence_stays_in_any_order():
    more, less, other = stays(3, HERE, range(8)), stays(1, HERE, range(3)), stays(2, THERE, range(8))
    for order in permutations((more, less, other)):
        things = {t.object_id: t for t in order}
        assert duplicates(things, MODEL) == {1: 3}
        assert sorted(merge_duplicates(things, RECORDING, MODEL)) == [2, 3]


def test_what_are_in_one_place_at_different_times_are_two():
    first, second = stays(1, HERE, range(4)), stays(2, HERE, range(4, 8))
    assert duplicates({1: first, 2: second}, MODEL) == {}


@pytest.fixture
def moved():
    """A mug that was moved, was begun anew at its new place, and was found to be the old one in the end."""
    old = thing(1, *((k, HERE, SEEN) for k in range(4)), (4, HERE, EMPTY), (5, HERE, EMPTY), (7, THERE, SEEN))
    return {1: old, 2: stays(2, THERE, (4, 5, 6, 7))}


def test_of_a_duplicate_its_life_elsewhere_is_kept_whichever_has_more_evidence(moved):
    assert duplicates(moved, MODEL) == {2: 1}
    parts = merge_duplicates(moved, RECORDING, MODEL)
    assert parts[1].keyframes == (0, 1, 2, 3, 4, 5)
    assert sorted(parts[1].boxes) == [0, 1, 2, 3]
    assert parts[2] is moved[2]


def test_and_is_joined_to_what_it_became(moved):
    joined = join_moved(merge_duplicates(moved, RECORDING, MODEL), RECORDING, MODEL)
    assert sorted(joined) == [1]
    assert joined[1].keyframes == tuple(range(8))
    assert sorted(joined[1].boxes) == list(range(8))
    assert joined[1].posteriors[0].moved[3] > 0.99
    assert (np.delete(joined[1].posteriors[0].moved, 3) < 0.01).all()
