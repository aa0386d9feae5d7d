"""What is in a place, and where it stands at first."""

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from sequences import se3
from sequences.errors import InputError
from sequences.simulation import MotionConfig, PlaceConfig, SimulationConfig, TrajectoryConfig
from sequences.simulation.layouts import KINDS
from sequences.simulation.motion import Visit, arrange
from sequences.simulation.place import KIN, Place, Placed, furnish
from sequences.simulation.standing import separation, shift
from tests.sequences.simulation.solid_geometry import winding_numbers

CONFIG = SimulationConfig(
    place=PlaceConfig(objects=12, clutter=4, cloth=0.5),
    motion=MotionConfig(visits=2, gap_h=48.0, nudges=2),
    trajectory=TrajectoryConfig(frames=5, period_s=2.0),
)
LIFT = np.array([0.0, 0.0, 1e-4])  # what stands on a surface touches it, which is neither in nor out


def world_vertices(p: Placed) -> np.ndarray:
    return se3.transform(p.T_world_object, p.body.mesh.vertices)


def inside(points: np.ndarray, other: Placed) -> bool:
    """Whether a point lies within another thing."""
    vertices = world_vertices(other)
    near = points[((points > vertices.min(axis=0)) & (points < vertices.max(axis=0))).all(axis=1)]
    return len(near) > 0 and bool((winding_numbers(near, vertices, other.body.mesh.faces) > 0.5).any())


def everything(visit: Visit) -> list[tuple[list[Placed], list[Placed]]]:
    """What stands about, and the furniture, for each arrangement of a visit."""
    return [([*a.things, *a.clutter], list(visit.furniture)) for a in visit.arrangements]


@pytest.mark.parametrize("seed", range(3))
def test_nothing_penetrates_anything(seed):
    for visit in arrange(furnish(CONFIG.place, seed), CONFIG, seed):
        for things, furniture in everything(visit)[::2]:
            for a, b in combinations(things, 2):
                assert not inside(world_vertices(a), b)
                assert not inside(world_vertices(b), a)
            for thing in things:
                for piece in furniture:
                    assert not inside(world_vertices(thing) + LIFT, piece)
                    assert not inside(world_vertices(piece) - LIFT, thing)


@pytest.mark.parametrize("seed", range(4))
def test_everything_rests_on_its_surface_in_a_stable_pose(seed):
    place = furnish(CONFIG.place, seed)
    for visit in arrange(place, CONFIG, seed):
        bare = {p.inst_id for p, there in zip(place.furniture, visit.furniture, strict=True) if p.body is there.body}
        for things, _ in everything(visit):
            for thing in things:
                surface = place.surfaces[thing.surface]
                local = se3.transform(se3.inverse(surface.T_world_area), world_vertices(thing))
                on_cloth = place.support(thing) not in bare
                assert (0.0005 < local[:, 2].min() < 0.005) if on_cloth else abs(local[:, 2].min()) < 1e-9
                assert (np.abs(local[:, :2]).max(axis=0) < surface.size / 2).all()
                assert local[:, 2].max() < surface.headroom_m + 0.005
                up_in_object = thing.T_world_object[2, :3]
                assert max(float(R[2] @ up_in_object) for R in thing.body.rests) > 1 - 1e-9


def test_all_surfaces_are_used():
    for seed in range(2):
        place = furnish(CONFIG.place, seed)
        used = {
            thing.surface
            for k in range(10)
            for thing in arrange(place, replace(CONFIG, motion=MotionConfig(visits=1)), k)[0].arrangements[0].things
        }
        assert used == set(range(len(place.surfaces)))


def test_the_catalogue_has_what_is_there_and_some_that_is_not():
    for seed in range(6):
        place = furnish(PlaceConfig(objects=5, twins=1, distractors=4), seed)
        stock = Counter(s.object_class.obj_id for s in place.stock)
        assert sorted(stock.values()) == [1, 1, 1, 2]
        small = {s.object_class.obj_id for s in place.shapes if not s.areas}
        assert set(stock) < small
        assert len(small) == 4 + 4
        assert len({s.object_class.obj_id for s in place.shapes}) == len(place.shapes)
        assert list(place.known) == list(range(1, 6 + len(place.furniture)))
        assert [place.known[p.inst_id] for p in place.furniture] == [p.body for p in place.furniture]


def test_classes_repeat_when_all_are_used():
    place = furnish(PlaceConfig(objects=35, twins=0), 0)
    counts = Counter(s.object_class.obj_id for s in place.stock)
    assert sorted(set(counts.values())) == [1, 2]
    assert len(place.shapes) == len(counts) + len(place.furniture)


def test_a_room_keeps_what_belongs_there():
    for kind in ("kitchen", "bathroom", "study"):
        kept = KINDS[kind].kept
        categories = Counter(
            s.object_class.category for seed in range(6) for s in furnish(PlaceConfig(kind=kind), seed).stock
        )
        assert categories.total() > sum(categories[c] for c in kept) > 0.6 * categories.total()


def neighbourhood(together: float) -> tuple[float, float]:
    """How much nearer than anything else things of one category are, and things of kin: ratios of mean distances."""
    apart: dict[str, list[float]] = {"same": [], "kin": [], "other": []}
    config = replace(CONFIG, place=PlaceConfig(together=together), motion=MotionConfig(visits=1))
    for seed in range(24):
        place = furnish(config.place, seed)
        things = arrange(place, config, seed)[0].arrangements[0].things
        for a, b in combinations(things, 2):
            pair = tuple(sorted(place.known[p.inst_id].object_class.category for p in (a, b)))
            which = "same" if pair[0] == pair[1] else "kin" if pair in KIN else "other"
            apart[which].append(float(np.linalg.norm(a.T_world_object[:3, 3] - b.T_world_object[:3, 3])))
    same, kin, other = (float(np.mean(apart[name])) for name in ("same", "kin", "other"))
    return same / other, kin / other


def test_things_of_a_category_stand_together_and_near_their_kin_with_exceptions():
    same, kin = neighbourhood(together=0.75)
    assert 0.3 < same < kin < 0.9
    assert neighbourhood(together=0.0)[0] == pytest.approx(1.0, abs=0.12)


def test_a_place_that_is_too_full_is_refused():
    config = replace(CONFIG, place=PlaceConfig(objects=40, clearance_m=0.2))
    with pytest.raises(InputError, match="no free spot"):
        arrange(furnish(config.place, 0), config, 0)


def stocked(seed: int) -> tuple[Place, Visit]:
    place = furnish(CONFIG.place, seed)
    return place, arrange(place, replace(CONFIG, motion=MotionConfig(visits=1)), seed)[0]


def test_a_thing_is_shifted_along_its_surface_or_not_at_all():
    shifted = refused = 0
    for seed in range(4):
        place, visit = stocked(seed)
        things = visit.arrangements[0].things
        for thing in things:
            others = [p for p in things if p is not thing]
            metres, yaw = np.array([0.04, -0.03]), 0.3
            new = shift(place, thing, others, CONFIG.place, metres, yaw)
            if new is None:
                refused += 1
                continue
            shifted += 1
            step = se3.local(thing.T_world_object, new.T_world_object)
            assert np.linalg.norm(step[:3]) == pytest.approx(0.3)
            assert new.T_world_object[2, 3] == pytest.approx(thing.T_world_object[2, 3])
            assert np.linalg.norm(new.T_world_object[:3, 3] - thing.T_world_object[:3, 3]) == pytest.approx(0.05)
            here = [o for o in others if o.surface == new.surface]
            assert all(separation(new.outline, o.outline) >= CONFIG.place.clearance_m for o in here)
    assert shifted > 5
    assert refused > 0


def test_separation_is_the_gap_between_outlines():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    assert separation(square, square + np.array([1.5, 0.3])) == pytest.approx(0.5)
    assert separation(square, square + np.array([0.0, -1.25])) == pytest.approx(0.25)
    assert separation(square, square + np.array([0.75, 0.5])) == pytest.approx(-0.25)
    diamond = np.array([[1.6, 0.5], [2.1, 1.0], [1.6, 1.5], [1.1, 1.0]])
    assert separation(square, diamond) == pytest.approx(0.1)
