"""Laws of signed distance fields, against distances known in closed form."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from sequences import se3
from sequences.catalogue import Mesh
from sequences.distance import distance_field
from tests.tiny import box_mesh


def mesh_of(solid: trimesh.Trimesh) -> Mesh:
    return Mesh(
        np.asarray(solid.vertices, dtype=np.float64),
        np.asarray(solid.faces, dtype=np.int32),
        np.full((len(solid.vertices), 3), 128, dtype=np.uint8),
    )


def box_distance(points, size):
    out = np.abs(points) - np.asarray(size) / 2
    return np.linalg.norm(np.maximum(out, 0.0), axis=-1) + np.minimum(out.max(-1), 0.0)


def annulus_distance(points, inner, outer, height):
    """A pipe along z: its section is a rectangle in (radius, z)."""
    section = np.stack([np.linalg.norm(points[..., :2], axis=-1) - (inner + outer) / 2, points[..., 2]], axis=-1)
    return box_distance(section, (outer - inner, height))


def points_around(mesh, seed, n=400):
    """Points within the mesh's bounding box and a little beyond."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    margin = 0.05 * (high - low).max()
    return np.random.default_rng(seed).uniform(low - margin, high + margin, (n, 3))


@settings(max_examples=15)
@given(st.tuples(*[st.floats(0.02, 0.4)] * 3), st.integers(0, 2**31))
def test_a_boxs_field_is_its_distance_to_the_grids_spacing(size, seed):
    mesh = box_mesh(*size)
    field, points = distance_field(mesh), points_around(mesh, seed)
    np.testing.assert_allclose(field.at(points), box_distance(points, size), atol=field.spacing_m)


def test_a_spheres_field_is_its_distance_well_within_the_grids_spacing():
    mesh = mesh_of(trimesh.creation.icosphere(subdivisions=3, radius=0.08))
    field, points = distance_field(mesh), points_around(mesh, 1)
    expected = np.linalg.norm(points, axis=-1) - 0.08
    # smooth but at the centre, so that interpolation errs less than the spacing
    smooth = expected > -0.07
    np.testing.assert_allclose(field.at(points)[smooth], expected[smooth], atol=0.25 * field.spacing_m)


def test_the_hole_of_a_pipe_is_outside_and_its_wall_is_inside():
    inner, outer, height = 0.03, 0.045, 0.1
    mesh = mesh_of(trimesh.creation.annulus(inner, outer, height, sections=96))
    field, points = distance_field(mesh), points_around(mesh, 2)
    np.testing.assert_allclose(field.at(points), annulus_distance(points, inner, outer, height), atol=field.spacing_m)
    z = np.linspace(-0.03, 0.03, 7)
    axis = np.stack([0 * z, 0 * z, z], axis=-1)
    assert (field.at(axis) > 0.025).all()
    assert (field.at(axis + np.array([(inner + outer) / 2, 0, 0])) < -0.004).all()


def test_nothing_is_deep_inside_of_a_wall_thinner_than_the_grid():
    """A cup with a wall of 1.5 mm on a grid of 4 mm: its hollow is outside, wherever the nodes happen to lie."""
    rim = trimesh.creation.annulus(0.0385, 0.04, 0.1, sections=32)
    floor = trimesh.creation.cylinder(0.04, 0.0015, sections=32)
    floor.apply_translation([0.0, 0.0, -0.05])
    mesh = mesh_of(trimesh.util.concatenate([rim, floor]))
    field = distance_field(mesh)
    assert field.spacing_m > 0.003
    points = points_around(mesh, 3, 3000)
    assert field.at(points).min() > -0.5 * field.spacing_m
    radius = np.linalg.norm(points[:, :2], axis=-1)
    hollow = (radius < 0.03) & (np.abs(points[:, 2]) < 0.04)
    assert hollow.sum() > 100
    assert (field.at(points[hollow]) > 0.004).all()


def test_a_body_made_of_overlapping_parts_is_solid_throughout():
    parts = trimesh.util.concatenate([trimesh.creation.box([0.1, 0.04, 0.04]), trimesh.creation.box([0.04, 0.04, 0.1])])
    field = distance_field(mesh_of(parts))
    assert (field.at(np.array([[0.0, 0, 0], [0.04, 0, 0], [0, 0, -0.04]])) < -0.005).all()
    assert (field.at(np.array([[0.035, 0, 0.035], [-0.04, 0, -0.04]])) > 0.01).all()


def test_a_hole_in_the_mesh_doesnt_turn_it_inside_out():
    mesh = box_mesh(0.1, 0.1, 0.1)
    leaky = Mesh(mesh.vertices, mesh.faces[1:], mesh.colours)
    points = points_around(mesh, 4)
    expected = box_distance(points, (0.1, 0.1, 0.1))
    # away from the missing triangle, x = -0.05
    sure = (np.abs(expected) > 0.01) & (points[:, 0] > 0.01)
    assert (np.sign(distance_field(leaky).at(points[sure])) == np.sign(expected[sure])).all()


@pytest.mark.parametrize("flip", [False, True])
def test_the_side_doesnt_hang_on_how_faces_are_wound(flip):
    mesh = box_mesh(0.06, 0.08, 0.1)
    wound = Mesh(mesh.vertices, mesh.faces[:, ::-1] if flip else mesh.faces, mesh.colours)
    assert distance_field(wound).at(np.zeros((1, 3)))[0] < -0.025


def test_beyond_its_grid_a_field_says_what_its_border_says():
    field = distance_field(box_mesh(0.1, 0.1, 0.1))
    assert field.at(np.array([[3.0, 0.0, 0.0]]))[0] == pytest.approx(2 * field.spacing_m, abs=0.5 * field.spacing_m)


def test_a_field_moves_with_its_mesh():
    mesh, shift = box_mesh(0.1, 0.07, 0.05), np.array([0.3, -1.0, 2.0])
    moved = Mesh(mesh.vertices + shift, mesh.faces, mesh.colours)
    points = points_around(mesh, 5)
    np.testing.assert_allclose(distance_field(moved).at(points + shift), distance_field(mesh).at(points), atol=1e-4)


@given(seed=st.integers(0, 2**16))
def test_the_deepest_point_is_what_the_field_says_of_all(seed):
    rng = np.random.default_rng(seed)
    field = distance_field(box_mesh(0.2, 0.1, 0.05))
    points, poses = rng.normal(0.0, 0.05, (20, 3)), se3.exp(rng.normal(0.0, [0.5, 0.5, 0.5, 0.05, 0.05, 0.05], (7, 6)))
    said = -field.at(se3.transform(poses, points)).min(axis=-1)
    np.testing.assert_allclose(field.deepest(poses, points), np.maximum(said, 0.0), atol=1e-7)
