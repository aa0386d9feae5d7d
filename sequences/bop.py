"""Runs on disk: BOP datasets with a few files of ours beside (docs/run-layout.md).

`load_run` reads all that an estimator may see and nothing of the truth; `load_truth` reads the truth; `RunWriter` of
`sequences.writing` writes both. Everything cheap is checked at once (all JSON, the header of each image); pixels are
read, and judged, when a frame is asked for them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sequences import layout
from sequences.camera import Camera
from sequences.catalogue import Catalogue
from sequences.classes import read_catalogue, read_obj_ids
from sequences.detections import read_detections
from sequences.errors import InputError
from sequences.images import check_size, depth_size, image_size, read_colour, read_depth
from sequences.jsonfile import Node
from sequences.problems import Checks
from sequences.truth import load_truth
from sequences.types import Frame, LocalisationNoise, Run, Visit

__all__ = ["load_catalogue", "load_run", "load_truth"]

Array = NDArray[np.float64]

DEFAULT_RATE_HZ = 30


@dataclass(frozen=True)
class Description:
    """What ctmap.json says of the recording."""

    visits: dict[int, Array]
    """scene_id -> T_world_visit (4, 4)"""
    up_world: Array | None
    localisation: LocalisationNoise


def load_catalogue(root: Path | str) -> Catalogue:
    """The classes of a run: models/ and, where there is one, catalogue.json. Raises InputError."""
    return read_catalogue(Path(root), Checks())


def load_run(path: Path | str, *, scene: int | None = None) -> Run:
    """Read a run: a BOP dataset, plain or with ctmap.json.

    Args:
        path: the folder that holds models/ and test/.
        scene: the scene to read. Without it, all visits that ctmap.json lists, or, in plain BOP data, the only scene.

    Raises:
        InputError: with file, field and remedy, for the first thing that is wrong.
    """
    return read_run(Path(path), scene, Checks())


def read_run(root: Path, scene: int | None, checks: Checks) -> Run:
    """As `load_run`; with gathering checks, a run without the parts that are wrong, for `inspect_run` alone."""
    scenes = layout.find_scenes(root)
    catalogue = Catalogue(())
    obj_ids: tuple[int, ...] = ()
    with checks.part():
        obj_ids = read_obj_ids(root)
        catalogue = read_catalogue(root, checks)
    description = None
    with checks.part():
        description = read_description(root, obj_ids, checks)
    # in a gathering run ctmap.json may be there and broken: all scenes are then taken to be visits
    listed = tuple(() if description is None else description.visits) or tuple(s.scene_id for s in scenes)
    chosen = _choose(root, scenes, listed, scene)
    image_camera = None
    with checks.part():
        image_camera = _read_camera(root, required=description is not None, checks=checks)
    visits = []
    for one in chosen:
        with checks.part():
            visits.append(_read_visit(one, obj_ids, description, image_camera, checks))
    ordered: tuple[Visit, ...] = ()
    with checks.part():
        ordered = _in_order_of_time(visits)
    name = root.resolve().name
    return Run(
        path=root,
        name=name if description is not None or len(scenes) == 1 else f"{name}-{chosen[0].scene_id}",
        catalogue=catalogue,
        visits=ordered,
        up_world=None if description is None else description.up_world,
        localisation=LocalisationNoise() if description is None else description.localisation,
        fingerprint=_fingerprint(root, catalogue, chosen, ordered),
        notes=(*checks.notes, *map(str, checks.problems)) if checks.strict else tuple(checks.notes),
    )


# --- what the place is ---


def read_description(root: Path, obj_ids: tuple[int, ...], checks: Checks) -> Description | None:
    """ctmap.json; None, with a note, where there is none."""
    file = root / layout.CTMAP
    if not file.is_file():
        checks.note(
            f"{layout.CTMAP} is missing: plain BOP data, so each scene is a run of its own, "
            "up is unknown and the recorded camera poses are taken as exact"
        )
        return None
    node = Node.read(file, "")
    if node["schema"].integer() != layout.SCHEMA:
        raise node["schema"].error(
            f"schema {node['schema'].value}, this version reads {layout.SCHEMA}",
            "convert the run, or update the program",
        )
    visits: dict[int, Array] = {}
    up_world, localisation = None, LocalisationNoise()
    with checks.part():
        _check_score_order(node["score_order"], obj_ids)
    with checks.part():
        visits = _read_visits(node["visits"])
    with checks.part():
        up = node.get("up_world")
        up_world = None if up is None else layout.unit(up)
    with checks.part():
        localisation = _read_localisation(node.get("localisation"))
    with checks.part():
        robot = node.get("T_robot_camera")
        if robot is not None:
            layout.motion(robot)
    return Description(visits, up_world, localisation)


def _check_score_order(node: Node, obj_ids: tuple[int, ...]) -> None:
    expected = [layout.BACKGROUND, *obj_ids]
    found = [element.value for element in node.elements()]
    if obj_ids and found != expected:
        raise node.error("not the background and then the catalogue's obj_ids, ascending", f"write {expected}")


def _read_visits(node: Node) -> dict[int, Array]:
    visits: dict[int, Array] = {}
    for element in node.elements():
        scene_id = element["scene_id"].integer()
        if scene_id in visits:
            raise element["scene_id"].error(f"scene {scene_id} is listed twice", "list each visit once")
        T = element.get("T_world_visit")
        visits[scene_id] = np.eye(4) if T is None else layout.motion(T)
    if not visits:
        raise node.error("lists no visit", "list each scene of the place: {scene_id, T_world_visit}")
    return visits


def _read_localisation(node: Node | None) -> LocalisationNoise:
    if node is None:
        return LocalisationNoise()
    rotation, translation = node["rotation_rad"], node["translation_mm"]
    for sigma in (rotation, translation):
        if sigma.number() < 0:
            raise sigma.error("a standard deviation below zero", "write zero or more")
    return LocalisationNoise(rotation.number(), translation.number() * layout.MM, node["correlation_time_s"].positive())


def _choose(
    root: Path, scenes: tuple[layout.Scene, ...], listed: tuple[int, ...], scene: int | None
) -> tuple[layout.Scene, ...]:
    """The scenes to read: `scene`, or all that are listed as visits of the place."""
    found = {s.scene_id: s for s in scenes}
    names = ", ".join(map(str, found))
    if scene is not None:
        if scene not in found:
            raise InputError(f"no scene {scene}", file=root, field="scene", remedy=f"choose one of {names}")
        return (found[scene],)
    if len(scenes) > 1 and not (root / layout.CTMAP).is_file():
        raise InputError(
            f"holds {len(scenes)} scenes and no {layout.CTMAP} that makes them visits of one place",
            file=root,
            field="scene",
            remedy=f"choose one of them with --scene (scene= in Python): {names}",
        )
    missing = [scene_id for scene_id in listed if scene_id not in found]
    if missing:
        raise InputError(
            f"lists scene {missing[0]}, which has no folder",
            file=root / layout.CTMAP,
            field="visits",
            remedy=f"add the scene's folder, or list only {names}",
        )
    return tuple(found[scene_id] for scene_id in listed)


# --- one visit ---


@dataclass(frozen=True)
class _ImageCamera:
    """What camera.json says of all images; None where it doesn't."""

    K: Array | None
    depth_scale: float | None
    size: tuple[int, int] | None


def _read_camera(root: Path, *, required: bool, checks: Checks) -> _ImageCamera:
    file = root / layout.CAMERA
    if not file.is_file() and not required:
        checks.note(f"{layout.CAMERA} is missing: image sizes are those of the depth images")
        return _ImageCamera(None, None, None)
    node = Node.read(file, "add it: {fx, fy, cx, cy, width, height, depth_scale}")
    K = None
    if node.get("fx") is not None:
        fx, fy = node["fx"].positive(), node["fy"].positive()
        K = np.array([[fx, 0.0, node["cx"].number()], [0.0, fy, node["cy"].number()], [0.0, 0.0, 1.0]])
    scale = node.get("depth_scale")
    size = None
    if node.get("width") is None or node.get("height") is None:
        checks.note(f"{layout.CAMERA} has no width and height: image sizes are those of the depth images")
    else:
        size = (int(node["width"].positive()), int(node["height"].positive()))
    return _ImageCamera(K, None if scale is None else scale.positive(), size)


def _read_visit(
    scene: layout.Scene,
    obj_ids: tuple[int, ...],
    description: Description | None,
    image_camera: _ImageCamera | None,
    checks: Checks,
) -> Visit:
    file = scene.folder / layout.SCENE_CAMERA
    root = Node.read(file, "add it: for each image its cam_K, depth_scale, cam_R_w2c and cam_t_w2c")
    entries = layout.image_entries(root)
    if not entries:
        raise root.error("the scene has no frames", "add an entry for each image, or remove the scene")
    T_world_visit = np.eye(4) if description is None else description.visits.get(scene.scene_id, np.eye(4))
    poses = _poses(scene, entries, required=description is not None, checks=checks)
    times = _times(scene, entries, alone=description is None or len(description.visits) == 1, checks=checks)
    detections = read_detections(scene, obj_ids, set(entries), checks)
    depths = layout.images_in(scene.folder / layout.DEPTH)
    colours = _colours(scene, checks)
    _check_unlisted(scene, depths, entries, checks)
    frames = []
    for im_id, node in entries.items():
        with checks.part():
            path = depths.get(im_id)
            if path is None:
                raise InputError(
                    f"image {im_id} has no depth image",
                    file=scene.folder / layout.DEPTH / layout.image_name(im_id),
                    field=str(im_id),
                    remedy=f"add the image, or take {im_id} out of {layout.SCENE_CAMERA}",
                )
            camera, depth_scale = _intrinsics(node, image_camera, path)
            colour = colours.get(im_id)
            _check_colour(node, colour, (camera.width, camera.height), any_colour=bool(colours))
            if im_id not in poses or im_id not in times:
                continue  # the problem has been gathered already
            frames.append(
                Frame(
                    index=-1,
                    visit=-1,
                    scene_id=scene.scene_id,
                    im_id=im_id,
                    time_ns=times[im_id],
                    T_world_camera=T_world_visit @ poses[im_id],
                    camera=camera,
                    detections=detections.get(im_id, ()),
                    depth_path=path,
                    colour_path=colour,
                    read_depth=partial(read_depth, path, depth_scale * layout.MM, (camera.width, camera.height)),
                    read_colour=partial(read_colour, colour, (camera.width, camera.height)),
                )
            )
    return Visit(scene.scene_id, tuple(frames), T_world_visit)


def _poses(scene: layout.Scene, entries: dict[int, Node], *, required: bool, checks: Checks) -> dict[int, Array]:
    """T_visit_camera of each image."""
    poses: dict[int, Array] = {}
    without: list[int] = []
    for im_id, node in entries.items():
        with checks.part():
            pose = layout.camera_pose(node)
            if pose is None:
                without.append(im_id)
            else:
                poses[im_id] = pose
    if len(without) == len(entries) and not required:
        checks.note(f"scene {scene.scene_id} has no camera poses: the camera is taken to stand still at the origin")
        return {im_id: np.eye(4) for im_id in entries}
    for im_id in without:
        with checks.part():
            raise entries[im_id].error(
                "the image has no recorded camera pose", "add cam_R_w2c and cam_t_w2c, world to camera, mm"
            )
    return poses


def _times(scene: layout.Scene, entries: dict[int, Node], *, alone: bool, checks: Checks) -> dict[int, int]:
    """time_ns of each image, ascending with the image number."""
    stamps = {im_id: node.get("timestamp_ns") for im_id, node in entries.items()}
    if alone and all(stamp is None for stamp in stamps.values()):
        checks.note(f"scene {scene.scene_id} has no timestamp_ns: times are image number / {DEFAULT_RATE_HZ} Hz")
        return {im_id: round(im_id * 1e9 / DEFAULT_RATE_HZ) for im_id in entries}
    times: dict[int, int] = {}
    latest: tuple[int, int] | None = None
    for im_id, stamp in stamps.items():
        with checks.part():
            if stamp is None:
                raise entries[im_id].error("the image has no timestamp_ns", "add timestamp_ns, UTC, to every image")
            time = stamp.integer()
            if latest is not None and time <= latest[1]:
                raise stamp.error(
                    f"time runs backwards: image {im_id} is not after image {latest[0]}",
                    "number the images in the order of their times, each with a time of its own",
                )
            times[im_id] = time
            latest = (im_id, time)
    return times


def _intrinsics(node: Node, image_camera: _ImageCamera | None, depth: Path) -> tuple[Camera, float]:
    """The camera of one image and its depth_scale, mm a count."""
    known = image_camera or _ImageCamera(None, None, None)
    K = known.K if node.get("cam_K") is None and known.K is not None else _calibration(node["cam_K"])
    scale_node = node.get("depth_scale")
    if scale_node is None and known.depth_scale is not None:
        scale = known.depth_scale
    else:
        scale = node["depth_scale"].positive()
    found = depth_size(depth)
    size = known.size or found
    check_size(depth, found, size, layout.CAMERA)
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(fx, fy, cx, cy, width=size[0], height=size[1]), scale


def _calibration(node: Node) -> Array:
    K = node.numbers(9).reshape(3, 3)
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise node.error(
            f"focal length {min(K[0, 0], K[1, 1]):g} is not above zero", "write the camera's fx and fy, pixels"
        )
    if np.abs(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]).max() > 1e-6:
        raise node.error("not fx 0 cx, 0 fy cy, 0 0 1", "rectify the images: a pinhole without skew is all there is")
    return K


def _colours(scene: layout.Scene, checks: Checks) -> dict[int, Path]:
    for name in layout.COLOUR:
        found = layout.images_in(scene.folder / name)
        if found:
            return found
    checks.note(f"scene {scene.scene_id} has no colour images")
    return {}


def _check_colour(node: Node, colour: Path | None, size: tuple[int, int], *, any_colour: bool) -> None:
    if colour is not None:
        check_size(colour, image_size(colour), size, "the depth image")
    elif any_colour:
        raise node.error("the image has no colour image, others of its scene have", "add it, or remove the rgb folder")


def _check_unlisted(scene: layout.Scene, depths: Iterable[int], entries: dict[int, Node], checks: Checks) -> None:
    unlisted = sorted(set(depths) - set(entries))
    if unlisted:
        checks.warn(
            f"{len(unlisted)} depth images are not listed, such as image {unlisted[0]}, and are not used",
            file=scene.folder / layout.SCENE_CAMERA,
            field=str(unlisted[0]),
            remedy="add their entries, or remove the images",
        )


# --- the whole ---


def _in_order_of_time(visits: list[Visit]) -> tuple[Visit, ...]:
    """Visits one after the other, frames numbered through the run."""
    ordered = sorted((v for v in visits if v.frames), key=lambda v: v.frames[0].time_ns)
    for before, after in pairwise(ordered):
        if after.frames[0].time_ns <= before.frames[-1].time_ns:
            raise InputError(
                f"visit {after.scene_id} starts before visit {before.scene_id} ends",
                file=after.frames[0].depth_path.parent.parent / layout.SCENE_CAMERA,
                field=f"{after.frames[0].im_id}.timestamp_ns",
                remedy="visits of one place follow each other: correct the times, or make them runs of their own",
            )
    numbered, count = [], 0
    for v, visit in enumerate(ordered):
        frames = tuple(replace(frame, visit=v, index=count + k) for k, frame in enumerate(visit.frames))
        numbered.append(replace(visit, frames=frames))
        count += len(frames)
    return tuple(numbered)


def _fingerprint(root: Path, catalogue: Catalogue, scenes: Iterable[layout.Scene], visits: Iterable[Visit]) -> str:
    """SHA-256 over names and contents of all files that an estimator may read."""
    models = root / layout.MODELS
    files = [root / name for name in (layout.CAMERA, layout.CATALOGUE, layout.CTMAP)]
    files += [models / layout.MODELS_INFO, *(models / layout.mesh_name(k) for k in catalogue.obj_ids)]
    for scene in scenes:
        files += [scene.folder / name for name in (layout.SCENE_CAMERA, layout.SCENE_DETECTIONS)]
    for visit in visits:
        for frame in visit.frames:
            files += [path for path in (frame.depth_path, frame.colour_path) if path is not None]
    total = hashlib.sha256()
    for file in files:
        if file.is_file():
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            total.update(f"{file.relative_to(root).as_posix()} {digest}\n".encode())
    return total.hexdigest()
