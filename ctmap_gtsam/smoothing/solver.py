"""Levenberg-Marquardt over GTSAM's linearisation and elimination.

GTSAM's own optimisers copy all of Values for every call of a Python factor; `graph.linearize(values)` on Values that
Python owns does not. So the loop is ours, and linearisation, elimination and marginals are GTSAM's. Levenberg's
damping (1944); undamped while that works. Steps are those of `elimination.Blocks`: of a long run no more is held linear
than some keyframes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ctmap_gtsam.smoothing.batched import Problem
from ctmap_gtsam.smoothing.elimination import Blocks

_FIRST, _GROWTH, _LAST = 1e-2, 100.0, 1e14
_MORE = 10.0  # so much more than it fell by may a converged problem's linearisation promise

End = Literal["converged", "stalled", "cap"]


@dataclass(frozen=True)
class Solution:
    """Where the loop ended, and how."""

    values: Any
    """gtsam.Values"""
    energy: float
    """graph.error at the values"""
    end: End
    """converged: the energy fell by less than the tolerance, and the linearisation promises no more; stalled: any
    damping raises it; cap: out of iterations"""
    trace: tuple[float, ...]
    """energy at the start and after every accepted step"""


def optimise(graph: Any, values: Any, *, max_iterations: int, tolerance: float) -> Solution:
    """Minimise graph.error from `values`.

    Args:
        graph: gtsam.NonlinearFactorGraph over poses and 6-vectors, or a `batched.Problem`, which is faster.
        values: gtsam.Values, not changed.
        max_iterations: accepted steps at most.
        tolerance: relative fall of the energy at which it is converged.
    """
    problem = graph if isinstance(graph, Problem) else Problem(graph, (), values)
    energy = problem.error(values)
    trace = [energy]
    damping = 0.0
    for _ in range(max_iterations):
        linear = problem.blocks(values)
        moved = None
        while damping < _LAST:
            step = linear.step(damping)
            moved = None if step is None else values.retract(step)
            after = np.inf if moved is None else problem.error(moved)
            if np.isfinite(after) and after <= energy:
                break
            moved = None
            damping = max(damping * _GROWTH, _FIRST)
        if moved is None:
            return Solution(values, energy, "stalled", tuple(trace))
        little = tolerance * max(after, 1.0)
        fell = energy - after
        trace.append(after)
        if fell <= little:
            # a step that is damped enough falls by little anywhere: what would a full one do?
            full = step if damping <= _FIRST else _full_step(linear)
            if full is not None and energy - linear.error(full) <= _MORE * little:
                return Solution(moved, after, "converged", tuple(trace))
        values, energy = moved, after
        del linear, step, moved  # or they are held while the next ones are made
        if fell <= little and damping <= _FIRST:
            damping = max(damping * _GROWTH, _FIRST)  # the linearisation is far off: shorter steps
        else:
            damping = 0.0 if damping <= _FIRST else damping / _GROWTH
    return Solution(values, energy, "cap", tuple(trace))


def _full_step(linear: Blocks) -> Any:
    """The step with the least damping that the system can be solved with."""
    undamped = linear.step(0.0)
    return undamped if undamped is not None else linear.step(_FIRST)
