"""Many factors of one form, evaluated in one call and handed to GTSAM's elimination as what they are at given values.

A Python factor inside a graph costs some hundred microseconds a linearisation, most of it calls on small arrays, and
GTSAM's own optimisers copy all of Values for each call besides. Here a form's residuals and Jacobians come from one
call over arrays (`factors.terms`). GTSAM gets them as JacobianFactors, beside what its compiled factors linearise to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.smoothing.elimination import Blocks
from factors.custom import FactorValueError
from factors.terms import Linearised, Terms

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Batch:
    """n factors of one kind and form."""

    kind: str
    keys: Ints
    """(n, a)"""
    terms: Terms
    """of batch shape (n,)"""
    name: Callable[[Sequence[int]], str]
    """what errors and tables call a factor of some keys (a,)"""

    def __len__(self) -> int:
        return len(self.keys)


BLOCK = 1000
"""keyframes that are eliminated together, at least: a run that is shorter than two blocks is one"""


@dataclass(frozen=True, eq=False)
class _Point:
    """Values of all variables as arrays."""

    pose_keys: Ints
    """(P,) ascending"""
    poses: Array
    """(P, 4, 4)"""
    vector_keys: Ints
    """(V,) ascending"""
    vectors: Array
    """(V, 6)"""

    def of(self, keys: Ints) -> Array:
        """Values (n, 4, 4) or (n, 6) of some keys (n,), all of poses or all of vectors."""
        rows = np.searchsorted(self.pose_keys, keys)
        if (self.pose_keys[rows[:1] % len(self.pose_keys)] == keys[:1]).all():
            return self.poses[rows]
        return self.vectors[np.searchsorted(self.vector_keys, keys)]


@dataclass(frozen=True, eq=False)
class _Piece:
    """Consecutive factors of a batch that are in one block."""

    batch: Batch
    rows: slice
    block: int

    def errors(self, at: _Point) -> Array:
        """Of each factor (n,)."""
        r, _ = self._linearised(at)
        return np.asarray(0.5 * (r**2).sum(axis=-1))

    def linearize(self, at: _Point, linear: Any) -> None:
        """Add its factors to a gtsam.GaussianFactorGraph."""
        r, jacobians = self._linearised(at)
        noise = gtsam.noiseModel.Unit.Create(self.batch.terms.rows)
        columns: list[Any] = []
        for keys, J in zip(self.batch.keys[self.rows].T, jacobians, strict=True):
            columns += [keys.tolist(), J]
        for factor in zip(*columns, -r, strict=True):
            linear.add(*factor, noise)

    def _linearised(self, at: _Point) -> Linearised:
        keys = self.batch.keys[self.rows]
        whole = len(keys) == len(self.batch)
        # what the terms of a part work out once is let go of with the part: of all parts it is as much as their numbers
        terms = self.batch.terms if whole else self.batch.terms[self.rows]
        r, jacobians = terms.linearised([at.of(column) for column in keys.T])
        finite = np.isfinite(r).all(axis=-1)
        for J in jacobians:
            finite &= np.isfinite(J).all(axis=(-2, -1))
        if not finite.all():
            name = self.batch.name(keys[int(np.argmin(finite))].tolist())
            raise FactorValueError(name, "residual or Jacobian", "has a value that isn't finite")
        return r, jacobians


class Problem:
    """What the solver minimises: `error` and `linearize` are those of a gtsam.NonlinearFactorGraph of the same factors.

    Args:
        compiled: gtsam.NonlinearFactorGraph of all factors that aren't in batches.
        batches: the others.
        values: gtsam.Values that holds all variables, poses and 6-vectors; what is evaluated later has the same keys.
        keyframes: of keys (n,) the keyframe that each is of (n,), -1 for none; None = the system is eliminated at once.
        block: keyframes that are eliminated together, at least.
    """

    def __init__(
        self,
        compiled: Any,
        batches: Sequence[Batch],
        values: Any,
        keyframes: Callable[[Ints], Ints] | None = None,
        block: int = BLOCK,
    ) -> None:
        self._compiled = compiled
        keys = np.array(values.keys(), dtype=np.int64)
        is_pose = np.array([_is_pose(values, key) for key in keys.tolist()], dtype=bool)
        # gtsam.Values is ordered by key, and so are the poses taken out of it
        self._poses, self._vectors = keys[is_pose], keys[~is_pose]
        of_compiled = padded([tuple(compiled.at(i).keys()) for i in range(compiled.size())])
        variables = [np.searchsorted(keys, own) for own in (of_compiled, *(batch.keys for batch in batches))]
        first = _blocks_of(np.full(len(keys), -1) if keyframes is None else keyframes(keys), block)
        (in_compiled, *in_batches), last = cut(first, variables)
        self._orders: list[Any] = []
        self._own = [keys[last == n] for n in range(last.max(initial=0) + 1)]
        self._compiled_in = [compiled] if len(self._own) == 1 else _split(compiled, in_compiled, len(self._own))
        self._pieces = [
            [_Piece(batch, rows, n) for rows, n in _runs(at)] for batch, at in zip(batches, in_batches, strict=True)
        ]

    def error(self, values: Any) -> float:
        """Sum of all factors' errors, nats but for constants."""
        return float(self._compiled.error(values) + sum(errors.sum() for errors in self.batch_errors(values)))

    def batch_errors(self, values: Any) -> list[Array]:
        """Each batch's errors (n,)."""
        at = self._read(values)
        return [np.concatenate([piece.errors(at) for piece in pieces]) for pieces in self._pieces]

    def linearize(self, values: Any) -> Any:
        """A gtsam.GaussianFactorGraph, one factor a factor."""
        linear, at = self._compiled.linearize(values), self._read(values)
        for pieces in self._pieces:
            for piece in pieces:
                piece.linearize(at, linear)
        return linear

    def blocks(self, values: Any) -> Blocks:
        """The same, to be eliminated in blocks of keyframes."""
        at = self._read(values)

        def make(block: int) -> Any:
            linear = self._compiled_in[block].linearize(values)
            for pieces in self._pieces:
                for piece in pieces:
                    if piece.block == block:
                        piece.linearize(at, linear)
            return linear

        return Blocks(self._own, make, self._orders)

    def _read(self, values: Any) -> _Point:
        rows = gtsam.utilities.extractPose3(values)
        poses = np.zeros((len(rows), 4, 4))
        poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:], 1.0
        vectors = np.array([values.atVector(key) for key in self._vectors.tolist()]).reshape(-1, 6)
        return _Point(self._poses, poses, self._vectors, vectors)


def cut(first: Ints, factors: Sequence[Ints]) -> tuple[list[Ints], Ints]:
    """In which block each factor is, and in which each variable is eliminated: that of its last factor.

    Args:
        first: (V,) block of each variable, -1 for those that may be in any: they begin with their first factor.
        factors: groups of n factors, (n, a) their variables among the V.

    Returns:
        For each group (n,), and (V,).
    """
    never = np.iinfo(np.int64).max
    begins = np.where(first < 0, never, first)
    for variables in factors:
        block = first[variables].max(axis=1, initial=-1)
        np.minimum.at(begins, variables[block >= 0], block[block >= 0, None])
    begins = np.where(first >= 0, first, np.where(begins == never, 0, begins))
    of_factors = [begins[variables].max(axis=1, initial=0) for variables in factors]
    last = begins.copy()
    for variables, block in zip(factors, of_factors, strict=True):
        np.maximum.at(last, variables, block[:, None])
    return of_factors, last


def _blocks_of(keyframes: Ints, least: int) -> Ints:
    """Block of each of some keyframes, which has so many or more; -1 for what is of none."""
    timed = keyframes >= 0
    if not timed.any():
        return np.full(len(keyframes), -1)
    begin = keyframes[timed].min()
    n = int(keyframes.max() - begin) + 1
    return np.where(timed, (keyframes - begin) * max(n // least, 1) // n, -1)


def padded(keys: Sequence[tuple[int, ...]]) -> Ints:
    """(n, a) keys of n factors, the first repeated where there are fewer than a."""
    most = max((len(own) for own in keys), default=1)
    return np.array([own + own[:1] * (most - len(own)) for own in keys], dtype=np.int64).reshape(-1, most)


def _split(compiled: Any, blocks: Ints, n: int) -> list[Any]:
    """The factors of each of n blocks."""
    out = [gtsam.NonlinearFactorGraph() for _ in range(n)]
    for i, block in enumerate(blocks.tolist()):
        out[block].add(compiled.at(i))
    return out


def _runs(blocks: Ints) -> Iterator[tuple[slice, int]]:
    """Where consecutive factors are in one block, and in which."""
    ends = np.flatnonzero(np.diff(blocks, prepend=-1, append=-1))
    for begin, end in pairwise(ends.tolist()):
        yield slice(begin, end), int(blocks[begin])


def _is_pose(values: Any, key: int) -> bool:
    """GTSAM has no way to ask for a value's type but to try."""
    try:
        values.atPose3(key)
    except RuntimeError:
        return False
    return True
