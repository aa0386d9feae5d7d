import itertools
from collections import Counter

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from sequences import se3
from sequences.simulation.shapes import Shape, catalogue, household
from tests.sequences.simulation.solid_geometry import distances, winding_numbers

SHAPES = household()
TURNED = [s for s in SHAPES if s.object_class.symmetries_continuous]
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.object_class.name)


def moved_by(shape: Shape, T: np.ndarray) -> float:
    """How far a motion takes the surface from itself, metres, by 250 of its vertices."""
    mesh = shape.object_class.mesh
    some = np.random.default_rng(0).permutation(mesh.vertices)[:250]
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
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert solid.area_faces.min() > 0
    assert mesh.is_solid
    assert 300 <= len(mesh.faces) <= (1800 if shape.object_class.movable else 4200)
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
            assert moved_by(shape, se3.make(R, np.zeros(3))) > 1e-3


@every_shape
def test_things_stand_stably_in_each_rest(shape):
    mesh = shape.object_class.mesh
    centre = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).center_mass
    for R in shape.rests:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        points = mesh.vertices @ R.T
        touching = points[points[:, 2] < points[:, 2].min() + 1.5e-3][:, :2]
        hull = ConvexHull(touching)
        margin = -(hull.equations[:, :2] @ (R @ centre)[:2] + hull.equations[:, 2]).max()
        assert margin > 1e-3


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


def test_the_measures_of_distance_and_inside_are_right():
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    points = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 2.0], [0.9, 0.0, 0.0]])
    vertices, faces = np.array(box.vertices), np.array(box.faces)
    np.testing.assert_allclose(distances(points, vertices, faces), [1.0, 1.0, 2**0.5, 3**0.5, 0.1])
    np.testing.assert_allclose(winding_numbers(points, vertices, faces), [1, 0, 0, 0, 1], atol=1e-9)
