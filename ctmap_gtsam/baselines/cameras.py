"""How well the cameras can be known: the smoother's graph by somebody who knows the objects. Reads the truth.

Every true object is given, its class and where it is in the world in every keyframe; what isn't known are the cameras.
Each object that is visible is registered to the depth as the smoother does it, from where it is in the recorded camera
(so no start knows the true one) and in the box of its visible pixels, and becomes a measurement. It is also known how
well each object is measured: to the covariance that the score's shape gives comes the second moment of the object's
errors in this run. (With the score's alone furniture, of whose pose a view tells less than its score lets one think,
would draw the cameras off. A map's objects give way to such errors, known ones can't.) The graph is the smoother's own,
with localisation that drifts and the depth's error that an object's views of a visit share; the objects are held at the
truth. What is left of the cameras' error is what depth and localisation leave open, not the map.

Of several modes the one is taken that is the likeliest beside where the object has to be; one that even so is further
off than localisation and depth allow is refused (a validation gate; Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ctmap_gtsam.baselines.oracle import true_boxes
from ctmap_gtsam.baselines.placing import Placement, certainly, estimate_of
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.proposer import PoseModes, Proposer
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.graph import Measured, Smoothed, SmootherGraph, build, object_key, smooth
from ctmap_gtsam.smoothing.modes import Look, Recording, Wanted, look, record
from ctmap_gtsam.smoothing.rounds import camera_of
from factors.symmetry import nearest_image, residual
from sequences import se3
from sequences.progress import SILENT, Progress
from sequences.truth import load_truth
from sequences.types import VISIBLE_FRACTION, Detection, Frame, Run, TrueObject, Truth

Array = NDArray[np.float64]
NAME = "cameras-oracle"

_HELD = np.repeat([1e-5, 1e-5], 3)
"""rad, metres: how firmly an object is held at the truth"""
_GATE = float(chi2.ppf(0.999, 6))
_LEAST_PX = 2.0  # a side of a box in which anything can be seen


@dataclass
class _Object:
    """A true object, and what is measured of it."""

    thing: TrueObject
    shape: Shape
    measured: list[Measured] = field(default_factory=list)
    last: Look | None = None

    def T_world_centre(self, frame: int) -> Array | None:
        """(4, 4); None where the truth doesn't have it."""
        i = int(np.searchsorted(self.thing.frames, frame))
        if i == len(self.thing.frames) or self.thing.frames[i] != frame:
            return None
        return self.shape.to_centre(self.thing.T_world_object[i])

    def shows(self, frame: int) -> bool:
        """Whether enough of it is visible in a frame."""
        return bool((self.thing.visible_fraction[self.thing.frames == frame] >= VISIBLE_FRACTION).any())


def cameras_of_known_objects(run: Run, config: Config, progress: Progress = SILENT) -> Estimate:
    """The cameras, the objects being known.

    Args:
        run: the recording, with truth beside it.
        config: settings.
        progress: who is told how far it is.

    Returns:
        The estimate, of the method "cameras-oracle": the true objects, and the cameras with their marginal covariances.
    """
    truth = load_truth(run)
    assert truth is not None, "a run without truth: see obstacle"
    model = Model(run.catalogue, config, context=False)
    proposer = Proposer(model)
    keyframes = select_keyframes(run, config.keyframes)
    recording = record(run, keyframes, model, progress)
    things = {
        row: _Object(thing, model.shapes[run.catalogue.index(thing.obj_id)]) for row, thing in enumerate(truth.objects)
    }
    refused = 0
    with progress.stage(NAME, total=len(keyframes)) as stage:
        for k in range(len(keyframes)):
            refused += _measure(k, things, truth, recording, proposer)
            stage.advance()
    for one in things.values():
        _weigh(one, recording, truth)
    smoothed = _solved(things, recording, model)
    diagnostics = {
        "hypotheses_scored": proposer.hypotheses_scored,
        "measurements": sum(len(one.measured) for one in things.values()),
        "refused": refused,
        "solver": {"end": smoothed.solution.end, "trace": list(smoothed.solution.trace)},
    }
    return estimate_of(
        run,
        config,
        NAME,
        keyframes,
        {one.thing.inst_id: _placements(one, recording, model) for one in things.values()},
        model.shapes,
        {"reads_truth": True, "diagnostics": diagnostics},
        (smoothed.T_world_camera, smoothed.camera_covariance),
    )


def _measure(k: int, things: Mapping[int, _Object], truth: Truth, recording: Recording, proposer: Proposer) -> int:
    """Register what shows in keyframe k, and say how many were refused."""
    f = int(recording.keyframes[k])
    shown = {row: one for row, one in things.items() if one.shows(f)}
    if not shown:
        return 0
    observation = recording.observe(k)
    boxes = dict(_boxes(observation.frame, shown, truth, recording))
    there = ((row, one.shape, one.T_world_centre(f)) for row, one in things.items())
    neighbours = tuple(Neighbour(row, shape, T, 0.0) for row, shape, T in there if T is not None)
    around = Surroundings(neighbours, recording.place.surfaces)
    refused = 0
    for row, box in boxes.items():
        one = things[row]
        T = one.T_world_centre(f)
        assert T is not None
        c, shape = one.shape.index, one.shape
        wish = Wanted({c: T[None]}, (c, T), frozenset({c}))
        found = look(observation, recording.time_s(k), proposer, wish, box, around.without(row), one.last)
        assert found is not None, "a box is where it is looked for"
        one.last = found
        expected = observation.frame.T_camera_world @ T
        modes = proposer.modes(shape, found.view, expected[None])
        best = _likeliest(modes, expected, shape, recording, proposer.model)
        if best is None:
            refused += 1
            continue
        visit, pose = observation.frame.visit, modes.T_camera_centre[best]
        one.measured.append(Measured(k, recording.time_s(k), visit, pose, modes.covariance[best], stays=False))
    return refused


def _boxes(
    frame: Frame, shown: Mapping[int, _Object], truth: Truth, recording: Recording
) -> Iterator[tuple[int, Detection]]:
    """What a detector that errs nowhere would say of the things that show."""
    catalogue = recording.run.catalogue
    rows = {one.thing.inst_id: row for row, one in shown.items()}
    for thing, box in true_boxes(catalogue, truth, frame, [one.thing for one in shown.values()]):
        if (box[2:] >= _LEAST_PX).all():
            x, y, w, h = (float(b) for b in box)
            scores = certainly(1 + catalogue.index(thing.obj_id), 1 + len(catalogue))
            yield rows[thing.inst_id], Detection((x, y, w, h), scores)


def _likeliest(modes: PoseModes, expected: Array, shape: Shape, recording: Recording, model: Model) -> int | None:
    """The mode to take for a thing that is expected at T_camera_centre (4, 4); None where all are too far off."""
    if not len(modes):
        return None
    away = float(np.linalg.norm(expected[:3, 3]))
    shared = np.diag(model.shared_variance(shape, recording.run.localisation, away))
    r = residual(expected[None], modes.T_camera_centre, shape.symmetry)
    squared = np.einsum("ni,nij,nj->n", r, np.linalg.inv(modes.covariance + shared), r)
    best = int(np.argmax(np.where(squared <= _GATE, modes.log_likelihood - 0.5 * squared, -np.inf)))
    return best if squared[best] <= _GATE else None


def _weigh(one: _Object, recording: Recording, truth: Truth) -> None:
    """Add to an object's covariances the second moment of its errors."""
    if not one.measured:
        return
    frames = [int(recording.keyframes[m.keyframe]) for m in one.measured]
    poses = [one.T_world_centre(f) for f in frames]
    true = se3.inverse(truth.T_world_camera[frames]) @ np.stack([T for T in poses if T is not None])
    r = residual(true, np.stack([m.T_camera_centre for m in one.measured]), one.shape.symmetry)
    moment = r.T @ r / len(r)
    one.measured = [replace(m, covariance=m.covariance + moment) for m in one.measured]


def _solved(things: Mapping[int, _Object], recording: Recording, model: Model) -> Smoothed:
    """The smoother's graph with the objects held."""
    objects = {row: (one.shape, one.measured) for row, one in things.items() if one.measured}
    cameras = [camera_of(recording, k) for k in range(len(recording.keyframes))]
    built = build(model, cameras, recording.run.localisation, objects)
    for row in objects:
        _hold(built, row, things[row], recording)
    return smooth(built, model, len(recording.keyframes))


def _hold(built: SmootherGraph, row: int, one: _Object, recording: Recording) -> None:
    """Fix an object at the truth, in that of the equivalent poses in which the graph has it."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(_HELD)
    for measured in one.measured:
        key = object_key(row, measured.keyframe)
        true = one.T_world_centre(int(recording.keyframes[measured.keyframe]))
        assert true is not None
        T = nearest_image(built.initial.atPose3(key).matrix(), true, one.shape.symmetry)
        built.add(
            "truth", f"object {row} keyframe {measured.keyframe}", gtsam.PriorFactorPose3(key, gtsam.Pose3(T), noise)
        )


def _placements(one: _Object, recording: Recording, model: Model) -> list[Placement | None]:
    """Where the object is, keyframe by keyframe."""
    probability = certainly(one.shape.index, len(model.catalogue))
    poses = (one.T_world_centre(int(f)) for f in recording.keyframes)
    return [None if T is None else Placement(probability, one.shape.to_object(T), np.diag(_HELD**2)) for T in poses]
