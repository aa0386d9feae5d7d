"""CT-Map's filter (Algorithm 1): particle sets for each object, each keyframe seeing only the past.

Departures from the letter, each for a reason: classes have their own particle sets and evidence, so that a class can't
die out by bad luck (Rao-Blackwellisation over the class); particles are also proposed around the score's modes, which
the weights account for; the context multiplies the reported posterior once, not once a keyframe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import Tables, build_estimate, localisation_covariance
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.belief import Belief
from ctmap_gtsam.filtering.diagnostics import Scored, diagnostics
from ctmap_gtsam.filtering.history import one_past
from ctmap_gtsam.filtering.identity import WAS_THERE, as_moved, at_place, moved_to, twin
from ctmap_gtsam.filtering.reporting import Reported
from ctmap_gtsam.filtering.tasks import Done, Hand, Scene, Search, Start, Step, with_past, without_past
from ctmap_gtsam.filtering.team import Team
from ctmap_gtsam.frontend.association import Associator, Track
from ctmap_gtsam.frontend.company import Stand, company
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.observation import Observation, observations
from ctmap_gtsam.frontend.place import Place, describe
from ctmap_gtsam.frontend.proposer import PoseModes
from ctmap_gtsam.frontend.standing import with_supports
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.model import Model
from sequences.geometry import Plane
from sequences.progress import SILENT, SILENT_STAGE, Progress, Stage, timed
from sequences.types import Detection, Frame, Run

Array = NDArray[np.float64]

NEIGHBOUR_PROBABILITY = 0.8
"""an object whose existence and class are both surer than this counts as a neighbour"""

_SEARCH = 4.0  # times as dear as another is a step with a search


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
    return filtered(run, forward(run, config or Config(), context=context, progress=progress or SILENT))


def forward(
    run: Run, config: Config, *, context: bool = True, progress: Progress = SILENT, keep_past: bool = False
) -> Forward:
    """The filter's pass over a run; `keep_past` for what is to go back over it."""
    model = Model(run.catalogue, config, context=context)
    keyframes = select_keyframes(run, config.keyframes)
    state = Forward(run, model, keyframes, keep_past=keep_past)
    with progress.stage("filter-ct" if context else "filter-t", total=len(keyframes)) as stage, state.team:
        images = observations(run, keyframes, config.seed)
        for _ in keyframes:
            with timed(stage, "images"):
                observation = next(images)
            state.step(observation, stage)
            stage.advance()
    return state


class Forward:
    """All beliefs after a keyframe, and what has been reported."""

    def __init__(self, run: Run, model: Model, keyframes: NDArray[np.int64], *, keep_past: bool = False) -> None:
        self.model = model
        self.keyframes = keyframes
        self.hand = Hand(model, run.localisation, keep_past=keep_past)
        self.team = Team(self.hand)
        self.associator = Associator(model.config.frontend, model.catalogue)
        self.place = Place(run)
        self.beliefs: dict[int, Belief] = {}
        self.owner: dict[int, int] = {}
        """track -> object"""
        self.known: dict[int, Array] = {}
        """object -> class probabilities (C,) when it last surely was there"""
        self.reports: list[dict[int, Reported]] = []
        self.found_moved: list[tuple[int, tuple[int, int], float]] = []
        """object, times of its last detection at the old place and its first at the new one, P(it is the same)"""
        self.visit = -1
        """of the last keyframe"""
        self.up_before: Array | None = None
        """(3,) which way was up by the visits before"""
        self.stood: dict[int, dict[int, Stand]] = {}
        """visit -> object -> how it stood when it was last in view there; of those that surely were there"""
        self.surfaces: list[tuple[Plane, ...]] = []
        """level surfaces at each keyframe, as far as they were known"""
        self.scored = Scored()

    def step(self, observation: Observation, stage: Stage = SILENT_STAGE) -> None:
        """Algorithm 1 for every object. Neighbours are those of the keyframe before, so objects have no order.

        Args:
            observation: of the next keyframe.
            stage: is told what parts take how long.
        """
        self.scored.begin()
        if observation.frame.visit != self.visit:
            self.visit, self.up_before = observation.frame.visit, self.place.up_world
        with timed(stage, "tracks and surfaces"):
            self.associator.step(observation)
            self.place.update(observation)
            self.surfaces.append(self.place.surfaces)
        boxes = len(observation.frame.detections)
        self.team.grow(max(len(self.beliefs), boxes), len(self.keyframes) - observation.keyframe)
        before = self.reports[-1] if self.reports else {}
        tracks = self.associator.tracks()
        reported = self._step(self._detections(tracks, observation), observation, before, stage)
        new = [t for t in tracks if t.track_id not in self.owner]
        reported = self._start(new, observation, reported, before, stage)
        self.known |= {i: r.class_probability for i, r in reported.items() if r.existence > WAS_THERE}
        self.reports.append(self._find_moved(self._merge(reported)))
        self._remember(self.reports[-1])

    def _step(
        self,
        detections: Mapping[int, Detection | None],
        observation: Observation,
        before: Mapping[int, Reported],
        stage: Stage,
    ) -> dict[int, Reported]:
        """Every object by its detection, beside what stood there before: what is said of them."""
        steps = [Step(without_past(self.beliefs[i]), box, before.get(i)) for i, box in detections.items()]
        scene = Scene(observation, self.surroundings(before))
        worth = [self._worth(i, box, observation) for i, box in detections.items()]
        done = self.team.do(steps, worth, scene, stage)
        self._count(list(detections), done)
        for i, one in zip(detections, done, strict=True):
            self.beliefs[i] = with_past(one.answer[0], self.beliefs[i])
        return {i: one.answer[1] for i, one in zip(detections, done, strict=True)}

    def _worth(self, i: int, detection: Detection | None, observation: Observation) -> float:
        """How dear a step will be, about: as the last one, and more where a search is due; out of view nothing."""
        belief = self.beliefs[i]
        if not self.hand.updater.sees(belief, detection, observation):
            return 0.0
        return (1.0 + self.scored.last(i)) * (_SEARCH if self.hand.updater.searches(belief, detection) else 1.0)

    def _count(self, objects: Sequence[int], done: Sequence[Done[Any]]) -> None:
        """Take down what was scored for objects."""
        for i, one in zip(objects, done, strict=True):
            self.scored.add(i, one.hypotheses)

    def _detections(self, tracks: tuple[Track, ...], observation: Observation) -> dict[int, Detection | None]:
        """Every object's detection, the surest where several of its tracks have one.

        A track that was taken for an object known before, and whose box has nothing to do with it any more, is let go.
        """
        out: dict[int, Detection | None] = dict.fromkeys(sorted(self.beliefs))
        for track in tracks:
            i, detection = self.owner.get(track.track_id), track.at(observation.keyframe)
            if i is None or detection is None:
                continue
            if i != track.track_id and not self.hand.updater.covers(self.beliefs[i], detection, observation):
                del self.owner[track.track_id]
                continue
            other = out[i]
            if other is None or detection.class_scores[1:].max() > other.class_scores[1:].max():
                out[i] = detection
        return out

    def _start(
        self,
        new: list[Track],
        observation: Observation,
        reported: Mapping[int, Reported],
        before: Mapping[int, Reported],
        stage: Stage,
    ) -> dict[int, Reported]:
        """`reported` with the objects of tracks that have just become consistent, where they aren't known already.

        They know no neighbours among themselves yet, so all start a second time beside those that were sure of
        themselves.
        """
        objects = [track.track_id for track in new]
        found = self._search(new, Scene(observation, self.surroundings(before)), stage)
        fresh: dict[int, Reported] = {}
        started: dict[int, Belief] = {}
        for _ in range(2 if len(new) > 1 else 1):
            scene = Scene(observation, self.surroundings({**before, **fresh}))
            starts = [Start(track, modes) for track, modes in zip(new, found, strict=True)]
            done = self.team.do(starts, [1.0] * len(new), scene, stage)
            self._count(objects, done)
            started = {i: one.answer[0] for i, one in zip(objects, done, strict=True)}
            fresh = {i: one.answer[1] for i, one in zip(objects, done, strict=True)}
        there = dict(reported)
        for i, report in fresh.items():
            known = at_place(report, there, self.model)
            owner = self.owner[i] = i if known is None else known
            if known is None or there[known].existence < min(0.5, report.existence):
                past = one_past(started[i].past, self.beliefs[owner].past if owner in self.beliefs else None)
                self.beliefs[owner] = replace(started[i], object_id=owner, past=past)
                there[owner] = report
        return there

    def _search(self, new: list[Track], scene: Scene, stage: Stage) -> list[tuple[PoseModes, ...]]:
        """What is found of each track, of each class."""
        each = [(track, shape) for track in new for shape in self.model.shapes]
        searches = [Search(track, shape.index) for track, shape in each]
        done = self.team.do(searches, [shape.reach_m for _, shape in each], scene, stage)
        self._count([track.track_id for track, _ in each], done)
        n = len(self.model.shapes)
        return [tuple(one.answer for one in done[n * k : n * (k + 1)]) for k in range(len(new))]

    def _merge(self, reported: dict[int, Reported]) -> dict[int, Reported]:
        """Objects of one class that have come to one place go on as the older, with what has more evidence."""
        kept: dict[int, Reported] = {}
        for i in sorted(reported, key=lambda i: (-reported[i].log_evidence, i)):
            same = twin(reported[i], kept, self.model)
            if same is None:
                kept[i] = reported[i]
                continue
            old, young = sorted((i, same), key=lambda j: (self.beliefs[j].first_ns, j))
            kept[old] = kept.pop(same)
            more, less = self.beliefs[same], self.beliefs[i]
            past = one_past(more.past, less.past)
            self.beliefs[old] = replace(more, object_id=old, first_ns=self.beliefs[old].first_ns, past=past)
            del self.beliefs[young]
            for stands in self.stood.values():
                if young in stands:
                    stands.setdefault(old, stands.pop(young))
            self.owner |= {track: old for track, owner in self.owner.items() if owner == young}
        return dict(sorted(kept.items()))

    def _find_moved(self, reported: dict[int, Reported]) -> dict[int, Reported]:
        """Objects whose place was found empty and that are met elsewhere go on there."""
        moved = moved_to(self.beliefs, reported, self.known, self.model)
        for i, (found, same) in moved.items():
            between = self.beliefs[i].present_ns, self.beliefs[found].first_ns
            self.found_moved.append((i, between, same))
            old, new = self.beliefs[i], self.beliefs.pop(found)
            self.beliefs[i] = as_moved(old, new, self.known[i], self.model, self.place.surfaces)
            self.owner |= {track: i for track, owner in self.owner.items() if owner == found}
            for stands in self.stood.values():
                if found in stands:
                    stands[i] = stands.pop(found)
            reported[i] = reported.pop(found)
        return reported

    def _remember(self, reported: Mapping[int, Reported]) -> None:
        """Take down how things in view stand, and strike out what of this visit is found not to be there."""
        stands = self.stood.setdefault(self.visit, {})
        for i, r in reported.items():
            if r.visible:
                stands.pop(i, None)
                stands |= _stands({i: r}, NEIGHBOUR_PROBABILITY)

    def surroundings(self, reports: Mapping[int, Reported]) -> Surroundings:
        """What stands around, by what was reported."""
        earlier = [self.stood[visit] for visit in sorted(self.stood) if visit < self.visit]
        partners = company(_stands(reports, 0.5), earlier, self.up_before, self.model) if earlier else {}
        return Surroundings(self._neighbours(reports), self.place.surfaces, partners)

    def _neighbours(self, reports: Mapping[int, Reported]) -> tuple[Neighbour, ...]:
        """Objects that are sure of themselves, by their most likely particle."""
        return tuple(
            Neighbour(i, self.model.shapes[r.best_class], r.best_pose, r.log_evidence)
            for i, r in sorted(reports.items())
            if r.best_pose is not None
            and r.existence > NEIGHBOUR_PROBABILITY
            and r.class_probability[r.best_class] > NEIGHBOUR_PROBABILITY
        )


def _stands(reports: Mapping[int, Reported], sure: float) -> dict[int, Stand]:
    """How objects stand whose existence and class are both so sure."""
    return {
        i: Stand(r.best_class, r.best_pose)
        for i, r in reports.items()
        if r.best_pose is not None and min(r.existence, r.class_probability[r.best_class]) > sure
    }


def filtered(run: Run, state: Forward) -> Estimate:
    """What the filter says of a run: its pass, written down."""
    model, keyframes = state.model, state.keyframes
    objects = sorted({i for reported in state.reports for i in reported})
    rows = {i: row for row, i in enumerate(objects)}
    tables = Tables(len(objects), len(keyframes), len(model.catalogue))
    for k, reported in enumerate(state.reports):
        for i, r in reported.items():
            r.write(tables, rows, i, k, model)
    frames = [run.frames[int(f)] for f in keyframes]
    _write_moves(tables, rows, frames, state)
    estimate = build_estimate(
        run,
        model.config,
        "filter-ct" if model.context else "filter-t",
        keyframes,
        objects,
        tables,
        np.stack([frame.T_world_camera for frame in frames]),
        np.tile(localisation_covariance(run.localisation), (len(frames), 1, 1)),
        {
            "diagnostics": diagnostics(objects, state.reports, state.scored),
            **describe(state.place),
        },
    )
    return with_supports(estimate, model, state.surfaces, settled=True)


def _write_moves(tables: Tables, rows: Mapping[int, int], frames: Sequence[Frame], state: Forward) -> None:
    """A line for each gap between views that is long enough to hold a move, by what is believed when its visit ends."""
    times = np.array([frame.time_ns for frame in frames])
    for i, between, same in state.found_moved:
        gap = (int(np.searchsorted(times, between[0])), int(np.searchsorted(times, between[1])))
        tables.move(rows[i], gap, same, between)
    significant_ns = state.model.config.prediction.significant_period_s * 1e9
    for i, row in rows.items():
        seen = [k for k, reported in enumerate(state.reports) if i in reported and reported[i].visible]
        for a, b in pairwise(seen):
            if times[b] - times[a] < significant_ns or _within(state.found_moved, i, times[a], times[b]):
                continue
            after = [state.reports[k][i] for k in seen if k >= b and frames[k].visit == frames[b].visit]
            elsewhere = after[-1].elsewhere
            # nearby: as believed when the visit ends, or the next absence in it begins
            nearby = [r.moved for r in after if r.returned_ns == times[b]]
            moved = elsewhere + (1.0 - elsewhere) * (nearby[-1] if nearby else 0.0)
            tables.move(row, (a, b), moved, (int(times[a]), int(times[b])))


def _within(found: Sequence[tuple[int, tuple[int, int], float]], i: int, begin: int, end: int) -> bool:
    """Whether an object was found to have moved in a time that overlaps with another."""
    return any(j == i and between[0] < end and begin < between[1] for j, between, _ in found)
