import itertools
from collections import Counter

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from sequences import se3
from sequences.camera import Camera
from sequences.meshes import simplify
from sequences.rendering.scene import render_scene
from sequences.simulation.shapes import Body, Shape, catalogue, clothed, clutter, household
from sequences.simulation.solids import rotation
from tests.sequences.simulation.solid_geometry import distances, winding_numbers

SHAPES = household()
TURNED = [s for s in SHAPES if s.object_class.symmetries_continuous]
NAMED = {s.object_class.name: s for s in SHAPES}
CLUTTER = clutter()
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.object_class.name)


def moved_by(shape: Shape, T: np.ndarray, middles: bool = False) -> float:
    """How far a motion takes the surface from itself, metres, by 250 of its vertices or of the middles of its faces.

    The middles lie everywhere; the vertices alone are exact where a rounded corner's faces are cut the other way.
    """
    mesh = shape.object_class.mesh
    points = mesh.vertices[mesh.faces].mean(axis=1) if middles else mesh.vertices
    some = np.random.default_rng(0).permutation(points)[:250]
    return float(distances(se3.transform(T, some), mesh.vertices, mesh.faces).max())


def cube_rotations() -> list[np.ndarray]:
    """The 24 rotations of a cube."""
    signed = [np.array(p) for p in itertools.permutations(range(3))]
    out = []
    for order in signed:
        for signs in itertools.product((-1.0, 1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0:
                out.append(R)
    return out


def test_the_catalogue_is_a_household():
    small = [s.object_class for s in SHAPES if s.object_class.movable]
    assert len(small) >= 18
    assert all(n >= 2 for n in Counter(c.category for c in small).values())
    assert {c.category for c in small} >= {"food", "kitchen", "bath", "cleaning", "office", "tool"}
    large = [s.object_class.name for s in SHAPES if s.object_class.supports]
    assert set(large) >= {"table", "desk", "side_table", "cabinet", "shelf", "sofa", "chair"}
    assert [s.object_class.name for s in SHAPES[-len(large) :]] == large
    classes = catalogue(tuple(reversed(SHAPES))).classes
    assert [c.obj_id for c in classes] == sorted({s.object_class.obj_id for s in SHAPES})
    assert len({c.name for c in classes}) == len(classes)


@every_shape
def test_meshes_are_closed_solids_of_moderate_size(shape):
    mesh = shape.object_class.mesh
    places, place_of = np.unique(mesh.vertices, axis=0, return_inverse=True)  # where colours differ there are two
    solid = trimesh.Trimesh(places, place_of.reshape(-1)[mesh.faces], process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert solid.area_faces.min() > 0
    assert mesh.is_solid
    assert 300 <= len(mesh.faces) <= (1800 if shape.object_class.movable else 1000)
    assert len(np.unique(mesh.colours, axis=0)) >= 2


@every_shape
def test_the_origin_is_the_middle_of_the_bounding_box(shape):
    vertices = shape.object_class.mesh.vertices
    np.testing.assert_allclose(vertices.min(axis=0) + vertices.max(axis=0), 0.0, atol=1e-9)
    assert 0.05 < shape.object_class.diameter_m < 2.0


@every_shape
def test_stated_discrete_symmetries_leave_the_surface_as_it_is(shape):
    symmetries = shape.object_class.symmetries_discrete
    np.testing.assert_array_equal(symmetries[0], np.eye(4))
    for T in symmetries[1:]:
        assert moved_by(shape, T) < 1e-6


@pytest.mark.parametrize("shape", TURNED, ids=lambda s: s.object_class.name)
@settings(max_examples=8)
@given(angle=st.floats(-np.pi, np.pi))
def test_turning_about_a_stated_axis_leaves_the_surface_as_it_is(shape, angle):
    (symmetry,) = shape.object_class.symmetries_continuous
    R = se3.so3_exp(angle * symmetry.axis)
    assert moved_by(shape, se3.make(R, symmetry.offset - R @ symmetry.offset)) < 5e-4  # a polygon for a circle


@every_shape
def test_no_symmetry_is_left_out(shape):
    stated = [T[:3, :3] for T in shape.object_class.symmetries_discrete]
    if shape.object_class.symmetries_continuous:
        axis = shape.object_class.symmetries_continuous[0].axis
        stated += [R @ se3.so3_exp(k * np.pi / 2 * axis) for R in stated for k in (1, 2, 3)]
    for R in cube_rotations():
        if not any(np.allclose(R, S, atol=1e-9) for S in stated):
            assert moved_by(shape, se3.make(R, np.zeros(3)), middles=True) > 1e-3


def least_margin(body: Body, R: np.ndarray) -> float:
    """How far within the outline of what touches the ground the middle of mass lies, metres."""
    solid = trimesh.Trimesh(body.mesh.vertices, body.mesh.faces, process=False)
    points = body.mesh.vertices @ R.T
    touching = points[points[:, 2] < points[:, 2].min() + 1.5e-3][:, :2]
    hull = ConvexHull(touching)
    return float(-(hull.equations[:, :2] @ (R @ solid.center_mass)[:2] + hull.equations[:, 2]).max())


@every_shape
def test_things_stand_stably_in_each_rest(shape):
    for R in shape.rests:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert least_margin(shape, R) > 1e-3


@every_shape
def test_support_areas_lie_on_the_furniture_and_are_free_above(shape):
    mesh = shape.object_class.mesh
    assert bool(shape.areas) == shape.object_class.supports
    for area in shape.areas:
        grid = np.stack(np.meshgrid(*(np.linspace(-0.47, 0.47, 5) * s for s in area.size), [0.0]), axis=-1).reshape(
            -1, 3
        )
        assert distances(area.centre + grid, mesh.vertices, mesh.faces).max() < 1e-6
        for height in (0.01, 0.5 * area.headroom_m, 0.98 * area.headroom_m):
            above = area.centre + grid + [0.0, 0.0, height]
            assert np.abs(winding_numbers(above, mesh.vertices, mesh.faces)).max() < 0.5


def seen_from(name: str, down: float, yaw: float) -> np.ndarray:
    """(h, w) depth of a thing standing on the ground a metre off, metres; 0 where it isn't."""
    mesh = NAMED[name].object_class.mesh
    stand = se3.make(rotation("z", yaw), np.array([0.0, 0.0, -mesh.vertices[:, 2].min()]))
    R = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ rotation("x", -down)
    look = se3.make(R, np.array([0.0, 0.0, 0.03]) - R[:, 2])
    camera = Camera(570.0, 570.0, 159.5, 119.5, 320, 240)
    return render_scene([(mesh, se3.inverse(look) @ stand)], camera).depth.astype(float)


@pytest.mark.parametrize("down", [20.0, 35.0, 50.0])
@pytest.mark.parametrize("yaw", [0.0, 35.0])
def test_depth_can_hardly_tell_the_shampoo_from_the_milk(down, yaw):
    one, other = seen_from("milk_carton", down, yaw), seen_from("shampoo_bottle", down, yaw)
    both = (one > 0) & (other > 0)
    assert both.sum() > 0.92 * ((one > 0) | (other > 0)).sum()
    assert np.median(np.abs(one - other)[both]) < 0.0016  # the sensor's noise at 1 m
    assert NAMED["milk_carton"].object_class.category != NAMED["shampoo_bottle"].object_class.category


@pytest.mark.parametrize("down", [20.0, 35.0, 50.0])
def test_the_loofah_fills_the_bowls_outline_but_depth_tells_them_apart(down):
    bowl, loofah = seen_from("bowl", down, 0.0), seen_from("loofah", down, 35.0)
    both = (bowl > 0) & (loofah > 0)
    assert both.sum() > 0.7 * ((bowl > 0) | (loofah > 0)).sum()
    assert np.median(np.abs(bowl - loofah)[both]) > 0.02
    assert NAMED["bowl"].object_class.category != NAMED["loofah"].object_class.category


def test_glossy_is_between_dull_and_a_mirror():
    assert all(0.0 <= body.gloss <= 1.0 for body in (*SHAPES, *CLUTTER))
    assert NAMED["soup_can"].gloss > NAMED["cereal_box"].gloss > NAMED["sponge"].gloss == 0.0


@pytest.mark.parametrize("thing", CLUTTER, ids=lambda c: c.name)
def test_clutter_is_solid_stands_stably_and_has_no_class(thing):
    assert 0.05 < np.ptp(thing.mesh.vertices, axis=0).max() < 0.5
    assert thing.mesh.is_solid
    assert len(thing.mesh.faces) <= 3000
    assert all(least_margin(thing, R) > 1e-3 for R in thing.rests)
    assert thing.name not in NAMED


@pytest.mark.parametrize("name", ["table", "desk", "side_table"])
@pytest.mark.parametrize("seed", range(3))
def test_a_cloth_changes_what_is_seen_but_not_what_is_known(name, seed):
    plain, covered = NAMED[name], clothed(NAMED[name], np.random.default_rng(seed))
    assert covered.object_class is plain.object_class
    assert plain.mesh is plain.object_class.mesh
    assert covered.mesh is covered.appearance
    assert covered.mesh.is_solid
    # a shell round the top: little wider, hardly higher, and it leaves the feet free
    wider = np.ptp(covered.mesh.vertices, axis=0) - np.ptp(plain.mesh.vertices, axis=0)
    assert (wider > 0).all()
    assert (wider[:2] < 0.2).all()
    assert wider[2] < 0.002
    cloth = covered.mesh.vertices[len(plain.mesh.vertices) :]
    assert cloth[:, 2].min() > plain.mesh.vertices[:, 2].min() + 0.05
    (area,), (below,) = covered.areas, plain.areas
    np.testing.assert_array_equal(area.size, below.size)
    corners = area.centre + 0.47 * np.array([[i, j, 0.0] for i in (-1, 0, 1) for j in (-1, 0, 1)]) * [*area.size, 0.0]
    assert distances(corners, covered.mesh.vertices, covered.mesh.faces).max() < 1e-6
    inside = winding_numbers(plain.mesh.vertices[::7] * 0.999, covered.mesh.vertices, covered.mesh.faces)
    assert inside.min() > -0.5  # nothing is turned inside out


@pytest.mark.parametrize("name", ["table", "desk", "side_table"])
def test_nothing_of_the_top_shows_through_its_cloth(name):
    covered = clothed(NAMED[name], np.random.default_rng(0))
    above = np.array([0.0, 0.0, 1.5])
    look = se3.make(np.diag([1.0, -1.0, -1.0]), covered.areas[0].centre + above)
    camera = Camera(150.0, 150.0, 119.5, 79.5, 240, 160)
    face = render_scene([(covered.mesh, se3.inverse(look))], camera).face
    assert (face[face >= 0] >= len(covered.object_class.mesh.faces)).all()


@every_shape
def test_coarse_copies_keep_their_form(shape):
    mesh = shape.object_class.mesh
    coarse = simplify(mesh, 500)
    some = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), 150, seed=0)[0]
    assert distances(np.asarray(some), coarse.vertices, coarse.faces).max() < 0.015 * shape.object_class.diameter_m


def test_the_measures_of_distance_and_inside_are_right():
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    points = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 2.0], [0.9, 0.0, 0.0]])
    vertices, faces = np.array(box.vertices), np.array(box.faces)
    np.testing.assert_allclose(distances(points, vertices, faces), [1.0, 1.0, 2**0.5, 3**0.5, 0.1])
    np.testing.assert_allclose(winding_numbers(points, vertices, faces), [1, 0, 0, 0, 1], atol=1e-9)
