"""Meshes on disk and their coarse copies."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sequences import meshes
from sequences.catalogue import Mesh
from sequences.errors import InputError
from tests.tiny import box_mesh


def sphere(radius: float = 0.05) -> Mesh:
    """4000-odd faces, coloured by height."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    shade = np.interp(ball.vertices[:, 2], [-radius, radius], [0, 255]).astype(np.uint8)
    return Mesh(np.array(ball.vertices), ball.faces.astype(np.int32), np.stack([shade, shade, 255 - shade], axis=1))


@given(st.integers(3, 40), st.integers(1, 40), st.integers(0, 2**31))
def test_what_is_written_is_what_is_read(tmp_path_factory, n, f, seed):
    rng = np.random.default_rng(seed)
    mesh = Mesh(
        rng.normal(size=(n, 3)),
        np.stack([rng.permutation(n)[:3] for _ in range(f)]).astype(np.int32),
        rng.integers(0, 255, (n, 3), dtype=np.uint8),
    )
    path = tmp_path_factory.mktemp("mesh") / "obj_000001.ply"
    path.write_bytes(meshes.encode_mesh(mesh))
    read = meshes.load_mesh(path)
    np.testing.assert_allclose(read.vertices, mesh.vertices, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(read.colours, mesh.colours)


def test_millimetres_on_disk_are_metres_in_memory(tmp_path):
    trimesh.creation.box((100, 50, 20)).export(tmp_path / "box.ply")
    mesh = meshes.load_mesh(tmp_path / "box.ply")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.1, 0.05, 0.02], rtol=1e-6)
    assert (mesh.colours == 128).all()


def test_a_texture_gives_its_colours_to_the_vertices(tmp_path):
    Image.fromarray(np.array([[[250, 0, 0], [0, 0, 250]]], dtype=np.uint8).repeat(2, axis=0)).save(tmp_path / "t.png")
    (tmp_path / "quad.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nproperty float s\nproperty float t\nelement face 2\nproperty list uchar int vertex_indices\n"
        "end_header\n0 0 0 0 0\n10 0 0 1 0\n10 10 0 1 1\n0 10 0 0 1\n3 0 1 2\n3 0 2 3\n"
    )
    mesh = meshes.load_mesh(tmp_path / "quad.ply")
    left, right = mesh.colours[mesh.vertices[:, 0] == 0], mesh.colours[mesh.vertices[:, 0] > 0]
    assert (left == [250, 0, 0]).all()
    assert (right == [0, 0, 250]).all()


PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "missing"),
        ("solid cube\nendsolid", "not a PLY"),
        ("", "not a PLY"),
        (PLY + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0", "not a PLY"),
        (PLY + "end_header\n0 0 0\n1 0 0\n0 1 0\n", "no faces"),
        (
            PLY
            + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n",
            "finite",
        ),
        (
            PLY + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            "not there",
        ),
    ],
)
def test_what_is_no_mesh_is_refused(tmp_path, content, message):
    path = tmp_path / "obj_000001.ply"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        meshes.load_mesh(path)
    assert caught.value.file == path
    assert caught.value.field
    assert caught.value.remedy


@pytest.mark.parametrize("faces", [100, 500, 2000])
def test_a_coarse_copy_is_small_near_and_of_the_same_colours(faces):
    mesh = sphere()
    small = meshes.simplify(mesh, faces)
    assert 0.9 * faces <= len(small.faces) <= faces
    assert small.faces.max() < len(small.vertices) == len(small.colours)
    # F equal triangles on a unit sphere have a sagitta of 4.8 / F; quadrics put the vertices that far outside
    radii = np.linalg.norm(small.vertices, axis=1)
    assert np.abs(radii / 0.05 - 1).max() < 12 / faces
    expected = np.interp(small.vertices[:, 2], [-0.05, 0.05], [0, 255])
    assert np.abs(small.colours[:, 0] - expected).max() < 15


def test_simplification_gives_the_same_every_time_and_leaves_its_input():
    mesh = sphere()
    before = mesh.vertices.copy(), mesh.faces.copy()
    first, second = meshes.simplify(mesh, 300), meshes.simplify(mesh, 300)
    for name in ("vertices", "faces", "colours"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    np.testing.assert_array_equal(mesh.vertices, before[0])
    np.testing.assert_array_equal(mesh.faces, before[1])


def test_simplification_follows_a_change_of_place_and_scale():
    mesh = sphere()
    away = Mesh(mesh.vertices * 1e-2 + [3.0, -2.0, 1.0], mesh.faces, mesh.colours)
    radii = np.linalg.norm(meshes.simplify(away, 300).vertices - [3.0, -2.0, 1.0], axis=1)
    assert np.abs(radii / 0.0005 - 1).max() < 12 / 300


def test_seams_are_welded_before_they_can_tear():
    mesh = sphere()
    # a vertex for each corner of each face, as an export with texture seams everywhere has
    torn = Mesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3),
        mesh.colours[mesh.faces].reshape(-1, 3),
    )
    small = meshes.simplify(torn, 300)
    assert trimesh.Trimesh(small.vertices, small.faces, process=False).is_watertight


def test_a_small_mesh_stays_as_it_is():
    mesh = box_mesh(0.1, 0.2, 0.3)
    assert meshes.simplify(mesh, 12) is mesh


def test_diameter_is_the_largest_distance_of_two_vertices():
    assert meshes.diameter(box_mesh(0.3, 0.4, 1.2)) == pytest.approx(1.3)
    flat = box_mesh(0.3, 0.4, 0.0)
    assert meshes.diameter(flat) == pytest.approx(0.5)
