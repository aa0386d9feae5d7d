"""Laws of which tracks are one object, as far as the past tells."""

from dataclasses import dataclass

import numpy as np

from ctmap_gtsam.filtering.belief import Reported
from ctmap_gtsam.filtering.identity import at_place, moved_to, twin
from sequences import se3
from tests.ctmap_gtsam.scenes import model_of

MODEL = model_of("mug", "soup_can")


@dataclass
class Times:
    """What `moved_to` reads of a belief."""

    first_ns: int
    present_ns: int


def report(x, existence=1.0, classes=(0.9, 0.1)):
    T = se3.make(np.eye(3), np.array([x, 0.0, 0.0]))
    best = int(np.argmax(classes))
    modes = ((best, 0.0, T, np.eye(6), np.zeros((6, 0))),)
    return Reported(np.array(classes), 10.0, existence, 0.0, True, modes, {})


def test_a_track_in_an_objects_place_is_that_object_whatever_its_class():
    known = {3: report(0.0), 7: report(0.3)}
    assert at_place(report(0.005), known, MODEL) == 3
    assert at_place(report(0.295, classes=(0.2, 0.8)), known, MODEL) == 7
    assert at_place(report(0.15), known, MODEL) is None
    assert at_place(report(0.0), {}, MODEL) is None


def test_two_of_one_class_in_one_place_are_one_and_of_two_classes_are_not():
    known = {3: report(0.0), 7: report(0.3, 0.2)}
    assert twin(report(0.005), known, MODEL) == 3
    assert twin(report(0.005, classes=(0.1, 0.9)), known, MODEL) is None
    assert twin(report(0.005, 0.2), known, MODEL) is None  # what may not exist is nobody's twin
    assert twin(report(0.3), known, MODEL) is None
    assert twin(report(0.15), known, MODEL) is None


def test_what_vanished_is_found_as_what_began_later_and_is_of_its_class():
    beliefs = {1: Times(0, 50), 2: Times(0, 50), 3: Times(60, 90), 4: Times(70, 90), 5: Times(10, 90)}
    gone = {1: report(0.0, 0.1), 2: report(0.2, 0.2, (0.1, 0.9))}
    there = {3: report(0.5, classes=(0.05, 0.95)), 4: report(0.7), 5: report(0.9)}
    surest = dict.fromkeys(beliefs, 1.0)
    found = moved_to(beliefs, gone | there, surest)
    assert {i: j for i, (j, _) in found.items()} == {1: 4, 2: 3}
    assert all(same > 0.8 for _, same in found.values())
    reordered = moved_to(dict(reversed(beliefs.items())), dict(reversed((gone | there).items())), surest)
    assert reordered == found


def test_what_never_was_there_has_not_moved_nor_has_what_still_is():
    beliefs = {1: Times(0, 50), 4: Times(70, 90)}
    assert moved_to(beliefs, {1: report(0.0, 0.1), 4: report(0.7)}, {1: 0.6, 4: 1.0}) == {}
    assert moved_to(beliefs, {1: report(0.0, 0.9), 4: report(0.7)}, {1: 1.0, 4: 1.0}) == {}
    # the other was there while this one was still seen
    early = {1: Times(0, 50), 4: Times(40, 90)}
    assert moved_to(early, {1: report(0.0, 0.1), 4: report(0.7)}, {1: 1.0, 4: 1.0}) == {}
