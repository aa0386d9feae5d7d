"""A run small enough to be written in each test: three classes, two visits, a handful of frames of 32 x 24 pixels."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue, ContinuousSymmetry, Mesh, ObjectClass
from sequences.types import Detection, LocalisationNoise
from sequences.writing import FrameTruth, RunWriter, Sighting

CAMERA = Camera(40.0, 41.0, 15.5, 11.5, width=32, height=24)
NOISE = LocalisationNoise(rotation_rad=0.01, translation_m=0.02, correlation_time_s=5.0)
SECOND = 1_000_000_000


def box_mesh(x: float, y: float, z: float) -> Mesh:
    """A box of the given edges, metres, each corner with a colour of its own."""
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]) * [x, y, z]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))], dtype=np.int32)
    return Mesh(corners, faces, np.arange(24, dtype=np.uint8).reshape(8, 3) * 10)


def tiny_catalogue() -> Catalogue:
    """obj_ids 1, 5 and 12: a box with its half-turns about an offset frame, a can, a table that supports."""
    half_turns = np.stack([np.eye(4), *(se3.exp(np.array([*axis, 0, 0, 0])) for axis in np.pi * np.eye(3))])
    centre = se3.make(np.eye(3), np.array([0.01, -0.02, 0.03]))
    return Catalogue(
        (
            _class(1, "box", "food", box_mesh(0.1, 0.06, 0.04), centre @ half_turns @ se3.inverse(centre)),
            _class(5, "can", "kitchen", box_mesh(0.07, 0.07, 0.1), axes=(np.array([0.0, 0.0, 1.0]),)),
            _class(12, "table", "furniture", box_mesh(1.0, 0.6, 0.7), supports=True),
        )
    )


def _class(
    obj_id: int,
    name: str,
    category: str,
    mesh: Mesh,
    discrete: np.ndarray | None = None,
    axes: tuple[np.ndarray, ...] = (),
    supports: bool = False,
) -> ObjectClass:
    return ObjectClass(
        obj_id=obj_id,
        name=name,
        category=category,
        persistence_s=3600.0 * obj_id,
        supports=supports,
        movable=not supports,
        mesh=mesh,
        diameter_m=float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))),
        symmetries_discrete=np.eye(4)[None] if discrete is None else discrete,
        symmetries_continuous=tuple(ContinuousSymmetry(axis, np.array([0.001, 0.002, 0.0])) for axis in axes),
    )


def write_tiny_run(target: Path, *, visits: int = 2, frames: int = 3, seed: int = 0, truth: bool = True) -> None:
    """Scenes 1, 2, ... with images 1, 2, ..., two detections and two true objects a frame, one moved between visits."""
    rng = np.random.default_rng(seed)
    with RunWriter(
        target, tiny_catalogue(), source="tests", up_world=np.array([0.0, 0.0, 1.0]), localisation=NOISE
    ) as writer:
        for v in range(visits):
            visit = writer.add_visit(v + 1, se3.exp(rng.normal(size=6)))
            if truth and v > 0:
                visit.add_move(101, (1000 * v - 500) * SECOND, "moved", None, 105)
            for k in range(frames):
                T_world_camera = se3.exp(rng.normal(size=6))
                sightings = tuple(
                    Sighting(100 + obj_id, obj_id, se3.exp(rng.normal(size=6)), 0.5, support)
                    for obj_id, support in ((1, 105), (5, None))
                )
                visit.add_frame(
                    k + 1,
                    (1000 * v + k) * SECOND,
                    CAMERA,
                    T_world_camera,
                    rng.uniform(0.5, 2.0, (24, 32)).astype(np.float32),
                    rng.integers(0, 255, (24, 32, 3), dtype=np.uint8),
                    [Detection((3.0 + 9 * d, 4.0, 5.0, 6.0), rng.dirichlet(np.ones(4))) for d in range(2)],
                    FrameTruth(T_world_camera @ se3.exp(0.01 * rng.normal(size=6)), sightings) if truth else None,
                )


def make_plain(run: Path) -> None:
    """Take away all that isn't BOP's own."""
    for name in ("ctmap.json", "catalogue.json"):
        (run / name).unlink()
    for scene in (run / "test").iterdir():
        (scene / "scene_camera_gt.json").unlink(missing_ok=True)
        (scene / "scene_detections.json").unlink()
        edit(scene / "scene_camera.json", lambda entries: [e.pop("timestamp_ns") for e in entries.values()])


def edit(file: Path, change: Callable[[Any], Any]) -> None:
    """Change a JSON file in place: `change` alters the value that it is handed."""
    value = json.loads(file.read_text())
    change(value)
    file.write_text(json.dumps(value))
