"""Measurement modes of every object, class and keyframe, with the whole run in view.

Seeding searches each track afresh at a few of its detections. Gathering then goes through the run once a round, depth
read once a keyframe, and refines on each image what was found at other times, what the smoother predicts, and what was
there before. Only the likelihood goes into a mode: the prior is the graph's and the trellis's business.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.association import Associator, Track
from ctmap_gtsam.frontend.observation import Observation, observations
from ctmap_gtsam.frontend.place import Place
from ctmap_gtsam.frontend.proposer import PoseModes, Proposer, View, distinct
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors.mixture import log_sum
from sequences.geometry import Plane
from sequences.progress import Progress
from sequences.seeds import generator
from sequences.types import Detection, Run

Array = NDArray[np.float64]

_WORTH_A_SEARCH = 30.0
"""nats behind the best class of the views before beyond which a class isn't searched for any more"""

_KEPT = 8  # poses of a class that a track starts from, at most
_ONE_POSE = (0.15, 0.015)  # rad, metres: what searches in several images find nearer to each other is found once


@dataclass(frozen=True)
class Recording:
    """What the whole run says before any object is estimated."""

    run: Run
    keyframes: NDArray[np.int64]
    """(K,) indices into Run.frames"""
    planes: tuple[tuple[Plane, ...], ...]
    """(K,) those of each keyframe's image, camera frame: found once, depth is read again each round"""
    tracks: tuple[Track, ...]
    place: Place

    def observe(self, keyframe: int) -> Observation:
        """Read a keyframe."""
        frame = self.run.frames[int(self.keyframes[keyframe])]
        return Observation(keyframe, frame, frame.read_depth(), self.planes[keyframe])

    def T_world_camera(self, keyframe: int) -> Array:
        """(4, 4) as recorded."""
        return self.run.frames[int(self.keyframes[keyframe])].T_world_camera

    def time_s(self, keyframe: int) -> float:
        """Since the first keyframe."""
        frames = self.run.frames
        start = frames[int(self.keyframes[0])].time_ns
        return (frames[int(self.keyframes[keyframe])].time_ns - start) * 1e-9


@dataclass(frozen=True)
class Sighting:
    """One object in one keyframe in whose view it should be."""

    keyframe: int
    modes: tuple[PoseModes | None, ...]
    """one a class, camera frame; None for classes no longer possible"""
    context: tuple[Array, ...]
    """(n,) log context of each mode of each class, nats"""
    log_clutter: float
    """what this keyframe says for something there that no mesh explains"""


@dataclass(frozen=True)
class Wanted:
    """What to gather for one object at one keyframe."""

    starts: Mapping[int, Array]
    """class index -> (n, 4, 4) T_world_centre to refine from"""
    expected: tuple[int, Array] | None
    """class index and T_world_centre of the best guess; None where there is none"""
    careful: frozenset[int]
    """classes whose covariance is worth probing"""


@dataclass
class Found:
    """What the full searches found of one track."""

    poses: dict[int, Array]
    """class index -> (n, 4, 4) T_world_centre, all apart from each other, the best first"""
    scores: dict[int, Array]
    """class index -> (n,) log-likelihood of each in the view that it was found in"""
    log_likelihood: Array
    """(C,) of the best pose of each search, summed: what the searched views say of the class"""

    def join(self, shape: Shape, poses: Array, scores: Array) -> None:
        """Take in poses (n, 4, 4) T_world_centre of a class that one search found, with their log-likelihoods (n,)."""
        poses = np.concatenate([self.poses[shape.index], poses])
        scores = np.concatenate([self.scores[shape.index], scores])
        kept = distinct(shape, poses, scores, _ONE_POSE, _KEPT)
        self.poses[shape.index], self.scores[shape.index] = poses[kept], scores[kept]

    def within(self, nats: float) -> list[int]:
        """Classes that come so near to the best."""
        return [int(c) for c in np.flatnonzero(self.log_likelihood >= self.log_likelihood.max() - nats)]


def record(run: Run, keyframes: NDArray[np.int64], model: Model, progress: Progress) -> Recording:
    """Associate boxes over the whole run, find the level surfaces and which way is up."""
    associator, place = Associator(model.config.frontend, model.catalogue), Place(run)
    planes: list[tuple[Plane, ...]] = []
    with progress.stage("tracks", total=len(keyframes)) as stage:
        for observation in observations(run, keyframes, model.config.seed):
            associator.step(observation)
            place.update(observation)
            planes.append(observation.planes)
            stage.advance()
    return Recording(run, keyframes, tuple(planes), associator.tracks(), place)


def seed(recording: Recording, proposer: Proposer, progress: Progress) -> dict[int, Found]:
    """Full searches for every track and class at a few detections, spread over the track."""
    model = proposer.model
    chosen = {t.track_id: _spread(t.keyframes, model.config.smoother.searches) for t in recording.tracks}
    at = sorted({k for keyframes in chosen.values() for k in keyframes})
    found = {
        t.track_id: Found(
            {s.index: np.zeros((0, 4, 4)) for s in model.shapes},
            {s.index: np.zeros(0) for s in model.shapes},
            np.zeros(len(model.shapes)),
        )
        for t in recording.tracks
    }
    with progress.stage("search", total=sum(map(len, chosen.values()))) as stage:
        for k in at:
            observation = recording.observe(k)
            for track in recording.tracks:
                if k not in chosen[track.track_id]:
                    continue
                _search(found[track.track_id], track, observation, recording.place, proposer)
                stage.advance()
    return found


def _search(found: Found, track: Track, observation: Observation, place: Place, proposer: Proposer) -> None:
    model = proposer.model
    detection = track.at(observation.keyframe)
    assert detection is not None
    around = Surroundings((), place.surfaces)
    view = proposer.view(observation, np.array(detection.box), detection, around)
    for c in found.within(_WORTH_A_SEARCH):
        shape = model.shapes[c]
        stage = f"smoother.search.{shape.source.obj_id}"
        rng = generator(model.config.seed, stage, track.track_id, observation.frame.index)
        starts = proposer.search(shape, view, observation, around, rng, model.config.smoother.search_share)
        modes = proposer.modes(shape, view, starts, probe=False)
        found.join(shape, observation.frame.T_world_camera @ modes.T_camera_centre, modes.log_likelihood)
        # a class that explains nothing here says as much as nothing being here
        found.log_likelihood[shape.index] += max(log_evidence(modes), 0.0)


def _spread(keyframes: tuple[int, ...], n: int) -> frozenset[int]:
    """n of a track's keyframes, evenly spread, ends included."""
    picks = np.unique(np.round(np.linspace(0, len(keyframes) - 1, n)).astype(int))
    return frozenset(keyframes[i] for i in picks)


def gather(
    recording: Recording,
    proposer: Proposer,
    wanted: Callable[[int, int], Wanted | None],
    tracks: Mapping[int, tuple[Track, ...]],
    neighbours: Callable[[int, int], tuple[Neighbour, ...]],
    progress: Progress,
    name: str,
) -> dict[int, dict[int, Sighting]]:
    """Go through the run and refine what is wanted.

    Args:
        recording: the run.
        proposer: who refines.
        wanted: (object, keyframe) -> what to start from; None where the object isn't looked for.
        tracks: object -> its tracks.
        neighbours: (object, keyframe) -> objects whose pixels are theirs.
        progress: who is told.
        name: of this round, for the progress.

    Returns:
        object -> keyframe -> sighting.
    """
    seen: dict[int, dict[int, Sighting]] = {i: {} for i in tracks}
    last: dict[int, tuple[Array, float]] = {}
    with progress.stage(name, total=len(recording.keyframes)) as stage:
        for k in range(len(recording.keyframes)):
            asked = {i: wish for i in tracks if (wish := wanted(i, k)) is not None}
            observation = recording.observe(k) if asked else None
            for i, wish in asked.items():
                assert observation is not None
                detection = _detection(tracks[i], k)
                around = Surroundings(neighbours(i, k), recording.place.surfaces)
                sighting = _sight(observation, recording.time_s(k), proposer, wish, detection, around, last.get(i))
                if sighting is not None:
                    seen[i][k] = sighting[0]
                    last[i] = sighting[1]
            stage.advance()
    return seen


def _detection(tracks: tuple[Track, ...], keyframe: int) -> Detection | None:
    found = [d for t in tracks if (d := t.at(keyframe)) is not None]
    return found[0] if found else None


def _sight(
    observation: Observation,
    time_s: float,
    proposer: Proposer,
    wish: Wanted,
    detection: Detection | None,
    around: Surroundings,
    last: tuple[Array, float] | None,
) -> tuple[Sighting, tuple[Array, float]] | None:
    """One object in one keyframe; None where it would not be in view. Also its viewpoint and time, for the next."""
    model = proposer.model
    T_camera_world = observation.frame.T_camera_world
    box = None if detection is None else np.array(detection.box)
    if box is None and wish.expected is not None:
        c, T = wish.expected
        ahead = outlook(model.shapes[c], T_camera_world @ T, observation.frame.camera)
        box = ahead.box if ahead.share > 0.0 and (ahead.box[2:] >= 2.0).all() else None
    if box is None:
        return None
    viewpoint = _viewpoint(wish, observation)
    share = 1.0 if last is None else model.view_share(last[0], viewpoint, time_s - last[1])
    view = proposer.view(observation, box, detection, around, share)
    modes: list[PoseModes | None] = []
    context: list[Array] = []
    for shape in model.shapes:
        starts = wish.starts.get(shape.index)
        if starts is None or not len(starts):
            modes.append(None)
            context.append(np.zeros(0))
            continue
        found = proposer.modes(shape, view, T_camera_world @ starts, probe=shape.index in wish.careful)
        modes.append(found)
        poses = observation.frame.T_world_camera @ found.T_camera_centre
        context.append(around.log_potential(model, shape, poses))
    clutter = _log_clutter(proposer, view, modes)
    return Sighting(observation.keyframe, tuple(modes), tuple(context), clutter), (viewpoint, time_s)


def _log_clutter(proposer: Proposer, view: View, modes: list[PoseModes | None]) -> float:
    """Of the silhouette that explains the view best."""
    best = [(float(m.log_likelihood[0]), c) for c, m in enumerate(modes) if m is not None and len(m)]
    if not best:
        return 0.0
    c = max(best)[1]
    found = modes[c]
    assert found is not None
    return proposer.log_clutter(proposer.model.shapes[c], view, found.T_camera_centre[0])


def _viewpoint(wish: Wanted, observation: Observation) -> Array:
    """From where the object is thought to be to the camera, (3,) metres, world frame."""
    camera = observation.frame.T_world_camera[:3, 3]
    if wish.expected is not None:
        return camera - wish.expected[1][:3, 3]
    everywhere = np.concatenate([starts[:, :3, 3] for starts in wish.starts.values()])
    return camera - np.median(everywhere, axis=0)


def log_evidence(modes: PoseModes) -> float:
    """log of the summed likelihood of a view's modes, nats; -inf without any."""
    return float(log_sum(modes.log_likelihood)) if len(modes) else -np.inf


def in_world(sighting: Sighting, c: int, T_world_camera: Array) -> Array:
    """(n, 4, 4) T_world_centre of a class's modes."""
    modes = sighting.modes[c]
    return np.zeros((0, 4, 4)) if modes is None else T_world_camera @ modes.T_camera_centre
