"""How far two methods agree, and what hindsight changed: needs no truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.evaluation import pose
from ctmap_gtsam.evaluation.detection import class_probability
from ctmap_gtsam.evaluation.matching import MethodMap, match
from ctmap_gtsam.evaluation.pose import Shape

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ObjectAgreement:
    """One object of the reference method and its match in the other method, over the run's frames."""

    reference_object: int
    """object_id in the reference"""
    other_object: int | None
    """object_id in the other method; None where it has no such object"""
    visible: NDArray[np.bool_]
    """(F,) frames where the reference has the object in view: those that are compared"""
    reference_class: Ints
    """(F,) obj_id, -1 where absent"""
    other_class: Ints
    """(F,) obj_id, -1 where absent"""
    distance_m: Array
    """(F,) between the centres of the bounding boxes, each in its own camera; inf where the other has none, NaN where
    not visible"""
    rotation_rad: Array
    """(F,) symmetry-aware; inf where the classes differ, NaN where not visible"""
    final_class: int
    """the reference's class in the last frame that has one"""
    reference_probability: Array
    """(F,) P(exists) P(final_class) in the reference"""
    other_probability: Array
    """(F,) the same in the other method"""

    @property
    def class_agreement(self) -> float:
        """Share of the visible frames in which both say the same class."""
        return float((self.reference_class == self.other_class)[self.visible].mean()) if self.visible.any() else np.nan

    @property
    def first_agreement(self) -> int | None:
        """The first visible frame after which the other keeps the reference's class; None where there is none."""
        frames = np.flatnonzero(self.visible)
        differs = np.flatnonzero(self.reference_class[frames] != self.other_class[frames])
        after = 0 if len(differs) == 0 else differs[-1] + 1
        return int(frames[after]) if after < len(frames) else None


@dataclass(frozen=True)
class Agreement:
    """One method held to another."""

    reference: str
    other: str
    objects: tuple[ObjectAgreement, ...]
    """one for each object of the reference that is in view in some frame"""
    only_in_other: tuple[int, ...]
    """object_ids that the reference doesn't have"""

    def metrics(self) -> dict[str, float]:
        """Over the object-frames the reference has in view; NaN where it has none, inf where half have no match."""
        distance = np.concatenate([o.distance_m[o.visible] for o in self.objects] or [np.zeros(0)])
        rotation = np.concatenate([o.rotation_rad[o.visible] for o in self.objects] or [np.zeros(0)])
        same = np.concatenate([(o.reference_class == o.other_class)[o.visible] for o in self.objects] or [np.zeros(0)])
        some = len(distance) > 0
        return {
            "distance_mm_median": 1e3 * float(np.median(distance)) if some else np.nan,
            "rotation_deg_median": float(np.rad2deg(np.median(rotation))) if some else np.nan,
            "class_agreement": float(same.mean()) if some else np.nan,
            "objects_without_match": sum(o.other_object is None for o in self.objects),
            "objects_only_here": len(self.only_in_other),
        }


def agree(reference: MethodMap, other: MethodMap, shapes: dict[int, Shape]) -> Agreement:
    """Match two methods by the same function that matches a method to the truth, and measure how far they are apart."""
    matching = match(reference.objects, other.objects, shapes)
    pairs = enumerate(int(row) for row in matching.row)
    objects = tuple(_pair(reference, n, other, m, shapes) for n, m in pairs if reference.objects.visible[n].any())
    only_in_other = tuple(int(other.objects.name[m]) for m in matching.unmatched)
    return Agreement(reference.name, other.name, objects, only_in_other)


def _pair(reference: MethodMap, n: int, other: MethodMap, m: int, shapes: dict[int, Shape]) -> ObjectAgreement:
    """Object n of the reference and object m of the other method, -1 where that has none."""
    ours, theirs = reference.objects, other.objects
    visible, classes = ours.visible[n], ours.class_id[n]
    other_classes = theirs.class_id[m] if m >= 0 else np.full_like(classes, -1)
    distance, rotation = (np.where(visible, np.inf, np.nan) for _ in range(2))
    pairs = np.stack([classes, other_classes], axis=1)
    both = visible & (other_classes >= 0)
    for a, b in np.unique(pairs[both], axis=0):
        f = both & (pairs == (a, b)).all(axis=1)
        mine, yours = ours.T_camera_object[n, f], theirs.T_camera_object[m, f]
        distance[f] = pose.translation_error(shapes[int(b)], yours, shapes[int(a)], mine)
        if a == b:
            rotation[f] = pose.rotation_error(shapes[int(a)], yours, mine)
    final = int(classes[classes >= 0][-1])
    asked = np.full_like(classes, final)
    return ObjectAgreement(
        reference_object=int(ours.name[n]),
        other_object=int(theirs.name[m]) if m >= 0 else None,
        visible=visible,
        reference_class=classes,
        other_class=other_classes,
        distance_m=distance,
        rotation_rad=rotation,
        final_class=final,
        reference_probability=class_probability(reference, n, asked),
        other_probability=class_probability(other, m, asked),
    )
