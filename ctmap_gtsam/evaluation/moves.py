"""Whether a method knows what was moved while nobody looked, and what was not.

A period is a true object and either a visit in which it is visible, from the first such frame to the last, or the time
between two such visits. In each period the object was moved or it stayed. An object of the map says so of its gaps
(`Estimate.moves`); a gap belongs to the period that its two keyframes lie in, or lie around. A move is found where the
object that matches the true one puts P(moved) above 1/2 on a gap of the period; claimed in a period without one, it is
false. Without a match, nothing is claimed.

What was moved is said by the truth's list of moves; where there is none at all, objects that are further than MOVED_M
(MSSD, so turns about an axis of symmetry are none) from where they were in the visit before have been moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation import pose
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames
from ctmap_gtsam.evaluation.pose import Shape
from ctmap_gtsam.evaluation.statistics import log_score, mean
from sequences.types import Frame, Run, TrueObject, Truth

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

MOVES = (
    "moves_recall",
    "moves_recall_seen",
    "nudges_recall",
    "false_moves",
    "false_moves_share",
    "moves_time_coverage",
    "moves_log_score",
)
"""How many moves between visits were found, of all and of those that can be seen, since no alike thing stands in their
old place afterwards; how many within visits; in how many periods without a move one was claimed, and what share of them
that is; how many of the moves found, with known time, happened in the interval that is claimed; -log P of what
happened, moved or not, over all periods, nats"""

MOVED_M = 0.02
"""A distance that isn't the truth's own inaccuracy"""


@dataclass(frozen=True)
class Periods:
    """True objects in periods (n,), and what a method says of them."""

    moved: Bools
    """(n,) what happened"""
    between: Bools
    """(n,) between two visits, not within one"""
    probability: Array
    """(n,) P(moved), 0 where the method says nothing"""
    exchanged: Bools
    """(n,) whether alike things took each other's places, so that nobody can see it"""
    in_interval: Array
    """(n,) whether the time of the move lies in the interval claimed: 0 or 1; NaN where either is unknown"""


@dataclass(frozen=True)
class Period:
    """One true object in one period, and what happened to it."""

    object: int
    """row of the truth"""
    frames: tuple[int, int]
    """in which it was seen at the start and at the end"""
    times_ns: tuple[int, int]
    """of these frames"""
    between: bool
    """two visits, not within one"""
    moved: bool
    exchanged: bool
    """whether it moved to where one of its class was, and that one to where it was"""
    moved_ns: tuple[int, ...]
    """when, where the truth says"""


def true_periods(run: Run, truth: Truth, objects: ObjectFrames, shapes: dict[int, Shape]) -> list[Period]:
    """All periods of a run's true objects."""
    out = []
    for n, thing in enumerate(truth.objects):
        for first, last, between in _stretches(run, objects.visible[n]):
            times = first.time_ns, last.time_ns
            when = tuple(
                m.time_ns for m in truth.moves if m.inst_id == thing.inst_id and times[0] < m.time_ns <= times[1]
            )
            frames = first.index, last.index
            moved = bool(when) if truth.moves else between and _displaced(thing, frames, shapes)
            exchanged = moved and between and _exchanged(truth, n, frames, shapes)
            out.append(Period(n, frames, times, between, moved, exchanged, when))
    return out


def periods(
    run: Run, method: MethodMap, truth: Truth, objects: ObjectFrames, matching: Matching, shapes: dict[int, Shape]
) -> Periods:
    """What a method says of all periods of a run."""
    happened = true_periods(run, truth, objects, shapes)
    said = [_claim(method.estimate, int(matching.row[period.object]), period) for period in happened]
    covered = [
        float(any(low <= t <= high for t in period.moved_ns)) if period.moved_ns and p > 0.0 else np.nan
        for period, (p, (low, high)) in zip(happened, said, strict=True)
    ]
    return Periods(
        moved=np.array([period.moved for period in happened], dtype=np.bool_),
        between=np.array([period.between for period in happened], dtype=np.bool_),
        exchanged=np.array([period.exchanged for period in happened], dtype=np.bool_),
        probability=np.array([p for p, _ in said], dtype=np.float64),
        in_interval=np.array(covered, dtype=np.float64),
    )


def move_metrics(found: Periods) -> dict[str, float | None]:
    """MOVES over periods."""
    claimed = found.probability > 0.5
    stayed = claimed[~found.moved]
    timed = claimed & found.moved & np.isfinite(found.in_interval)
    return {
        "moves_recall": mean(claimed[found.moved & found.between]),
        "moves_recall_seen": mean(claimed[found.moved & found.between & ~found.exchanged]),
        "nudges_recall": mean(claimed[found.moved & ~found.between]),
        "false_moves": int(stayed.sum()),
        "false_moves_share": mean(stayed),
        "moves_time_coverage": mean(found.in_interval[timed]),
        "moves_log_score": log_score(np.where(found.moved, found.probability, 1.0 - found.probability)),
    }


def _stretches(run: Run, visible: Bools) -> Iterator[tuple[Frame, Frame, bool]]:
    """First and last frame of the periods of one true object, visible in frames (F,); whether between two visits."""
    last = None
    for visit in run.visits:
        seen = [frame for frame in visit.frames if visible[frame.index]]
        if seen:
            if last is not None:
                yield last, seen[0], True
            last = seen[-1]
            if len(seen) > 1:
                yield seen[0], last, False


def _displaced(thing: TrueObject, frames: tuple[int, int], shapes: dict[int, Shape]) -> bool:
    before, after = (_pose(thing, f) for f in frames)
    return before is not None and after is not None and _apart(thing, before, after, shapes)


def _exchanged(truth: Truth, n: int, frames: tuple[int, int], shapes: dict[int, Shape]) -> bool:
    """Whether another of its class stands where it stood, and stood where it stands."""
    own = truth.objects[n]
    alike = [other for k, other in enumerate(truth.objects) if k != n and other.obj_id == own.obj_id]

    def met(mine: int, theirs: int) -> bool:
        here, there = _pose(own, mine), [_pose(other, theirs) for other in alike]
        return here is not None and any(T is not None and not _apart(own, here, T, shapes) for T in there)

    return met(*frames) and met(*frames[::-1])


def _pose(thing: TrueObject, frame: int) -> Array | None:
    """(4, 4) in a frame; None where it isn't there."""
    row = int(np.searchsorted(thing.frames, frame))
    return thing.T_world_object[row] if row < len(thing.frames) and thing.frames[row] == frame else None


def _apart(thing: TrueObject, before: Array, after: Array, shapes: dict[int, Shape]) -> bool:
    return float(pose.mssd(shapes[thing.obj_id], after, before)) > MOVED_M


def _claim(estimate: Estimate, row: int, period: Period) -> tuple[float, tuple[int, int]]:
    """The largest P(moved) of an object's gaps in a period, 0 without any, and the interval claimed with it."""
    moves = estimate.moves
    before, after = (estimate.keyframe_frame[moves.gap[:, side]] for side in (0, 1))
    start, end = period.frames
    # not "within": a method may have seen the object a little earlier or later than it counts as visible
    overlaps = (before < end) & (after > start)
    visits = estimate.keyframe_visit[moves.gap]
    own = (moves.object == row) & overlaps & ((visits[:, 0] != visits[:, 1]) == period.between)
    if not own.any():
        return 0.0, (0, 0)
    best = np.flatnonzero(own)[int(np.argmax(moves.probability[own]))]
    low, high = (int(t) for t in moves.interval_ns[best])
    return float(moves.probability[best]), (low, high)
