"""What happens between visits and in them."""

from collections import defaultdict
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from sequences import se3
from sequences.simulation import MotionConfig, PlaceConfig, SimulationConfig, TrajectoryConfig
from sequences.simulation.motion import Visit, arrange
from sequences.simulation.place import Place, Placed, furnish

CONFIG = SimulationConfig(place=PlaceConfig(objects=10, clutter=2), trajectory=TrajectoryConfig(frames=4, period_s=2.0))
HOUR = 3600.0


def config(**motion) -> SimulationConfig:
    return replace(CONFIG, motion=MotionConfig(**motion))


@cache
def place_of(seed: int, twins: int = 1) -> Place:
    return furnish(replace(CONFIG.place, twins=twins), seed)


def first(visit: Visit) -> dict[int, Placed]:
    return {p.inst_id: p for p in visit.arrangements[0].things}


def last(visit: Visit) -> dict[int, Placed]:
    return {p.inst_id: p for p in visit.arrangements[-1].things}


def same_place(a: Placed, b: Placed) -> bool:
    """Where it was, but for the thickness of a cloth."""
    return np.allclose(a.T_world_object, b.T_world_object, atol=0.005) and a.surface == b.surface


@pytest.mark.parametrize("gap_h", [4.0, 96.0])
def test_each_thing_is_moved_as_often_as_its_persistence_says(gap_h):
    """Equation 3: it stays with probability 1/2 + 1/2 exp(-dt / mu)."""
    moved: dict[str, list[bool]] = defaultdict(list)
    expected: dict[str, float] = {}
    for seed in range(16):
        place = place_of(seed % 6)
        for before, after in pairwise(arrange(place, config(visits=4, gap_h=gap_h), seed)):
            for inst_id, old in last(before).items():
                one = place.known[inst_id].object_class
                new = first(after).get(inst_id)
                moved[one.category].append(new is None or not same_place(old, new))
                expected[one.category] = 0.5 * (1.0 - np.exp(-gap_h * HOUR / one.persistence_s))
    for category, cases in moved.items():
        p, n = expected[category], len(cases)
        assert abs(sum(cases) - p * n) < 3.5 * np.sqrt(n * p * (1 - p)) + 1.0, category
    total, variance = (
        sum(f(expected[c]) * len(m) for c, m in moved.items()) for f in (lambda p: p, lambda p: p - p * p)
    )
    assert abs(sum(map(sum, moved.values())) - total) < 3.0 * np.sqrt(variance) + 1.0


def test_the_same_share_of_things_is_away_at_every_visit():
    counts = np.zeros(4)
    for seed in range(18):
        visits = arrange(place_of(seed % 6), config(visits=4, gap_h=200.0, away=0.3), seed)
        counts += [len(first(visit)) for visit in visits]
    np.testing.assert_allclose(counts / 180, 0.7, atol=0.1)


@pytest.mark.parametrize("seed", range(6))
def test_the_moves_tell_everything_that_changed(seed):
    place = place_of(seed)
    visits = arrange(place, config(visits=4, gap_h=30.0, away=0.3, nudges=2, swap_twins=0.5), seed)
    for k, visit in enumerate(visits):
        assert all(move.visit == k for move in visit.moves)
        assert [move.time_ns for move in visit.moves] == sorted(move.time_ns for move in visit.moves)
    for before, after in pairwise(visits):
        old, new = last(before), first(after)
        moves = {move.inst_id: move for move in after.moves if move.kind != "nudged"}
        assert len(moves) == sum(move.kind != "nudged" for move in after.moves)
        for inst_id in place.known:
            kind = moves[inst_id].kind if inst_id in moves else None
            if inst_id in old and inst_id in new:
                assert (kind == "moved") == (not same_place(old[inst_id], new[inst_id]))
            elif inst_id in old or inst_id in new:
                assert kind == ("vanished" if inst_id in old else "appeared")
            else:
                assert kind is None
        for inst_id, move in moves.items():
            assert before.start_ns + before.times_ns[-1] < move.time_ns < after.start_ns
            assert move.from_support == (place.support(old[inst_id]) if inst_id in old else None)
            assert move.to_support == (place.support(new[inst_id]) if inst_id in new else None)


def test_what_is_moved_lands_on_other_furniture():
    for seed in range(6):
        place = place_of(seed)
        for visit in arrange(place, config(visits=3, gap_h=100.0), seed)[1:]:
            assert all(m.from_support != m.to_support for m in visit.moves if m.kind == "moved")
            supports = {piece.inst_id for piece in place.furniture}
            assert all(m.to_support in supports for m in visit.moves if m.kind != "vanished")


@pytest.mark.parametrize("moves", [0, 1, 3])
def test_a_given_number_of_things_is_moved_and_nothing_else(moves):
    for seed in range(5):
        place = place_of(seed)
        visits = arrange(place, config(visits=3, gap_h=2.0, moves=moves), seed)
        for before, after in pairwise(visits):
            assert [move.kind for move in after.moves] == ["moved"] * moves
            assert len(first(after)) == len(place.stock)
            assert all(
                np.allclose(a.T_world_object, b.T_world_object, atol=0.005)
                for a, b in zip(before.arrangements[0].clutter, after.arrangements[0].clutter, strict=True)
            )


def test_restless_things_are_moved_rather():
    """A draw by chances p has E[1 / p of what is drawn] = n / sum(p)."""
    drawn, evenly = [], []
    places = [furnish(replace(CONFIG.place, kind="workroom"), seed) for seed in range(4)]
    for seed in range(24):
        place = places[seed % 4]
        p = {i: 1.0 - np.exp(-2 * HOUR / place.known[i].object_class.persistence_s) for i in range(1, 11)}
        for visit in arrange(place, config(visits=4, gap_h=2.0, moves=1), seed)[1:]:
            drawn += [np.mean(list(p.values())) / p[move.inst_id] for move in visit.moves]
        evenly += [np.mean(list(p.values())) / one for one in p.values()]
    assert np.mean(drawn) == pytest.approx(1.0, abs=0.2)
    assert np.mean(evenly) > 1.3


def test_gaps_are_given_or_drawn_between_bounds():
    place = furnish(PlaceConfig(objects=1, twins=0, clutter=0), 0)
    gaps = []
    for seed in range(30):
        visits = arrange(place, config(visits=4, moves=0, shortest_gap_h=0.5, longest_gap_h=50.0), seed)
        gaps += [(b.start_ns - a.start_ns - a.times_ns[-1]) / 3.6e12 for a, b in pairwise(visits)]
    assert 0.5 <= min(gaps) < 1.0
    assert 25.0 < max(gaps) <= 50.0
    assert len(set(gaps)) == len(gaps)
    assert np.log(gaps).mean() == pytest.approx(np.log([0.5, 50.0]).mean(), abs=0.4)
    before, after = arrange(place, config(visits=2, moves=0, gap_h=3.0), 0)
    assert after.start_ns - before.start_ns - before.times_ns[-1] == 3 * 3600 * 10**9
    with pytest.raises(ValueError, match="above"):
        MotionConfig(shortest_gap_h=2.0, longest_gap_h=1.0)


def test_twins_take_each_others_place():
    swapped = 0
    for seed in range(6):
        place = place_of(seed, twins=2)
        before, after = arrange(place, config(visits=2, moves=0, swap_twins=1.0), seed)
        a, b = (move.inst_id for move in after.moves)
        assert place.known[a] is place.known[b]
        assert same_place(replace(last(before)[a], inst_id=b), first(after)[b])
        assert same_place(replace(last(before)[b], inst_id=a), first(after)[a])
        swapped += 1
    assert swapped == 6


@pytest.mark.parametrize("seed", range(4))
def test_nudges_are_small_seen_and_between_two_frames(seed):
    place = place_of(seed)
    motion = config(visits=1, nudges=3)
    nudged = replace(motion, trajectory=TrajectoryConfig(frames=20))
    (visit,) = arrange(place, nudged, seed)
    assert 1 <= len(visit.moves) == len(visit.arrangements) - 1 <= 3
    covered = [k for _, frames in visit.episodes() for k in frames]
    assert covered == list(range(20))
    camera = nudged.sensor.camera
    for (before, after), move in zip(pairwise(visit.arrangements), visit.moves, strict=True):
        old, new = ({p.inst_id: p for p in a.things} for a in (before, after))
        changed = [i for i in old if not np.array_equal(old[i].T_world_object, new[i].T_world_object)]
        assert changed == [move.inst_id]
        assert move.kind == "nudged"
        step = new[move.inst_id].T_world_object[:3, 3] - old[move.inst_id].T_world_object[:3, 3]
        assert 0.02 <= np.linalg.norm(step) <= 0.06
        assert abs(step[2]) < 1e-9
        k = after.frame
        assert visit.times_ns[k - 1] < move.time_ns - visit.start_ns < visit.times_ns[k]
        assert move.from_support == move.to_support == place.support(new[move.inst_id])
        for frame, placed in ((k - 1, old[move.inst_id]), (k, new[move.inst_id])):
            T = se3.inverse(visit.T_world_camera[frame]) @ placed.T_world_object
            pixels = camera.project(se3.transform(T, placed.body.mesh.vertices))
            assert ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=-1).any()


def test_later_visits_change_nothing_about_earlier_ones():
    for seed in range(3):
        few, many = (arrange(place_of(seed), config(visits=n, nudges=1), seed) for n in (2, 4))
        for a, b in zip(few, many, strict=False):
            assert (a.start_ns, a.moves) == (b.start_ns, b.moves)
            assert all(same_place(p, q) for p, q in zip(first(a).values(), first(b).values(), strict=True))


def test_a_table_wears_a_cloth_as_often_as_asked():
    shares = []
    for cloth in (0.0, 0.5, 1.0):
        covered = []
        few = PlaceConfig(kind="kitchen", objects=2, twins=0, clutter=0, cloth=cloth)
        for seed in range(4):
            place = furnish(few, seed)
            for visit in arrange(place, replace(config(visits=4, moves=0), place=few), seed):
                for piece, bare in zip(visit.furniture, place.furniture, strict=True):
                    under = piece.body is not bare.body
                    if place.known[piece.inst_id].object_class.name in ("table", "cabinet"):
                        covered.append(under)
                        assert piece.body.mesh.vertices.shape >= bare.body.mesh.vertices.shape
                    else:
                        assert not under
        shares.append(np.mean(covered))
    assert (shares[0], shares[2]) == (0.0, 1.0)
    assert 0.2 < shares[1] < 0.8
