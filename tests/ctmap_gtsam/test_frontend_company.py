"""Laws of who was moved together: one fact counts once, and what stayed is none."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.company import Stand, company
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.smoothing.rounds import company_of
from sequences import se3
from tests.ctmap_gtsam.scenes import UP, config_of, model_of, shape_named, standing

NAMES = ("mug", "cereal_box", "soup_can", "shelf")
MODEL = model_of(*NAMES, config=config_of("context.relations.same_category.strength=0.0"))
MUG, BOX, CAN, SHELF = (shape_named(MODEL, n) for n in NAMES)
ALONE = float(np.log(MODEL.config.context.relations.category_weight))
"""what a moved thing is charged that suits the one partner it could have had not at all"""


def placed(**at):
    """Object -> stand: m, b, c, s by their letters, at (x, y, yaw)."""
    shapes = {"m": MUG, "b": BOX, "c": CAN, "s": SHELF}
    return {
        "mbcs".index(name[0]) + 4 * int(name[1:] or 0): Stand(shapes[name[0]].index, standing(shapes[name[0]], *where))
        for name, where in at.items()
    }


def carried(stands, *objects, by=(0.8, -0.3, 1.0)):
    """The same with some objects carried off together."""
    T = se3.make(se3.so3_exp(by[2] * UP), np.array([by[0], by[1], 0.0]))
    return {
        i: replace(s, T_world_centre=T @ s.T_world_centre) if i in objects else s for i, s in stands.items()
    }  # fmt: skip


def said(own, now, others, model=MODEL, up=UP):
    """What the context says (nats) of an object where it stands, by the relations to all others alone."""
    there = tuple(Neighbour(i, model.shapes[s.class_index], s.T_world_centre, 0.0) for i, s in now.items())
    around = Surroundings(there, (), company(now, others, up, model)).without(own)
    stand = now[own]
    alone = Surroundings(there, ()).without(own)
    shape, T = model.shapes[stand.class_index], stand.T_world_centre[None]
    return float((around.log_potential(model, shape, T) - alone.log_potential(model, shape, T))[0])


BEFORE = placed(m=(0.0, 0.0), b=(0.3, 0.1, 0.4), c=(-0.4, 0.2), s=(1.5, 1.5))
M, B, C, S = 0, 1, 2, 3


@pytest.mark.parametrize("visits", [1, 2, 5])
def test_who_stayed_says_nothing_however_many_and_however_often(visits):
    crowd = BEFORE | placed(**{f"c{n}": (0.15 * n, -0.5) for n in range(1, 10)})
    assert company(crowd, [crowd] * visits, UP, MODEL) == {}
    # nor do they to one that was moved alone
    now = carried(crowd, M)
    assert company(now, [crowd] * visits, UP, MODEL) == {}


def test_what_was_moved_together_gains_and_what_was_moved_apart_is_charged_for_it():
    together = carried(BEFORE, M, B)
    for own in (M, B):
        assert 3.0 < said(own, together, [BEFORE]) < 10.0
    assert said(C, together, [BEFORE]) == 0.0
    apart = carried(carried(BEFORE, M), B, by=(-0.9, -1.0, 2.0))
    for own in (M, B):
        assert ALONE - 1e-9 < said(own, apart, [BEFORE]) < ALONE + 0.1


def test_ten_neighbours_are_one_fact():
    crowd = BEFORE | placed(**{f"c{n}": (0.15 * n, -0.5) for n in range(1, 10)})
    everyone = [i for i in crowd if i != S]
    now = carried(crowd, *everyone)
    one = said(M, carried(BEFORE, M, B), [BEFORE])
    found = company(now, [crowd], UP, MODEL)
    for own in everyone:
        assert said(own, now, [crowd]) <= one
    # nobody is the partner of two
    assert all(found[p.object_id].object_id == i for i, p in found.items())


def test_what_stood_so_in_many_visits_untouched_is_one_observation():
    now = carried(BEFORE, M, B)
    once, often = (company(now, [BEFORE] * n, UP, MODEL)[M].relation for n in (1, 6))
    assert often.freedom == once.freedom
    np.testing.assert_array_equal(often.precision, once.precision)
    elsewhere = carried(BEFORE, M, B, by=(-0.7, 0.6, 2.0))
    twice = company(now, [BEFORE, elsewhere], UP, MODEL)[M].relation
    assert twice.freedom == once.freedom + 1


def test_where_it_was_moved_to_it_stays_one_fact():
    """The visits in which the pair stands as it does now are no evidence for it, and don't take away what was."""
    now = carried(BEFORE, M, B)
    assert said(M, now, [BEFORE, now, now]) == pytest.approx(said(M, now, [BEFORE]))


def test_what_cannot_be_moved_has_no_partner():
    now = carried(BEFORE, M, S)
    assert company(now, [BEFORE], UP, MODEL) == {}


def test_it_is_silent_without_context_without_its_weight_and_without_up():
    now = carried(BEFORE, M, B)
    assert company(now, [BEFORE], UP, MODEL)
    assert company(now, [BEFORE], None, MODEL) == {}
    assert company(now, [BEFORE], UP, model_of(*NAMES, context=False)) == {}
    off = model_of(*NAMES, config=config_of("context.relations.category_weight=1.0"))
    assert company(now, [BEFORE], UP, off) == {}


def test_another_class_than_the_one_that_was_there_says_nothing():
    now = carried(BEFORE, M, B)
    now[M] = replace(now[M], class_index=CAN.index)
    assert company(now, [BEFORE], UP, MODEL) == {}
    partner = company(carried(BEFORE, M, B), [BEFORE], UP, MODEL)[M]
    assert partner.log_ratio(CAN, now[M].T_world_centre, BOX, now[B].T_world_centre) == 0.0


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31))
def test_order_and_the_worlds_frame_change_nothing(seed):
    rng = np.random.default_rng(seed)
    by = (*rng.uniform(0.5, 1.0, 2), rng.uniform(-3, 3))
    shaken = {
        i: replace(s, T_world_centre=se3.retract(s.T_world_centre, rng.normal(size=6) * 0.02))
        for i, s in BEFORE.items()
    }
    now = carried(shaken, M, B, C, by=by)
    G = se3.exp(rng.normal(size=6))

    def moved(stands):
        return {i: replace(s, T_world_centre=G @ s.T_world_centre) for i, s in reversed(stands.items())}

    plain = company(now, [BEFORE, shaken], UP, MODEL)
    there = company(moved(now), [moved(BEFORE), moved(shaken)], G[:3, :3] @ UP, MODEL)
    assert {i: p.object_id for i, p in there.items()} == {i: p.object_id for i, p in plain.items()}
    for i, p in plain.items():
        own, other = (MODEL.shapes[c] for c in p.classes)
        here = p.log_ratio(own, now[i].T_world_centre, other, now[p.object_id].T_world_centre)
        T = (G @ now[j].T_world_centre for j in (i, p.object_id))
        assert there[i].log_ratio(own, next(T), other, next(T)) == pytest.approx(float(here), abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.floats(-np.pi, np.pi))
def test_a_turn_that_nobody_sees_changes_nothing(turn):
    now = carried(BEFORE, M, C)
    about = CAN.symmetry.free_axes[:, 0]
    spun = now | {
        C: replace(now[C], T_world_centre=se3.retract(now[C].T_world_centre, turn * about / np.linalg.norm(about[:3])))
    }
    assert said(M, spun, [BEFORE]) == pytest.approx(said(M, now, [BEFORE]), abs=1e-6)


class Mapped:
    """What `company_of` reads of a thing of the map."""

    def __init__(self, stands):
        self.poses = dict.fromkeys(stands)
        self._stands = stands
        self.best_class = next(iter(stands.values())).class_index

    def present_pose(self, keyframe):
        return self._stands[keyframe].T_world_centre


def test_a_visit_learns_nothing_from_itself():
    """However the poses of a visit change, what it is held to is of the others."""
    rng = np.random.default_rng(0)
    visits = [0, 0, 1, 1, 2]
    by_visit = [BEFORE, carried(BEFORE, M, B), carried(BEFORE, M, B, by=(-0.7, 0.6, 2.0))]

    def companies(stands):
        things = {i: Mapped({k: stands[v][i] for k, v in enumerate(visits)}) for i in BEFORE}
        return company_of(things, visits, UP, MODEL)

    plain = companies(by_visit)
    assert {v: sorted(c) for v, c in plain.items()} == {v: [M, B] for v in range(3)}
    for visit in range(3):
        changed = list(by_visit)
        changed[visit] = {
            i: replace(s, T_world_centre=se3.retract(s.T_world_centre, rng.normal(size=6) * 0.01))
            for i, s in by_visit[visit].items()
        }
        other = companies(changed)
        for name in ("T_a_b", "precision", "log_background"):
            same = getattr(plain[visit][M].relation, name), getattr(other[visit][M].relation, name)
            np.testing.assert_array_equal(*same)
        elsewhere = next(v for v in range(3) if v != visit)
        assert (other[elsewhere][M].relation.T_a_b != plain[elsewhere][M].relation.T_a_b).any()
