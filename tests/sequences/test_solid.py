"""Which meshes are solid: whose faces, seen from behind, are always hidden."""

import numpy as np
import pytest
import trimesh

from sequences.catalogue import Mesh
from tests.sequences.rendering.shapes import SHAPES, mesh_of


def changed(mesh: Mesh, faces: np.ndarray) -> Mesh:
    return Mesh(mesh.vertices, np.ascontiguousarray(faces), mesh.colours)


@pytest.mark.parametrize("shape", ["box", "mug", "ball"])
def test_closed_bodies_are_solid_until_a_face_is_lost_or_turned(shape: str) -> None:
    mesh = mesh_of(SHAPES[shape]())
    assert mesh.is_solid
    assert not changed(mesh, mesh.faces[1:]).is_solid
    assert not changed(mesh, mesh.faces[:, ::-1]).is_solid
    turned = mesh.faces.copy()
    turned[0] = turned[0, ::-1]
    assert not changed(mesh, turned).is_solid


def test_a_body_inside_out_beside_a_right_one_is_not_solid() -> None:
    right, wrong = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.icosphere(2, 0.02)
    wrong.invert()
    wrong.apply_translation((0.2, 0, 0))
    assert not mesh_of(trimesh.util.concatenate([right, wrong])).is_solid


def test_seams_of_a_texture_do_not_matter_but_a_crack_does() -> None:
    box = mesh_of(SHAPES["box"]())
    corners = np.arange(3 * len(box.faces), dtype=np.int32).reshape(-1, 3)
    torn = Mesh(box.vertices[box.faces].reshape(-1, 3), corners, np.repeat(box.colours[:1], corners.size, axis=0))
    assert torn.is_solid
    vertices = torn.vertices.copy()
    vertices[0, 0] += 1e-5
    assert not Mesh(vertices, torn.faces, torn.colours).is_solid


def test_sheets_and_nothing_are_not_solid() -> None:
    assert not mesh_of(SHAPES["sheet"]()).is_solid
    assert not Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8)).is_solid
