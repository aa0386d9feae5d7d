"""How a keyframe changes one object's belief: the loop body of Algorithm 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.filtering.belief import Absence, Belief, ClassBelief, Glimpse
from ctmap_gtsam.filtering.history import Kept, Past, Stage
from ctmap_gtsam.filtering.memory import Memory
from ctmap_gtsam.filtering.particles import (
    MODE_RADIUS,
    Gaussians,
    Particles,
    Spread,
    Transition,
    clusters,
    filled,
    first_count,
    predict,
    predicted_log_density,
    predicted_spread,
    sufficient,
)
from ctmap_gtsam.frontend.association import Track
from ctmap_gtsam.frontend.landing import landing_log_density
from ctmap_gtsam.frontend.observation import Observation
from ctmap_gtsam.frontend.proposer import PoseModes, Proposer, View
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors import mixture, symmetry
from factors.measurement import box_iou
from factors.mixture import log_sum
from sequences.geometry import Plane
from sequences.seeds import generator
from sequences.types import Detection, LocalisationNoise

Array = NDArray[np.float64]

_INFLATION = 2.0  # of the modes' covariances when proposing: a proposal with lighter tails gives wild weights
_LIKELY = 15.0  # nats behind the best class within which modes are probed with care
_DORMANT = (45.0, 0.25)  # by so much less than the best class, or that share of it, does a class explain that sleeps
_STARTS = 3  # heaviest particles that a likely class's modes are looked for from
_WAKE_EVERY = 15  # keyframes in view between two at which what sleeps is weighed and searched for
_BETTER = 10.0  # nats by which a pose that is found late must explain more than what was believed of its class
_LOCALISED = 3.0  # standard deviations of the localisation by which a pose may seem elsewhere in another view
_IN_SIGHT = 0.8  # least visible share of what has jumped and isn't detected


@dataclass(frozen=True)
class _Effort:
    """What one class of one object is worth at a keyframe."""

    particles: int
    likely: bool
    """near enough to the best class to be looked at closely"""
    search: float
    """effort of a fresh search, as a share of the first one's; 0 = none"""
    standard: _Standard | None
    """what the poses that a search finds are held to, beside what is believed"""


@dataclass(frozen=True)
class _Change:
    """What may have happened to one class of one object since its place was last in view."""

    spread: Spread
    log_moved: float
    """log of P(moved) / P(stayed); -inf where the time was too short, or it can't be moved"""
    supports: tuple[Plane, ...]
    """level surfaces, world frame, that it may have been moved onto"""


@dataclass(frozen=True)
class _Standard:
    """What the most probable class says of the views so far: what poses found late are held to."""

    log_evidence: float
    """depth and boxes"""
    remembered: float
    """log-likelihood of the views that are kept"""


class Updater:
    """Starts and steps beliefs; `keep_past` lets them keep what a backward pass needs."""

    def __init__(
        self, model: Model, proposer: Proposer, localisation: LocalisationNoise, *, keep_past: bool = False
    ) -> None:
        self.model = model
        self.proposer = proposer
        self.localisation = localisation
        self.keep_past = keep_past

    def search(self, track: Track, shape: Shape, observation: Observation, around: Surroundings) -> PoseModes:
        """A full search for a track that has just become consistent: what was found of one class."""
        view = self._first_view(track, observation, around)
        rng = self._rng("filter.search", track.track_id, observation, shape)
        starts = self.proposer.search(shape, view, observation, around, rng)
        return self.proposer.modes(shape, view, starts, probe=False)

    def start(
        self, track: Track, observation: Observation, around: Surroundings, found: tuple[PoseModes, ...]
    ) -> Belief:
        """The belief of a track that has just become consistent, from what `search` found of each class."""
        view = self._first_view(track, observation, around)
        n = len(self.model.shapes)
        score_sum = np.sum([self.model.class_scores(d) for d in track.detections], axis=0)
        best = np.array([m.log_likelihood.max(initial=-np.inf) for m in found]) + self.model.class_evidence(score_sum)
        counts, classes = self._counts(best), []
        for shape, modes in zip(self.model.shapes, found, strict=True):
            rng = self._rng("filter.start", track.track_id, observation, shape)
            likely = best[shape.index] > best.max() - 2.0 * _LIKELY
            modes = self.proposer.modes(shape, view, modes.T_camera_centre, probe=likely)
            classes.append(
                self._weigh(
                    None, self._in_world(modes, observation), shape, view, observation, int(counts[shape.index]), rng
                )
            )
        fresh = Belief(
            object_id=track.track_id,
            classes=tuple(classes),
            score_sum=score_sum,
            score_evidence=np.zeros(n),
            log_clutter=0.0,
            witness=0.0,
            witness_before=0.0,
            log_elsewhere=-np.inf,
            visit=observation.frame.visit,
            first_ns=observation.frame.time_ns,
            present_ns=observation.frame.time_ns,
            time_ns=observation.frame.time_ns,
            viewpoint=np.zeros(3),
            visible=True,
            steps=1,
            glimpse=Glimpse(view, observation.frame.T_camera_world, None),
        )
        memory = Memory().joined(view, observation.frame.T_camera_world)
        fresh = replace(fresh, viewpoint=self._viewpoint(fresh, observation), memory=memory)
        fresh = self._rivalled(fresh, view, observation)
        return self._kept(fresh, None, Past(track.keyframes[0]), observation)

    def _first_view(self, track: Track, observation: Observation, around: Surroundings) -> View:
        detection = track.at(observation.keyframe)
        assert detection is not None
        return self.proposer.view(observation, np.array(detection.box), detection, around)

    def step(
        self, belief: Belief, detection: Detection | None, observation: Observation, around: Surroundings
    ) -> Belief:
        """Algorithm 1 for one object and keyframe."""
        belief = self._enter_visit(belief, observation)
        box = self._where(belief, detection, observation)
        if box is None:
            return replace(belief, visible=False)
        belief = self._allow_move(belief, observation)
        viewpoint = self._viewpoint(belief, observation)
        waited = (observation.frame.time_ns - belief.time_ns) * 1e-9
        share = self.model.view_share(belief.viewpoint, viewpoint, waited)
        view = self.proposer.view(observation, box, detection, around, share)
        search = self.searches(belief, detection)
        classes = self._step_classes(belief, view, observation, around, search)
        scores = belief.score_sum if detection is None else belief.score_sum + self.model.class_scores(detection)
        moved = replace(
            belief,
            classes=classes,
            absence=_still_known(belief.absence, classes),
            score_sum=scores,
            present_ns=belief.present_ns if detection is None else observation.frame.time_ns,
            time_ns=observation.frame.time_ns,
            viewpoint=viewpoint,
            visible=True,
            steps=belief.steps + 1,
            searched=belief.steps if search else belief.searched,
            memory=belief.memory.joined(view, observation.frame.T_camera_world),
            glimpse=Glimpse(view, observation.frame.T_camera_world, waited),
        )
        moved = self._rivalled(moved, view, observation)
        return self._kept(moved, belief, belief.past, observation)

    def _kept(self, belief: Belief, before: Belief | None, past: Past | None, observation: Observation) -> Belief:
        """The belief with what is to be kept of this keyframe: the classes that were weighed."""
        if not self.keep_past or past is None:
            return belief
        old = (None,) * len(belief.classes) if before is None else before.classes
        weighed = {
            c: Kept.of(own.particles, own.transition)
            for c, (own, was) in enumerate(zip(belief.classes, old, strict=True))
            if own is not None and (was is None or own.particles is not was.particles)
        }
        stage = Stage(
            keyframe=observation.keyframe,
            time_ns=observation.frame.time_ns,
            away_m=float(np.linalg.norm(belief.viewpoint)),
            classes=weighed,
            log_evidence=belief.class_log_evidence(self.model),
            log_clutter=belief.log_clutter,
            witness=belief.witnessed(self.model),
        )
        return replace(belief, past=past.joined(stage))

    def _enter_visit(self, belief: Belief, observation: Observation) -> Belief:
        """A new visit: the detector's persistent belief of the last one has said what it had to say, and its misses."""
        if observation.frame.visit == belief.visit:
            return belief
        return replace(
            belief,
            visit=observation.frame.visit,
            score_evidence=belief.called(self.model),
            score_sum=np.zeros_like(belief.score_sum),
            witness_before=belief.witnessed(self.model),
            witness=0.0,
        )

    def _where(self, belief: Belief, detection: Detection | None, observation: Observation) -> Array | None:
        """The box to look in: the detection's, or where the most probable class would appear; None out of view."""
        return self._outline(belief, observation) if detection is None else np.array(detection.box)

    def sees(self, belief: Belief, detection: Detection | None, observation: Observation) -> bool:
        """Whether an object is in view at a keyframe, so that a step has something to do."""
        return detection is not None or self._outline(belief, observation) is not None

    def searches(self, belief: Belief, detection: Detection | None) -> bool:
        """Whether a fresh search is due: after as many views again as there were until the last, and never too soon.

        What was not found in twenty views is seldom found in the next five. Ages are counted from the end of the last
        absence, when a thing may stand anyhow again.
        """
        again = max(self.model.config.filter.search_every, belief.searched - belief.returned)
        return detection is not None and belief.steps - belief.searched >= again

    def covers(self, belief: Belief, detection: Detection, observation: Observation) -> bool:
        """Whether a box overlaps at all with where the object would appear."""
        outline = self._outline(belief, observation)
        return outline is not None and float(box_iou(outline, np.array(detection.box))) > 0.0

    def _outline(self, belief: Belief, observation: Observation) -> Array | None:
        """The box (x, y, w, h) of the most probable class at its heaviest pose; None out of view."""
        best = int(np.argmax(belief.class_log_evidence(self.model)))
        own = belief.classes[best]
        if own is None:
            return None
        T = observation.frame.T_camera_world @ own.particles.heaviest
        seen = outlook(self.model.shapes[best], T, observation.frame.camera)
        return seen.box if seen.share > 0.0 and (seen.box[2:] >= 2.0).all() else None

    def _viewpoint(self, belief: Belief, observation: Observation) -> Array:
        """From the object to the camera, (3,) metres, world frame."""
        own = belief.classes[int(np.argmax(belief.class_log_evidence(self.model)))]
        camera = observation.frame.T_world_camera[:3, 3]
        return camera if own is None else camera - own.particles.heaviest[:3, 3]

    def _allow_move(self, belief: Belief, observation: Observation) -> Belief:
        """It stayed, or was taken away: after a significant absence with 1 - S(dt) (Equation 3), in view now and then.

        What was taken away is where nobody has looked, or else, after an absence, a pose of this view, see `_weigh`.
        """
        gap = (observation.frame.time_ns - belief.time_ns) * 1e-9
        log_leave = self.model.log_leave(gap)
        log_stay = np.log1p(-np.exp(log_leave))
        left = float(log_sum(belief.class_log_evidence(self.model) + log_leave))
        classes = tuple(
            None if own is None else replace(own, log_evidence=own.log_evidence + float(log_stay[c]))
            for c, own in enumerate(belief.classes)
        )
        taken = replace(belief, classes=classes, log_elsewhere=float(np.logaddexp(belief.log_elsewhere, left)))
        if gap < self.model.config.prediction.significant_period_s:
            return taken
        poses = tuple(None if own is None else own.particles for own in belief.classes)
        absence = Absence(poses, log_leave - log_stay, belief.time_ns, observation.frame.time_ns)
        return replace(taken, absence=absence, returned=belief.steps)

    def _moved_odds(self, belief: Belief, shape: Shape, observation: Observation) -> float:
        """log of P(moved) / P(stayed) of a class, in the keyframe that ends an absence; else -inf."""
        gap = belief.absence
        returned = gap is not None and gap.end_ns == observation.frame.time_ns
        return float(gap.log_odds[shape.index]) if gap is not None and returned else -np.inf

    def _counts(self, log_evidence: Array) -> NDArray[np.int64]:
        """Particles a class, by its probability, none fewer than the least."""
        settings = self.model.config.filter
        share = np.exp(mixture.normalised(log_evidence))
        return np.maximum(np.round(settings.particles * share), settings.min_particles).astype(np.int64)

    def _step_classes(
        self, belief: Belief, view: View, observation: Observation, around: Surroundings, search: bool
    ) -> tuple[ClassBelief | None, ...]:
        """Every class; those far behind the best only now and then: in between they keep their distance to it."""
        evidence = belief.class_log_evidence(self.model)
        counts, best = self._counts(evidence), int(np.argmax(evidence))
        behind = evidence - evidence[best]
        depth, explained = belief.classes[best], belief.explained
        least, share = _DORMANT
        bound = max(least, share * (0.0 if depth is None else depth.log_evidence))
        # what wakes is searched for: it may be behind because nobody found it
        waking = search and belief.steps // _WAKE_EVERY > belief.searched // _WAKE_EVERY
        awake = (explained - explained[best] > -bound) | waking
        efforts = np.full(len(evidence), self.model.config.filter.search_share if search else 0.0)
        named = self._named(belief)
        lost = depth is None or depth.log_evidence < belief.log_clutter
        if view.detection is not None and (named != best or lost):
            awake[named], efforts[named] = True, 1.0
        standard = self._standard(belief, best) if efforts.any() else None
        stepped = {}
        for c in np.flatnonzero(awake):
            effort = _Effort(int(counts[c]), bool(behind[c] > -_LIKELY), float(efforts[c]), standard)
            stepped[int(c)] = self._step_class(belief, self.model.shapes[c], view, observation, around, effort)
        after = stepped[best]
        gained = after.log_evidence - depth.log_evidence if depth is not None and after is not None else 0.0
        asleep = (
            None if own is None else replace(own, log_evidence=own.log_evidence + gained) for own in belief.classes
        )
        return tuple(stepped[c] if awake[c] else own for c, own in enumerate(asleep))

    def _named(self, belief: Belief) -> int:
        """The class that the detector has named so far.

        Where depth says another, or nothing that clutter wouldn't, its pose may not have been found.
        """
        return int(np.argmax(belief.called(self.model)))

    def _standard(self, belief: Belief, best: int) -> _Standard | None:
        own = belief.classes[best]
        if own is None:
            return None
        return _Standard(own.log_evidence, self._remembered(belief, self.model.shapes[best], own.particles.heaviest))

    def _remembered(self, belief: Belief, shape: Shape, T_world_centre: Array) -> float:
        away = float(np.linalg.norm(belief.viewpoint))
        noise = self.localisation
        reach = np.array([noise.rotation_rad, noise.translation_m + away * noise.rotation_rad])
        rates = self.model.config.prediction
        walked = np.array([rates.rotation_rate, rates.translation_rate])
        return belief.memory.log_likelihood(self.proposer, shape, T_world_centre, _LOCALISED * (reach + walked))

    def _step_class(
        self,
        belief: Belief,
        shape: Shape,
        view: View,
        observation: Observation,
        around: Surroundings,
        effort: _Effort,
    ) -> ClassBelief | None:
        own = belief.classes[shape.index]
        if not effort.likely:
            view = view.coarse()
        rng = self._rng("filter.step", belief.object_id, observation, shape)
        starts = np.zeros((0, 4, 4))
        if own is not None:
            starts = observation.frame.T_camera_world @ own.particles.best(_STARTS if effort.likely else 1)
        if effort.search > 0.0:
            found = self.proposer.search(shape, view, observation, around, rng, effort.search)
            starts = np.concatenate([starts, found])
        modes = self.proposer.modes(shape, view, starts, probe=effort.likely)
        proposals = self._in_world(modes, observation)
        if effort.search > 0.0 and effort.standard is not None and proposals is not None:
            own = self._reconsider(belief, shape, own, proposals, effort.standard, rng)
        change = _Change(
            self._spread(observation, belief.time_ns, starts),
            self._moved_odds(belief, shape, observation),
            around.supports,
        )
        stepped = self._weigh(own, proposals, shape, view, observation, effort.particles, rng, change)
        if stepped is None or own is belief.classes[shape.index]:
            return stepped
        return replace(stepped, transition=None)  # a pose found late has no past among the particles

    def _reconsider(
        self,
        belief: Belief,
        shape: Shape,
        own: ClassBelief | None,
        found: Gaussians,
        standard: _Standard,
        rng: np.random.Generator,
    ) -> ClassBelief | None:
        """What is believed of a class, or what should have been if the views kept are better explained by a new pose.

        Args:
            belief: of the object.
            shape: the class.
            own: what was believed of the class.
            found: modes of this view, the best first.
            standard: what the most probable class says of the views that are kept.
            rng: draws particles around the new pose.
        """
        T = found.T_world_centre[0]
        if own is not None and symmetry.near(own.particles.heaviest, T, shape.symmetry, *MODE_RADIUS):
            return own
        mode = Gaussians(found.T_world_centre[:1], found.covariance[:1], np.zeros(1))
        remembered = self._remembered(belief, shape, T)
        # the views that are kept stand for all roughly, in which both err alike; unless the standard itself has moved
        beside = standard.log_evidence + remembered - standard.remembered
        alone = remembered + self.model.log_uniform(shape) - float(mode.log_density(T[None], shape)[0])
        late = min(beside, alone)
        if own is not None and late < own.log_evidence + _BETTER:
            return own
        n = self.model.config.filter.min_particles
        return ClassBelief(Particles(mode.draw(n, shape, rng), np.full(n, -np.log(n))), late)

    def _spread(self, observation: Observation, before_ns: int, starts: Array) -> Spread:
        """Sigma = Q dt, and the localisation's own error, which moves everything that the camera sees."""
        dt = (observation.frame.time_ns - before_ns) * 1e-9
        away = float(np.median(starts[:, 2, 3])) if len(starts) else 1.0
        return predicted_spread(self.model, self.localisation, dt, away)

    def _weigh(
        self,
        own: ClassBelief | None,
        proposals: Gaussians | None,
        shape: Shape,
        view: View,
        observation: Observation,
        count: int,
        rng: np.random.Generator,
        change: _Change | None = None,
    ) -> ClassBelief | None:
        """Draw from prediction and proposals, weigh by the model (see `particles`)."""
        log_uniform = self.model.log_uniform(shape)
        if proposals is None and own is None:
            return None
        settings = self.model.config.filter
        share = 1.0 if own is None else settings.proposal_share if proposals is not None else 0.0
        drawn = []
        prior = None if own is None else own.particles
        # what is hardly possible isn't worth it
        if own is not None and change is not None and count > settings.min_particles:
            modes = tuple(clusters(own.particles, shape))
            prior = filled(own.particles, change.spread, shape, rng, modes)
            # what may have been moved may be anywhere
            if not np.isfinite(change.log_moved):
                count = sufficient(prior, count, shape, modes if prior is own.particles else None)
        elif proposals is not None and own is None and count > settings.min_particles:
            count = first_count(proposals, count, shape)
        n_proposed = round(share * count)
        if prior is not None and change is not None:
            drawn.append(predict(prior, count - n_proposed, change.spread, shape, rng))
        if proposals is not None:
            drawn.append(proposals.draw(n_proposed, shape, rng))
        T = np.concatenate(drawn)
        score, scores = self.proposer.score(shape, view, observation.frame.T_camera_world @ T)
        log_prior = log_drawn = np.full(len(T), log_uniform)
        transition = None
        if own is not None and prior is not None and change is not None:
            # if what can't be moved seems to be elsewhere it was never found, which a search can mend
            jump = self.model.jump_probability(shape.source)
            stayed = np.log1p(-jump) + predicted_log_density(prior, T, change.spread, shape)
            elsewhere = np.full(len(T), np.log(jump) + log_uniform if jump > 0.0 else -np.inf)
            if np.isfinite(change.log_moved):
                landed = landing_log_density(self.model, shape, T, change.supports)
                elsewhere = np.logaddexp(elsewhere, change.log_moved + landed)
            log_drawn = np.logaddexp(stayed, elsewhere)
            # what jumps nearby is seen there: to have got out of sight is to have been moved elsewhere, and where it
            # is seen through it isn't
            in_sight = (scores.visible > _IN_SIGHT * scores.covered) & (scores.log_ratio > 0.0)
            seen = (view.detection is not None) | in_sight
            log_prior = np.where(seen, log_drawn, stayed)
            transition = Transition(change.spread, np.where(seen, elsewhere, -np.inf))
            # the prediction's tails end somewhere, or thousands of nats of depth buy any distance
            log_prior = np.where(self._nearby(own.particles, T), log_prior, -np.inf)
        log_q = log_drawn
        if proposals is not None:
            # the prior is part of the mixture, so no weight exceeds the likelihood by more than 1 / (1 - share)
            proposed = np.log(share) + proposals.log_density(T, shape)
            log_q = proposed if own is None else np.logaddexp(np.log1p(-share) + log_drawn, proposed)
        log_weight = log_prior + score - log_q
        gained = float(log_sum(log_weight)) - np.log(len(T))
        before = 0.0 if own is None else own.log_evidence
        return ClassBelief(Particles(T, mixture.normalised(log_weight)), before + gained, transition)

    def _nearby(self, particles: Particles, T_world_centre: Array) -> NDArray[np.bool_]:
        """Which poses (K, 4, 4) a push can bring about; a box farther away is another thing's."""
        away = np.linalg.norm(T_world_centre[:, :3, 3] - particles.heaviest[:3, 3], axis=-1)
        return np.asarray(away < self.model.config.prediction.region_radius_m)

    def _in_world(self, modes: PoseModes, observation: Observation) -> Gaussians | None:
        """The modes as proposals in the world frame; None where there are none."""
        if not len(modes):
            return None
        # half of the proposals' weight goes by likelihood, half is spread evenly: the likelihood may be wrong
        by_score = np.exp(mixture.normalised(modes.log_likelihood))
        weight = np.log(0.5 * by_score + 0.5 / len(modes))
        poses = observation.frame.T_world_camera @ modes.T_camera_centre
        return Gaussians(poses, _INFLATION * modes.covariance, weight)

    def _rivalled(self, belief: Belief, view: View, observation: Observation) -> Belief:
        """With what this keyframe says for things of unknown mesh, where the best hypothesis stands."""
        best = int(np.argmax(belief.class_log_evidence(self.model)))
        own = belief.classes[best]
        if own is None:
            return belief
        shape, T = self.model.shapes[best], observation.frame.T_camera_world @ own.particles.heaviest
        return replace(
            belief,
            log_clutter=belief.log_clutter + self.proposer.log_clutter(shape, view, T, first=belief.steps == 1),
            witness=belief.witness + self.proposer.witness(shape, view, T),
        )

    def _rng(self, stage: str, object_id: int, observation: Observation, shape: Shape) -> np.random.Generator:
        return generator(self.model.config.seed, f"{stage}.{shape.source.obj_id}", object_id, observation.frame.index)


def _still_known(absence: Absence | None, classes: Sequence[ClassBelief | None]) -> Absence | None:
    """An absence without classes whose pose before it has been given up: the one found late was theirs then, too."""
    if absence is None:
        return None
    known = tuple(
        None if own is None or own.transition is None else before
        for before, own in zip(absence.classes, classes, strict=True)
    )
    return replace(absence, classes=known)
