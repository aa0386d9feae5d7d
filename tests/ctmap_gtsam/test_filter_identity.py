"""Laws of which tracks are one object, as far as the past tells."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.filtering.belief import ClassBelief
from ctmap_gtsam.filtering.identity import as_moved, at_place, moved_to, twin
from ctmap_gtsam.filtering.particles import Particles
from ctmap_gtsam.filtering.reporting import Reported
from sequences import se3
from tests.ctmap_gtsam.beliefs import belief_of
from tests.ctmap_gtsam.scenes import model_of

MODEL = model_of("mug", "soup_can")
MUG = np.array([0.9, 0.1])


@dataclass
class Times:
    """What `moved_to` reads of a belief."""

    first_ns: int
    present_ns: int


def report(x, existence=1.0, classes=(0.9, 0.1)):
    T = se3.make(np.eye(3), np.array([x, 0.0, 0.0]))
    best = int(np.argmax(classes))
    modes = ((best, 0.0, T, np.eye(6), np.zeros((6, 0))),)
    return Reported(np.array(classes), 10.0, existence, 0.0, True, modes)


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
    known = {i: report.class_probability for i, report in gone.items()}
    found = moved_to(beliefs, gone | there, known, MODEL)
    assert {i: j for i, (j, _) in found.items()} == {1: 4, 2: 3}
    assert all(same > 0.8 for _, same in found.values())
    reordered = moved_to(dict(reversed(beliefs.items())), dict(reversed((gone | there).items())), known, MODEL)
    assert reordered == found


def test_what_is_gone_is_what_it_was_when_it_was_last_there():
    """What it would be if it were there now, hidden elsewhere, is no class that it had."""
    beliefs = {1: Times(0, 50), 4: Times(70, 90)}
    gone, there = report(0.0, 0.1, (0.0, 1.0)), report(0.7, 1.0, (0.9, 0.1))
    assert moved_to(beliefs, {1: gone, 4: there}, {1: MUG}, MODEL)[1] == (4, pytest.approx(0.82))
    assert moved_to(beliefs, {1: gone, 4: there}, {1: 1.0 - MUG}, MODEL) == {}


def test_what_never_was_there_has_not_moved_nor_has_what_still_is():
    beliefs = {1: Times(0, 50), 4: Times(70, 90)}
    assert moved_to(beliefs, {1: report(0.0, 0.1), 4: report(0.7)}, {4: MUG}, MODEL) == {}
    assert moved_to(beliefs, {1: report(0.0, 0.9), 4: report(0.7)}, {1: MUG, 4: MUG}, MODEL) == {}
    # the other was there while this one was still seen
    early = {1: Times(0, 50), 4: Times(40, 90)}
    assert moved_to(early, {1: report(0.0, 0.1), 4: report(0.7)}, {1: MUG, 4: MUG}, MODEL) == {}


def test_what_cannot_be_moved_is_not_found_elsewhere():
    model = model_of("shelf", "mug")
    assert [shape.source.movable for shape in model.shapes].count(False) == 1
    beliefs = {1: Times(0, 50), 4: Times(70, 90)}
    for shape in model.shapes:
        classes = (0.9, 0.1) if shape.index == 0 else (0.1, 0.9)
        known = {1: np.array(classes)}
        found = moved_to(beliefs, {1: report(0.0, 0.1, classes), 4: report(0.7, 1.0, classes)}, known, model)
        assert bool(found) == shape.source.movable


def believed(object_id, evidence):
    particles = Particles(np.eye(4)[None], np.zeros(1))
    classes = tuple(ClassBelief(particles, float(nats)) for nats in evidence)
    return belief_of(classes, object_id=object_id, first_ns=10 * object_id)


@given(st.floats(0.0, 1.0), st.floats(-50.0, 50.0))
def test_what_was_known_of_a_thing_that_seems_to_be_found_again_counts_as_far_as_it_may_be_another(old, found):
    """Ten to one at most against what the new place says, however sure the old one was."""
    gone, there = believed(1, (0.0, 0.0)), believed(2, (found, 0.0))
    joined = as_moved(gone, there, np.array([old, 1.0 - old]), MODEL, ())
    assert (joined.object_id, joined.first_ns) == (1, gone.first_ns)
    before, after = (float(np.subtract(*b.class_log_evidence(MODEL))) for b in (there, joined))
    assert abs(after - before) <= np.log(20.0)
    assert np.sign(after - before) == np.sign(old - 0.5) or abs(old - 0.5) < 1e-9
    assert after - before >= 1.0 or old < 0.95
