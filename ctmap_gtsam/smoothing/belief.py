"""What the trellises of all classes say of one object."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.discrete import Posterior, Stage, solve
from ctmap_gtsam.smoothing.graph import Measured
from ctmap_gtsam.smoothing.modes import Boxes, Recording, Sighting, in_world
from factors.mixture import log_sum

Array = NDArray[np.float64]

POSSIBLE = 60.0
"""nats behind the best class beyond which a class is given up"""
LIKELY = 15.0
"""nats behind the best class within which its modes are probed with care"""
SURE = 0.8
"""a class more probable than this is taken for granted by the neighbours"""


@dataclass(frozen=True)
class Held:
    """A pose that stands for an object at a keyframe."""

    view: int
    """position of the view that it is taken from in `Thing.keyframes`"""
    T_world_centre: Array
    """(4, 4)"""
    covariance: Array
    """(6, 6)"""
    smoothed: bool
    """from the graph, with all that a camera gets wrong in the covariance; else a single view's"""


@dataclass(frozen=True)
class Thing:
    """One object: its detections, sightings, and the trellis of every class."""

    object_id: int
    boxes: Boxes
    sightings: Mapping[int, Sighting]
    """by keyframe"""
    stages: Mapping[int, tuple[Stage, ...]]
    """class index -> states at the keyframes in view"""
    posteriors: Mapping[int, Posterior]
    """class index -> what its trellis says"""
    class_log_evidence: Array
    """(C,) depth, boxes, context, scores and prior"""
    score_evidence: Array
    """(C,) the scores' part of it"""
    posterior: tuple[float, Array]
    """P(a known mesh rather than clutter or nothing) and the classes' probabilities (C,), see `Model.existence`"""
    claims: Array
    """(views,) what all views of a visit say for the best class where it then stood, nats: other visits' don't count"""
    poses: Mapping[int, tuple[Array, Array]] = field(default_factory=dict)
    """keyframe -> smoothed T_world_centre (4, 4) and covariance (6, 6) of the best class"""

    @property
    def class_probability(self) -> Array:
        """(C,) posterior of the classes."""
        return self.posterior[1]

    @property
    def best_class(self) -> int:
        """Index in the catalogue, of the class whose poses explain most."""
        return int(np.argmax(self.class_log_evidence))

    @property
    def reported_class(self) -> int:
        """Index in the catalogue; of what no pose explains, the detector's word decides."""
        return int(np.argmax(self.class_probability))

    @property
    def log_evidence(self) -> float:
        """Of all classes together, against nothing."""
        return float(log_sum(self.class_log_evidence))

    @property
    def solid(self) -> float:
        """P(a known mesh rather than clutter or nothing)."""
        return self.posterior[0]

    @property
    def exists(self) -> bool:
        """Whether it is more likely a thing than not."""
        return self.solid > 0.5 and self.best_class in self.posteriors

    @cached_property
    def keyframes(self) -> tuple[int, ...]:
        """In view, ascending: those of every stage."""
        return tuple(sorted(self.sightings))

    @cached_property
    def presence(self) -> Array:
        """P(present | it exists) at each of `keyframes`, for the reported class."""
        posterior = self.posteriors.get(self.reported_class)
        if posterior is None:
            return np.zeros(len(self.keyframes))
        return np.clip([1.0 - m[-1] for m in posterior.modes], 0.0, 1.0)

    @property
    def anchor(self) -> Array | None:
        """A smoothed pose (4, 4) in the middle of its life; None where it has none."""
        return self.poses[self._posed[len(self._posed) // 2]][0] if self.poses else None

    def possible(self, model: Model) -> list[int]:
        """Classes worth another round."""
        floor = self.class_log_evidence.max() - POSSIBLE
        return [c for c in range(len(model.shapes)) if self.class_log_evidence[c] >= floor]

    def likely(self) -> list[int]:
        """Classes whose covariances matter."""
        floor = self.class_log_evidence.max() - LIKELY
        return [int(c) for c in np.flatnonzero(self.class_log_evidence >= floor)]

    def pose_near(self, c: int, keyframe: int) -> Array | None:
        """(1, 4, 4) best guess of class c at a keyframe: smoothed, or the trellis's nearest mode."""
        if c == self.best_class and self.poses:
            return self.poses[self._posed[_nearest(self._posed, keyframe)]][0][None]
        i = self._measured_near(c, keyframe)
        return None if i is None else self.stages[c][i].T_world_centre[self.posteriors[c].path[i]][None]

    def _measured_near(self, c: int, keyframe: int) -> int | None:
        """The view nearest in time in which the best path of class c goes through a mode."""
        there = self._measured.get(c)
        return there[1][_nearest(there[0], keyframe)] if there is not None and there[0] else None

    @cached_property
    def _posed(self) -> tuple[int, ...]:
        """Keyframes that have a smoothed pose, ascending."""
        return tuple(sorted(self.poses))

    @cached_property
    def _measured(self) -> dict[int, tuple[list[int], list[int]]]:
        """Class index -> keyframes in which its best path goes through a mode, ascending, and which views they are."""
        out = {}
        for c, stages in self.stages.items():
            path = self.posteriors[c].path
            views = [i for i, stage in enumerate(stages) if path[i] < len(stage.log_evidence)]
            out[c] = [stages[i].keyframe for i in views], views
        return out

    def view_at(self, keyframe: int) -> int:
        """Position in `keyframes` of one that is among them."""
        return bisect_left(self.keyframes, keyframe)

    def presence_at(self, keyframe: int) -> float:
        """P(present | it exists) at any keyframe: that of the last one in view, or of the first before that."""
        if not self.keyframes:
            return 0.0
        i = max(int(np.searchsorted(self.keyframes, keyframe, side="right")) - 1, 0)
        return float(self.presence[i])

    def claim_at(self, keyframe: int) -> float:
        """By which of two things in one place has it at a keyframe: what it explains there in that visit, nats."""
        i = self._measured_near(self.best_class, keyframe)
        return 0.0 if i is None else float(self.claims[i])

    def present_pose(self, keyframe: int) -> Array | None:
        """(4, 4) where it surely is at a keyframe; None where that isn't sure, or its class isn't."""
        sure = self.exists and self.class_probability[self.best_class] > SURE and self.presence_at(keyframe) > 0.5
        pose = self.pose_near(self.best_class, keyframe) if sure else None
        return None if pose is None else pose[0]

    def measured(self, recording: Recording) -> list[Measured]:
        """The modes that the best path goes through."""
        c = self.best_class
        out: list[Measured] = []
        stayed = True
        for i, (stage, state) in enumerate(zip(self.stages[c], self.posteriors[c].path, strict=True)):
            if i:
                stayed = stayed and self.posteriors[c].stayed(i)
            if state >= len(stage.log_evidence):
                stayed = stayed and state == len(stage.log_evidence)
                continue
            modes = self.sightings[stage.keyframe].modes[c]
            assert modes is not None
            out.append(
                Measured(
                    stage.keyframe,
                    stage.time_s,
                    recording.visit(stage.keyframe),
                    modes.T_camera_centre[state],
                    modes.covariance[state],
                    stays=stayed and bool(out),
                )
            )
            stayed = True
        return out

    def held(self, keyframe: int) -> Held | None:
        """What is believed of the reported class at a keyframe; None where it has no pose.

        Smoothed at the nearest measured keyframe, the past first; what more likely doesn't exist isn't smoothed.
        """
        c = self.reported_class
        if c != self.best_class or not self.poses:
            i = self._measured_near(c, keyframe)
            if i is None:
                return None
            stage, state = self.stages[c][i], self.posteriors[c].path[i]
            return Held(i, stage.T_world_centre[state], stage.covariance[state], smoothed=False)
        nearest = self._posed[max(bisect_right(self._posed, keyframe) - 1, 0)]
        return Held(self.view_at(nearest), *self.poses[nearest], smoothed=True)

    def shares(self, c: int, i: int) -> Array:
        """(n,) of the modes of class c at its i-th view, given that it is there: their sum is 1.

        What is unmeasured is where it was, and that is where the best path goes through.
        """
        marginal, state = self.posteriors[c].modes[i], self.posteriors[c].path[i]
        shares = marginal[:-2].copy()
        if state < len(shares):
            shares[state] += marginal[-2]
        total = shares.sum()
        return shares / total if total > 0.0 else shares

    def modes_at(self, c: int, keyframe: int) -> Array:
        """(n, 4, 4) T_world_centre of the modes of class c at a keyframe; none where it wasn't in view."""
        return self._modes_of_views(c, keyframe, (0,))

    def modes_beside(self, c: int, keyframe: int) -> Array:
        """(n, 4, 4) the same of the views before and after a keyframe that is one."""
        return self._modes_of_views(c, keyframe, (-1, 1))

    def _modes_of_views(self, c: int, keyframe: int, away: Sequence[int]) -> Array:
        """(n, 4, 4) of those so many views away from a keyframe; none where it wasn't in view."""
        i = self.view_at(keyframe)
        if c not in self.stages or i == len(self.keyframes) or self.keyframes[i] != keyframe:
            return np.zeros((0, 4, 4))
        views = [i + step for step in away if 0 <= i + step < len(self.keyframes)]
        return np.concatenate([np.zeros((0, 4, 4)), *(self.stages[c][view].T_world_centre for view in views)])

    def to_start_from(self) -> Thing:
        """The same without what only its graph and the estimate ask for: sightings' modes, and covariances.

        A map holds them for every object, class and keyframe, and the next round gathers as many again.
        """
        unseen, untold = np.zeros((0, 6, 6)), np.full((6, 6), np.nan)
        return replace(
            self,
            sightings={k: replace(s, modes=(), context=()) for k, s in self.sightings.items()},
            stages={c: tuple(replace(s, covariance=unseen) for s in stages) for c, stages in self.stages.items()},
            poses={k: (T, untold) for k, (T, _) in self.poses.items()},
        )

    def with_poses(self, poses: Mapping[int, tuple[Array, Array]]) -> Thing:
        """The same with smoothed poses."""
        return replace(self, poses=dict(poses))


def _nearest(keyframes: Sequence[int], keyframe: int) -> int:
    """Position of the nearest of ascending keyframes, at least one; the earlier of two."""
    after = bisect_left(keyframes, keyframe)
    if after in (0, len(keyframes)):
        return min(after, len(keyframes) - 1)
    return after - (keyframe - keyframes[after - 1] <= keyframes[after] - keyframe)


def judge(
    object_id: int,
    boxes: Boxes,
    sightings: Mapping[int, Sighting],
    recording: Recording,
    model: Model,
) -> Thing:
    """Solve the trellis of every class that has modes, and weigh the classes."""
    keyframes = sorted(sightings)
    stages: dict[int, tuple[Stage, ...]] = {}
    posteriors: dict[int, Posterior] = {}
    evidence = np.full(len(model.shapes), -np.inf)
    for shape in model.shapes:
        c = shape.index
        if not any(len(modes) for s in sightings.values() if (modes := s.modes[c]) is not None):
            continue
        stages[c] = tuple(_stage(sightings[k], c, len(keyframes), recording) for k in keyframes)
        noise = _noise_variance(stages[c], shape, recording, model)
        posteriors[c] = solve(stages[c], model, shape, noise, recording.place.surfaces)
        evidence[c] = posteriors[c].log_evidence
    scores = _score_evidence(boxes, recording, model)
    clutter = float(sum(s.log_clutter for s in sightings.values()))
    log_evidence = model.between_classes(evidence) + scores - np.log(len(model.shapes))
    posed = np.where(np.isfinite(evidence), scores, -np.inf)
    best = int(np.argmax(log_evidence))
    visits = [recording.visit(k) for k in keyframes]
    witness = _witness(stages[best], posteriors[best], sightings, best, visits, model) if best in stages else 0.0
    solid, probability = model.existence(log_evidence, posed, clutter, witness, 0.0)
    # objects are what was detected: what has no box of its own left is what others are
    posterior = (solid if boxes else 0.0, probability)
    claims = _claims(stages[best], posteriors[best], visits) if best in stages else np.zeros(len(keyframes))
    return Thing(object_id, boxes, sightings, stages, posteriors, log_evidence, scores, posterior, claims)


def _claims(stages: tuple[Stage, ...], posterior: Posterior, visits: Sequence[int]) -> Array:
    """(views,) what the views say along the best path, summed for as long as a visit lasts and the thing stays."""
    said = [
        float(stage.log_evidence[state]) if state < len(stage.log_evidence) else 0.0
        for stage, state in zip(stages, posterior.path, strict=True)
    ]
    begins = [i == 0 or visits[i] != visits[i - 1] or not posterior.stayed(i) for i in range(len(stages))]
    stand = np.cumsum(begins) - 1
    return np.asarray(np.bincount(stand, weights=said)[stand])


def _witness(
    stages: tuple[Stage, ...],
    posterior: Posterior,
    sightings: Mapping[int, Sighting],
    c: int,
    visits: Sequence[int],
    model: Model,
) -> float:
    """What boxes and their absences say along the best path of a class, where it was measured, nats."""
    by_visit: dict[int, float] = {}
    for stage, state, visit in zip(stages, posterior.path, visits, strict=True):
        modes = sightings[stage.keyframe].modes[c]
        if modes is not None and state < len(modes):
            by_visit[visit] = by_visit.get(visit, 0.0) + float(modes.witness[state])
    return sum(model.seen_in_visit(witness) for witness in by_visit.values())


def _noise_variance(stages: tuple[Stage, ...], shape: Shape, recording: Recording, model: Model) -> Array:
    """(6,) how far two views of a still object differ, for localisation's error and the depth's bias."""
    seen = [s for s in stages if len(s.log_evidence)]
    cameras = np.stack([recording.T_world_camera(s.keyframe)[:3, 3] for s in seen])
    away = float(np.median(np.linalg.norm(cameras - np.stack([s.T_world_centre[0, :3, 3] for s in seen]), axis=-1)))
    return model.shared_variance(shape, recording.run.localisation, away)


def _stage(sighting: Sighting, c: int, n_keyframes: int, recording: Recording) -> Stage:
    modes = sighting.modes[c]
    T = in_world(sighting, c, recording.T_world_camera(sighting.keyframe))
    if modes is None:
        empty = np.zeros(0)
        return Stage(sighting.keyframe, recording.time_s(sighting.keyframe), T, np.zeros((0, 6, 6)), empty)
    # one fact for as long as the object stands still: a share of it a keyframe
    nats = modes.log_likelihood + sighting.context[c] / n_keyframes
    return Stage(sighting.keyframe, recording.time_s(sighting.keyframe), T, modes.covariance, nats)


def _score_evidence(boxes: Boxes, recording: Recording, model: Model) -> Array:
    """(C,) what the detector's score vectors say, a persistent belief a visit."""
    by_visit: dict[int, Array] = {}
    for k, detection in sorted(boxes.items()):
        visit = recording.visit(k)
        by_visit[visit] = by_visit.get(visit, np.zeros(len(model.shapes))) + model.class_scores(detection)
    return np.asarray(sum((model.class_evidence(s) for s in by_visit.values()), np.zeros(len(model.shapes))))
