"""Identity switches: how often a true object becomes another object of the map.

Bernardin, Stiefelhagen, Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics (2008). The one matching
that all other metrics rest on can't see a switch, since it gives a true object one object of the map for the whole run.
So here, and only here, objects are associated frame by frame, by distance: a pair of the frame before is kept as long
as it is within reach; the rest is assigned by least distance, blind to the class. A switch is a true object that is
visible and associated with another object than last time, however long ago that was.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.evaluation.matching import ObjectFrames, centres, reach_of
from ctmap_gtsam.evaluation.pose import Shape

Array = NDArray[np.float64]

_OUT_OF_REACH = 1e3


def identity_switches(truth: ObjectFrames, estimated: ObjectFrames, shapes: dict[int, Shape]) -> int:
    """Over all frames of a run, in the frames where true objects are visible."""
    ours, theirs = centres(truth, shapes), centres(estimated, shapes)
    reach, their_reach = reach_of(truth, shapes), reach_of(estimated, shapes)
    last: dict[int, int] = {}
    switches = 0
    for f in range(truth.visible.shape[1]):
        n, m = np.flatnonzero(truth.visible[:, f]), np.flatnonzero(estimated.present[:, f])
        distance = np.linalg.norm(ours[n, None, f] - theirs[None, m, f], axis=-1)
        near = distance < np.minimum(reach[n, f][:, None], their_reach[m, f])
        for i, j in _associated(np.where(near, distance, _OUT_OF_REACH), [last.get(int(k), -1) for k in n], m.tolist()):
            true, found = int(n[i]), int(m[j])
            switches += last.get(true, found) != found
            last[true] = found
    return switches


def _associated(distance: Array, last: list[int], candidates: list[int]) -> list[tuple[int, int]]:
    """Pairs of rows and columns of distances (n, m): those of `last`, the candidate each row had, first."""
    cost = distance.copy()
    for i, known in enumerate(last):
        if known in candidates and distance[i, candidates.index(known)] < _OUT_OF_REACH:
            cost[i, candidates.index(known)] -= _OUT_OF_REACH
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if distance[i, j] < _OUT_OF_REACH]
