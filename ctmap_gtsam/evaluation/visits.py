"""A method at the end of each visit: what the paper judges, and what a robot that comes back would start from.

The paper (section V-B) compares "the estimated object poses at the end of each RGB-D sequence" with the truth in "the
frames that each object is last seen", in that frame's camera. N_total, all objects present, are here the true objects
that are visible somewhere in the visit. What counts as visible, matched and near is as everywhere (see `matching`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.evaluation import pose
from ctmap_gtsam.evaluation.frames import named_accuracies
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames, centres, reach_of
from ctmap_gtsam.evaluation.pose import Shape
from ctmap_gtsam.evaluation.statistics import mean
from sequences import se3
from sequences.types import Run

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LAST_SEEN = ("last_seen_class_accuracy", "last_seen_2cm_10deg", "last_seen_5cm_15deg")
"""The map at the end of each visit, at the frame in which each object was last seen"""

MAPS = ("map_precision", "map_recall")
"""Of the maps at the ends of the visits: how many existing objects are at the place of the true object that they match;
how many of the true objects visible in the visit have such an object"""


@dataclass(frozen=True)
class LastSeen:
    """One method at the object-visits (n,) that count: true objects in visits in which they are visible."""

    class_correct: Bools
    """(n,)"""
    translation_m: Array
    """(n,) between the bounding boxes' centres; inf without an answer"""
    rotation_rad: Array
    """(n,) symmetry-aware; inf without an answer, and where the class is wrong"""


@dataclass(frozen=True)
class MapEnds:
    """Objects of the maps at the ends of V visits."""

    existing: Ints
    """(V,) that the method has"""
    right: Ints
    """(V,) of those, at the place of the true object that they match"""
    present: Ints
    """(V,) true objects visible in the visit"""
    found: Ints
    """(V,) of those, with an object at their place"""


def ends(run: Run) -> Ints:
    """(V,) the last frame of each visit; visits without frames are left out."""
    return np.array([visit.frames[-1].index for visit in run.visits if visit.frames], dtype=np.int64)


def last_frames(run: Run, asked: Bools) -> Ints:
    """(N, V) the last frame of each visit, of those with frames, in which each object is asked for (N, F); else -1."""
    out = []
    for visit in run.visits:
        if visit.frames:
            indices = np.array([frame.index for frame in visit.frames])
            out.append(np.where(asked[:, indices], indices, -1).max(axis=1))
    return np.stack(out, axis=1) if out else np.zeros((len(asked), 0), dtype=np.int64)


def last_seen(
    run: Run, method: MethodMap, truth: ObjectFrames, matching: Matching, shapes: dict[int, Shape]
) -> LastSeen:
    """Each true object's estimate at the end of each visit, held to the truth where it was last seen in it."""
    seen, final = last_frames(run, truth.visible), ends(run)
    rows = []
    for n, v in zip(*np.nonzero(seen >= 0), strict=True):
        f, row = seen[n, v], matching.row[n]
        said = int(method.objects.class_id[row, final[v]]) if row >= 0 else -1
        true = int(truth.class_id[n, f])
        if said < 0:
            rows.append((False, np.inf, np.inf))
            continue
        T_world_object = method.estimate.pose[row, method.held[final[v]]]
        T, T_true = se3.inverse(method.T_world_camera[f]) @ T_world_object, truth.T_camera_object[n, f]
        shift = float(pose.translation_error(shapes[said], T, shapes[true], T_true))
        turn = float(pose.rotation_error(shapes[true], T, T_true)) if said == true else np.inf
        rows.append((said == true, shift, turn))
    return LastSeen(
        class_correct=np.array([r[0] for r in rows], dtype=np.bool_),
        translation_m=np.array([r[1] for r in rows], dtype=np.float64),
        rotation_rad=np.array([r[2] for r in rows], dtype=np.float64),
    )


def map_ends(run: Run, method: MethodMap, truth: ObjectFrames, matching: Matching, shapes: dict[int, Shape]) -> MapEnds:
    """Which objects of the maps at the ends of the visits are true ones, and which true ones are there."""
    there = last_frames(run, truth.present)  # the truth of an image may list only what lies in it
    found = _at_its_place(method.objects, truth, matching, shapes)
    at_end = (there >= 0) & np.take_along_axis(found, np.maximum(there, 0), axis=1)
    counts = last_frames(run, truth.visible) >= 0
    return MapEnds(
        existing=(method.objects.class_id[:, ends(run)] >= 0).sum(axis=0),
        right=at_end.sum(axis=0),
        present=counts.sum(axis=0),
        found=(at_end & counts).sum(axis=0),
    )


def _at_its_place(estimated: ObjectFrames, truth: ObjectFrames, matching: Matching, shapes: dict[int, Shape]) -> Bools:
    """(N, F) whether each true object's match is in the map, within reach of it."""
    out = np.zeros(truth.class_id.shape, dtype=np.bool_)
    n = np.flatnonzero(matching.row >= 0)
    row = matching.row[n]
    distance = np.linalg.norm(centres(estimated, shapes)[row] - centres(truth, shapes)[n], axis=-1)
    reach = np.minimum(reach_of(estimated, shapes)[row], reach_of(truth, shapes)[n])
    out[n] = np.nan_to_num(distance, nan=np.inf) < reach
    return out


def last_seen_metrics(errors: LastSeen) -> dict[str, float | None]:
    """LAST_SEEN over object-visits."""
    accuracies = named_accuracies("last_seen", errors.translation_m, errors.rotation_rad)
    return {"last_seen_class_accuracy": mean(errors.class_correct), **accuracies}


def map_metrics(maps: MapEnds) -> dict[str, float | None]:
    """MAPS over visits."""
    return {
        "map_precision": _share(maps.right, maps.existing),
        "map_recall": _share(maps.found, maps.present),
    }


def _share(part: Ints, whole: Ints) -> float | None:
    return float(part.sum() / whole.sum()) if whole.any() else None
