"""What the smoother starts from: the objects, classes and poses of a forward pass.

A filter over the run knows which objects there are, of which classes they may be and roughly where they were. The
smoother takes from it hypotheses alone: no weight, covariance or probability of it goes into what is smoothed, or the
past would be counted twice.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import EXISTS, Estimate
from ctmap_gtsam.frontend.proposer import distinct
from ctmap_gtsam.frontend.surroundings import Neighbour
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import one_place_m
from ctmap_gtsam.smoothing.belief import SURE
from factors.symmetry import near

Array = NDArray[np.float64]

_KEPT = 8  # poses of a class that an object starts from, at most
_ONE_POSE = (0.15, 0.015)  # rad, metres: what was believed nearer to each other at different times is one pose
_LIKELY = 1e-3  # classes less probable than this in the forward pass are not probed with care at first
_ALIKE = 1e-3  # visits between which a thing is of one class with this probability may hold two opinions of it, ...
_NEARBY_M = 0.1  # ... if it is no farther away than it may have been pushed
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
    """(C,) when it was last there"""
    there: NDArray[np.bool_]
    """(K,) the keyframes at which it was believed to be there"""
    surest: int
    """the last of these; of what never was there the likeliest"""

    @property
    def best_class(self) -> int:
        """Index in the catalogue, of the most probable class that has a pose."""
        return most_probable(self.poses, self.class_probability)

    def neighbour(self, keyframe: int, claim: float, model: Model) -> Neighbour | None:
        """What others have beside them at a keyframe; None where it wasn't there, or its class wasn't sure.

        Args:
            keyframe: when.
            claim: by which of two things in one place has it.
            model: shapes.
        """
        c = self.best_class
        if not self.there[keyframe] or self.class_probability[c] <= SURE:
            return None
        return Neighbour(self.object_id, model.shapes[c], self.expected(keyframe), claim)

    def expected(self, keyframe: int) -> Array:
        """(4, 4) T_world_centre of the best class at a keyframe."""
        return self._nearest(self.best_class, keyframe)[0]

    def starts(self, keyframe: int) -> dict[int, Array]:
        """Class index -> (n, 4, 4) T_world_centre to try at a keyframe: all, and what was believed then."""
        return {c: np.concatenate([poses, self._nearest(c, keyframe)]) for c, poses in self.poses.items()}

    def then(self, keyframe: int) -> dict[int, Array]:
        """Class index -> (m, 4, 4) T_world_centre believed at a keyframe."""
        return {c: then[keyframe] for c, then in self.believed.items() if keyframe in then}

    def _nearest(self, c: int, keyframe: int) -> Array:
        """What was believed of a class at a keyframe, or next to it, the past first."""
        keyframes = self._keyframes[c]
        return self.believed[c][keyframes[max(bisect_right(keyframes, keyframe) - 1, 0)]]

    @cached_property
    def _keyframes(self) -> dict[int, list[int]]:
        """Class index -> keyframes at which something was believed of it, ascending."""
        return {c: sorted(then) for c, then in self.believed.items()}


def most_probable(poses: Mapping[int, Array], probability: Array) -> int:
    """The class index of the most probable class (C,) that has a pose."""
    return max(poses, key=lambda c: (probability[c], -c))


def careful(poses: Mapping[int, Array], probability: Array) -> frozenset[int]:
    """Classes whose covariance is worth probing, by their probability (C,)."""
    return frozenset(c for c in poses if probability[c] > _LIKELY) | {most_probable(poses, probability)}


def seeds(forward: Estimate, model: Model) -> dict[int, Seed]:
    """The objects of an estimate, by object id.

    Those that are still there at its end, or were taken away. What was taken for one of them in the end is that one
    from its own beginning on, since the filter learned late where it had gone. What was given up where no other object
    was then begins anew, and so does who came back: an object that is of one class in a visit and of another in a later
    one may be two, and the second has an id of its own.
    """
    out: dict[int, Seed] = {}
    let_go: list[Seed] = []
    ended: list[Seed] = []
    last = len(forward.keyframe_frame) - 1
    unused = itertools.count(int(forward.object_id.max(initial=-1)) + 1)
    for row, object_id in enumerate(forward.object_id):
        stays = forward.best_mode[row, last] >= 0 and forward.existence[row].max() >= _EVER
        for n, (first, end) in enumerate(_lives(row, forward, model)):
            if not stays and forward.existence[row, first:end].max() <= EXISTS:
                continue
            seed = _seed(next(unused) if n else int(object_id), row, forward, model, first, end)
            if stays:
                out[seed.object_id] = seed
            else:
                (let_go if end > last else ended).append(seed)
    # the last first: what was taken for what was taken for an object is that object, but for what it was before
    for seed in sorted(let_go, key=lambda s: (-s.surest, s.object_id)):
        heir = next((i for i, other in sorted(out.items()) if _stands_at(other, seed, seed.surest + 1, model)), None)
        if heir is None:
            out |= _begun_anew(seed, out, model)
        else:
            out[heir] = _begun_as(out[heir], seed, model)
    for seed in ended:
        out |= _begun_anew(seed, out, model)
    return dict(sorted(out.items()))


def _begun_anew(seed: Seed, others: Mapping[int, Seed], model: Model) -> dict[int, Seed]:
    """By its id what was given up, where none of the others was then."""
    beside = any(_stands_at(other, seed, seed.surest, model) for other in others.values())
    return {} if beside else {seed.object_id: seed}


def _lives(row: int, forward: Estimate, model: Model) -> list[tuple[int, int]]:
    """Keyframes, from the first to before the second, in which an object of the forward pass was one thing.

    Within a visit it is the same thing, and what is believed of it at the visit's end is what it was.
    """
    begun: list[int] = [0]
    before: _Opinion | None = None
    for visit in np.unique(forward.keyframe_visit):
        own = np.flatnonzero(forward.keyframe_visit == visit)
        there = own[forward.existence[row, own] > EXISTS]
        if not len(there) or forward.class_probability[row, there[-1]].max() <= SURE:
            continue
        first, after = (_Opinion.of(row, k, forward, model) for k in there[[0, -1]])
        if before is not None and not before.may_be(first.at, after.class_probability):
            begun.append(int(own[0]))
        before = after
    return list(itertools.pairwise([*begun, len(forward.keyframe_frame)]))


@dataclass(frozen=True)
class _Opinion:
    """What the forward pass says of an object at a keyframe."""

    class_probability: Array
    """(C,)"""
    at: Array
    """(3,) its centre in the world; NaN where nobody knows"""

    @classmethod
    def of(cls, row: int, k: int, forward: Estimate, model: Model) -> _Opinion:
        p = forward.class_probability[row, k]
        return cls(p, model.shapes[int(np.argmax(p))].to_centre(forward.pose[row, k])[:3, 3])

    def may_be(self, at: Array, class_probability: Array) -> bool:
        """Whether what is met later, at (3,) and of classes (C,), may be the same thing, called by another name."""
        if np.argmax(class_probability) == np.argmax(self.class_probability):
            return True
        alike = float(class_probability @ self.class_probability) > _ALIKE
        return alike and bool(np.linalg.norm(at - self.at) < _NEARBY_M)


def _stands_at(other: Seed, seed: Seed, keyframe: int, model: Model) -> bool:
    """Whether an object is believed at a keyframe to be where another was last."""
    at = seed.expected(seed.surest)[:3, 3]
    own = model.shapes[seed.best_class]
    return any(
        bool((np.linalg.norm(T[:, :3, 3] - at, axis=-1) < one_place_m(own, model.shapes[c])).any())
        for c, T in other.then(keyframe).items()
    )


def _begun_as(seed: Seed, other: Seed, model: Model) -> Seed:
    """An object, with what was believed of the one that was taken for it, while that was elsewhere."""
    apart = [k for k in np.flatnonzero(other.there).tolist() if not _stands_at(seed, other, k, model)]
    believed = {c: {k: T for k, T in then.items() if k not in apart} for c, then in seed.believed.items()}
    for c, then in other.believed.items():
        believed[c] = believed.get(c, {}) | {k: T for k, T in then.items() if k in apart}
    believed = {c: then for c, then in believed.items() if then}
    poses = {c: T for c, T in remembered(model, seed.poses, other.poses).items() if c in believed}
    surest = max(seed.surest, other.surest)
    return replace(seed, poses=poses, believed=believed, there=seed.there | other.there, surest=surest)


def _seed(object_id: int, row: int, forward: Estimate, model: Model, first: int, end: int) -> Seed:
    """What was believed of an object at the keyframes from the first to before the end."""
    modes = forward.modes
    own = np.flatnonzero((modes.object == row) & (modes.keyframe >= first) & (modes.keyframe < end))
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
    keyframes = np.arange(len(forward.keyframe_frame))
    there = (forward.existence[row] > EXISTS) & (first <= keyframes) & (keyframes < end)
    surest = first + _surest(forward.existence[row, first:end])
    return Seed(object_id, poses, believed, forward.class_probability[row, surest], there, surest)


def _surest(existence: Array) -> int:
    """The last of some keyframes at which an object was there, by its existence (K,); else the likeliest.

    What a thing that is gone would be if it were there after all, is no class that it had.
    """
    there = np.flatnonzero(existence > EXISTS)
    return int(there[-1]) if len(there) else int(np.argmax(existence))


@dataclass(frozen=True)
class Believed:
    """One object of the forward pass at one keyframe."""

    poses: Mapping[int, Array]
    """class index -> (n, 4, 4) T_world_centre, the heaviest first"""
    class_probability: Array
    """(C,) when it was last there"""

    @property
    def best_class(self) -> int:
        """Index in the catalogue, of the most probable class that has a pose."""
        return most_probable(self.poses, self.class_probability)


def believed(forward: Estimate, model: Model, keyframe: int) -> dict[int, Believed]:
    """What a filter says at a keyframe, by object id: of what is there, or was taken away. It knows the past alone."""
    modes = forward.modes
    here = np.flatnonzero(modes.keyframe == keyframe)
    here = here[np.argsort(-modes.log_weight[here], kind="stable")]
    out = {}
    for row in np.unique(modes.object[here]):
        if forward.existence[row, : keyframe + 1].max() < _EVER:
            continue
        own = here[modes.object[here] == row]
        poses = {}
        for class_id in np.unique(modes.class_id[own]):
            shape = model.shapes[model.catalogue.index(int(class_id))]
            poses[shape.index] = shape.to_centre(modes.T_world_object[own[modes.class_id[own] == class_id]])
        surest = _surest(forward.existence[row, : keyframe + 1])
        out[int(forward.object_id[row])] = Believed(poses, forward.class_probability[row, surest])
    return dict(sorted(out.items()))


def news(model: Model, known: Mapping[int, Array], poses: Mapping[int, Array]) -> dict[int, Array]:
    """Class index -> those poses that are none of the known ones of the class."""
    out = {}
    for c, some in poses.items():
        there = known.get(c)
        if there is None or not len(there):
            out[c] = some
            continue
        fresh = [T for T in some if not near(T, there, model.shapes[c].symmetry, *_ONE_POSE).any()]
        if fresh:
            out[c] = np.stack(fresh)
    return out


def remembered(model: Model, known: Mapping[int, Array], poses: Mapping[int, Array]) -> dict[int, Array]:
    """Class index -> poses (n, 4, 4) that are apart from each other, the latest first, at most a few."""
    out = dict(known)
    for c, some in poses.items():
        every = np.concatenate([some, known[c]]) if c in known else some
        order = -np.arange(len(every), dtype=float)
        out[c] = every[distinct(model.shapes[c], every, order, _ONE_POSE, _KEPT)]
    return out
