"""The potentials bound to settings and catalogue: the one object that filter, graph and ledger hold."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr

from ctmap_gtsam.config import Config
from ctmap_gtsam.frontend.scoring import Scores
from ctmap_gtsam.shapes import Shape, build_shapes
from factors import mixture, prediction
from factors.context import PairMixture, relation_table
from factors.measurement import (
    DepthModel,
    box_log_ratio,
    class_log_ratio,
    confusion,
    detected_log_potential,
    persistent_class_log_evidence,
)
from factors.persistence import stay_probability
from sequences.catalogue import Catalogue, ObjectClass
from sequences.types import Detection, LocalisationNoise

Array = NDArray[np.float64]

_EDGES = 4.0  # of a box
_TRUE_NATS = 1e-9  # that the mesh of a thing may be wrong by that explains nothing


def localisation_variance(noise: LocalisationNoise, away_m: float) -> tuple[float, float]:
    """By how much localisation turns (rad^2) and moves (m^2) what a camera sees at a distance; its turn moves, too."""
    return noise.rotation_rad**2, noise.translation_m**2 + (away_m * noise.rotation_rad) ** 2


class Model:
    """What every number means, for one catalogue and one configuration."""

    def __init__(self, catalogue: Catalogue, config: Config, *, context: bool = True) -> None:
        self.catalogue = catalogue
        self.config = config
        self.context = context
        self.kappa = config.sensor.kappa

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """One a class, in the catalogue's order."""
        return build_shapes(self.catalogue, self.config.frontend.mesh_faces)

    @cached_property
    def relations(self) -> PairMixture:
        """Category-level relations of all pairs of classes."""
        classes = self.catalogue.classes
        names, categories = [c.name for c in classes], [c.category for c in classes]
        return relation_table(names, categories, self.config.context.relations)

    @cached_property
    def depth_parameters(self) -> tuple[float, ...]:
        """What the fused kernel takes."""
        s = self.config.sensor
        depth = DepthModel(
            s.sigma_m, s.sigma_quadratic_per_m, s.outlier_weight, s.range_m, s.occluder_weight, s.background_sigma_m
        )
        return depth.parameters()

    @cached_property
    def log_confusion(self) -> Array:
        """(C, C) log pi(d | c): the detector persistently believes class d (column) where the true class is c (row)."""
        return confusion(len(self.catalogue), 1.0 - self.config.detector.confusion)

    def prediction_covariance(self, dt_s: float) -> Array:
        """Sigma = Q dt (6, 6) in the centre frame's tangent, of `prediction_variances`."""
        return prediction.covariance(*self.prediction_variances(dt_s), 1.0)

    def prediction_variances(self, dt_s: float) -> tuple[float, float]:
        """By how much a thing turns (rad^2) and moves (m^2) along each axis: Q dt.

        What stays doesn't wander on while nobody looks: dt counts up to the significant period.
        """
        p = self.config.prediction
        dt_s = min(dt_s, p.significant_period_s)
        return dt_s * p.rotation_rate**2, dt_s * p.translation_rate**2

    def stay_probability(self, known: ObjectClass, away_s: float) -> float:
        """Equation 3 for a thing of a class that nobody saw for so many seconds; what can't be moved stays."""
        r1 = self.config.prediction.stay_limit
        return float(stay_probability(away_s, known.persistence_s, r1, 1.0 - r1)) if known.movable else 1.0

    def jump_probability(self, known: ObjectClass) -> float:
        """The chance of a push from one keyframe to the next; nobody pushes a cupboard."""
        return self.config.prediction.jump_probability if known.movable else 0.0

    def log_leave(self, dt_s: float) -> Array:
        """(C,) log probability of being taken away between two keyframes: Equation 3 in absences, else as a push."""
        if dt_s < self.config.prediction.significant_period_s:
            left = [self.jump_probability(s.source) for s in self.shapes]
        else:
            left = [1.0 - self.stay_probability(s.source, dt_s) for s in self.shapes]
        with np.errstate(divide="ignore"):
            return np.log(np.array(left))

    def log_transitions(self, known: ObjectClass, dt_s: float) -> tuple[float, float, float]:
        """What may happen to a thing of a class from one view to the next, so many seconds later: logs.

        Returns:
            That it simply stays: Equation 3 over a gap, else certain but for a push in view. That it leaves for
            elsewhere nearby, or for where nobody looks, or comes from there: each as likely. That what isn't here
            doesn't come.
        """
        p = self.config.prediction
        stay = self.stay_probability(known, dt_s) if dt_s > p.significant_period_s else 1.0
        stay = min(stay, 1.0 - p.jump_probability)
        leave = np.log1p(-stay) - np.log(2.0)
        return float(np.log(stay)), float(leave), float(np.log1p(-np.exp(leave)))

    def bias_sigmas(self, shape: Shape) -> Array:
        """(6,) rad and metres: the error that all depth measurements of an object in a visit share.

        A surface that is off by a millimetre or two turns a cup by degrees and a sofa by nothing.
        """
        sensor = self.config.sensor
        turned = np.hypot(sensor.bias_rotation_rad, sensor.bias_surface_m / shape.radius_m)
        moved = np.hypot(sensor.bias_translation_m, sensor.bias_size * shape.radius_m)
        return np.repeat([turned, moved], 3)

    def shared_variance(self, shape: Shape, localisation: LocalisationNoise, away_m: float) -> Array:
        """(6,) by how much all that one view says of an object's pose in the world may be off together.

        Localisation's error, which turns about the camera, and the depth's bias: more samples don't lessen them.

        Args:
            shape: the class.
            localisation: of the recorded camera poses.
            away_m: from the camera to the object.
        """
        return np.repeat(localisation_variance(localisation, away_m), 3) + self.bias_sigmas(shape) ** 2

    @property
    def anywhere(self) -> Array:
        """(6,) variances of a pose anywhere in the neighbourhood: any turn, and anywhere in a ball, rad^2 and m^2.

        A uniform rotation's angle a has E a^2 = pi^2 / 3 + 2.
        """
        radius = self.config.prediction.region_radius_m
        return np.repeat([(np.pi**2 / 3.0 + 2.0) / 3.0, radius**2 / 5.0], 3)

    def log_uniform(self, shape: Shape) -> float:
        """log density of a pose anywhere in the neighbourhood, over poses modulo the object's symmetries."""
        radius = self.config.prediction.region_radius_m
        return -(shape.symmetry.log_quotient_rotations + float(np.log(4.0 / 3.0 * np.pi * radius**3)))

    def view_share(self, before: Array, after: Array, dt_s: float) -> float:
        """How much of a view is news, 0 to 1: the share its evidence counts.

        What depth and detector get wrong of an object, they get wrong again in the next frame from the same side. So
        that more frames of one view are not more evidence, a frame counts by how far the camera has moved around it.

        Args:
            before: (3,) from the object to the camera at the last view, metres, world frame.
            after: (3,) the same now.
            dt_s: seconds between.
        """
        sensor = self.config.sensor
        a, b = np.linalg.norm(before), np.linalg.norm(after)
        turned = np.arccos(np.clip(before @ after / (a * b), -1.0, 1.0)) + abs(np.log(b / a))
        return float(min(1.0, turned / sensor.fresh_view_rad + dt_s / sensor.fresh_view_s))

    def log_likelihood(self, scores: Scores, detection: Detection | None, image_size: tuple[int, int]) -> Array:
        """log phi_m (K,) of rendered hypotheses but for the class scores: tempered depth and the box, nats.

        A hypothesis that covers no pixel of the region is out of view: 0 (the paper's delta = 1), but that a box of its
        track's own would then be something else's.
        """
        d = self.config.detector
        if detection is None:
            found = np.log1p(-d.detection_probability * _shares(scores))
        else:
            seen = scores.covered, scores.visible, scores.box
            widths = d.box_sigma, image_size, d.box_outlier
            found = detected_log_potential(detection.box, *seen, *widths, d.detection_probability)
        return self.kappa * scores.log_ratio + found

    def box(self, detected: Array, rendered: Array, image_size: tuple[int, int]) -> Array:
        """(K,) log ratio of a detected box (4,) for rendered boxes (K, 4), both x, y, w, h in pixels.

        A mixture: some detected boxes have nothing to do with their objects.
        """
        d = self.config.detector
        return box_log_ratio(detected, rendered, d.box_sigma, image_size, d.box_outlier)

    def class_scores(self, detection: Detection) -> Array:
        """(C,) log p(s | d) / p(s | clutter) of a score vector for each class d that the detector may believe in."""
        return class_log_ratio(detection.class_scores, floor=self.config.detector.score_floor)

    def class_evidence(self, summed: Array) -> Array:
        """(C,) log evidence of the true class c from class_scores (C,) summed over a track and visit: saturating."""
        return persistent_class_log_evidence(summed, self.log_confusion)

    def between_classes(self, log_evidence: Array) -> Array:
        """What depth and boxes say of the classes (C,), where that has an end: nats; -inf for none.

        A mesh isn't quite the thing. What it is off by costs it a share of what it explains in every view alike, with
        standard deviation `sensor.mesh_share`, and more views don't lessen that: a class that is behind by z of these
        is the true one with probability Phi(-z), if its evidence doesn't give it more.

        Args:
            log_evidence: (C,) of each class's poses, against nothing being there.
        """
        best = float(log_evidence.max())
        if not np.isfinite(best):
            return log_evidence
        z = (best - log_evidence) / max(self.config.sensor.mesh_share * best, _TRUE_NATS)
        return np.maximum(log_evidence, best + log_ndtr(-z) - log_ndtr(z))

    def clutter_detection(
        self, visible: Array, detection: Detection | None, image_size: tuple[int, int], first: bool
    ) -> Array:
        """log of the detection potential (K,) of something that no mesh explains, of which shares (K,) are visible.

        Its boxes come less often than a known thing's, and jitter, too, about one that nobody knows: a nat is what an
        edge of Laplace's density expects to lose. Nothing foretells its first box, which may be anywhere.
        """
        rate = self.config.detector.clutter_rate
        if detection is None:
            return np.log1p(-rate * visible)
        box = np.array(detection.box)
        fit = 0.0 if first else float(self.box(box, box[None], image_size)[0]) - _EDGES
        return np.full(len(visible), np.log(rate) + fit)

    def witness(self, scores: Scores, detected: bool) -> Array:
        """What a track's box in a view, or the lack of one, says (K,) for a known thing against a look-alike, nats.

        Known things are found in most views. How well the box fits says nothing: the look-alike's would fit as well.

        Args:
            scores: of poses (K).
            detected: whether there is a box.
        """
        d, visible = self.config.detector, _shares(scores)
        if detected:
            # a box where next to nothing shows is another thing's
            return np.log(
                (d.detection_probability * visible + d.box_outlier) / (d.clutter_rate * visible + d.box_outlier)
            )
        return np.log1p(-d.detection_probability * visible) - np.log1p(-d.clutter_rate * visible)

    def seen_in_visit(self, witness: float) -> float:
        """What a visit says for a known thing against a look-alike, nats, for its views' sum of `witness`.

        What a detector misses it misses again: a table under a cloth isn't found in any view of a visit, and each
        tells no more than the one before (`detector.overlooked`).
        """
        share = self.config.detector.overlooked
        return float(np.logaddexp(np.log1p(-share) + witness, np.log(share)))

    def told(self, witness: ArrayLike) -> Array:
        """By what all visits tell a known thing from one of unknown mesh (...), nats, for sums of `seen_in_visit`.

        It has an end: some things of unknown mesh are taken for known ones as often as those are found
        (`detector.deceived`).
        """
        share = self.config.detector.deceived
        return -np.logaddexp(np.log1p(-share) - np.asarray(witness), np.log(share))

    def existence(
        self,
        log_evidence: Array,
        score_evidence: Array,
        log_clutter: float,
        witness: float,
        *log_rivals: float,
    ) -> tuple[float, Array]:
        """P(a track is a known thing), and its class.

        That no pose explains more than clutter would may be the search's fault: a part of such tracks are known things
        all the same (`detector.unfound`), of the class that the scores say. That a pose explains the depth however well
        may be because of a thing of unknown mesh that looks alike (`detector.lookalike`). In both cases depth can't
        tell, and the detector decides, see `told`.

        Args:
            log_evidence: (C,) of each class at the poses that were found, scores and context included; -inf for none.
            score_evidence: (C,) the scores' part of it; -inf for classes that have no pose.
            log_clutter: log evidence of something that no mesh explains.
            witness: what all boxes and their absences say for the most probable class, see `seen_in_visit`.
            log_rivals: of what else it may be.

        Returns:
            P(exists) and P(class | exists) (C,).
        """
        d = self.config.detector
        found = mixture.log_sum(log_evidence)
        told = float(self.told(witness))
        unfound = d.unfound if np.isfinite(score_evidence).any() else 0.0
        with np.errstate(divide="ignore"):
            rivals = [log_clutter + np.log(unfound) + told, log_clutter + np.log1p(-unfound)]
        alike = found + float(np.log(d.lookalike)) - told
        p_found, p_unfound, *_ = np.exp(mixture.normalised(np.array([found, *rivals, alike, *log_rivals])))
        by_pose, by_scores = np.exp(mixture.normalised(log_evidence)), np.exp(mixture.normalised(score_evidence))
        each = p_found * by_pose + p_unfound * by_scores
        total = float(each.sum())
        return total, each / total if total > 0.0 else by_pose


def _shares(scores: Scores) -> Array:
    """(K,) of each silhouette that is visible; 0 out of view."""
    return np.divide(scores.visible, scores.covered, out=np.zeros_like(scores.visible), where=scores.covered > 0)
