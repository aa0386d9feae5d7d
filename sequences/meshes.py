"""Triangle meshes on disk (PLY, millimetres) and in memory (`catalogue.Mesh`, metres); coarse copies for scoring."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.errors import InputError

GREY = 128
_MM = 1e-3


def load_mesh(path: Path) -> Mesh:
    """Read a PLY in millimetres.

    Colours come from the vertices, or are sampled at the vertices from a texture, or are the mean of the faces around.

    Raises:
        InputError: no such file, not a PLY, no faces, a coordinate that isn't finite, a face without its vertices.
    """
    import trimesh

    if not path.is_file():
        raise InputError("the mesh is missing", file=path, field="(whole file)", remedy="add it, or drop the class")
    try:
        loaded: Any = trimesh.load(path, file_type="ply", process=False, force="mesh")
    except Exception as error:  # trimesh's PLY reader raises whatever its parsing runs into
        raise _bad(path, "header", f"not a PLY that can be read ({error})", "export the mesh as PLY") from error
    vertices = np.array(getattr(loaded, "vertices", np.zeros((0, 3))), dtype=np.float64) * _MM
    faces = np.array(getattr(loaded, "faces", np.zeros((0, 3))), dtype=np.int64)
    if len(faces) == 0 or faces.ndim != 2:
        raise _bad(path, "element face", "has no faces", "export triangles, not a point cloud")
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise _bad(path, f"vertex {bad}", "a coordinate is not finite", "repair the mesh and export it again")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise _bad(path, "element face", "a face names a vertex that is not there", "export the mesh again")
    return Mesh(vertices, faces.astype(np.int32), _vertex_colours(loaded, len(vertices)))


def encode_mesh(mesh: Mesh) -> bytes:
    """A binary PLY in millimetres with vertex colours; coordinates are rounded to float32."""
    import trimesh

    out = trimesh.Trimesh(mesh.vertices / _MM, mesh.faces, vertex_colors=mesh.colours, process=False)
    data: Any = out.export(file_type="ply")
    return bytes(data)


def simplify(mesh: Mesh, faces: int) -> Mesh:
    """A copy of at most `faces` triangles or thereabouts, by quadric decimation; the mesh itself where it has no more.

    Garland and Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997. Vertices at one place are
    welded first, or the seams of a texture would tear; each takes the colour of the nearest vertex of `mesh`.
    """
    if len(mesh.faces) <= faces:
        return mesh
    import fast_simplification
    from scipy.spatial import cKDTree

    points, inverse = np.unique(mesh.vertices, axis=0, return_inverse=True)
    welded = inverse.reshape(-1)[mesh.faces].astype(np.int32)
    welded = welded[(welded != np.roll(welded, 1, axis=1)).all(axis=1)]
    # the library works in float32: centre and scale, so that no digits are lost
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    scale = float(np.ptp(points, axis=0).max())
    small, triangles = fast_simplification.simplify(
        ((points - centre) / scale).astype(np.float32), welded, target_count=faces
    )
    vertices = small.astype(np.float64) * scale + centre
    colours = mesh.colours[cKDTree(mesh.vertices).query(vertices)[1]]
    return Mesh(vertices, triangles.astype(np.int32), colours)


def diameter(mesh: Mesh) -> float:
    """The largest distance between two vertices, metres."""
    from scipy.spatial import ConvexHull, QhullError
    from scipy.spatial.distance import pdist

    try:
        corners = mesh.vertices[ConvexHull(mesh.vertices).vertices]
    except QhullError:  # a flat mesh has no hull of volume
        corners = np.unique(mesh.vertices, axis=0)
    return float(pdist(corners).max())


def _vertex_colours(loaded: Any, n: int) -> NDArray[np.uint8]:
    """(n, 3) of a trimesh.Trimesh."""
    visual = loaded.visual
    if visual.kind == "texture":
        visual = visual.to_color()
    if visual.kind not in ("vertex", "face"):
        return np.full((n, 3), GREY, dtype=np.uint8)
    colours = np.array(visual.vertex_colors, dtype=np.uint8)[:, :3]
    return colours if len(colours) == n else np.full((n, 3), GREY, dtype=np.uint8)


def _bad(path: Path, field: str, message: str, remedy: str) -> InputError:
    return InputError(message, file=path, field=field, remedy=remedy)
