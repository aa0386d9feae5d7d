"""The particle smoother: forward filtering, backward simulation (Godsill, Doucet and West, J. Am. Stat. Assoc. 2004).

The filter runs forward and keeps its particles. Then trajectories are drawn from the last keyframe to the first: given
where a trajectory is at one keyframe, it was at particle j of the keyframe before with probability

    w_j p(x_next | x_j) / sum_l w_l p(x_next | x_l)

with the transition p that the forward pass weighed with: the prediction in view, and a small part that comes from
anywhere nearby. What is reported of a keyframe are the means of these probabilities over all trajectories (the draws
but for the last, Rao-Blackwellised), a weighted particle set as the filter's. The class is not drawn: it has its own
particles and trajectories. No image is looked at again.

Whether the thing was there, and of what class, is weighed beside that, exactly: either it is still there in the end, as
the filter says then, or it was taken away after one of the keyframes (Equation 3 in absences, the chance of a push in
view), or it never was a known thing; each with the evidence that the filter had collected by then, since what comes
later says nothing of one that has gone. A trajectory begins where its thing was last there.

What has no past among the particles is carried back by the prediction alone: a pose that a search found late and that
explained the views kept before better, and an object before its track was consistent. It is carried to its first box,
and on to the beginning of that visit, where it stood with Equation 3's probability for the time until the first box.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ctmap_gtsam.building import Tables, build_estimate, localisation_covariance
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.diagnostics import diagnostics, number
from ctmap_gtsam.filtering.filter import Forward, forward
from ctmap_gtsam.filtering.history import Kept, Past, Stage
from ctmap_gtsam.filtering.particles import (
    Particles,
    Spread,
    modes_of,
    predicted_spread,
    systematic,
    transition_log_density,
)
from ctmap_gtsam.filtering.reporting import REPORTED, Reported
from ctmap_gtsam.frontend.place import describe
from ctmap_gtsam.frontend.standing import with_supports
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors import mixture
from factors.mixture import log_sum
from factors.motions import retract
from sequences.progress import SILENT, Progress
from sequences.seeds import generator
from sequences.types import LocalisationNoise, Run

Array = NDArray[np.float64]

_NOTHING = 1e-9  # of a set's weight: particles that trajectories pass by are left out


def backward_run(
    run: Run, config: Config | None = None, *, context: bool = True, progress: Progress | None = None
) -> Estimate:
    """The particle smoother over a run.

    Args:
        run: from `sequences.bop.load_run`.
        config: settings; None = the defaults.
        context: False for objects that know nothing of each other.
        progress: who is told how far it is.

    Returns:
        The estimate p(o_t | z_1:T) at every keyframe.
    """
    config, told = config or Config(), progress or SILENT
    state = forward(run, config, context=context, progress=told, keep_past=True)
    return traced_back(run, state, told)


@dataclass(frozen=True)
class Traced:
    """What trajectories of one class say of the stages of a past."""

    particles: Mapping[int, Particles]
    """stage -> weighted poses given the whole run; stages at which the class slept have none"""
    elsewhere: Mapping[int, float]
    """stage -> share of the trajectories that did not come to it from where they were by the prediction"""

    def at(self, stage: int) -> Particles:
        """Those of a stage, or of the last one before that has some, or of the first one."""
        known = sorted(self.particles)
        before = [j for j in known if j <= stage]
        return self.particles[before[-1] if before else known[0]]


@dataclass(frozen=True)
class _Line:
    """Where n trajectories of one class are."""

    T_world_centre: Array
    """(n, 4, 4)"""
    log_elsewhere: Array
    """(n,) log density of having come there from elsewhere; -inf where that can't be"""
    carried: NDArray[np.bool_]
    """(n,) which have no past among the particles"""

    def joined(self, particles: Particles, kept: Kept, picks: NDArray[np.int64]) -> _Line:
        """With some that begin at a set of particles."""
        return _Line(
            np.concatenate([self.T_world_centre, particles.T_world_centre[picks]]),
            np.append(self.log_elsewhere, kept.log_elsewhere[picks]),
            np.append(self.carried, np.zeros(len(picks), dtype=np.bool_)),
        )


@dataclass(frozen=True)
class _Link:
    """How the particles of a stage came from those of one before."""

    spread: Spread | None
    """None: not at all"""
    log_joined: float | None
    """those before are of another belief: what doesn't come from them by the prediction doesn't come from them, and
    comes with this log density from anywhere nearby; None: they are of the same one"""
    walked: Array
    """(6,) standard deviations of the prediction alone, without localisation's error"""


class Tracer:
    """Draws trajectories back through what was kept."""

    def __init__(self, model: Model, localisation: LocalisationNoise) -> None:
        self.model = model
        self.localisation = localisation

    def trace(
        self, object_id: int, stages: Sequence[Stage], c: int, last: Array, final: Particles | None = None
    ) -> Traced | None:
        """Trajectories of one class through all stages.

        Args:
            object_id: for the random numbers.
            stages: n in order of time.
            c: index of the class.
            last: (n,) weight of having been there for the last time at each.
            final: the last particles that are kept of it, weighted with all that is known; None = as they are kept.

        Returns:
            None where no stage at which it may have been has particles of the class.
        """
        sets = [(j, stage.classes[c]) for j, stage in enumerate(stages) if c in stage.classes]
        begin = self._beginning([j for j, _ in sets], last, self._rng(object_id, c, stages[-1]).random())
        particles: dict[int, Particles] = {}
        elsewhere: dict[int, float] = {}
        line = _Line(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0, dtype=np.bool_))
        for m, (j, kept) in reversed(list(enumerate(sets))):
            rng, seen = self._rng(object_id, c, stages[j]), []
            if len(line.carried):
                later, after = sets[m + 1]
                link = self._link(stages[j], stages[later], after, c)
                line, smoothed, elsewhere[later] = step_back(line, kept, link, self.model.shapes[c], rng)
                seen.append((smoothed, len(line.carried)))
            if begin[m]:
                own = kept.particles() if final is None or m + 1 < len(sets) else final
                seen.append((own, int(begin[m])))
                line = line.joined(own, kept, systematic(own.log_weight, int(begin[m]), rng.random()))
            if seen:
                particles[j] = _mixed(seen)
        return Traced(particles, elsewhere) if particles else None

    def _beginning(self, sets: Sequence[int], last: Array, uniform: float) -> NDArray[np.int64]:
        """How many trajectories begin at each set of particles, which are held until the next one."""
        weight = np.zeros(len(sets))
        held = np.searchsorted(sets, np.arange(len(last)), side="right") - 1
        np.add.at(weight, held[held >= 0], last[held >= 0])
        if weight.sum() <= 0.0:
            return np.zeros(len(sets), dtype=np.int64)
        picks = systematic(_log(weight), self.model.config.filter.trajectories, uniform)
        return np.bincount(picks, minlength=len(sets))

    def _link(self, earlier: Stage, later: Stage, after: Kept, c: int) -> _Link:
        shape, settings = self.model.shapes[c], self.model.config.prediction
        dt = (later.time_ns - earlier.time_ns) * 1e-9
        spread, joined = after.spread, None
        if spread is None and later.joins:
            spread = predicted_spread(self.model, self.localisation, dt, later.away_m)
            joined = float(np.log(settings.jump_probability)) + self.model.log_uniform(shape)
        walked = np.sqrt(np.diag(self.model.prediction_covariance(max(dt, 1e-3))))
        return _Link(spread, joined, walked)

    def _rng(self, object_id: int, c: int, stage: Stage) -> np.random.Generator:
        name = f"ffbsi.{self.model.shapes[c].source.obj_id}"
        return generator(self.model.config.seed, name, object_id, stage.keyframe)


def step_back(
    line: _Line, before: Kept, link: _Link, shape: Shape, rng: np.random.Generator
) -> tuple[_Line, Particles, float]:
    """Trajectories one set of particles earlier; what they say of that set; the share that came from elsewhere."""
    n, earlier = len(line.carried), before.particles()
    share = np.zeros(len(earlier.log_weight))
    uniform, normal = rng.random((n, 2)), rng.normal(size=(n, 6))
    # what has no past is carried by the prediction, which is the same forth and back
    T = retract(line.T_world_centre, link.walked * normal)
    elsewhere, carried, jumped = np.full(n, -np.inf), line.carried.copy(), np.zeros(n)
    on = np.flatnonzero(~line.carried)
    if link.spread is None:
        carried[:] = True
    elif len(on):
        density = transition_log_density(earlier.T_world_centre, line.T_world_centre[on], link.spread, shape)
        joint = earlier.log_weight + density
        stayed = logsumexp(joint, axis=1)
        jump = line.log_elsewhere[on] if link.log_joined is None else np.full(len(on), link.log_joined)
        jumped[on] = np.exp(jump - np.logaddexp(stayed, jump))
        jumps = uniform[on, 0] < jumped[on]
        kernel = np.exp(joint - stayed[:, None])
        share = (1.0 - jumped[on]) @ kernel
        picks = _pick(kernel, uniform[on, 1])
        weight = np.exp(earlier.log_weight)
        if link.log_joined is not None:
            carried[on[jumps]] = True
        else:
            share += jumped[on].sum() * weight
            picks[jumps] = _pick(np.broadcast_to(weight, (int(jumps.sum()), len(weight))), uniform[on[jumps], 1])
        kept = on[~carried[on]]
        T[kept] = earlier.T_world_centre[picks[~carried[on]]]
        elsewhere[kept] = before.log_elsewhere[picks[~carried[on]]]
    seen = Particles(
        np.concatenate([earlier.T_world_centre, T[carried]]), _log(np.append(share, np.ones(int(carried.sum()))))
    )
    return _Line(T, elsewhere, carried), _compressed(seen), float(jumped.mean())


def _pick(weights: Array, uniform: Array) -> NDArray[np.int64]:
    """One column a row of weights (n, M) of any sum, by numbers (n,) in [0, 1)."""
    edges = np.cumsum(weights, axis=1)
    picks = (edges <= uniform[:, None] * edges[:, -1:]).sum(axis=1)
    return np.minimum(picks, weights.shape[1] - 1)


def _log(weights: Array) -> Array:
    with np.errstate(divide="ignore"):
        return np.log(weights / weights.sum())


def _compressed(particles: Particles) -> Particles:
    """Without those that weigh nothing."""
    kept = particles.log_weight > np.log(_NOTHING)
    return Particles(particles.T_world_centre[kept], mixture.normalised(particles.log_weight[kept]))


def _mixed(sets: Sequence[tuple[Particles, int]]) -> Particles:
    """Several sets as one, each with the weight of its trajectories."""
    if len(sets) == 1:
        return sets[0][0]
    weights = [particles.log_weight + np.log(count) for particles, count in sets]
    T = np.concatenate([particles.T_world_centre for particles, _ in sets])
    return _compressed(Particles(T, mixture.normalised(np.concatenate(weights))))


def leaving(stages: Sequence[Stage], until_ns: int | None, model: Model) -> Array:
    """log weight (n, C) of having been there, as each class, up to each stage and taken away before the next.

    Args:
        stages: n of one place, in order of time.
        until_ns: when it is known to be elsewhere; None: the last stage has no next, and nothing left after it.
        model: potentials.
    """
    times = [stage.time_ns for stage in stages] + ([] if until_ns is None else [until_ns])
    out = np.full((len(stages), len(model.shapes)), -np.inf)
    for j, (earlier, later) in enumerate(pairwise(times)):
        out[j] = stages[j].log_evidence + model.log_leave((later - earlier) * 1e-9)
    return out


def last_there(end: Array, left: Array, stages: Sequence[Stage], model: Model) -> Array:
    """P(it was there as class c, for the last time at stage j | the whole run) (n, C).

    What is left to one is that nothing ever was there, clutter, or something of unknown mesh that looks alike, and that
    may have been taken away, too.

    Args:
        end: (C,) P(it is there after the last stage, as class c).
        left: (n, C) from `leaving`.
        stages: n of one place.
        model: potentials.
    """
    clutter = stages[-1].log_clutter + np.log1p(-model.config.detector.unfound)
    told = model.told([stage.witness for stage in stages])
    alike = float(np.log(model.config.detector.lookalike)) - told
    still = log_sum(stages[-1].log_evidence) + alike[-1]
    rivals = [0.0, clutter, still, *(log_sum(left) + alike)]
    share = np.exp(mixture.normalised(np.concatenate([left.ravel(), rivals])))[: left.size]
    last = (1.0 - end.sum()) * share.reshape(left.shape)
    last[-1] += end
    return last


@dataclass(frozen=True)
class _Place:
    """What is said of an object at one place: its stages, and from which keyframe to which it stood there."""

    past: Past
    first: int
    """keyframe"""
    end: int
    """keyframe after the last"""
    last: Array
    """(n, C) P(it was there as class c, for the last time at stage j)"""
    presence: Array
    """(n,) P(it was there at each stage)"""
    class_probability: Array
    """(n, C) given that it was there"""
    traced: Mapping[int, Traced]
    """by class"""

    @property
    def stages(self) -> tuple[Stage, ...]:
        return self.past.stages

    def stage_at(self, keyframe: int) -> int:
        """The last one at or before a keyframe, or the first one."""
        keyframes = [stage.keyframe for stage in self.stages]
        return max(int(np.searchsorted(keyframes, keyframe, side="right")) - 1, 0)


class _Writer:
    """Puts objects into tables."""

    def __init__(self, run: Run, state: Forward, tables: Tables) -> None:
        self.model = state.model
        self.state = state
        self.tables = tables
        self.rows = {i: row for row, i in enumerate(sorted(state.beliefs))}
        self.localisation = run.localisation
        self.frames = [run.frames[int(f)] for f in state.keyframes]
        self.tracer = Tracer(state.model, run.localisation)
        self.sizes: list[list[float | None]] = [[None] * len(self.frames) for _ in range(tables.objects)]
        """effective sample size of what trajectories say of each row at each keyframe, for the class it ends with"""

    def write(self, row: int, object_id: int) -> None:
        """One object at every keyframe from its first on."""
        final = self.state.reports[-1][object_id]
        places = self._places(object_id, final)
        for place in places:
            for k in range(place.first, place.end):
                if place is places[-1] and k >= place.stages[-1].keyframe:
                    # it has seen all that there is to see
                    visible = final.visible if k == len(self.frames) - 1 else self._in_view(final, k)
                    replace(final, visible=visible).write(self.tables, self.rows, object_id, k, self.model)
                else:
                    self._smoothed(place, final, k).write(self.tables, self.rows, object_id, k, self.model)
            self._write_moves(row, place)
            for j, stage in enumerate(place.stages):
                traced = place.traced.get(int(np.argmax(place.class_probability[j])))
                if traced is not None and j in traced.particles:
                    self.sizes[row][stage.keyframe] = number(traced.particles[j].effective)

    def _places(self, object_id: int, final: Reported) -> list[_Place]:
        """Where it stood, in order of time."""
        belief = self.state.beliefs[object_id]
        pasts: list[Past] = []
        past = belief.past
        while past is not None:
            pasts.insert(0, past)
            past = past.before
        places: list[_Place] = []
        for past, later in zip(reversed(pasts), [None, *reversed(pasts)], strict=False):
            places.insert(0, self._place(object_id, past, later, final, places[0] if places else None))
        return places

    def _place(
        self, object_id: int, past: Past, later: Past | None, final: Reported, following: _Place | None
    ) -> _Place:
        """What is said of one place, given what is said of the one after it."""
        until = None if later is None else max(self.frames[later.begin].time_ns, past.stages[-1].time_ns)
        end = final.existence * final.class_probability * (later is None)
        last = last_there(end, leaving(past.stages, until, self.model), past.stages, self.model)
        joint = np.cumsum(last[::-1], axis=0)[::-1]
        there = joint.sum(axis=1)
        probability = joint / np.maximum(there, 1e-300)[:, None]
        probability[there <= 0.0] = final.class_probability
        if following is not None:  # one thing has one class, which the place after knows best
            probability = np.tile(following.class_probability[0], (len(there), 1))
        best = np.argmax(probability, axis=1)
        chosen = sorted({*np.flatnonzero((probability > REPORTED).any(axis=0)).tolist(), *best.tolist()})
        ends = self._ends(object_id, chosen) if later is None else dict.fromkeys(chosen)
        traced = {}
        for c in chosen:
            own = last[:, c] if last[:, c].sum() > 0.0 else last.sum(axis=1)
            one = self.tracer.trace(object_id, past.stages, c, own, ends[c])
            if one is not None:
                traced[c] = one
        return _Place(
            past,
            first=self._visit_begin(past.begin) if past.before is None else past.begin,
            end=len(self.frames) if later is None else later.begin,
            last=last,
            presence=there,
            class_probability=probability,
            traced=traced,
        )

    def _ends(self, object_id: int, chosen: Sequence[int]) -> dict[int, Particles | None]:
        """The last particles of classes, with the context that they have in the end."""
        around = self.state.surroundings(self.state.reports[-1]).without(object_id)
        ends: dict[int, Particles | None] = {}
        for c in chosen:
            own = self.state.beliefs[object_id].classes[c]
            if own is None:
                ends[c] = None
                continue
            nats = around.log_potential(self.model, self.model.shapes[c], own.particles.T_world_centre)
            weight = mixture.normalised(own.particles.log_weight + nats)
            ends[c] = Particles(own.particles.T_world_centre, weight)
        return ends

    def _visit_begin(self, keyframe: int) -> int:
        visit = self.frames[keyframe].visit
        return next(k for k, frame in enumerate(self.frames) if frame.visit == visit)

    def _smoothed(self, place: _Place, final: Reported, k: int) -> Reported:
        """What is said of an object at a keyframe."""
        j = place.stage_at(k)
        stage = place.stages[j]
        early_s = max((stage.time_ns - self.frames[k].time_ns) * 1e-9, 0.0)
        early = self.model.prediction_covariance(early_s) if early_s > 0.0 else np.zeros((6, 6))
        shared = {
            c: early + np.diag(self.model.shared_variance(self.model.shapes[c], self.localisation, stage.away_m))
            for c in place.traced
        }
        probability = place.class_probability[j]
        best = int(np.argmax(probability))
        modes = tuple(
            (c, log_weight, T, covariance + shared[c], free)
            for c, traced in place.traced.items()
            if probability[c] > REPORTED or c == best
            for _, log_weight, T, covariance, free in modes_of(c, traced.at(j), self.model.shapes[c])
        )
        stood = self._stood(probability, self.frames[place.past.begin].time_ns - self.frames[k].time_ns)
        existence = float(np.clip(place.presence[j] * stood, 0.0, 1.0))
        smoothed = replace(
            final, class_probability=probability, existence=existence, modes=modes, ledger=(), visible=True
        )
        return replace(smoothed, visible=self._in_view(smoothed, k))

    def _stood(self, class_probability: Array, before_ns: int) -> float:
        """P(it stood there already so long before it was first detected)."""
        if before_ns * 1e-9 < self.model.config.prediction.significant_period_s:
            return 1.0
        stay = [self.model.stay_probability(s.source, before_ns * 1e-9) for s in self.model.shapes]
        return float(class_probability @ np.array(stay))

    def _in_view(self, reported: Reported, k: int) -> bool:
        T, frame = reported.best_pose, self.frames[k]
        if T is None:
            return False
        return outlook(self.model.shapes[reported.best_class], frame.T_camera_world @ T, frame.camera).share > 0.0

    def _write_moves(self, row: int, place: _Place) -> None:
        """A line for each gap between views that is long enough to hold a move."""
        significant_ns = self.model.config.prediction.significant_period_s * 1e9
        for j, (a, b) in enumerate(pairwise(place.stages)):
            if b.keyframe >= place.end or b.time_ns - a.time_ns < significant_ns:
                continue
            traced = place.traced.get(int(np.argmax(place.class_probability[j + 1])))
            elsewhere = 0.0 if traced is None else traced.elsewhere.get(j + 1, 0.0)
            moved = place.last[j].sum() + place.presence[j + 1] * elsewhere
            probability = float(np.clip(moved / max(place.presence[j], 1e-12), 0.0, 1.0))
            self.tables.move(row, (a.keyframe, b.keyframe), probability, (a.time_ns, b.time_ns))


def traced_back(run: Run, state: Forward, progress: Progress) -> Estimate:
    """The particle smoother from a pass of the filter that has kept its past."""
    objects = sorted(state.beliefs)
    tables = Tables(len(objects), len(state.keyframes), len(state.model.catalogue))
    writer = _Writer(run, state, tables)
    with progress.stage("backward simulation", total=len(objects)) as stage:
        for row, i in enumerate(objects):
            writer.write(row, i)
            stage.advance()
    times = np.array([frame.time_ns for frame in writer.frames])
    for i, between, same in state.found_moved:
        if i in state.beliefs:
            gap = (int(np.searchsorted(times, between[0])), int(np.searchsorted(times, between[1])))
            tables.move(objects.index(i), gap, same, between)
    told = diagnostics(objects, state.reports, state.scored)
    told["objects"]["smoothed_sample_size"] = writer.sizes
    estimate = build_estimate(
        run,
        state.model.config,
        "ffbsi-ct" if state.model.context else "ffbsi-t",
        state.keyframes,
        objects,
        tables,
        np.stack([frame.T_world_camera for frame in writer.frames]),
        np.tile(localisation_covariance(run.localisation), (len(writer.frames), 1, 1)),
        {"diagnostics": told, **describe(state.place)},
    )
    return with_supports(estimate, state.model, [state.place.surfaces] * len(state.keyframes))
