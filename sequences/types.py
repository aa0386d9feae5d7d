"""What a recorded run is made of. Poses are (4, 4) float64 ``T_a_b`` ("b in a"), metres; times integer nanoseconds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sequences.camera import Camera

if TYPE_CHECKING:
    from sequences.catalogue import Catalogue

Array = NDArray[np.float64]
Depth = NDArray[np.float32]
Colour = NDArray[np.uint8]
MoveKind = Literal["moved", "nudged", "appeared", "vanished"]


@dataclass(frozen=True)
class Detection:
    """One box of the detector, with its belief over classes (the paper's s_k)."""

    box: tuple[float, float, float, float]
    """x, y, width, height in pixels (COCO)"""
    class_scores: Array
    """(C + 1,) scores: background, then the catalogue's obj_ids in ascending order; sums to 1"""


@dataclass(frozen=True)
class Frame:
    """One image pair with its time and recorded pose. The images are read when asked for, never kept."""

    index: int
    """position in the run, 0-based, over all visits in order of time"""
    visit: int
    """position of the visit in Run.visits"""
    scene_id: int
    im_id: int
    time_ns: int
    """UTC, nanoseconds"""
    T_world_camera: Array
    """(4, 4) the recorded localisation, in the place's world frame"""
    camera: Camera
    detections: tuple[Detection, ...]
    depth_path: Path
    colour_path: Path | None
    read_depth: Callable[[], Depth] = field(repr=False, compare=False)
    """-> (height, width) float32 metres, 0 = no measurement. Raises InputError naming a file that can't be read."""
    read_colour: Callable[[], Colour] = field(repr=False, compare=False)
    """-> (height, width, 3) uint8 RGB; mid-grey where the run has no colour images"""

    @cached_property
    def T_camera_world(self) -> Array:
        """(4, 4) inverse of T_world_camera."""
        from sequences import se3

        return se3.inverse(self.T_world_camera)


@dataclass(frozen=True)
class LocalisationNoise:
    """Standard deviations of the recorded camera poses: a stationary Gauss-Markov error e_t per visit."""

    rotation_rad: float = 0.0
    translation_m: float = 0.0
    correlation_time_s: float = 10.0


@dataclass(frozen=True)
class Visit:
    """One recording: a BOP scene."""

    scene_id: int
    frames: tuple[Frame, ...]
    T_world_visit: Array
    """(4, 4) the visit's own frame in the place's world frame; identity where not given"""


@dataclass(frozen=True)
class Run:
    """One place, one or more visits, read-only. Holds nothing of the truth (see `sequences.bop.load_truth`)."""

    path: Path
    name: str
    catalogue: Catalogue
    visits: tuple[Visit, ...]
    up_world: Array | None
    """(3,) unit vector against gravity in the world frame; None where the recording doesn't say"""
    localisation: LocalisationNoise
    fingerprint: str
    """SHA-256 over everything an estimator may read (never over truth files)"""
    notes: tuple[str, ...] = ()
    """defaults that were derived because the data did not say, in words"""

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """All frames of all visits in order."""
        return tuple(frame for visit in self.visits for frame in visit.frames)


VISIBLE_FRACTION = 0.1
"""A true object counts in a frame where at least this share of its silhouette is visible (BOP's threshold)"""


@dataclass(frozen=True)
class TrueObject:
    """One physical object over a run: what scene_gt.json says. Only evaluation and simulation read it."""

    inst_id: int
    obj_id: int
    frames: NDArray[np.int64]
    """(n,) indices into Run.frames where the truth has the object"""
    T_world_object: Array
    """(n, 4, 4) at those frames, with the true camera pose"""
    visible_fraction: Array
    """(n,) visible share of the silhouette, 1 where scene_gt_info.json is missing"""
    visible_box: Array
    """(n, 4) x, y, width, height of the visible pixels; NaN where there are none, or nobody says"""
    support: NDArray[np.int64]
    """(n,) inst_id of the object that it stands on; -1 where that isn't known, or is none of the truth's objects"""


@dataclass(frozen=True)
class TrueMove:
    """One thing that somebody did to a physical object, as scene_gt_moves.json has it."""

    inst_id: int
    visit: int
    """position in Run.visits of the visit that it happened in, or else before, after the visit before that"""
    time_ns: int
    """UTC, nanoseconds"""
    kind: MoveKind
    """"moved" to another place; "nudged" where it stands, during a visit; "appeared" or "vanished" from the place"""
    from_support: int | None
    """inst_id of the object that it stood on; None where that isn't known, is none of the truth's, or it appeared"""
    to_support: int | None
    """the same of where it went; None where it vanished"""


@dataclass(frozen=True)
class Truth:
    """The truth about a run, read apart from it so that no estimator can see it."""

    objects: tuple[TrueObject, ...]
    T_world_camera: Array
    """(F, 4, 4) the true camera poses, the recorded ones where scene_camera_gt.json is missing"""
    moves: tuple[TrueMove, ...] = ()
    """by time; empty where no visit has a scene_gt_moves.json"""
