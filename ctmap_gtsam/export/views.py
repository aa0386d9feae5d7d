"""A map as each frame's camera sees it: what all result formats are written from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation.matching import snapshots
from ctmap_gtsam.evaluation.silhouettes import Silhouette, silhouettes
from sequences import se3
from sequences.types import Frame, Run

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class FrameView:
    """The existing objects (n) whose meshes reach into one image."""

    frame: Frame
    objects: Ints
    """(n,) rows of Estimate.object_id"""
    class_id: Ints
    """(n,) the most probable class"""
    score: Array
    """(n,) P(exists) P(class)"""
    T_camera_object: Array
    """(n, 4, 4) inv(T_world_camera) T_world_object, with the method's own camera, metres"""
    silhouettes: tuple[Silhouette, ...]
    """(n) each object behind and in front of the others of the map"""


def views(run: Run, estimate: Estimate) -> list[FrameView]:
    """One view a frame of the run, in order."""
    out = []
    for frame, snapshot in zip(run.frames, snapshots(run.frames, estimate), strict=True):
        poses = se3.inverse(snapshot.T_world_camera) @ snapshot.T_world_object
        drawn = silhouettes(run.catalogue, snapshot.class_id, poses, frame.camera)
        seen = np.array([s.pixels > 0 for s in drawn], dtype=np.bool_)
        shown = tuple(s for s in drawn if s.pixels > 0)
        out.append(
            FrameView(frame, snapshot.objects[seen], snapshot.class_id[seen], snapshot.score[seen], poses[seen], shown)
        )
    return out
