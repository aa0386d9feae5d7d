"""Which tracks are one object: causally, from the beliefs of a keyframe.

A track that starts where an object is known to be is that object, met again on another box; and two objects of one
class that come to be in one place are one. A track of the same class that starts elsewhere, after an object was last
seen at its place and that place was found empty, is that object, moved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.filtering.belief import Belief, ClassBelief
from ctmap_gtsam.filtering.history import moved_past
from ctmap_gtsam.filtering.reporting import Reported
from ctmap_gtsam.frontend.landing import landing_log_density
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape, one_place_m
from factors.mixture import log_sum, normalised
from sequences.geometry import Plane

Array = NDArray[np.float64]

_SAME_CLASS = 0.5  # least P(both are of one class) for a join
WAS_THERE = 0.8
"""an object that never existed with this probability can't have moved"""
_MISTAKEN = 0.1  # of the objects that seem to be found again, so many are others of like class


def at_place(track_report: Reported, objects: Mapping[int, Reported], model: Model) -> int | None:
    """The object that already stands where a new track's object is; None where there is none."""
    T = track_report.best_pose
    if T is None:
        return None
    nearest, closest = None, np.inf
    for i, other in sorted(objects.items()):
        if other.best_pose is None:
            continue
        apart = float(np.linalg.norm(T[:3, 3] - other.best_pose[:3, 3]))
        own, its = (model.shapes[r.best_class] for r in (track_report, other))
        if apart < min(one_place_m(own, its), closest):
            nearest, closest = i, apart
    return nearest


def twin(report: Reported, objects: Mapping[int, Reported], model: Model) -> int | None:
    """The object of the same class in the same place; None where there is none, or either may not exist."""
    there = {i: r for i, r in objects.items() if r.existence > 0.5 and r.best_class == report.best_class}
    return at_place(report, there, model) if report.existence > 0.5 else None


def moved_to(
    beliefs: Mapping[int, Belief], reports: Mapping[int, Reported], known: Mapping[int, Array], model: Model
) -> dict[int, tuple[int, float]]:
    """Which objects were found again as others, by a global assignment.

    Args:
        beliefs: of every object.
        reports: of this keyframe.
        known: what each object that ever surely was there was when it last was, class probabilities (C,): what it would
            be if it were there now is no class that it had.
        model: tells what can be moved.

    Returns:
        Object -> the object that it is now, and P(both are of one class).
    """
    gone = [i for i in sorted(reports) if reports[i].existence < 0.5 and i in known]
    there = [i for i in sorted(reports) if reports[i].existence > WAS_THERE]
    if not gone or not there:
        return {}
    movable = np.array([shape.source.movable for shape in model.shapes])
    same = np.array([[_one_class(beliefs[a], beliefs[b], known[a], reports[b], movable) for b in there] for a in gone])
    rows, columns = linear_sum_assignment(-same)
    return {
        gone[r]: (there[c], float(same[r, c])) for r, c in zip(rows, columns, strict=True) if same[r, c] >= _SAME_CLASS
    }


def _one_class(gone: Belief, found: Belief, known: Array, found_report: Reported, movable: NDArray[np.bool_]) -> float:
    """P(one class that can be moved) where the second began after the first was last seen at its place, else 0."""
    if found.first_ns <= gone.present_ns:
        return 0.0
    return float((known * found_report.class_probability)[movable].sum())


def as_moved(old: Belief, found: Belief, known: Array, model: Model, supports: tuple[Plane, ...]) -> Belief:
    """The belief of an object at its new place: what was known of its class (C,) is still known.

    And somebody put it there: where level surfaces are known, poses and classes that rest on them are likelier. That
    says nothing for or against there being a known thing, as what nobody knows rests on them, too.

    Args:
        old: of the object at its old place.
        found: what it was met again as.
        known: what was known of its class (C,) when it last surely was there.
        model: shapes and settings.
        supports: level surfaces, world frame.
    """
    evidence = np.log((1.0 - _MISTAKEN) * len(known) * known + _MISTAKEN)
    found = replace(found, score_evidence=found.score_evidence + evidence)
    landed = [
        None if own is None else _landed(own, model, shape, supports)
        for shape, own in zip(model.shapes, found.classes, strict=True)
    ]
    resting = replace(found, classes=tuple(landed))
    gained = log_sum(resting.class_log_evidence(model)) - log_sum(found.class_log_evidence(model))
    classes = tuple(None if c is None else replace(c, log_evidence=c.log_evidence - float(gained)) for c in landed)
    return replace(
        found,
        object_id=old.object_id,
        classes=classes,
        first_ns=old.first_ns,
        past=moved_past(found.past, old.past),
    )


def _landed(own: ClassBelief, model: Model, shape: Shape, supports: tuple[Plane, ...]) -> ClassBelief:
    """A class that was begun anywhere in the neighbourhood, as one that was put there."""
    particles = own.particles
    ratio = landing_log_density(model, shape, particles.T_world_centre, supports) - model.log_uniform(shape)
    joint = particles.log_weight + ratio
    weighed = replace(particles, log_weight=normalised(joint))
    return replace(own, particles=weighed, log_evidence=own.log_evidence + float(log_sum(joint)))
