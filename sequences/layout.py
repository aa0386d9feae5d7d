"""The names and units of a run on disk, shared by its reader and its writer; docs/run-layout.md describes them.

A run is a BOP dataset (https://bop.felk.cvut.cz), millimetres on disk. Matrices are row-major lists.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.errors import InputError
from sequences.jsonfile import Node

Array = NDArray[np.float64]

SCHEMA = 1
MM = 1e-3
ROTATION_TOLERANCE = 1e-3  # BOP files round to six digits, some tools to four

CAMERA, CATALOGUE, CTMAP = "camera.json", "catalogue.json", "ctmap.json"
MODELS, MODELS_INFO = "models", "models_info.json"
SCENE_CAMERA, SCENE_DETECTIONS = "scene_camera.json", "scene_detections.json"
SCENE_GT, SCENE_GT_INFO, SCENE_CAMERA_GT = "scene_gt.json", "scene_gt_info.json", "scene_camera_gt.json"
SCENE_GT_MOVES = "scene_gt_moves.json"
DEPTH, COLOUR = "depth", ("rgb", "gray")
SPLIT = "test"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
BACKGROUND = "background"


@dataclass(frozen=True)
class Scene:
    """The folder of one scene."""

    scene_id: int
    folder: Path


def mesh_name(obj_id: int) -> str:
    """File name of a class's mesh."""
    return f"obj_{obj_id:06d}.ply"


def image_name(im_id: int) -> str:
    """File name of an image as written here; the reader takes any padding."""
    return f"{im_id:06d}.png"


def scene_name(scene_id: int) -> str:
    """Folder name of a scene."""
    return f"{scene_id:06d}"


def find_scenes(root: Path) -> tuple[Scene, ...]:
    """The scenes of the folder `test`, or of the only split folder that has any, by ascending scene_id.

    Raises InputError where there is none, where several splits compete, or where `root` is in another layout.
    """
    if not root.is_dir():
        raise InputError(
            "no such folder", file=root, field="run", remedy="give the folder that holds models/ and test/"
        )
    splits = {folder.name: found for folder in sorted(root.iterdir()) if (found := _scenes_in(folder))}
    if SPLIT in splits:
        return splits[SPLIT]
    if len(splits) == 1:
        return next(iter(splits.values()))
    if splits:
        names = ", ".join(splits)
        raise InputError(
            f"several split folders hold scenes ({names}) and none is called {SPLIT}",
            file=root,
            field="split",
            remedy=f"rename the one to use to {SPLIT}",
        )
    raise _no_scenes(root)


def _scenes_in(split: Path) -> tuple[Scene, ...]:
    if not split.is_dir():
        return ()
    folders = [folder for folder in split.iterdir() if folder.name.isdigit() and folder.is_dir()]
    return tuple(sorted((Scene(int(folder.name), folder) for folder in folders), key=lambda scene: scene.scene_id))


def _no_scenes(root: Path) -> InputError:
    if (root / "depth.txt").is_file() or (root / "rgb.txt").is_file():
        return InputError(
            "this is a recording in the TUM RGB-D layout, not a BOP dataset",
            file=root,
            field="layout",
            remedy="convert it to a BOP dataset, as docs/run-layout.md describes",
        )
    if (root / SCENE_CAMERA).is_file():
        return InputError(
            "this is the folder of one scene, not the dataset",
            file=root,
            field="layout",
            remedy="give the folder two levels up, which holds models/ and test/",
        )
    return InputError(
        "holds no scene",
        file=root,
        field=f"{SPLIT}/000001",
        remedy=f"put each scene into a folder {SPLIT}/NNNNNN with {SCENE_CAMERA}, {DEPTH}/ and rgb/",
    )


def images_in(folder: Path) -> dict[int, Path]:
    """Image files by their number; empty where the folder is missing."""
    if not folder.is_dir():
        return {}
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.stem.isdigit())
    return {int(p.stem): p for p in files}


def unit(node: Node) -> Array:
    """Three numbers -> the unit vector (3,) along them."""
    vector = node.numbers(3)
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise node.error("has no direction", "write a vector that isn't zero")
    return vector / length


def rotation(node: Node) -> Array:
    """Nine numbers -> the nearest rotation (3, 3); rounding to four digits is forgiven."""
    R = node.numbers(9).reshape(3, 3)
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise node.error("not a rotation: R R^T differs from the identity, or det R < 0", "write an orthonormal matrix")
    U, _, Vt = np.linalg.svd(R)
    nearest: Array = U @ Vt
    return nearest


def motion(node: Node) -> Array:
    """Sixteen numbers, translation in mm -> a rigid motion (4, 4) in metres."""
    T = node.numbers(16).reshape(4, 4)
    if np.abs(T[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        raise node.error("the last row is not 0 0 0 1", "write a rigid motion, row by row")
    R = rotation(Node(T[:3, :3].ravel().tolist(), node.file, node.field))
    return se3.make(R, T[:3, 3] * MM)


def camera_pose(node: Node) -> Array | None:
    """An entry of scene_camera.json (or scene_camera_gt.json) -> T_visit_camera (4, 4); None where it has no pose."""
    R, t = node.get("cam_R_w2c"), node.get("cam_t_w2c")
    if R is None and t is None:
        return None
    return se3.inverse(se3.make(rotation(node["cam_R_w2c"]), node["cam_t_w2c"].numbers(3) * MM))


def image_entries(root: Node) -> dict[int, Node]:
    """A file keyed by image number -> its entries by ascending number."""
    entries = {}
    for key, node in root.members():
        if not key.isdigit():
            raise node.error("the key is not an image number", "key each entry with its image number")
        entries[int(key)] = node
    return dict(sorted(entries.items()))
