"""What things stood on before they were moved, and what they stand on since: the supports of an estimate's moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import NO_SUPPORT
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from sequences import se3
from sequences.geometry import Plane

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Surfaces = Sequence[tuple[Plane, ...]]
"""(K,) level surfaces that are known when a keyframe is reported, world frame, in the order of `meta["surfaces"]`"""

_LEVEL = 0.95  # least cosine between up and the normal of a flat part that things stand on
_TOUCHING_M = 0.005  # points of a thing that lie no higher above its lowest one bear it


def with_supports(estimate: Estimate, model: Model, surfaces: Surfaces, *, settled: bool = False) -> Estimate:
    """The estimate with `moves.from_support` and `moves.to_support`.

    That is the object whose top the thing stands on, if the map has it there, else the level surface; neither where the
    thing is not in the map, or touches nothing that is known.

    Args:
        estimate: of which the supports are not said yet.
        model: shapes, and how exactly surfaces are known.
        surfaces: at each keyframe.
        settled: take the new place from what is believed when the visit ends, or the thing's next gap in it begins.
            For a filter, that needs some views to know where a thing has gone; else at the first keyframe after it.
    """
    up = estimate.meta.get("up_world")
    moves = estimate.moves
    if up is None or not len(moves.object):
        return estimate
    after = _settled(estimate) if settled else moves.gap[:, 1]
    standing = _Standing(estimate, model, np.array(up))
    pairs = [
        (standing.on(int(i), int(a), surfaces[b]), standing.on(int(i), int(b), surfaces[b]))
        for i, a, b in zip(moves.object, moves.gap[:, 0], after, strict=True)
    ]
    supports = np.array(pairs, dtype=np.int64)
    return replace(estimate, moves=replace(moves, from_support=supports[:, 0], to_support=supports[:, 1]))


def _settled(estimate: Estimate) -> Ints:
    """(G,) the last keyframe of the visit after each gap that lies before the object's next gap."""
    moves, visit = estimate.moves, estimate.keyframe_visit
    ends = np.searchsorted(visit, visit[moves.gap[:, 1]], side="right") - 1
    for g, (i, b) in enumerate(zip(moves.object, moves.gap[:, 1], strict=True)):
        begins = moves.gap[(moves.object == i) & (moves.gap[:, 0] >= b), 0]
        ends[g] = min([ends[g], *begins.tolist()])
    return np.asarray(ends)


class _Standing:
    """What stands on what in an estimate's maps."""

    def __init__(self, estimate: Estimate, model: Model, up: Array) -> None:
        self.estimate, self.model, self.up = estimate, model, up
        self.within_m = model.config.context.bearing_m

    def on(self, row: int, keyframe: int, surfaces: tuple[Plane, ...]) -> int:
        """Row of the object, or -1 - k for surface k, that bears one; `NO_SUPPORT` where nothing is known to."""
        if not self.estimate.exists[row, keyframe]:
            return NO_SUPPORT
        foot, centre = self._foot(row, keyframe)
        gaps = {o: self._above(o, keyframe, foot) for o in np.flatnonzero(self.estimate.exists[:, keyframe]).tolist()}
        tops = {o: gap for o, gap in gaps.items() if o != row and gap is not None}
        if tops:
            return min(tops, key=lambda o: tops[o])
        bearing = {
            k: abs(float(foot @ plane.normal - plane.offset))
            for k, plane in enumerate(surfaces)
            if plane.contains(centre[None]).item()
        }
        nearest = min(bearing, key=lambda k: bearing[k], default=None)
        return NO_SUPPORT if nearest is None or bearing[nearest] > self.within_m else -1 - nearest

    def _of(self, row: int, keyframe: int) -> tuple[Shape, Array]:
        """Its most probable class and T_world_centre (4, 4)."""
        shape = self.model.shapes[self.model.catalogue.index(int(self.estimate.best_class[row, keyframe]))]
        return shape, shape.to_centre(self.estimate.pose[row, keyframe])

    def _foot(self, row: int, keyframe: int) -> tuple[Array, Array]:
        """The middle (3,) of what bears a thing, and its centre (3,), world frame."""
        shape, T = self._of(row, keyframe)
        points = se3.transform(T, shape.hull_points)
        heights = points @ self.up
        return points[heights < heights.min() + _TOUCHING_M].mean(axis=0), T[:3, 3]

    def _above(self, row: int, keyframe: int, foot: Array) -> float | None:
        """Metres from a point (3,) to the level flat part of an object that may bear it; None where none does."""
        shape, T = self._of(row, keyframe)
        if not shape.source.supports or np.linalg.norm(foot - T[:3, 3]) > shape.reach_m + self.within_m:
            return None
        at = se3.transform(se3.inverse(T), foot[None])
        if abs(shape.distance.at(at).item()) > self.within_m:
            return None
        level = shape.flats[shape.flats[:, :3] @ (T[:3, :3].T @ self.up) > _LEVEL]
        apart = np.abs(level[:, :3] @ at[0] - level[:, 3])
        return float(apart.min()) if len(apart) and apart.min() <= self.within_m else None
