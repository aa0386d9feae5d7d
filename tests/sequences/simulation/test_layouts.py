"""Rooms: furniture along the walls, a way for the robot between."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest

from sequences import se3
from sequences.errors import InputError
from sequences.simulation import PlaceConfig, layouts
from sequences.simulation.layouts import KINDS, ROBOT_M, choose_furniture, lay_out
from sequences.simulation.place import Place, furnish
from sequences.simulation.shapes import household
from sequences.simulation.standing import separation


@cache
def places(kind: str) -> list[Place]:
    return [furnish(PlaceConfig(kind=kind), seed) for seed in range(3)]


@pytest.mark.parametrize("kind", KINDS)
def test_furniture_stands_on_the_floor_with_its_back_to_a_wall_and_touches_nothing(kind):
    for place in places(kind):
        assert 2 <= len(place.furniture) <= 4
        width, depth = place.layout.size
        for piece in place.furniture:
            vertices = se3.transform(piece.T_world_object, piece.body.mesh.vertices)
            assert abs(vertices[:, 2].min()) < 1e-9
            assert vertices[:, :2].min() > 0.0
            assert (vertices[:, :2].max(axis=0) < (width, depth)).all()
            to_walls = [vertices[:, 0].min(), width - vertices[:, 0].max(), depth - vertices[:, 1].max()]
            back = piece.T_world_object[:2, 1]  # +y of the piece, which the nearest wall is behind
            behind = [-back[0], back[0], back[1]]
            assert to_walls[int(np.argmax(behind))] < 0.06
            assert max(behind) > 1 - 1e-9
        for a, b in combinations(place.furniture, 2):
            assert separation(a.outline, b.outline) > 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_the_robot_has_a_way_clear_of_furniture_and_walls(kind):
    for place in places(kind):
        low, high = place.layout.free_low, place.layout.free_high
        assert (high - low).min() >= 1.0
        free = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        assert (low >= ROBOT_M).all()
        assert (high <= place.layout.size - ROBOT_M).all()
        assert all(separation(free, piece.outline) > ROBOT_M - 1e-9 for piece in place.furniture)


def test_a_room_has_what_its_kind_always_has_and_perhaps_more():
    furniture = {s.object_class.name for s in household() if s.areas}
    for kind in KINDS.values():
        drawn = [choose_furniture(kind, np.random.default_rng(seed)) for seed in range(40)]
        assert {name for names in drawn for name in names} == {*kind.always, *kind.sometimes} <= furniture
        assert all(set(kind.always) <= set(names) and 2 <= len(names) <= 4 for names in drawn)
        assert len({len(names) for names in drawn}) > 1


def test_all_kinds_of_room_are_drawn():
    assert {furnish(PlaceConfig(objects=1, twins=0, clutter=0), seed).kind for seed in range(30)} == set(KINDS)


def test_furniture_that_fits_in_no_room_is_refused(monkeypatch):
    monkeypatch.setattr(layouts, "TRIES", 50)
    with pytest.raises(InputError, match="no room"):
        lay_out([np.array([4.0, 2.0, 1.0])] * 3, np.random.default_rng(0))
