"""Many factors of one form, evaluated in one call and handed to GTSAM's elimination as what they are at given values.

A Python factor inside a graph costs some hundred microseconds a linearisation, most of it calls on small arrays, and
GTSAM's own optimisers copy all of Values for each call besides. Here a form's residuals and Jacobians come from one
call over arrays (`factors.terms`). GTSAM gets them as JacobianFactors, beside what its compiled factors linearise to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.custom import FactorValueError
from factors.terms import Terms

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Batch:
    """n factors of one kind and form."""

    kind: str
    names: tuple[str, ...]
    """(n,) what errors and tables call them"""
    keys: Ints
    """(n, a)"""
    terms: Terms
    """of batch shape (n,)"""


class Problem:
    """What the solver minimises: `error` and `linearize` are those of a gtsam.NonlinearFactorGraph of the same factors.

    Args:
        compiled: gtsam.NonlinearFactorGraph of all factors that aren't in batches.
        batches: the others.
        values: gtsam.Values that holds all variables, poses and 6-vectors; what is evaluated later has the same keys.
    """

    def __init__(self, compiled: Any, batches: Sequence[Batch], values: Any) -> None:
        self._compiled = compiled
        self._batches = tuple(batches)
        keys = list(values.keys())
        is_pose = np.array([_is_pose(values, key) for key in keys], dtype=bool)
        at = np.array(keys, dtype=np.int64)
        # gtsam.Values is ordered by key, and so are the poses taken out of it
        poses = at[is_pose]
        self._vectors = at[~is_pose].tolist()
        self._places = [[_place(column, poses, at[~is_pose]) for column in batch.keys.T] for batch in self._batches]

    def error(self, values: Any) -> float:
        """Sum of all factors' errors, nats but for constants."""
        return float(self._compiled.error(values) + sum(errors.sum() for errors in self.batch_errors(values)))

    def batch_errors(self, values: Any) -> list[Array]:
        """Each batch's errors (n,)."""
        return [0.5 * (r**2).sum(axis=-1) for r, _ in self._linearised(values)]

    def linearize(self, values: Any) -> Any:
        """A gtsam.GaussianFactorGraph, one factor a factor."""
        linear = self._compiled.linearize(values)
        for batch, (r, jacobians) in zip(self._batches, self._linearised(values), strict=True):
            noise = gtsam.noiseModel.Unit.Create(batch.terms.rows)
            columns: list[Any] = []
            for keys, J in zip(batch.keys.T, jacobians, strict=True):
                columns += [keys.tolist(), J]
            for factor in zip(*columns, -r, strict=True):
                linear.add(*factor, noise)
        return linear

    def _linearised(self, values: Any) -> Iterator[tuple[Array, tuple[Array, ...]]]:
        """Batch by batch: all Jacobians at once are as much again as the graph that is made of them."""
        rows = gtsam.utilities.extractPose3(values)
        poses = np.zeros((len(rows), 4, 4))
        poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:], 1.0
        vectors = np.array([values.atVector(key) for key in self._vectors]).reshape(-1, 6)
        for batch, places in zip(self._batches, self._places, strict=True):
            arrays = [(poses if among_poses else vectors)[at] for among_poses, at in places]
            yield _checked(batch, *batch.terms.linearised(arrays))


def _is_pose(values: Any, key: int) -> bool:
    """GTSAM has no way to ask for a value's type but to try."""
    try:
        values.atPose3(key)
    except RuntimeError:
        return False
    return True


def _place(column: Ints, poses: Ints, vectors: Ints) -> tuple[bool, Ints]:
    """Where a batch's keys (n,) are among the poses, or else among the vectors."""
    among_poses = bool(np.isin(column, poses).all())
    keys = poses if among_poses else vectors
    return among_poses, np.searchsorted(keys, column)


def _checked(batch: Batch, r: Array, jacobians: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
    finite = np.isfinite(r).all(axis=-1)
    for J in jacobians:
        finite &= np.isfinite(J).all(axis=(-2, -1))
    if not finite.all():
        name = batch.names[int(np.argmin(finite))]
        raise FactorValueError(name, "residual or Jacobian", "has a value that isn't finite")
    return r, jacobians
