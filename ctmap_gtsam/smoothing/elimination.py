"""A linear system along time, eliminated block by block: of a long run no more is held at once than a block takes.

A block's variables are those whose last factor is in it. Eliminated, they leave one dense Gaussian on those of their
neighbours that go on, the separator, and that is all that the next block is handed. On the way back a block is made and
eliminated once more: what GTSAM holds for a block is some hundred times the separator's Gaussian, and making it again
costs less than looking at one image. All is exact: the same normal equations, in another order of elimination.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

LEVER_M = 0.1
"""how far from an object's centre its surface is, more or less: what a turn of a radian moves"""


@dataclass(frozen=True)
class Blocks:
    """A linear system over variables of 6 numbers, in blocks."""

    own: Sequence[NDArray[np.int64]]
    """keys of each block, ascending: those that no factor of a later block has"""
    make: Callable[[int], Any] = field(repr=False)
    """block -> gtsam.GaussianFactorGraph of its factors, whose variables are its own or later blocks'"""
    orders: list[Any] = field(default_factory=list, repr=False)
    """the gtsam.Ordering of the last block, once found: it hangs on the factors' variables alone"""

    @cached_property
    def last(self) -> Any:
        """gtsam.GaussianFactorGraph of the last block's factors: where one block is all, it is made once."""
        return self.make(len(self.own) - 1)

    def ordering(self, linear: Any) -> Any:
        """In which order the last block is eliminated (gtsam.Ordering), by its gtsam.GaussianFactorGraph."""
        if not self.orders:
            self.orders.append(gtsam.Ordering.ColamdGaussianFactorGraph(linear))
        return self.orders[0]

    def graph(self, block: int, before: Any) -> Any:
        """gtsam.GaussianFactorGraph of a block's factors and of the message that it is handed."""
        if block < len(self.own) - 1:
            linear = self.make(block)
        else:
            linear = gtsam.GaussianFactorGraph()
            linear.push_back(self.last)
        if before is not None:
            linear.push_back(before)
        return linear

    def error(self, step: Any) -> float:
        """Of a step (gtsam.VectorValues), nats but for constants."""
        return float(sum(self.make(block).error(step) for block in range(len(self.own) - 1)) + self.last.error(step))

    def step(self, damping: float) -> Any:
        """The step (gtsam.VectorValues) that is damped so much; None where the system is singular."""
        try:
            return self._step(damping)
        except RuntimeError:
            return None

    def _step(self, damping: float) -> Any:
        messages = self.messages(damping)
        linear = self.graph(len(messages) - 1, messages.pop())
        step = _damped(linear, self.own[-1], damping).optimize(self.ordering(linear))
        del linear
        while messages:
            self._solve_back(len(messages) - 1, messages.pop(), damping, step)
        return step

    def _solve_back(self, block: int, message: Any, damping: float, step: Any) -> None:
        """Add a block's part to a step that holds all that comes after it."""
        linear = _damped(self.graph(block, message), self.own[block], damping)
        net, _ = linear.eliminatePartialSequential(self.own[block].tolist())
        for i in reversed(range(net.size())):
            step.insert(net.at(i).solve(step))

    def messages(self, damping: float = 0.0) -> list[Any]:
        """What each block is handed by those before it (gtsam.HessianFactor); None = nothing."""
        out = [None]
        for block, keys in enumerate(self.own[:-1]):
            linear = _damped(self.graph(block, out[-1]), keys, damping)
            out.append(_as_one(linear.eliminatePartialMultifrontal(keys.tolist())[1]))
        return out


def _as_one(linear: Any) -> Any:
    """The factors of a gtsam.GaussianFactorGraph as one gtsam.HessianFactor; None where they concern nothing."""
    return gtsam.HessianFactor(linear) if len(linear.keyVector()) else None


def _damped(linear: Any, keys: NDArray[np.int64], damping: float) -> Any:
    """Levenberg's damping on some variables, in a unit in which a radian weighs as much as `LEVER_M` metres."""
    if damping > 0.0:
        scale = np.sqrt(damping) * np.repeat([1.0, 1.0 / LEVER_M], 3)
        for key in keys.tolist():
            linear.add(key, np.diag(scale), np.zeros(6), gtsam.noiseModel.Unit.Create(6))
    return linear
