"""Laws of what else a pose may be."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.alternatives import Mode, Ways, elsewhere, exchanges, other_ways, ways_round
from sequences import se3
from tests.ctmap_gtsam.scenes import model_of, shape_named
from tests.ctmap_gtsam.things import EMPTY, HERE, MODEL, RECORDING, SEEN, THERE, stays, thing

BANANA = shape_named(model_of("banana"), "banana")
(TURN,) = se3.make(BANANA.near_symmetries, np.zeros((1, 3)))
COVARIANCE = np.diag(np.repeat([1e-4, 1e-6], 3))
POSE = se3.exp(np.array([0.3, -0.2, 1.0, 0.1, 0.2, 0.7]))
APART = se3.make(np.eye(3), np.array([0.3, 0.0, 0.0]))


def mode(share, T=POSE):
    return Mode(share, T, COVARIANCE)


def turned_by(lead):
    return Ways(TURN[None], np.array([lead]))


def total(own, others):
    return own.share + sum(m.share for m in others)


# --- ways round ---


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(-3.0, 3.0))
def test_what_depth_says_of_two_ways_round_goes_no_further_than_it_can_be_trusted(turned, apart, lead):
    """The odds of the other way are those of all views together, or those of their mean against the surface's error."""
    shares = np.array([1.0, turned, apart]) / (1.0 + turned + apart)
    others = (mode(shares[1], POSE @ TURN), mode(shares[2], POSE @ APART))
    own, found = ways_round(mode(shares[0]), others, BANANA, turned_by(lead), 0.3)
    assert total(own, found) == pytest.approx(1.0)
    by_pose = {m.T_world_centre.tobytes(): m.share for m in found}
    wrong = norm.cdf(-lead / 0.3)
    odds = by_pose[(POSE @ TURN).tobytes()] / own.share
    assert odds == pytest.approx(max(turned, min(wrong / norm.sf(-lead / 0.3), 0.98)))
    # what is no way round is as much less likely than the pose as before
    assert by_pose[(POSE @ APART).tobytes()] / own.share == pytest.approx(apart)


def test_a_way_that_the_keyframe_has_no_mode_of_is_the_pose_turned():
    own, (other,) = ways_round(mode(1.0), (), BANANA, turned_by(0.0), 0.3)
    assert (own.share, other.share) == (pytest.approx(0.5, abs=0.01), pytest.approx(0.5, abs=0.01))
    np.testing.assert_allclose(other.T_world_centre, POSE @ TURN)
    # as uncertain as the pose, and more: the two surfaces aren't just the same
    extra = np.diag(other.covariance) - np.diag(se3.adjoint(TURN) @ COVARIANCE @ se3.adjoint(TURN).T)
    assert (extra > 0.0).all()


def test_a_mode_of_a_view_that_is_turned_so_stands_for_its_way():
    near = mode(0.0, POSE @ TURN @ se3.exp(np.array([0.1, 0.0, 0.0, 0.004, 0.0, 0.0])))
    _, (other,) = ways_round(mode(1.0), (near,), BANANA, turned_by(0.0), 0.3)
    assert other == replace(near, share=other.share)
    assert other.share == pytest.approx(0.5, abs=0.01)


def test_a_way_of_which_no_view_knows_is_none():
    own, others = mode(0.7), (mode(0.3, POSE @ APART),)
    after, (turned, apart) = sorted_by_pose(*ways_round(own, others, BANANA, turned_by(np.inf), 0.3))
    assert (after.share, turned.share, apart.share) == (pytest.approx(0.7), 0.0, pytest.approx(0.3))


def sorted_by_pose(own, others):
    return own, sorted(others, key=lambda m: np.linalg.norm(m.T_world_centre - POSE @ TURN))


@pytest.mark.parametrize("repeats", [1, 3])
def test_the_lead_is_that_of_a_view_however_many_there_are(repeats):
    """Mugs stand on either end, here; the second way is ten nats behind in each view but one, which has it alone."""
    (upside_down,) = se3.make(MODEL.shapes[0].near_symmetries, np.zeros((1, 3)))
    looks = [(k, np.stack([HERE, HERE @ upside_down, THERE]), [SEEN, SEEN - 10.0, EMPTY]) for k in range(repeats)]
    looks.append((repeats, (HERE @ upside_down)[None], [SEEN]))
    mug = thing(1, *looks)
    assert other_ways(mug, 0, HERE, RECORDING, MODEL).lead == pytest.approx([10.0])
    assert other_ways(mug, 0, HERE @ upside_down, RECORDING, MODEL).lead[0] == pytest.approx(-10.0)
    assert other_ways(mug, 1, HERE, RECORDING, MODEL).lead == np.inf


@pytest.mark.parametrize("behind", [0.0, 0.4, 2.0])
def test_a_way_that_the_views_hardly_tell_apart_is_one_however_many_views_there_are(behind):
    """Half hidden, a thing may lie on its side, elsewhere: no near-symmetry of a mug's."""
    lying = HERE @ se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.03, 0.0, 0.0]))
    looks = [(k, np.stack([HERE, lying]), [SEEN, SEEN - behind]) for k in range(4)]
    ways = other_ways(thing(1, *looks), 0, HERE, RECORDING, MODEL)
    np.testing.assert_allclose((HERE @ ways.T_own_way)[-1], lying, atol=1e-9)
    assert ways.lead[-1] == pytest.approx(behind)
    own, others = ways_round(mode(0.9, HERE), (mode(0.1, lying),), MODEL.shapes[0], ways, 0.3)
    at_least = min(norm.cdf(-behind / 0.3) / norm.sf(-behind / 0.3), 0.98)
    (other,) = (m for m in others if m.T_world_centre is lying)
    assert other.share / own.share == pytest.approx(max(at_least, 1.0 / 9.0))


def test_a_way_that_most_views_have_not_kept_is_as_far_behind_as_they_can_tell():
    lying = HERE @ se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.03, 0.0, 0.0]))
    once = (0, np.stack([HERE, lying]), [SEEN, SEEN])
    few = other_ways(thing(1, once, *((k, HERE, SEEN) for k in (1, 2, 3))), 0, HERE, RECORDING, MODEL)
    assert few.lead[-1] == pytest.approx(0.75 * SEEN)
    beside = [HERE @ se3.exp(np.array([0.0, 0.0, 0.0, 0.01 * n, 0.0, 0.0])) for n in range(4)]
    full = [(k, np.stack(beside), SEEN - np.arange(4.0)) for k in (1, 2, 3)]
    assert other_ways(thing(1, once, *full), 0, HERE, RECORDING, MODEL).lead[-1] == pytest.approx(0.75 * 3.0)


# --- alike things ---


def exchanged(a, b):
    return exchanges({1: a, 2: b}, RECORDING, MODEL)


def test_two_alike_things_that_both_were_moved_may_be_either():
    """Nothing but their old places told them apart."""
    there, elsewhere_ = (se3.make(np.eye(3), np.array([x, 0.9, 0.8])) for x in (0.0, 0.6))
    looks = [
        [(k, a, SEEN) for k in range(4)] + [(k, b, SEEN) for k in range(4, 8)]
        for a, b in ((HERE, there), (THERE, elsewhere_))
    ]
    found = exchanged(thing(1, *looks[0]), thing(2, *looks[1]))
    (visit,) = found.in_place_of[1]  # they have their names from the other one
    assert found.at(1, visit) == {2: pytest.approx(0.5, abs=0.01)}
    assert found.at(2, visit) == {1: found.at(1, visit)[2]}


@pytest.mark.parametrize("chance", [0.0, 0.1, 0.5])
def test_who_stayed_was_handled_as_equation_3_says_or_exchanged_anyhow(chance):
    """Two independent causes: an odd number of exchanges is one of them without the other."""
    model = Model(MODEL.catalogue, replace(MODEL.config, smoother=replace(MODEL.config.smoother, exchange=chance)))
    pair = {1: stays(1, HERE, range(8)), 2: stays(2, THERE, range(8))}
    found = exchanges(pair, RECORDING, model)
    handled = 1.0 - MODEL.stay_probability(MODEL.shapes[0].source, RECORDING.time_s(4) - RECORDING.time_s(3))
    both = 0.5 * handled**2
    (visit,) = found.in_place_of[1]
    assert found.at(1, visit)[2] == pytest.approx(both * (1.0 - chance) + chance * (1.0 - both), abs=0.01)


def test_within_a_visit_nothing_is_exchanged():
    found = exchanged(stays(1, HERE, range(4)), stays(2, THERE, range(4)))
    assert found.at(1, 0) == found.at(2, 0) == {}


def test_no_order_of_things_matters():
    a, b = stays(1, HERE, range(8)), stays(2, THERE, range(8))
    assert exchanges({2: b, 1: a}, RECORDING, MODEL) == exchanged(a, b)


def test_what_does_not_exist_is_exchanged_with_nothing():
    assert exchanged(stays(1, HERE, range(8)), stays(2, THERE, range(8), EMPTY)).in_place_of == {}


@given(st.floats(0.01, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_reported_pose_stays_the_heavier_one(share, first, second):
    own, rest = mode(share), (mode(1.0 - share, POSE @ TURN),)
    places = {5: mode(1.0, HERE), 6: mode(1.0, THERE)}
    after, others = elsewhere(own, rest, {5: first, 6: second, 7: 0.3}, places)
    assert total(after, others) == pytest.approx(1.0)
    assert after.share >= max([m.share for m in others[1:]], default=0.0)
