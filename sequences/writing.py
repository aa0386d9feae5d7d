"""Writing a run: everything goes into a hidden folder beside the target, which takes the target's place at the end."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sequences import layout, se3
from sequences.atomic import replace_folder, write_json
from sequences.camera import Camera
from sequences.catalogue import Catalogue, ObjectClass
from sequences.detections import detection_json
from sequences.errors import InputError
from sequences.images import encode_png
from sequences.jsonfile import Node
from sequences.meshes import encode_mesh
from sequences.types import Detection, LocalisationNoise, MoveKind

Array = NDArray[np.float64]
Json = dict[str, Any]

_DEEPEST = np.iinfo(np.uint16).max


@dataclass(frozen=True)
class Sighting:
    """One physical object in one frame, as the truth has it."""

    inst_id: int
    """which physical object, the same in all visits"""
    obj_id: int
    T_world_object: Array
    """(4, 4) metres"""
    visible_fraction: float
    """visible share of the silhouette"""
    support: int | None = None
    """inst_id of the object that it stands on; None where that isn't known, or is none of the truth's objects"""
    visible_box: tuple[float, float, float, float] | None = None
    """x, y, width, height of the visible pixels, pixels; zeros where there are none, None where that isn't known"""


@dataclass(frozen=True)
class FrameTruth:
    """The truth about one frame."""

    T_world_camera: Array
    """(4, 4) where the camera really was"""
    sightings: tuple[Sighting, ...]


class RunWriter:
    """Writes a run whole or not at all; a context manager.

    Leaving the block in good order puts the run in place; an exception leaves the target as it was. A target that holds
    anything is refused, unless it is a run that the same `source` wrote.

    Args:
        target: the run's folder.
        catalogue: the classes, with their meshes.
        source: what writes the run, such as "simulation"; kept in ctmap.json.
        up_world: (3,) against gravity, or None where it isn't known.
        localisation: noise of the recorded camera poses.
        T_robot_camera: (4, 4) the camera on the robot, or None.
        depth_scale: millimetres a count of the depth images.

    Raises:
        InputError: the target is taken, or can't be written.
    """

    def __init__(
        self,
        target: Path | str,
        catalogue: Catalogue,
        *,
        source: str,
        up_world: Array | None = None,
        localisation: LocalisationNoise | None = None,
        T_robot_camera: Array | None = None,
        depth_scale: float = 0.1,
    ) -> None:
        self._target = Path(target)
        self._catalogue = catalogue
        self._source = source
        self._up_world = up_world
        self._localisation = localisation or LocalisationNoise()
        self._T_robot_camera = T_robot_camera
        self._depth_scale = depth_scale
        self._visits: dict[int, VisitWriter] = {}
        self._check_target()

    def __enter__(self) -> Self:
        try:
            self._target.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(dir=self._target.parent, prefix=f".{self._target.name}.partial-"))
        except OSError as error:
            raise InputError(
                f"can't be written ({error.strerror})", file=self._target, field="run", remedy="choose another folder"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
                self._check_target()
                replace_folder(self._folder, self._target)
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def add_visit(self, scene_id: int, T_world_visit: Array | None = None) -> VisitWriter:
        """A new visit, whose own frame stands at T_world_visit (4, 4) in the world; the identity where not given."""
        if scene_id in self._visits:
            raise ValueError(f"visit {scene_id} has been added already")
        visit = VisitWriter(
            scene_id=scene_id,
            folder=self._folder / layout.SPLIT / layout.scene_name(scene_id),
            T_world_visit=np.eye(4) if T_world_visit is None else T_world_visit,
            catalogue=self._catalogue,
            depth_scale=self._depth_scale,
            source=self._source,
        )
        self._visits[scene_id] = visit
        return visit

    def _check_target(self) -> None:
        if not self._target.exists() or (self._target.is_dir() and not any(self._target.iterdir())):
            return
        about = self._target / layout.CTMAP
        if about.is_file():
            source = Node.read(about, "").get("source")
            if source is not None and source.value == self._source:
                return
        raise InputError(
            f"there is something that {self._source} did not write",
            file=self._target,
            field="run",
            remedy="choose another folder, or move it away",
        )

    def _finish(self) -> None:
        cameras = [camera for visit in self._visits.values() for camera in visit.cameras]
        if not cameras:
            raise ValueError("a run needs at least one frame")
        write_json(self._folder / layout.CAMERA, _camera_json(cameras[0], self._depth_scale))
        models = self._folder / layout.MODELS
        for one in self._catalogue.classes:
            _write(models / layout.mesh_name(one.obj_id), encode_mesh(one.mesh))
        write_json(models / layout.MODELS_INFO, {str(c.obj_id): _model_json(c) for c in self._catalogue.classes})
        write_json(self._folder / layout.CATALOGUE, {str(c.obj_id): class_json(c) for c in self._catalogue.classes})
        write_json(self._folder / layout.CTMAP, self._description())
        for visit in self._visits.values():
            visit.finish()
        self._folder.chmod(0o755)  # mkdtemp's folders are closed to others

    def _description(self) -> Json:
        noise = self._localisation
        return {
            "schema": layout.SCHEMA,
            "source": self._source,
            "score_order": [layout.BACKGROUND, *self._catalogue.obj_ids],
            "visits": [
                {"scene_id": scene_id, "T_world_visit": _motion_json(visit.T_world_visit)}
                for scene_id, visit in self._visits.items()
            ],
            "up_world": None if self._up_world is None else np.asarray(self._up_world, dtype=float).tolist(),
            "localisation": {
                "rotation_rad": noise.rotation_rad,
                "translation_mm": noise.translation_m / layout.MM,
                "correlation_time_s": noise.correlation_time_s,
            },
            "T_robot_camera": None if self._T_robot_camera is None else _motion_json(self._T_robot_camera),
        }


@dataclass
class VisitWriter:
    """One visit of a run that is being written; see `RunWriter.add_visit`."""

    scene_id: int
    folder: Path
    T_world_visit: Array
    catalogue: Catalogue
    depth_scale: float
    source: str
    cameras: list[Camera] = field(default_factory=list)
    _frames: Json = field(default_factory=dict)
    _detections: list[Json] = field(default_factory=list)
    _truth: Json = field(default_factory=dict)
    _truth_info: Json = field(default_factory=dict)
    _truth_cameras: Json = field(default_factory=dict)
    _moves: list[Json] = field(default_factory=list)

    def add_frame(
        self,
        im_id: int,
        time_ns: int,
        camera: Camera,
        T_world_camera: Array,
        depth: NDArray[np.float32],
        colour: NDArray[np.uint8] | None = None,
        detections: Sequence[Detection] = (),
        truth: FrameTruth | None = None,
    ) -> None:
        """Write the images of a frame now, the rest at the end.

        Args:
            im_id: image number; image numbers and times ascend together.
            time_ns: UTC.
            camera: intrinsics.
            T_world_camera: (4, 4) the recorded localisation, in the world frame.
            depth: (h, w) metres, 0 = no measurement; what is too deep for 16 bits becomes 0.
            colour: (h, w, 3) RGB.
            detections: class_scores in the catalogue's order.
            truth: what is known of the frame; give it for all frames of a visit, or for none.
        """
        if depth.shape != (camera.height, camera.width):
            raise ValueError(f"depth of shape {depth.shape}, camera of {camera.height} x {camera.width}")
        key = str(im_id)
        self.cameras.append(camera)
        counts = np.rint(np.asarray(depth, dtype=np.float64) / (self.depth_scale * layout.MM))
        counts = np.where(counts <= _DEEPEST, counts, 0).astype(np.uint16)
        _write(self.folder / layout.DEPTH / layout.image_name(im_id), encode_png(counts))
        if colour is not None:
            _write(self.folder / layout.COLOUR[0] / layout.image_name(im_id), encode_png(colour))
        self._frames[key] = {
            "cam_K": camera.K.ravel().tolist(),
            "depth_scale": self.depth_scale,
            **self._pose_json(T_world_camera),
            "timestamp_ns": int(time_ns),
        }
        obj_ids = self.catalogue.obj_ids
        self._detections += [detection_json(d, self.scene_id, im_id, obj_ids, self.source) for d in detections]
        if truth is not None:
            self._truth_cameras[key] = self._pose_json(truth.T_world_camera)
            self._truth[key] = [_sighting_json(s, truth.T_world_camera) for s in truth.sightings]
            self._truth_info[key] = [_visibility_json(s) for s in truth.sightings]

    def add_move(
        self,
        inst_id: int,
        time_ns: int,
        kind: MoveKind,
        from_support: int | None = None,
        to_support: int | None = None,
    ) -> None:
        """The truth about one move, made in this visit or between the one before and this; see `types.TrueMove`."""
        supports = {"from_support": from_support, "to_support": to_support}
        self._moves.append({"inst_id": inst_id, "time_ns": int(time_ns), "kind": kind, **supports})

    def finish(self) -> None:
        """Write the visit's JSON files."""
        write_json(self.folder / layout.SCENE_CAMERA, self._frames)
        write_json(self.folder / layout.SCENE_DETECTIONS, self._detections)
        if self._truth:
            write_json(self.folder / layout.SCENE_GT, self._truth)
            write_json(self.folder / layout.SCENE_GT_INFO, self._truth_info)
            write_json(self.folder / layout.SCENE_CAMERA_GT, self._truth_cameras)
        if self._moves:
            write_json(self.folder / layout.SCENE_GT_MOVES, self._moves)

    def _pose_json(self, T_world_camera: Array) -> Json:
        T_camera_visit = se3.inverse(T_world_camera) @ self.T_world_visit
        return {
            "cam_R_w2c": T_camera_visit[:3, :3].ravel().tolist(),
            "cam_t_w2c": (T_camera_visit[:3, 3] / layout.MM).tolist(),
        }


def _write(path: Path, data: bytes) -> None:
    # the whole folder is hidden until it is complete, so files need no care of their own
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _motion_json(T: Array) -> list[float]:
    out = np.array(T, dtype=np.float64)
    out[:3, 3] /= layout.MM
    numbers: list[float] = out.ravel().tolist()
    return numbers


def _camera_json(camera: Camera, depth_scale: float) -> Json:
    size = {"width": camera.width, "height": camera.height}
    return {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, **size, "depth_scale": depth_scale}


def class_json(c: ObjectClass) -> Json:
    """What catalogue.json says of a class."""
    return {
        "name": c.name,
        "category": c.category,
        "persistence_s": c.persistence_s,
        "supports": c.supports,
        "movable": c.movable,
    }


def _model_json(c: ObjectClass) -> Json:
    low, high = c.mesh.vertices.min(axis=0) / layout.MM, c.mesh.vertices.max(axis=0) / layout.MM
    out: Json = {"diameter": c.diameter_m / layout.MM}
    out |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    out |= {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
    if len(c.symmetries_discrete) > 1:
        out["symmetries_discrete"] = [_motion_json(T) for T in c.symmetries_discrete[1:]]
    if c.symmetries_continuous:
        out["symmetries_continuous"] = [
            {"axis": s.axis.tolist(), "offset": (s.offset / layout.MM).tolist()} for s in c.symmetries_continuous
        ]
    return out


def _visibility_json(sighting: Sighting) -> Json:
    out: Json = {"visib_fract": float(sighting.visible_fraction)}
    box = sighting.visible_box
    if box is not None:
        out["bbox_visib"] = [float(value) for value in box] if box[2] > 0 else [-1, -1, -1, -1]  # as BOP has it
    return out


def _sighting_json(sighting: Sighting, T_world_camera: Array) -> Json:
    T_camera_object = se3.inverse(T_world_camera) @ sighting.T_world_object
    out: Json = {
        "obj_id": sighting.obj_id,
        "inst_id": sighting.inst_id,
        "cam_R_m2c": T_camera_object[:3, :3].ravel().tolist(),
        "cam_t_m2c": (T_camera_object[:3, 3] / layout.MM).tolist(),
    }
    return out if sighting.support is None else {**out, "support": sighting.support}
