"""What the smoother starts from: the objects, classes and poses of a forward pass.

A filter over the run knows which objects there are, of which classes they may be and roughly where they were. The
smoother takes from it hypotheses alone: no weight, covariance or probability of it goes into what is smoothed, or the
past would be counted twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import EXISTS, Estimate
from ctmap_gtsam.frontend.proposer import distinct
from ctmap_gtsam.model import Model

Array = NDArray[np.float64]

_KEPT = 8  # poses of a class that an object starts from, at most
_ONE_POSE = (0.15, 0.015)  # rad, metres: what was believed nearer to each other at different times is one pose
_EVER = 0.05  # an object that never existed with this probability isn't started from


@dataclass(frozen=True)
class Seed:
    """One object of the forward pass."""

    object_id: int
    poses: Mapping[int, Array]
    """class index -> (n, 4, 4) T_world_centre that it ever was believed to have"""
    believed: Mapping[int, Mapping[int, Array]]
    """class index -> keyframe -> (m, 4, 4) T_world_centre believed then, the heaviest first"""
    class_probability: Array
    """(C,) at the end"""

    @property
    def best_class(self) -> int:
        """Index in the catalogue, of the most probable class that has a pose."""
        return max(self.poses, key=lambda c: (self.class_probability[c], -c))

    def expected(self, keyframe: int) -> Array:
        """(4, 4) T_world_centre of the best class at a keyframe."""
        return self._then(self.best_class, keyframe)[0]

    def starts(self, keyframe: int) -> dict[int, Array]:
        """Class index -> (n, 4, 4) T_world_centre to try at a keyframe: all, and what was believed then."""
        return {c: np.concatenate([poses, self._then(c, keyframe)]) for c, poses in self.poses.items()}

    def _then(self, c: int, keyframe: int) -> Array:
        """What was believed of a class at a keyframe, or next to it, the past first."""
        keyframes = sorted(self.believed[c])
        before = [k for k in keyframes if k <= keyframe]
        return self.believed[c][before[-1] if before else keyframes[0]]


def seeds(forward: Estimate, model: Model) -> dict[int, Seed]:
    """The objects of an estimate that are still there at its end, or were taken away. By object id."""
    out = {}
    last = len(forward.keyframe_frame) - 1
    for row, object_id in enumerate(forward.object_id):
        if forward.best_mode[row, last] < 0 or forward.existence[row].max() < _EVER:
            continue
        out[int(object_id)] = _seed(int(object_id), row, forward, model)
    return out


def _seed(object_id: int, row: int, forward: Estimate, model: Model) -> Seed:
    modes = forward.modes
    own = np.flatnonzero(modes.object == row)
    # what is believed of a thing that is gone says little of where it was; of the rest the later knows more
    gone = forward.existence[row, modes.keyframe[own]] <= EXISTS
    own = own[np.lexsort((-modes.log_weight[own], -modes.keyframe[own], gone))]
    poses, believed = {}, {}
    for class_id in np.unique(modes.class_id[own]):
        shape = model.shapes[model.catalogue.index(int(class_id))]
        rows = own[modes.class_id[own] == class_id]
        T = shape.to_centre(modes.T_world_object[rows])
        poses[shape.index] = T[distinct(shape, T, -np.arange(len(rows), dtype=float), _ONE_POSE, _KEPT)]
        then = modes.keyframe[rows]
        believed[shape.index] = {int(k): T[then == k] for k in np.unique(then)}
    return Seed(object_id, poses, believed, forward.class_probability[row, -1])
