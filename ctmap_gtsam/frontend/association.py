"""Boxes become tracks: the paper's association over frames by overlap, causally, for filter and smoother alike.

A track remembers where in the world the centre of its last box was, so that its box is predicted for any later camera:
the overlap is with the predicted box. Thus a thing that left the view and was not moved is met again on its own track.
A new track counts only after `start_after` frames with a box, none more than `lost_after_s` after the one before: of
what is half hidden half of the boxes are missing, and three in a row may never come.

What the image's edge cuts has boxes that can't be predicted so, tables and shelves above all. A box that overlaps no
prediction is also met where the detector calls it the same and it lies within half that class's diameter of the track.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.frontend.observation import Observation, centre_point
from ctmap_gtsam.parameters import Frontend
from factors.measurement import box_iou
from sequences import se3
from sequences.catalogue import Catalogue
from sequences.types import Detection, Frame

Array = NDArray[np.float64]

_SAME_CLASS = 0.5  # least probability that two score vectors mean one class, for a box to be met by its place


@dataclass(frozen=True)
class Track:
    """Detections taken for one object."""

    track_id: int
    """in order of the first detection; ties in the canonical order of detections"""
    keyframes: tuple[int, ...]
    """rows of Estimate.keyframe_frame, ascending"""
    detections: tuple[Detection, ...]
    """one a keyframe"""
    started: int
    """the keyframe at which it had been consistent for long enough"""

    def at(self, keyframe: int) -> Detection | None:
        """Its detection at a keyframe, if any."""
        i = bisect_left(self.keyframes, keyframe)
        return self.detections[i] if i < len(self.keyframes) and self.keyframes[i] == keyframe else None


@dataclass
class _Open:
    """A track while it grows."""

    point_world: Array
    box: Array
    z: float
    last_ns: int
    score_sum: Array
    """(C,) class scores, background left out, each vector of sum 1"""
    keyframes: list[int] = field(default_factory=list)
    detections: list[Detection] = field(default_factory=list)
    started: int | None = None


class Associator:
    """Grows tracks from observations in order of time; what it says of a keyframe depends on the past alone."""

    def __init__(self, settings: Frontend, catalogue: Catalogue) -> None:
        self._settings = settings
        self._reach_m = np.array([0.5 * c.diameter_m for c in catalogue.classes])
        self._tracks: list[_Open] = []
        self._live: list[int] = []
        """tracks that a box may join: all but those given up, of which a long run has more and more"""

    def step(self, observation: Observation) -> None:
        """Take in the next keyframe."""
        frame, detections = observation.frame, observation.frame.detections
        points = [centre_point(frame, observation.depth, np.array(d.box)) for d in detections]
        usable = [i for i, point in enumerate(points) if point is not None]
        matched = self._match(frame, [detections[i] for i in usable], [p for p in points if p is not None])
        for track, i in matched.items():
            self._extend(self._tracks[track], observation, detections[usable[i]], points[usable[i]])
        taken = {usable[i] for i in matched.values()}
        self._age(frame, set(matched))
        for i in usable:
            if i not in taken:
                self._open(observation, detections[i], points[i])

    def tracks(self) -> tuple[Track, ...]:
        """All tracks so far that have been consistent for long enough."""
        return tuple(
            Track(i, tuple(t.keyframes), tuple(t.detections), t.started)
            for i, t in enumerate(self._tracks)
            if t.started is not None
        )

    def _match(self, frame: Frame, detections: list[Detection], points: list[Array]) -> dict[int, int]:
        """Hungarian assignment by overlap with the predicted boxes, else by place: track -> detection."""
        if not detections or not self._live:
            return {}
        live = [self._tracks[i] for i in self._live]
        predicted = np.stack([_predicted_box(t, frame) for t in live])
        boxes = np.array([d.box for d in detections])
        overlap = box_iou(predicted[:, None], boxes[None])
        # what is too small counts nothing, or two that are too small could outweigh one that is not
        least = self._settings.association_iou
        affinity = np.where(overlap >= least, overlap, least * self._nearness(live, detections, points))
        rows, columns = linear_sum_assignment(-affinity)
        return {self._live[r]: int(c) for r, c in zip(rows, columns, strict=True) if affinity[r, c] > 0.0}

    def _nearness(self, tracks: list[_Open], detections: list[Detection], points: list[Array]) -> Array:
        """(tracks, detections) from 1, in one place and called the same, to 0, further apart than its size allows."""
        believed = np.stack([t.score_sum / t.score_sum.sum() for t in tracks])
        called = np.stack([class_shares(d) for d in detections])
        same = believed @ called.T
        apart = np.linalg.norm(np.stack([t.point_world for t in tracks])[:, None] - np.stack(points), axis=-1)
        near = np.maximum(1.0 - apart / self._reach_m[np.argmax(believed, axis=1)][:, None], 0.0)
        return np.where(same >= _SAME_CLASS, same * near, 0.0)

    def _extend(self, track: _Open, observation: Observation, detection: Detection, point: Array | None) -> None:
        assert point is not None
        frame = observation.frame
        track.point_world, track.box, track.last_ns = point, np.array(detection.box), frame.time_ns
        track.z = float(se3.transform(frame.T_camera_world, point[None])[0, 2])
        track.score_sum = track.score_sum + class_shares(detection)
        track.keyframes.append(observation.keyframe)
        track.detections.append(detection)
        if track.started is None and len(track.keyframes) >= self._settings.start_after:
            track.started = observation.keyframe

    def _age(self, frame: Frame, matched: set[int]) -> None:
        """Tracks that were not met: one that has not started is given up after a while."""
        lost = set()
        for i in self._live:
            track = self._tracks[i]
            if i in matched or track.started is not None:
                continue
            if frame.time_ns - track.last_ns > self._settings.lost_after_s * 1e9:
                lost.add(i)
        self._live = [i for i in self._live if i not in lost]

    def _open(self, observation: Observation, detection: Detection, point: Array | None) -> None:
        assert point is not None
        nothing = np.zeros(len(self._reach_m))
        track = _Open(point, np.array(detection.box), 0.0, observation.frame.time_ns, nothing)
        self._live.append(len(self._tracks))
        self._tracks.append(track)
        self._extend(track, observation, detection, point)


def class_shares(detection: Detection) -> Array:
    """(C,) a detection's scores without the background's, of sum 1."""
    scores = detection.class_scores[1:] + 1e-9
    return np.asarray(scores / scores.sum())


def _predicted_box(track: _Open, frame: Frame) -> Array:
    """The track's last box (x, y, w, h) carried to another camera: centre projected, size scaled by depth, clipped."""
    centre = se3.transform(frame.T_camera_world, track.point_world[None])[0]
    if centre[2] <= 0.0:
        return np.zeros(4)
    size = track.box[2:] * track.z / centre[2]
    low = frame.camera.project(centre) - size / 2
    image = np.array([frame.camera.width, frame.camera.height])
    clipped = np.clip(np.concatenate([low, low + size]), 0.0, np.tile(image, 2))
    return np.concatenate([clipped[:2], clipped[2:] - clipped[:2]])
