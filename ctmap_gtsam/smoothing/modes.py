"""Measurement modes of every object, class and keyframe, with the whole run in view.

Gathering goes through the run once a round, depth read once a keyframe, and refines on each image what was found at
other times, what the smoother predicts, and what was there before. Only the likelihood goes into a mode: the prior is
the graph's and the trellis's business.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.observation import Observation, centre_depth, observations
from ctmap_gtsam.frontend.place import Place
from ctmap_gtsam.frontend.proposer import PoseModes, Proposer, View
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.model import Model
from sequences import se3
from sequences.geometry import Plane
from sequences.progress import Progress
from sequences.types import Detection, Run

Array = NDArray[np.float64]

_NOWHERE = np.zeros(0)  # context of no modes: one array for all classes, objects and keyframes

Boxes = Mapping[int, Detection]
"""keyframe -> the detection that is taken for an object there"""


@dataclass(frozen=True)
class Recording:
    """What the whole run says before any object is estimated."""

    run: Run
    keyframes: NDArray[np.int64]
    """(K,) indices into Run.frames"""
    planes: tuple[tuple[Plane, ...], ...]
    """(K,) those of each keyframe's image, camera frame: found once, depth is read again each round"""
    box_depths: tuple[Array, ...]
    """(K,) of (D,) depths in the middle of each keyframe's detections, metres; 0 where nothing was measured"""
    place: Place

    def observe(self, keyframe: int) -> Observation:
        """Read a keyframe."""
        frame = self.run.frames[int(self.keyframes[keyframe])]
        return Observation(keyframe, frame, frame.read_depth(), self.planes[keyframe])

    def T_world_camera(self, keyframe: int) -> Array:
        """(4, 4) as recorded."""
        return self.run.frames[int(self.keyframes[keyframe])].T_world_camera

    def visit(self, keyframe: int) -> int:
        """Which one it is of."""
        return self.run.frames[int(self.keyframes[keyframe])].visit

    def time_s(self, keyframe: int) -> float:
        """Since the first keyframe."""
        frames = self.run.frames
        start = frames[int(self.keyframes[0])].time_ns
        return (frames[int(self.keyframes[keyframe])].time_ns - start) * 1e-9


@dataclass(frozen=True)
class Look:
    """Where and beside what one object is looked for in one keyframe: a tile of its depth, not the image."""

    keyframe: int
    time_s: float
    T_world_camera: Array
    """(4, 4) as recorded"""
    view: View
    around: Surroundings
    viewpoint: Array
    """(3,) from where the object is thought to be to the camera, metres, world frame"""
    first: bool
    """whether it is the object's first"""


@dataclass(frozen=True, slots=True)  # a map holds one for each object and keyframe
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


def record(run: Run, keyframes: NDArray[np.int64], model: Model, progress: Progress) -> Recording:
    """Go through the run once: level surfaces, which way is up, and how far away what was detected is."""
    place = Place(run)
    planes: list[tuple[Plane, ...]] = []
    depths: list[Array] = []
    with progress.stage("place", total=len(keyframes)) as stage:
        for observation in observations(run, keyframes, model.config.seed):
            place.update(observation)
            planes.append(observation.planes)
            depths.append(box_depths(observation))
            stage.advance()
    return Recording(run, keyframes, tuple(planes), tuple(depths), place)


def box_depths(observation: Observation) -> Array:
    """(D,) depths in the middle of a keyframe's detections, metres; 0 where nothing was measured."""
    boxes = [np.array(d.box) for d in observation.frame.detections]
    return np.array([centre_depth(observation.depth, box) for box in boxes])


def gather(
    recording: Recording,
    proposer: Proposer,
    wanted: Callable[[int, int], Wanted | None],
    boxes: Mapping[int, Boxes],
    around: Callable[[int], Surroundings],
    progress: Progress,
    name: str,
) -> dict[int, dict[int, Sighting]]:
    """Go through the run and refine what is wanted.

    Args:
        recording: the run.
        proposer: who refines.
        wanted: (object, keyframe) -> what to start from; None where the object isn't looked for.
        boxes: object -> its detections.
        around: keyframe -> what stands there: the neighbours' pixels are theirs.
        progress: who is told.
        name: of this round, for the progress.

    Returns:
        object -> keyframe -> sighting.
    """
    seen: dict[int, dict[int, Sighting]] = {i: {} for i in boxes}
    last: dict[int, Look] = {}
    with progress.stage(name, total=len(recording.keyframes)) as stage:
        for k in range(len(recording.keyframes)):
            asked = {i: wish for i in boxes if (wish := wanted(i, k)) is not None}
            if asked:
                observation, there = recording.observe(k), around(k)
            for i, wish in asked.items():
                detection, beside = boxes[i].get(k), there.without(i)
                found = look(observation, recording.time_s(k), proposer, wish, detection, beside, last.get(i))
                if found is not None:
                    seen[i][k] = sight(found, proposer, wish)
                    last[i] = found
            stage.advance()
    return seen


def look(
    observation: Observation,
    time_s: float,
    proposer: Proposer,
    wish: Wanted,
    detection: Detection | None,
    around: Surroundings,
    last: Look | None,
) -> Look | None:
    """Where in a keyframe an object is looked for; None where it would not be in view.

    Args:
        observation: the keyframe.
        time_s: of the keyframe.
        proposer: cuts the tile.
        wish: what is wanted of the object here.
        detection: its box; without one it is looked for where it is expected.
        around: what stands around it.
        last: the look before this one, by which it is known how much of this one is news.
    """
    model = proposer.model
    box = None if detection is None else np.array(detection.box)
    if box is None and wish.expected is not None:
        c, T = wish.expected
        ahead = outlook(model.shapes[c], observation.frame.T_camera_world @ T, observation.frame.camera)
        box = ahead.box if ahead.share > 0.0 and (ahead.box[2:] >= 2.0).all() else None
    if box is None:
        return None
    viewpoint = _viewpoint(wish, observation)
    share = 1.0 if last is None else model.view_share(last.viewpoint, viewpoint, time_s - last.time_s)
    view = proposer.view(observation, box, detection, around, share)
    return Look(observation.keyframe, time_s, observation.frame.T_world_camera, view, around, viewpoint, last is None)


def sight(at: Look, proposer: Proposer, wish: Wanted, known: Sighting | None = None) -> Sighting:
    """The modes of one object in one keyframe.

    Args:
        at: the look at it.
        proposer: who refines.
        wish: what from, for each class.
        known: modes of the same look that classes keep for which nothing is wished.
    """
    model = proposer.model
    T_camera_world = se3.inverse(at.T_world_camera)
    modes: list[PoseModes | None] = []
    context: list[Array] = []
    for shape in model.shapes:
        starts = wish.starts.get(shape.index)
        if starts is None or not len(starts):
            modes.append(None if known is None else known.modes[shape.index])
            context.append(_NOWHERE if known is None else known.context[shape.index])
            continue
        careful = shape.index in wish.careful
        found = proposer.modes(shape, at.view, T_camera_world @ starts, probe=careful, ways_round=careful)
        modes.append(found)
        context.append(at.around.log_potential(model, shape, at.T_world_camera @ found.T_camera_centre))
    return Sighting(at.keyframe, tuple(modes), tuple(context), _log_clutter(proposer, at.view, modes, at.first))


def _log_clutter(proposer: Proposer, view: View, modes: list[PoseModes | None], first: bool) -> float:
    """Of the silhouette that explains the view best."""
    best = [(float(m.log_likelihood[0]), c) for c, m in enumerate(modes) if m is not None and len(m)]
    if not best:
        return 0.0
    c = max(best)[1]
    found = modes[c]
    assert found is not None
    return proposer.log_clutter(proposer.model.shapes[c], view, found.T_camera_centre[0], first)


def _viewpoint(wish: Wanted, observation: Observation) -> Array:
    """From where the object is thought to be to the camera, (3,) metres, world frame."""
    camera = observation.frame.T_world_camera[:3, 3]
    if wish.expected is not None:
        return camera - wish.expected[1][:3, 3]
    everywhere = np.concatenate([starts[:, :3, 3] for starts in wish.starts.values()])
    return camera - np.median(everywhere, axis=0)


def in_world(sighting: Sighting, c: int, T_world_camera: Array) -> Array:
    """(n, 4, 4) T_world_centre of a class's modes."""
    modes = sighting.modes[c]
    return np.zeros((0, 4, 4)) if modes is None else T_world_camera @ modes.T_camera_centre
