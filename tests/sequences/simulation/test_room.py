import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sequences import se3
from sequences.camera import Camera
from sequences.rendering.scene import render_scene
from sequences.simulation.room import HEIGHT_M, STYLES, Room, room
from sequences.simulation.solids import rotation

SIZE = np.array([4.4, 3.8])
AROUND = Camera(60.0, 60.0, 59.5, 59.5, 120, 120)  # 90 degrees each way
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def against_a_wall(wall: int, along: float, size: tuple[float, float, float]) -> np.ndarray:
    """(2, 3) box of a piece of furniture with its back to one of the walls."""
    width, depth, height = size
    extent = np.array([width, depth] if wall % 2 == 0 else [depth, width])
    low = 0.02 + along * (SIZE - extent - 0.04)
    low[(wall + 1) % 2] = 0.02 if wall < 2 else SIZE[(wall + 1) % 2] - depth - 0.02
    return np.array([[*low, 0.0], [*(low + extent), height]])


boxes = st.lists(
    st.builds(
        against_a_wall,
        st.integers(0, 3),
        st.floats(0.0, 1.0),
        st.tuples(st.floats(0.4, 1.6), st.floats(0.3, 0.8), st.floats(0.4, 1.6)),
    ),
    max_size=5,
).map(lambda some: np.array(some).reshape(-1, 2, 3))
seeds = st.integers(0, 10**6)


def made(some: np.ndarray, seed: int) -> Room:
    return room(SIZE, some, np.random.default_rng(seed), kind=(*STYLES, "mixed")[seed % (1 + len(STYLES))])


@settings(max_examples=15)
@given(some=boxes, seed=seeds)
def test_nothing_it_adds_reaches_into_what_stands_there(some, seed):
    vertices = made(some, seed).mesh.vertices
    above = vertices[vertices[:, 2] > 1e-3]  # the floor runs on below
    for low, high in some:
        assert not ((above > low + 1e-6) & (above < high - 1e-6)).all(axis=1).any()


@settings(max_examples=8, phases=[Phase.generate])  # a room takes too long for shrinking
@given(some=boxes, seed=seeds)
def test_it_is_closed_all_round(some, seed):
    mesh = made(some, seed).mesh
    centre = np.array([*SIZE / 2, 1.3])
    views = [rotation("z", 90.0 * k) @ LEVEL for k in range(4)] + [np.eye(3), np.diag([1.0, -1.0, -1.0])]
    for R in views:
        depth = render_scene([(mesh, se3.inverse(se3.make(R, centre)))], AROUND).depth
        assert (depth > 0).all()
        assert depth.max() < 0.7 * np.hypot(*SIZE)


@settings(max_examples=15)
@given(some=boxes, seed=seeds)
def test_daylight_comes_through_a_hole_in_a_wall_over_low_furniture(some, seed):
    window = made(some, seed).window
    if window is None:
        return
    at, outwards = window.T_world_window[:3, 3], window.T_world_window[:3, 1]
    outside = np.array([at[0] < 0, at[0] > SIZE[0], at[1] < 0, at[1] > SIZE[1]])
    assert outside.sum() == 1
    assert outwards @ (at - [*SIZE / 2, 1.3]) > 0
    assert 0.8 < at[2] - window.size[1] / 2 < at[2] + window.size[1] / 2 < HEIGHT_M
    # looking in from the middle of the window nothing tall stands right before it
    for low, high in some:
        near = np.abs(np.clip(at, low, high) - at)[:2].max() < 0.3
        assert not (near and high[2] > 1.2)


def test_a_room_without_a_free_wall_has_no_window():
    walls = np.array([against_a_wall(k, 0.0, (4.35 if k % 2 == 0 else 3.7, 0.3, 2.2)) for k in range(4)])
    assert made(walls, 0).window is None
    assert made(walls[:0], 0).window is not None


@given(seed=seeds)
@settings(max_examples=5)
def test_the_generator_alone_decides(seed):
    table = against_a_wall(0, 0.5, (1.3, 0.7, 0.75))[None]
    one, same, other = made(table, seed), made(table, seed), made(table, seed + 1)
    np.testing.assert_array_equal(one.mesh.vertices, same.mesh.vertices)
    np.testing.assert_array_equal(one.mesh.colours, same.mesh.colours)
    assert one.mesh.vertices.shape != other.mesh.vertices.shape or (one.mesh.vertices != other.mesh.vertices).any()


@pytest.mark.parametrize("size", [(2.4, 2.2), (3.0, 5.5), (6.0, 4.0)])
def test_sizes_are_as_asked(size):
    mesh = room(size, np.zeros((0, 2, 3)), np.random.default_rng(1)).mesh
    high, low = mesh.vertices.max(axis=0), mesh.vertices.min(axis=0)
    # windows and doors lie in the wall's thickness
    assert (np.abs(low[:2]) < 0.15).all()
    assert (np.abs(high[:2] - size) < 0.15).all()
    assert high[2] == pytest.approx(HEIGHT_M, abs=0.01)


@settings(max_examples=15, phases=[Phase.generate])
@given(some=boxes, seed=seeds)
def test_the_middle_of_the_floor_is_free_for_a_robot(some, seed):
    vertices = made(some, seed).mesh.vertices
    inside = ((vertices[:, :2] > 0.47) & (vertices[:, :2] < SIZE - 0.47)).all(axis=1)
    assert vertices[inside & (vertices[:, 2] < 2.0), 2].max(initial=0.0) < 0.005  # a rug
