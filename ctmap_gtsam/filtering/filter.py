"""CT-Map's filter (Algorithm 1): particle sets for each object, each keyframe seeing only the past.

Departures from the letter, each for a reason: classes have their own particle sets and evidence, so that a class can't
die out by bad luck (Rao-Blackwellisation over the class); particles are also proposed around the score's modes, which
the weights account for; the context multiplies the reported posterior once, not once a keyframe.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import Tables, build_estimate
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.belief import Belief, Reported, Updater
from ctmap_gtsam.frontend.association import Associator
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.observation import Observation, observations
from ctmap_gtsam.frontend.place import Place, describe
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.model import Model
from sequences.progress import SILENT, Progress
from sequences.types import LocalisationNoise, Run

Array = NDArray[np.float64]

NEIGHBOUR_PROBABILITY = 0.8
"""an object whose existence and class are both surer than this counts as a neighbour"""


def filter_run(
    run: Run, config: Config | None = None, *, context: bool = True, progress: Progress | None = None
) -> Estimate:
    """The particle filter over a run: the paper's CT-Map, or T-Map without context.

    Args:
        run: from `sequences.bop.load_run`.
        config: settings; None = the defaults.
        context: False for T-Map, which knows nothing of relations between objects.
        progress: who is told how far it is.

    Returns:
        The estimate p(o_t | z_1:t) at every keyframe.
    """
    config = config or Config()
    model = Model(run.catalogue, config, context=context)
    keyframes = select_keyframes(run, config.keyframes)
    proposer = Proposer(model)
    state = _State(run, model, proposer)
    with (progress or SILENT).stage("filter-ct" if context else "filter-t", total=len(keyframes)) as stage:
        for observation in observations(run, keyframes, config.seed):
            state.step(observation)
            stage.advance()
    return _estimate(run, model, keyframes, state)


class _State:
    """All beliefs after a keyframe, and what has been reported."""

    def __init__(self, run: Run, model: Model, proposer: Proposer) -> None:
        self.model = model
        self.proposer = proposer
        self.associator = Associator(model.config.frontend)
        self.place = Place(run)
        self.updater = Updater(model, proposer, run.localisation)
        self.beliefs: dict[int, Belief] = {}
        self.reports: list[dict[int, Reported]] = []

    def step(self, observation: Observation) -> None:
        """Algorithm 1 for every object. Neighbours are those of the keyframe before, so objects have no order."""
        self.associator.step(observation)
        self.place.update(observation)
        before = self.reports[-1] if self.reports else {}
        reported: dict[int, Reported] = {}
        surroundings = self._surroundings(before)
        known = [track for track in self.associator.tracks() if track.track_id in self.beliefs]
        for track in known:
            i, around = track.track_id, surroundings.without(track.track_id)
            detection = track.at(observation.keyframe)
            self.beliefs[i] = self.updater.step(self.beliefs[i], detection, observation, around)
            reported[i] = self.updater.report(self.beliefs[i], around)
        self.reports.append(reported | self._start(observation, before))

    def _start(self, observation: Observation, before: Mapping[int, Reported]) -> dict[int, Reported]:
        """Beliefs of tracks that have just become consistent.

        They know no neighbours among themselves yet, so all start a second time beside those that were sure of
        themselves.
        """
        new = [track for track in self.associator.tracks() if track.track_id not in self.beliefs]
        started: dict[int, Belief] = {}
        reported: dict[int, Reported] = {}
        for _ in range(2 if len(new) > 1 else 1):
            surroundings = self._surroundings({**before, **reported})
            for track in new:
                around = surroundings.without(track.track_id)
                started[track.track_id] = self.updater.start(track, observation, around)
            reported = {i: self.updater.report(belief, surroundings.without(i)) for i, belief in started.items()}
        self.beliefs |= started
        return reported

    def _surroundings(self, reports: Mapping[int, Reported]) -> Surroundings:
        return Surroundings(self._neighbours(reports), self.place.surfaces)

    def _neighbours(self, reports: Mapping[int, Reported]) -> tuple[Neighbour, ...]:
        """Objects that are sure of themselves, by their most likely particle."""
        return tuple(
            Neighbour(i, self.model.shapes[r.best_class], r.best_pose, r.log_evidence)
            for i, r in sorted(reports.items())
            if r.best_pose is not None
            and r.existence > NEIGHBOUR_PROBABILITY
            and r.class_probability[r.best_class] > NEIGHBOUR_PROBABILITY
        )


def _estimate(run: Run, model: Model, keyframes: NDArray[np.int64], state: _State) -> Estimate:
    objects = sorted(state.beliefs)
    rows = {i: row for row, i in enumerate(objects)}
    tables = Tables(len(objects), len(keyframes), len(model.catalogue))
    for k, reported in enumerate(state.reports):
        for i, r in reported.items():
            r.write(tables, rows[i], k, model)
    frames = [run.frames[int(f)] for f in keyframes]
    return build_estimate(
        run,
        model.config,
        "filter-ct" if model.context else "filter-t",
        keyframes,
        objects,
        tables,
        np.stack([frame.T_world_camera for frame in frames]),
        np.tile(localisation_covariance(run.localisation), (len(frames), 1, 1)),
        {
            "diagnostics": {"hypotheses_scored": state.proposer.hypotheses_scored},
            **describe(state.place),
        },
    )


def localisation_covariance(noise: LocalisationNoise) -> Array:
    """(6, 6) of the recorded camera pose's right tangent."""
    return np.diag(np.repeat([noise.rotation_rad, noise.translation_m], 3) ** 2)
