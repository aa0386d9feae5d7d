"""The truth about a run, where it is known. No estimator imports this module.

BOP's scene_gt.json says T_camera_object for the true camera, so T_world_object = T_world_camera_true T_camera_object.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from sequences import layout, se3
from sequences.errors import InputError
from sequences.jsonfile import Node
from sequences.problems import Checks
from sequences.types import Frame, MoveKind, Run, TrueMove, TrueObject, Truth, Visit

Array = NDArray[np.float64]


_UNKNOWN_BOX = np.full(4, np.nan)


class _Visibility(NamedTuple):
    """One entry of scene_gt_info.json."""

    fraction: float
    box: Array
    """(4,)"""


@dataclass(frozen=True)
class _Sighting:
    """One entry of scene_gt.json."""

    key: tuple[int, ...]
    """(inst_id,), or, where the file names none, (visit, obj_id, k)"""
    obj_id: int
    frame: int
    T_world_object: Array
    visible: _Visibility
    support: int
    """inst_id, -1 where the file names none"""
    node: Node


def load_truth(run: Run) -> Truth | None:
    """What was really where, from scene_gt.json and its companions; None where no visit has a scene_gt.json.

    - `inst_id` says which physical object an entry is, over all visits. In a visit without inst_id the k-th entry of an
      obj_id is taken to be one object in all frames of that visit, and another in each other visit.
    - scene_camera_gt.json holds the true camera poses in the visit's frame; without it the recorded ones count.
    - visible_fraction is scene_gt_info.json's visib_fract, 1 where it is missing; visible_box its bbox_visib.
    - Moves are those of scene_gt_moves.json. What they say of visits that the run doesn't have is left out.

    Raises:
        InputError: broken files; unknown obj_id; an inst_id that names two objects of one frame, or two classes; a
            support that isn't there; a move of what isn't there, or at a time that isn't the visit's.
    """
    return read_truth(run, run.catalogue.obj_ids, Checks())


def truth_fingerprint(run: Run) -> str:
    """SHA-256 over names and contents of all files of the truth, which `Run.fingerprint` leaves out."""
    total = hashlib.sha256()
    prefixes = tuple(name.removesuffix(".json") for name in (layout.SCENE_GT, layout.SCENE_CAMERA_GT))
    for visit in run.visits:
        folder = visit.frames[0].depth_path.parent.parent
        for file in sorted(path for path in folder.glob("*.json") if path.name.startswith(prefixes)):
            digest = hashlib.sha256(file.read_bytes()).hexdigest()
            total.update(f"{file.relative_to(run.path).as_posix()} {digest}\n".encode())
    return total.hexdigest()


def read_truth(run: Run, obj_ids: Collection[int], checks: Checks) -> Truth | None:
    """As `load_truth`; with gathering checks, the truth without the frames that are wrong, for `inspect_run` alone."""
    cameras = np.stack([frame.T_world_camera for frame in run.frames]) if run.frames else np.zeros((0, 4, 4))
    sightings: list[_Sighting] = []
    found: list[tuple[int, Path]] = []
    for v, visit in enumerate(run.visits):
        if not visit.frames:
            continue
        folder = visit.frames[0].depth_path.parent.parent
        with checks.part():
            cameras[[frame.index for frame in visit.frames]] = _true_cameras(folder, visit, checks)
        if (folder / layout.SCENE_GT).is_file():
            found.append((v, folder))
            with checks.part():
                sightings += _sightings(folder, v, visit, obj_ids, cameras, checks)
    if not found:
        return None
    objects = _objects(_on_known_supports(sightings, checks), checks)
    moves: list[TrueMove] = []
    for v, folder in found:
        with checks.part():
            moves += _moves(folder, v, run, {o.inst_id: o for o in objects}, checks)
    return Truth(objects, cameras, tuple(sorted(moves, key=lambda move: move.time_ns)))


def _true_cameras(folder: Path, visit: Visit, checks: Checks) -> Array:
    """(n, 4, 4) T_world_camera of the visit's frames."""
    file = folder / layout.SCENE_CAMERA_GT
    if not file.is_file():
        return np.stack([frame.T_world_camera for frame in visit.frames])
    root = Node.read(file, "")
    poses = np.stack([frame.T_world_camera for frame in visit.frames])
    for k, frame in enumerate(visit.frames):
        with checks.part():
            pose = layout.camera_pose(root[str(frame.im_id)])
            if pose is None:
                raise root[str(frame.im_id)].error("the image has no true camera pose", "add cam_R_w2c and cam_t_w2c")
            poses[k] = visit.T_world_visit @ pose
    return poses


def _sightings(
    folder: Path, v: int, visit: Visit, obj_ids: Collection[int], cameras: Array, checks: Checks
) -> list[_Sighting]:
    entries = layout.image_entries(Node.read(folder / layout.SCENE_GT, ""))
    visible = _visibility(folder)
    found: list[_Sighting] = []
    given: set[bool] = set()
    for frame in visit.frames:
        if frame.im_id not in entries:
            continue
        elements = entries[frame.im_id].elements()
        given |= {element.get("inst_id") is not None for element in elements}
        if len(given) > 1:
            raise entries[frame.im_id].error("some entries have an inst_id, others none", "give it to all, or to none")
        key = _named if given == {True} else _counted(v)
        in_frame: set[tuple[int, ...]] = set()
        for k, element in enumerate(elements):
            with checks.part():
                sighting = _sighting(element, frame, obj_ids, cameras, key, visible(frame.im_id, k))
                if sighting.key in in_frame:
                    raise element["inst_id"].error("names two objects of one frame", "give each object its own inst_id")
                in_frame.add(sighting.key)
                found.append(sighting)
    return found


def _sighting(
    node: Node,
    frame: Frame,
    obj_ids: Collection[int],
    cameras: Array,
    key: Callable[[Node, int], tuple[int, ...]],
    visible: _Visibility,
) -> _Sighting:
    obj_id = node["obj_id"].integer()
    if obj_id not in obj_ids:
        raise node["obj_id"].error(f"unknown obj_id {obj_id}", "add its model to models/, or remove the entry")
    T_camera_object = se3.make(layout.rotation(node["cam_R_m2c"]), node["cam_t_m2c"].numbers(3) * layout.MM)
    T_world_object = cameras[frame.index] @ T_camera_object
    support = node.get("support")
    on = -1 if support is None else support.integer()
    return _Sighting(key(node, obj_id), obj_id, frame.index, T_world_object, visible, on, node)


def _named(node: Node, obj_id: int) -> tuple[int, ...]:
    return (node["inst_id"].integer(),)


def _counted(v: int) -> Callable[[Node, int], tuple[int, ...]]:
    """Keys for the entries of one frame by their order, the same in each frame of the visit and in no other visit."""
    seen: Counter[int] = Counter()

    def key(node: Node, obj_id: int) -> tuple[int, ...]:
        seen[obj_id] += 1
        return (v, obj_id, seen[obj_id])

    return key


def _visibility(folder: Path) -> Callable[[int, int], _Visibility]:
    file = folder / layout.SCENE_GT_INFO
    if not file.is_file():
        return lambda im_id, k: _Visibility(1.0, _UNKNOWN_BOX)
    entries = layout.image_entries(Node.read(file, ""))

    def visibility(im_id: int, k: int) -> _Visibility:
        elements = entries[im_id].elements() if im_id in entries else []
        if k >= len(elements):
            raise InputError(
                f"has no entry {k} that scene_gt.json has",
                file=file,
                field=str(im_id),
                remedy=f"write one entry for each of {layout.SCENE_GT}, or remove the file",
            )
        box = elements[k].get("bbox_visib")
        known = _UNKNOWN_BOX if box is None else box.numbers(4)
        return _Visibility(elements[k]["visib_fract"].number(), known if (known[2:] > 0).all() else _UNKNOWN_BOX)

    return visibility


def _on_known_supports(sightings: list[_Sighting], checks: Checks) -> list[_Sighting]:
    """Those whose support is another object of the truth, or isn't named."""
    known = {s.key for s in sightings if len(s.key) == 1}
    good = []
    for s in sightings:
        with checks.part():
            if s.support != -1 and ((s.support,) not in known or s.key == (s.support,)):
                raise s.node["support"].error(
                    f"no other object has inst_id {s.support}",
                    "name the inst_id of what it stands on, or leave support out",
                )
            good.append(s)
    return good


def _objects(sightings: list[_Sighting], checks: Checks) -> tuple[TrueObject, ...]:
    by_key: dict[tuple[int, ...], list[_Sighting]] = {}
    for sighting in sightings:
        by_key.setdefault(sighting.key, []).append(sighting)
    # objects without an inst_id are numbered after those with one
    last = max((key[0] for key in by_key if len(key) == 1), default=0)
    names = {key: k for k, key in enumerate(sorted(key for key in by_key if len(key) > 1), start=last + 1)}
    objects = []
    for key, some in by_key.items():
        with checks.part():
            objects.append(_object(names.get(key, key[0]), some))
    return tuple(sorted(objects, key=lambda o: o.inst_id))


def _object(inst_id: int, sightings: list[_Sighting]) -> TrueObject:
    obj_ids = sorted({s.obj_id for s in sightings})
    if len(obj_ids) > 1:
        raise InputError(
            f"inst_id {inst_id} is of classes {obj_ids}",
            file=sightings[-1].node.file,
            field="inst_id",
            remedy="give each physical object an inst_id of its own",
        )
    return TrueObject(
        inst_id=inst_id,
        obj_id=obj_ids[0],
        frames=np.array([s.frame for s in sightings], dtype=np.int64),
        T_world_object=np.stack([s.T_world_object for s in sightings]),
        visible_fraction=np.array([s.visible.fraction for s in sightings]),
        visible_box=np.stack([s.visible.box for s in sightings]),
        support=np.array([s.support for s in sightings], dtype=np.int64),
    )


def _moves(folder: Path, v: int, run: Run, objects: Mapping[int, TrueObject], checks: Checks) -> list[TrueMove]:
    file = folder / layout.SCENE_GT_MOVES
    if not file.is_file():
        return []
    moves = []
    for element in Node.read(file, "").elements():
        with checks.part():
            moves.append(_move(element, v, run, objects))
    return moves


def _move(node: Node, v: int, run: Run, objects: Mapping[int, TrueObject]) -> TrueMove:
    kind = next((kind for kind in get_args(MoveKind) if kind == node["kind"].text()), None)
    if kind is None:
        raise node["kind"].error(f"unknown kind {node['kind'].text()}", f"write one of {', '.join(get_args(MoveKind))}")
    move = TrueMove(
        inst_id=node["inst_id"].integer(),
        visit=v,
        time_ns=_move_time(node["time_ns"], v, run, in_view=kind == "nudged"),
        kind=kind,
        from_support=_move_support(node.get("from_support"), v, objects),
        to_support=_move_support(node.get("to_support"), v + 1, objects),
    )
    frames = objects[move.inst_id].frames if move.inst_id in objects else np.zeros(0, dtype=np.int64)
    afterwards = [f for f in run.visits[v].frames if f.time_ns >= move.time_ns and f.index in frames]
    if bool(afterwards) == (kind == "vanished"):
        where = "still" if afterwards else "not"
        raise node["inst_id"].error(
            f"object {move.inst_id} {kind}, but is {where} in {layout.SCENE_GT} afterwards",
            f"correct the move, or the entries of {layout.SCENE_GT}",
        )
    return move


def _move_time(node: Node, v: int, run: Run, *, in_view: bool) -> int:
    """After the visit before this one and not after this one; during this one where it was in view."""
    time, frames = node.integer(), run.visits[v].frames
    early = time < frames[0].time_ns if in_view else v > 0 and time <= run.visits[v - 1].frames[-1].time_ns
    if early or time > frames[-1].time_ns:
        raise node.error(
            f"the time is not of visit {run.visits[v].scene_id}",
            "write the time, UTC, and put the move into the visit that it happened in, or before",
        )
    return time


def _move_support(node: Node | None, v: int, objects: Mapping[int, TrueObject]) -> int | None:
    """An inst_id; what stands on something in a visit that the run doesn't have (v < 1) may stand on the unknown."""
    if node is None:
        return None
    support = node.integer()
    if support in objects:
        return support
    if v > 0:
        raise node.error(f"no object has inst_id {support}", "name the inst_id of what it stood on, or leave it out")
    return None
