"""Laws of who was moved together: one fact counts once, and what stayed is none."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.filtering.filter import Forward
from ctmap_gtsam.filtering.reporting import Reported
from ctmap_gtsam.frontend.company import Stand, company
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.smoothing.graph import Camera, Measured, build
from ctmap_gtsam.smoothing.rounds import company_of
from factors.context import context_log_ratio
from sequences import se3
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.scenes import UP, config_of, frame_of, looking, model_of, run_of, shape_named, standing

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
    for off in ("context.relations.category_weight=1.0", "context.moved_m=1000.0"):
        assert company(now, [BEFORE], UP, model_of(*NAMES, config=config_of(off))) == {}


def test_another_class_than_the_one_that_was_there_says_nothing():
    now = carried(BEFORE, M, B)
    now[M] = replace(now[M], class_index=CAN.index)
    assert company(now, [BEFORE], UP, MODEL) == {}
    together = carried(BEFORE, M, B)
    there = (Neighbour(B, BOX, together[B].T_world_centre, 0.0),)
    around = Surroundings(there, (), company(together, [BEFORE], UP, MODEL)).without(M)
    at = together[M].T_world_centre
    assert set(around.relations(MODEL, MUG, at)) == {B}
    assert around.relations(MODEL, CAN, at) == {}
    alone = Surroundings(there, ())
    np.testing.assert_array_equal(*(x.log_potential(MODEL, CAN, at[None]) for x in (around, alone)))


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


def reported(stands, sure=1.0):
    """What a filter says of stands."""
    out = {}
    for i, stand in stands.items():
        probability = np.full(len(NAMES), (1.0 - sure) / (len(NAMES) - 1))
        probability[stand.class_index] = sure
        modes = ((stand.class_index, 0.0, stand.T_world_centre, np.eye(6), np.zeros((6, 0))),)
        out[i] = Reported(probability, 10.0, sure, 0.0, True, modes, {})
    return out


class Walked(Forward):
    """A filter of which the visits and what it said are given."""

    def __init__(self, *visits):
        image = np.zeros((4, 4), np.float32)
        super().__init__(run_of(MODEL.catalogue, [frame_of(0, looking(), image)]), MODEL, np.zeros(1, np.int64))
        self.up_before = UP
        for self.visit, said_then in enumerate(visits):
            self._remember(said_then)

    def partners(self, stands):
        return {i: p.object_id for i, p in self.surroundings(reported(stands)).company.items()}


def test_the_filter_learns_from_the_visits_before_alone():
    now = carried(BEFORE, M, B)
    state = Walked(reported(BEFORE), reported(now))
    assert state.partners(now) == {M: B, B: M}
    relation = state.surroundings(reported(now)).company[M].relation
    # whatever it says of this visit, and had it said nothing of it
    state._remember(reported(carried(BEFORE, M, C, by=(0.9, 0.9, 0.0))))
    assert state.surroundings(reported(now)).company[M].relation is relation
    assert Walked(reported(BEFORE), {}).partners(now) == {M: B, B: M}
    assert Walked(reported(now)).partners(now) == {}


def test_the_filter_remembers_what_surely_was_there():
    now = carried(BEFORE, M, B)
    assert Walked(reported(BEFORE, sure=0.6), {}).partners(now) == {}
    # what was found not to be there after all is struck out, and what is out of view is no sight of it
    assert Walked({**reported(BEFORE), M: replace(reported(BEFORE)[M], visible=False)}, {}).partners(now) == {}
    state = Walked(reported(BEFORE))
    state._remember(reported({M: BEFORE[M]}, sure=0.1))
    assert set(state.stood[0]) == {B, C, S}


def test_the_graph_has_the_context_that_the_filter_weighs_with():
    """Energy and potential are one function, spread over the keyframes, and of nobody else than those who moved."""
    now = carried(BEFORE, M, B)
    cameras = [Camera(np.eye(4), 100.0 * v + k, v) for v in range(2) for k in range(3)]
    objects = {}
    for i in (M, B, C):
        stands = [(BEFORE, now)[c.visit][i].T_world_centre for c in cameras]
        shape = MODEL.shapes[now[i].class_index]
        modes = [
            Measured(k, c.time_s, c.visit, T, 1e-8 * np.eye(6), k % 3 > 0)
            for k, (c, T) in enumerate(zip(cameras, stands, strict=True))
        ]
        objects[i] = (shape, modes)
    partners = {1: company(now, [BEFORE], UP, MODEL)}
    built = build(MODEL, cameras, LocalisationNoise(), objects, company=partners)
    assert built.count()["context"] == 3
    assert "context" not in build(MODEL, cameras, LocalisationNoise(), objects).count()
    said_there, pair = built.energy(built.initial)["context"], MODEL.relations[MUG.index, BOX.index]
    relation = partners[1][M]
    peak = context_log_ratio(1.0, pair, relation.relation.log_peak)
    # three of six keyframes
    assert said_there == pytest.approx(0.5 * (peak - said(M, now, [BEFORE])), abs=1e-9)
    # the ledger has it of the lower object of the two, whichever the relation is from
    assert not relation.first
    lines, own = built.contributions(built.initial), np.array(built.contributions(built.initial).kind) == "context"
    assert set(zip(lines.object[own], lines.other[own], strict=True)) == {(M, B)}
    beside = Surroundings((Neighbour(B, BOX, now[B].T_world_centre, 0.0),), (), partners[1]).without(M)
    told = beside.relations(MODEL, MUG, now[M].T_world_centre)[B]
    np.testing.assert_allclose(lines.nats[own], told / 6.0, atol=1e-9)
