"""A map as each frame's camera sees it: what the boxes of the metrics and all result formats are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import EXISTS, Estimate, Snapshot
from ctmap_gtsam.evaluation.matching import snapshots
from ctmap_gtsam.evaluation.silhouettes import Box, Silhouette, silhouettes
from sequences import se3
from sequences.types import VISIBLE_FRACTION, Frame, Run

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

DOUBTFUL = 0.05
"""least P(exists) of what counts as a detection: precision and recall are ranked by the score, which holds it"""


@dataclass(frozen=True)
class FrameView:
    """The objects (n) that may exist and whose meshes reach into one image."""

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
    """(n) each object behind and in front of the others of the map; what is more likely not there hides nothing"""

    def boxes(self) -> list[tuple[int, float, Box]]:
        """obj_id, score and box of each object that shows: the box of its pixels that no other object hides.

        An object of which less than VISIBLE_FRACTION is visible has no box.
        """
        return [
            (int(obj_id), float(score), seen.visible_box)
            for obj_id, score, seen in zip(self.class_id, self.score, self.silhouettes, strict=True)
            if seen.visible_box is not None and seen.visible_fraction >= VISIBLE_FRACTION
        ]


def views(run: Run, estimate: Estimate, step: int = 1, least: float = EXISTS) -> list[FrameView]:
    """One view a frame of the run, in order: each frame's own estimate.

    Drawn from every `step`-th pixel each way; what exists with less than the probability `least` is left out.
    """
    return _views(run, snapshots(run.frames, estimate, least), step)


def final_views(run: Run, estimate: Estimate, step: int = 1, least: float = EXISTS) -> list[FrameView]:
    """As `views`, of the map at the end of each frame's visit: the paper's protocol of detection (section V-A).

    "We take the estimated 6 DOF pose of all objects in the scene at the end of each RGB-D sequence, and project them
    back onto each camera frame in that sequence." The cameras are those that the method says.
    """
    own = snapshots(run.frames, estimate, least)
    ends = {frame.visit: snapshot for frame, snapshot in zip(run.frames, own, strict=True)}
    shown = [
        replace(ends[frame.visit], T_world_camera=snapshot.T_world_camera)
        for frame, snapshot in zip(run.frames, own, strict=True)
    ]
    return _views(run, shown, step)


def _views(run: Run, shown: Sequence[Snapshot], step: int) -> list[FrameView]:
    out = []
    for frame, snapshot in zip(run.frames, shown, strict=True):
        poses = se3.inverse(snapshot.T_world_camera) @ snapshot.T_world_object
        there = snapshot.existence > EXISTS
        drawn = silhouettes(run.catalogue, snapshot.class_id, poses, frame.camera, step, hides=there)
        seen = np.array([s.pixels > 0 for s in drawn], dtype=np.bool_)
        objects, class_id, score = snapshot.objects[seen], snapshot.class_id[seen], snapshot.score[seen]
        shapes = tuple(s for s in drawn if s.pixels > 0)
        out.append(FrameView(frame, objects, class_id, score, poses[seen], shapes))
    return out
