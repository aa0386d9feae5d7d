"""Static fusion: what a map gains from all frames of a visit when nothing may move, and objects know nothing of others.

Each visit is mapped by itself. Its detections of one track have one class, that of the largest mean score; in each
keyframe the shared proposer searches the box for that class's poses; and all of these are fused into the one pose that
most keyframes agree on. No prediction, no context, no localisation: cameras are as recorded, and their stated error is
added to each pose's covariance as if it were fresh in each keyframe.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.baselines.placing import Placement, estimate_of, seen_as
from ctmap_gtsam.building import localisation_covariance
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.association import Associator, Track
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.observation import Observation, observations
from ctmap_gtsam.frontend.place import Place, describe
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors.symmetry import NONE, Symmetry, residual, residual_jacobians
from sequences import se3
from sequences.progress import SILENT, Progress
from sequences.seeds import generator
from sequences.types import Detection, Run

Array = NDArray[np.float64]
NAME = "static-fusion"

_FREEDOM = 6.0  # the mean of d^2 were all as it says
_STEPS = 30  # of the fusion's iteration, at most
_DONE = 1e-9  # a step so short ends it, rad and metres


@dataclass(frozen=True)
class Poses:
    """What one keyframe says of one object's pose: n alternatives."""

    T: Array
    """(n, 4, 4)"""
    covariance: Array
    """(n, 6, 6) of their right tangents"""
    behind: Array
    """(n,) how much less likely each is than the best, nats"""


@dataclass
class _Seen:
    """One track in one visit."""

    keyframes: list[int] = field(default_factory=list)
    detections: list[Detection] = field(default_factory=list)
    poses: list[Poses] = field(default_factory=list)
    """T_world_centre, of the keyframes that have any"""

    @property
    def class_probability(self) -> Array:
        """(C,) of all of them together."""
        return seen_as(np.stack([d.class_scores for d in self.detections]))


def static_fusion(run: Run, config: Config, progress: Progress = SILENT) -> Estimate:
    """One pose an object and visit.

    Args:
        run: from `sequences.bop.load_run`.
        config: settings.
        progress: who is told how far it is.

    Returns:
        The estimate. An object of which a visit has no detection, or no pose, doesn't exist in it.
    """
    model = Model(run.catalogue, config, context=False)
    proposer = Proposer(model)
    keyframes = select_keyframes(run, config.keyframes)
    with progress.stage(NAME, total=2 * len(keyframes)) as stage:
        associator, place = Associator(config.frontend, run.catalogue), Place(run)
        for observation in observations(run, keyframes, config.seed):
            associator.step(observation)
            place.update(observation)
            stage.advance()
        visits = [run.frames[int(f)].visit for f in keyframes]
        seen = {track.track_id: _by_visit(track, visits) for track in associator.tracks()}
        surroundings = Surroundings((), place.surfaces)
        for observation in observations(run, keyframes, config.seed):
            _measure(seen, observation, surroundings, proposer, localisation_covariance(run.localisation))
            stage.advance()
    fused = {i: {visit: _fused(s, model) for visit, s in of.items()} for i, of in seen.items()}
    placements = {i: [of.get(visit) for visit in visits] for i, of in fused.items()}
    extra = {"diagnostics": {"hypotheses_scored": proposer.hypotheses_scored}, **describe(place)}
    return estimate_of(run, config, NAME, keyframes, placements, model.shapes, extra)


def fuse(measured: Sequence[Poses], symmetry: Symmetry = NONE) -> tuple[Array, Array]:
    """The one pose that most of the measurements agree on, and its covariance.

    Of each measurement one alternative counts, that of the least d^2, its squared distance by its own covariance plus
    twice what it is behind, with the weight (1 + d^2 / 6)^-1: Cauchy's M-estimator of the mean on SE(3). It is found by
    iterated least squares (Barfoot and Furgale, Associating uncertainty with three-dimensional poses, T-RO 2014,
    Section V) from the alternative whose total cost is least.

    Args:
        measured: one or more, independent of each other.
        symmetry: of the object, in the frame that the poses are of.

    Returns:
        (4, 4), and (6, 6) of its right tangent: the inverse of the weighted sum of informations, so that n equal
        measurements have an n-th of one's covariance.
    """
    information: list[Array] = [np.asarray(np.linalg.inv(m.covariance), np.float64) for m in measured]
    starts = np.concatenate([m.T for m in measured])
    nearest = [_squared(starts, m, L, symmetry).min(axis=1) for m, L in zip(measured, information, strict=True)]
    T = starts[int(np.argmin(np.log1p(np.array(nearest) / _FREEDOM).sum(axis=0)))]
    for _ in range(_STEPS):
        H, g = _normal_equations(T, measured, information, symmetry)
        step = np.asarray(-np.linalg.solve(H, g), np.float64)
        T = se3.retract(T, step)
        if np.abs(step).max() < _DONE:
            break
    return T, np.asarray(np.linalg.inv(_normal_equations(T, measured, information, symmetry)[0]), np.float64)


def _normal_equations(
    T: Array, measured: Sequence[Poses], information: Sequence[Array], symmetry: Symmetry
) -> tuple[Array, Array]:
    """(6, 6) and (6,) of the nearest alternatives' residuals at T."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    for m, L in zip(measured, information, strict=True):
        squared = _squared(T[None], m, L, symmetry)[0]
        k = int(np.argmin(squared))
        r, _, J = residual_jacobians(m.T[k], T, symmetry)
        weight = 1.0 / (1.0 + squared[k] / _FREEDOM)
        H += weight * J.T @ L[k] @ J
        g += weight * J.T @ L[k] @ r
    # what the object's symmetry leaves free stays where it is
    free = symmetry.free_axes
    return H + free @ free.T / np.pi**2, g


def _squared(T: Array, m: Poses, information: Array, symmetry: Symmetry) -> Array:
    """(K, n) d^2 of poses (K, 4, 4) from the alternatives."""
    r = residual(m.T[None], T[:, None], symmetry)
    return np.einsum("kni,nij,knj->kn", r, information, r) + 2.0 * m.behind


def _by_visit(track: Track, visits: Sequence[int]) -> dict[int, _Seen]:
    out: dict[int, _Seen] = defaultdict(_Seen)
    for k, detection in zip(track.keyframes, track.detections, strict=True):
        out[visits[k]].keyframes.append(k)
        out[visits[k]].detections.append(detection)
    return dict(out)


def _measure(
    seen: dict[int, dict[int, _Seen]],
    observation: Observation,
    surroundings: Surroundings,
    proposer: Proposer,
    localisation: Array,
) -> None:
    """Search this keyframe's boxes."""
    frame, config = observation.frame, proposer.model.config
    for i, of in seen.items():
        here = of.get(frame.visit)
        if here is None or observation.keyframe not in here.keyframes:
            continue
        detection = here.detections[here.keyframes.index(observation.keyframe)]
        shape = proposer.model.shapes[int(np.argmax(here.class_probability))]
        view = proposer.view(observation, np.array(detection.box), detection, surroundings)
        rng = generator(config.seed, NAME, i, frame.index)
        starts = proposer.search(shape, view, observation, surroundings, rng, config.baselines.fusion_search_share)
        found = proposer.modes(shape, view, starts)
        if len(found):
            # an error of the camera's pose moves what the camera sees
            A = se3.adjoint(se3.inverse(found.T_camera_centre))
            covariance = found.covariance + A @ localisation @ A.swapaxes(-1, -2)
            behind = found.log_likelihood[0] - found.log_likelihood
            here.poses.append(Poses(frame.T_world_camera @ found.T_camera_centre, covariance, behind))


def _fused(seen: _Seen, model: Model) -> Placement | None:
    if not seen.poses:
        return None
    probability = seen.class_probability
    shape: Shape = model.shapes[int(np.argmax(probability))]
    T, covariance = fuse(seen.poses, shape.symmetry)
    return Placement(probability, shape.to_object(T), shape.covariance_to_object(covariance))
