"""A window of keyframes that slides over the run: what leaves it is marginalised into a Gaussian on what stays.

The marginal is exact where all is linear and Gaussian (the fixed lag is then the Rauch-Tung-Striebel smoother given all
that was seen). It approximates in three ways: factors that leave are linear about where they were solved last; context
doesn't leave with them, since it is one fact that the window holds; and where the trellis changes its mind about an
object's class or its last mode before the window, what was carried of that object is dropped (Kaess et al., iSAM2, IJRR
2012, on marginals and relinearisation; Dong-Si and Mourikis, ICRA 2011, on what linearising once costs).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam

from ctmap_gtsam.frontend.company import Company
from ctmap_gtsam.frontend.place import Place
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.graph import (
    Camera,
    Carried,
    Measured,
    Smoothed,
    SmootherGraph,
    Variable,
    bias_key,
    build,
    camera_key,
    object_key,
    smooth,
)
from sequences.types import LocalisationNoise

Objects = Mapping[int, tuple[Shape, Sequence[Measured]]]


@dataclass(frozen=True)
class Window:
    """What is known before solving the next keyframe."""

    length: int
    """keyframes that are solved anew, at most"""
    carried: Carried | None = None
    """what came before them"""
    left: Mapping[int, tuple[int, Measured]] = field(default_factory=dict)
    """object -> its class and its last measurement among what was carried"""

    @property
    def first(self) -> int:
        """First keyframe that is solved."""
        return 0 if self.carried is None else self.carried.first

    def solve(
        self,
        model: Model,
        cameras: Sequence[Camera],
        noise: LocalisationNoise,
        objects: Objects,
        company: Mapping[int, Company] | None = None,
        place: Place | None = None,
    ) -> tuple[Smoothed, Window]:
        """Solve the window up to the last camera, and slide it so that the next keyframe fits in.

        Args:
            model: potentials.
            cameras: one a keyframe, from the first of the run on.
            noise: of the recorded poses.
            objects: object -> its class and chosen modes in order of time; older ones than the window are not used but
                to see whether what was carried of the object still holds.
            company: visit -> who was moved together; None = nobody.
            place: on which things stand; None = nowhere.

        Returns:
            The solution, whose cameras begin at `first`, and the next window.
        """
        window = self._without([i for i in self.left if not self._holds(i, objects.get(i))])
        inside = {i: (shape, window._inside(i, measured)) for i, (shape, measured) in objects.items()}
        inside = {i: entry for i, entry in inside.items() if entry[1]}
        built = build(model, cameras, noise, inside, window.carried, company, place)
        smoothed = smooth(built, model, len(cameras), self.first)
        begin = len(cameras) + 1 - self.length
        return smoothed, window._slid(begin, built, smoothed.solution.values, inside, cameras)

    def _holds(self, i: int, entry: tuple[Shape, Sequence[Measured]] | None) -> bool:
        """Whether an object's class, and its last mode before the window, are what was carried."""
        if entry is None:
            return False
        shape, measured = entry
        c, left = self.left[i]
        before = [m for m in measured if m.keyframe < self.first]
        if shape.index != c or not before:
            return shape.index == c  # its views may be forgotten
        last = before[-1]
        return last.keyframe < left.keyframe or (
            last.keyframe == left.keyframe and (last.T_camera_centre == left.T_camera_centre).all()
        )

    def _inside(self, i: int, measured: Sequence[Measured]) -> list[Measured]:
        left = [self.left[i][1]] if i in self.left else []
        return left + [m for m in measured if m.keyframe >= self.first]

    def _without(self, rows: Sequence[int]) -> Window:
        """The same with some objects marginalised out of what was carried."""
        if self.carried is None or not rows:
            return self
        kept = [key for key in self.carried.at.keys() if Variable.of(key).row not in rows]  # noqa: SIM118
        carried = _marginal(self.carried.factors, self.carried.at, kept, self.carried.first)
        return replace(self, carried=carried, left={i: left for i, left in self.left.items() if i not in rows})

    def _slid(
        self, begin: int, built: SmootherGraph, values: Any, objects: Objects, cameras: Sequence[Camera]
    ) -> Window:
        """The window from keyframe `begin` on."""
        if begin <= self.first:
            return self
        left = {
            i: (shape.index, [m for m in measured if m.keyframe < begin][-1])
            for i, (shape, measured) in objects.items()
            if measured[0].keyframe < begin
        }
        old = _old_factors(built, begin, values)
        kept = [camera_key(begin - 1), *(object_key(i, m.keyframe) for i, (_, m) in left.items())]
        visit = cameras[begin - 1].visit
        biases = [bias_key(i, visit) for i, (_, m) in left.items()]
        return replace(self, left=left, carried=_marginal(old, values, kept + biases, begin))


def _old_factors(built: SmootherGraph, begin: int, values: Any) -> Any:
    """What the factors are at some values that a window from `begin` on doesn't have: all of whose poses are older."""
    linear = built.problem().linearize(values)
    old = gtsam.GaussianFactorGraph()
    biases: set[int] = set()
    for n, label in enumerate(built.labels):
        variables = {key: Variable.of(key) for key in label.keys}
        poses = [v for v in variables.values() if v.kind != "b"]
        if label.kind not in ("context", "bias") and all(v.index < begin for v in poses):
            old.add(linear.at(n))
            biases |= {key for key, v in variables.items() if v.kind == "b"}
    for n, label in enumerate(built.labels):
        if label.kind == "bias" and label.keys[0] in biases:
            old.add(linear.at(n))
    return old


def _marginal(linear: Any, values: Any, kept: Sequence[int], first: int) -> Carried:
    """Of a gtsam.GaussianFactorGraph, linear about some values, on those of its keys that are kept."""
    there = set(linear.keyVector())
    out = sorted(there - set(kept))
    if out:
        linear = linear.eliminatePartialMultifrontal(out)[1]
    at = gtsam.Values()
    for key in sorted(there & set(kept)):
        at.insert(key, values.atVector(key) if Variable.of(key).kind == "b" else values.atPose3(key))
    return Carried(first, linear, at)
