"""What is said of an object at a keyframe: its belief with the context, and what each potential says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import Tables
from ctmap_gtsam.filtering.belief import Belief
from ctmap_gtsam.filtering.particles import (
    Particles,
    modes_of,
    predicted_log_density,
    predicted_spread,
)
from ctmap_gtsam.frontend.landing import landing_log_density
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors import mixture, prediction
from factors.mixture import log_sum
from sequences.types import LocalisationNoise

Array = NDArray[np.float64]

REPORTED = 0.01
"""classes less probable than this are not reported with poses"""

_BEHIND = 45.0  # nats behind the best class from which on a class's context isn't looked at
_ASKED = 8  # particles of which it is asked whether they came by a move


@dataclass(frozen=True)
class Line:
    """A line of the ledger."""

    potential: str
    nats: float
    other: int | None = None
    """the neighbour"""


@dataclass(frozen=True)
class Reported:
    """What is said of an object at a keyframe."""

    class_probability: Array
    """(C,)"""
    log_evidence: float
    """of all classes together, nats"""
    existence: float
    elsewhere: float
    """P(it was moved to where nobody looked | it exists)"""
    visible: bool
    modes: tuple[tuple[int, float, Array, Array, Array], ...]
    """class index, log weight, T_world_centre (4, 4), covariance (6, 6), free axes (6, f)"""
    ledger: tuple[Line, ...] = ()
    """of a keyframe that had its place in view"""
    effective: float = 0.0
    """effective sample size of the most probable class"""
    moved: float = 0.0
    """P(it was moved in the last absence, to where it is now | it is there)"""
    returned_ns: int | None = None
    """when that absence ended; None where there was none"""

    @property
    def best_class(self) -> int:
        """Index of the most probable class."""
        return int(np.argmax(self.class_probability))

    @property
    def best_pose(self) -> Array | None:
        """T_world_centre (4, 4) of the heaviest mode of the most probable class."""
        own = [m for m in self.modes if m[0] == self.best_class]
        return max(own, key=lambda m: m[1])[2] if own else None

    def write(self, tables: Tables, rows: Mapping[int, int], i: int, keyframe: int, model: Model) -> None:
        """Into an estimate's tables, poses in the mesh frame.

        Args:
            tables: written to.
            rows: object -> its row.
            i: the object.
            keyframe: row of it.
            model: knows the meshes.
        """
        row = rows[i]
        tables.class_probability[row, keyframe] = self.class_probability
        tables.existence[row, keyframe] = self.existence
        tables.in_view[row, keyframe] = self.visible
        for c, log_weight, T, covariance, free in self.modes:
            shape = model.shapes[c]
            tables.mode(
                row,
                keyframe,
                shape.source.obj_id,
                log_weight,
                shape.to_object(T),
                shape.covariance_to_object(covariance),
                shape.free_axes_to_object(free),
            )
        for line in self.ledger:
            # a neighbour may have turned out to be an object known before
            other = -1 if line.other is None else rows.get(line.other, -1)
            tables.note(row, keyframe, line.potential, line.nats, other)


class Reporter:
    """Says what beliefs say."""

    def __init__(self, model: Model, proposer: Proposer, localisation: LocalisationNoise) -> None:
        self.model = model
        self.proposer = proposer
        self.localisation = localisation

    def report(self, belief: Belief, around: Surroundings, before: Reported | None = None) -> Reported:
        """The posterior, the context multiplied in once.

        Args:
            belief: of the object.
            around: what stands there.
            before: what was said of it at the keyframe before, for the ledger.
        """
        log_evidence = belief.class_log_evidence(self.model)
        weighted: list[Particles | None] = []
        context = np.zeros(len(self.model.shapes))
        for c, own in enumerate(belief.classes):
            if own is None or log_evidence[c] < log_evidence.max() - _BEHIND:
                weighted.append(None if own is None else own.particles)
                context[c] = -np.inf  # too far behind to be looked at: its context can't make it the best
                continue
            nats = around.log_potential(self.model, self.model.shapes[c], own.particles.T_world_centre)
            joint = own.particles.log_weight + nats
            context[c] = float(log_sum(joint))
            weighted.append(Particles(own.particles.T_world_centre, mixture.normalised(joint)))
        # a solid thing can't be where another or a surface is: context decides on existence, too
        there = float(log_sum(log_evidence + context))
        scores = belief.called(self.model)
        posed = np.where([own is not None for own in belief.classes], scores, -np.inf)
        rivals = (belief.log_clutter, belief.witnessed(self.model), 0.0, belief.log_elsewhere)
        existence, probability = self.model.existence(log_evidence + context, posed, *rivals)
        # particles are what views of this camera agree on; that the camera itself is elsewhere they can't know
        away_m = float(np.linalg.norm(belief.viewpoint))
        modes: list[tuple[int, float, Array, Array, Array]] = []
        for c, particles in enumerate(weighted):
            if particles is not None and (probability[c] > REPORTED or c == int(np.argmax(probability))):
                found = modes_of(c, particles, self.model.shapes[c])
                shared = np.diag(self.model.shared_variance(self.model.shapes[c], self.localisation, away_m))
                modes += [(c, log_weight, T, covariance + shared, free) for _, log_weight, T, covariance, free in found]
        chosen = belief.classes[int(np.argmax(probability))]
        elsewhere = float(np.exp(belief.log_elsewhere - np.logaddexp(there, belief.log_elsewhere)))
        effective = 0.0 if chosen is None else chosen.particles.effective
        best = int(np.argmax(probability))
        moved = 0.0 if chosen is None else self._moved(belief, self.model.shapes[best], chosen.particles, around)
        said = Reported(
            probability,
            there,
            existence,
            elsewhere,
            belief.visible,
            tuple(modes),
            effective=effective,
            moved=moved,
            returned_ns=None if belief.absence is None else belief.absence.end_ns,
        )
        return replace(said, ledger=self._ledger(belief, said, before, around, scores, context))

    def _ledger(
        self,
        belief: Belief,
        said: Reported,
        before: Reported | None,
        around: Surroundings,
        scores: Array,
        context: Array,
    ) -> tuple[Line, ...]:
        """What each potential says of an object at the reported pose and class.

        Args:
            belief: of the object.
            said: of it now.
            before: of it at the keyframe before.
            around: what stands there.
            scores: (C,) the score vectors' evidence.
            context: (C,) what context says of each class's particles together.
        """
        best, T = said.best_class, said.best_pose
        own, shape = belief.classes[best], self.model.shapes[best]
        lines = [
            Line("class", float(scores[best])),
            Line("clutter", -belief.log_clutter),
            Line("witness", belief.witnessed(self.model)),
        ]
        if own is None or T is None:
            return tuple(lines)
        glimpse = belief.glimpse
        depth, detection = self.proposer.told(shape, glimpse.view, glimpse.T_camera_world @ T)
        lines += [Line("depth", depth), Line("detection", detection), Line("evidence", own.log_evidence)]
        lines += [Line("context", nats, j) for j, nats in around.relations(self.model, shape, T).items()]
        lines.append(Line("surroundings", float(context[best])))
        if glimpse.waited_s is not None:
            lines.append(Line("persistence", self.model.log_transitions(shape.source, glimpse.waited_s)[0]))
            if before is not None and before.best_class == best and before.best_pose is not None:
                away = float(np.linalg.norm(belief.viewpoint))
                spread = predicted_spread(self.model, self.localisation, glimpse.waited_s, away)
                sigma = np.diag(np.repeat([spread.rotation_rad, spread.translation_m], 3) ** 2)
                nats = prediction.exponent(before.best_pose, T, sigma, shape.symmetry)
                lines.append(Line("prediction", float(nats)))
        return tuple(lines)

    def _moved(self, belief: Belief, shape: Shape, particles: Particles, around: Surroundings) -> float:
        """P(particles came to where they are by a move in the last absence), against having stayed."""
        gap = belief.absence
        before = None if gap is None else gap.classes[shape.index]
        if gap is None or before is None or not np.isfinite(gap.log_odds[shape.index]):
            return 0.0
        T = particles.resampled(_ASKED, 0.5)
        away = float(np.linalg.norm(belief.viewpoint))
        spread = predicted_spread(self.model, self.localisation, (belief.time_ns - gap.begin_ns) * 1e-9, away)
        stayed = predicted_log_density(before, T, spread, shape)
        landed = gap.log_odds[shape.index] + landing_log_density(self.model, shape, T, around.supports)
        return float(np.exp(landed - np.logaddexp(stayed, landed)).mean())
