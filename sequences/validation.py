"""Everything that is in a run and everything that is wrong with it, by the same checks that `load_run` makes.

Beyond what loading checks, this decodes every image, reads the truth and compares each mesh with its stated diameter.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sequences import layout
from sequences.bop import read_run
from sequences.catalogue import ObjectClass
from sequences.classes import read_obj_ids
from sequences.meshes import diameter
from sequences.problems import Checks, Problem
from sequences.truth import read_truth
from sequences.types import Frame, Run, Truth, Visit

__all__ = ["ClassFacts", "Facts", "Inspection", "Problem", "VisitFacts", "inspect_run"]

_DIAMETER_TOLERANCE = 0.1
_PLAUSIBLE_DEPTH_M = (0.05, 20.0)
_FILES = (layout.CAMERA, layout.CATALOGUE, layout.CTMAP, f"{layout.MODELS}/{layout.MODELS_INFO}")
_SCENE_FILES = (
    layout.SCENE_CAMERA,
    layout.SCENE_DETECTIONS,
    layout.SCENE_GT,
    layout.SCENE_GT_INFO,
    layout.SCENE_CAMERA_GT,
    layout.SCENE_GT_MOVES,
)


@dataclass(frozen=True)
class ClassFacts:
    """One class of the catalogue."""

    obj_id: int
    name: str
    category: str
    persistence_s: float
    diameter_m: float
    faces: int
    symmetries: str
    """in words: "none", "4 discrete", "1 continuous" """


@dataclass(frozen=True)
class VisitFacts:
    """One visit."""

    scene_id: int
    frames: int
    duration_s: float
    width: int
    """pixels, of the first frame"""
    height: int
    """pixels, of the first frame"""
    colour: bool
    """whether there are colour images"""
    detections: int
    detections_per_frame: float
    files: dict[str, bool]
    """which files of the scene are there"""


@dataclass(frozen=True)
class Facts:
    """What is there, as far as it could be read."""

    name: str
    visits: tuple[VisitFacts, ...]
    frames: int
    duration_s: float
    """from the first frame of the first visit to the last of the last"""
    classes: tuple[ClassFacts, ...]
    categories: tuple[str, ...]
    detections_per_frame: float
    files: dict[str, bool]
    """which files of the run are there"""
    has_truth: bool
    true_objects: int
    true_moves: int
    up_world: tuple[float, ...] | None
    localisation: dict[str, float]
    """standard deviations of the recorded poses: rotation_rad, translation_m, correlation_time_s"""
    derived: tuple[str, ...]
    """defaults taken because the data doesn't say, in words"""
    fingerprint: str


@dataclass(frozen=True)
class Inspection:
    """The answer of `inspect_run`."""

    path: Path
    facts: Facts | None
    """None where there is nothing that could be read as a run"""
    problems: tuple[Problem, ...]
    """all of them: errors before warnings, else in the order of reading"""

    @property
    def errors(self) -> tuple[Problem, ...]:
        """The problems that keep the run from being used."""
        return tuple(p for p in self.problems if p.severity == "error")

    def to_json(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        problems = [{**asdict(p), "file": None if p.file is None else str(p.file)} for p in self.problems]
        facts = None if self.facts is None else asdict(self.facts)
        return {"schema": 1, "path": str(self.path), "facts": facts, "problems": problems}


def inspect_run(path: Path | str, scene: int | None = None) -> Inspection:
    """Read all of a run, its images and its truth too, and gather every problem instead of raising the first.

    Args:
        path: the folder that holds models/ and test/.
        scene: as for `load_run`.
    """
    root = Path(path)
    checks = Checks(strict=False)
    facts = None
    with checks.part():
        run = read_run(root, scene, checks)
        truth = read_truth(run, read_obj_ids(root), checks)
        _check_meshes(run, checks)
        for frame in run.frames:
            _check_images(frame, checks)
        facts = _facts(run, truth, checks)
    problems = sorted(checks.problems, key=lambda p: p.severity != "error")
    return Inspection(root, facts, tuple(problems))


def _check_meshes(run: Run, checks: Checks) -> None:
    for one in run.catalogue.classes:
        measured = diameter(one.mesh)
        if abs(measured - one.diameter_m) > _DIAMETER_TOLERANCE * one.diameter_m:
            checks.warn(
                f"diameter {one.diameter_m * 1e3:.4g} mm, but the mesh measures {measured * 1e3:.4g} mm",
                file=run.path / layout.MODELS / layout.MODELS_INFO,
                field=f"{one.obj_id}.diameter",
                remedy="scale the mesh to millimetres, or correct the diameter",
            )


def _check_images(frame: Frame, checks: Checks) -> None:
    with checks.part():
        frame.read_colour()
    with checks.part():
        depth = frame.read_depth()
        measured = depth[depth > 0]
        low, high = _PLAUSIBLE_DEPTH_M
        if len(measured) == 0:
            checks.warn(
                "no pixel has a depth",
                file=frame.depth_path,
                field="pixels",
                remedy="remove the frame, or copy the image again from the recording",
            )
        elif not low <= (median := float(np.median(measured))) <= high:
            checks.warn(
                f"the median depth is {median:.3g} m",
                file=frame.depth_path.parent.parent / layout.SCENE_CAMERA,
                field=f"{frame.im_id}.depth_scale",
                remedy="write depth_scale in millimetres a count",
            )


def _facts(run: Run, truth: Truth | None, checks: Checks) -> Facts:
    frames = run.frames
    classes = run.catalogue.classes
    return Facts(
        name=run.name,
        visits=tuple(_visit_facts(visit) for visit in run.visits),
        frames=len(frames),
        duration_s=_duration_s(frames),
        classes=tuple(
            ClassFacts(c.obj_id, c.name, c.category, c.persistence_s, c.diameter_m, len(c.mesh.faces), symmetries)
            for c, symmetries in zip(classes, map(_symmetries, classes), strict=True)
        ),
        categories=tuple(sorted({c.category for c in classes})),
        detections_per_frame=_mean(len(frame.detections) for frame in frames),
        files={name: (run.path / name).is_file() for name in _FILES},
        has_truth=truth is not None and len(truth.objects) > 0,
        true_objects=0 if truth is None else len(truth.objects),
        true_moves=0 if truth is None else len(truth.moves),
        up_world=None if run.up_world is None else tuple(run.up_world.tolist()),
        localisation=asdict(run.localisation),
        derived=tuple(checks.notes),
        fingerprint=run.fingerprint,
    )


def _visit_facts(visit: Visit) -> VisitFacts:
    first = visit.frames[0]
    folder = first.depth_path.parent.parent
    counts = [len(frame.detections) for frame in visit.frames]
    return VisitFacts(
        scene_id=visit.scene_id,
        frames=len(visit.frames),
        duration_s=_duration_s(visit.frames),
        width=first.camera.width,
        height=first.camera.height,
        colour=first.colour_path is not None,
        detections=sum(counts),
        detections_per_frame=_mean(counts),
        files={name: (folder / name).is_file() for name in _SCENE_FILES},
    )


def _duration_s(frames: tuple[Frame, ...]) -> float:
    return (frames[-1].time_ns - frames[0].time_ns) * 1e-9 if frames else 0.0


def _mean(counts: Iterable[int]) -> float:
    values = list(counts)
    return sum(values) / len(values) if values else 0.0


def _symmetries(c: ObjectClass) -> str:
    parts = []
    if len(c.symmetries_discrete) > 1:
        parts.append(f"{len(c.symmetries_discrete)} discrete")
    if c.symmetries_continuous:
        parts.append(f"{len(c.symmetries_continuous)} continuous")
    return ", ".join(parts) or "none"
