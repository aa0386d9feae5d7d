"""Which objects are one.

Two of one class in one place are one thing. And what left one place and what came to another may be
the same thing, moved: an object that is gone from some keyframe on and one of the same class that was not there before
are joined by a global assignment of what vanished to what appeared.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import one_place_m
from ctmap_gtsam.smoothing.belief import Thing, judge
from ctmap_gtsam.smoothing.modes import Recording

_SAME_CLASS = 0.5  # least P(both are of one class) for a join


def merge_duplicates(things: Mapping[int, Thing], model: Model) -> dict[int, Thing]:
    """Of things of one class in one place, present at one time, the one with most evidence stays."""
    kept: list[Thing] = []
    for thing in sorted(things.values(), key=lambda t: (-t.log_evidence, t.object_id)):
        if not any(_same(other, thing, model) for other in kept):
            kept.append(thing)
    return {thing.object_id: thing for thing in sorted(kept, key=lambda t: t.object_id)}


def _same(a: Thing, b: Thing, model: Model) -> bool:
    if not (a.exists and b.exists) or a.best_class != b.best_class:
        return False
    shared = {k for k, p in zip(a.keyframes, a.presence, strict=True) if p > 0.5} & {
        k for k, p in zip(b.keyframes, b.presence, strict=True) if p > 0.5
    }
    if not shared:
        return False
    k = sorted(shared)[len(shared) // 2]
    T_a, T_b = a.pose_near(a.best_class, k), b.pose_near(b.best_class, k)
    if T_a is None or T_b is None:
        return False
    apart = np.linalg.norm(T_a[0, :3, 3] - T_b[0, :3, 3])
    return bool(apart < one_place_m(model.shapes[a.best_class], model.shapes[b.best_class]))


def join_moved(things: Mapping[int, Thing], recording: Recording, model: Model) -> dict[int, Thing]:
    """Join each object that vanished with the one that it reappeared as; the rest stays as it is."""
    joined = dict(things)
    vanished = [
        t for t in things.values() if t.exists and (last := _last_present(t)) is not None and last < t.keyframes[-1]
    ]
    appeared = [t for t in things.values() if t.exists and _first_present(t) is not None]
    if not vanished or not appeared:
        return joined
    score = np.array([[_match(a, b) for b in appeared] for a in vanished])
    pairs = [
        (vanished[row], appeared[column])
        for row, column in zip(*linear_sum_assignment(-score), strict=True)
        if score[row, column] >= _SAME_CLASS
    ]
    became: dict[int, int] = {}
    # in order of time, so that a chain of moves grows at its end
    for a, b in sorted(pairs, key=lambda pair: (_first_present(pair[1]) or 0, pair[1].object_id)):
        whole = became.get(a.object_id, a.object_id)
        joined[whole] = _joined(joined[whole], b, recording, model)
        del joined[b.object_id]
        became[b.object_id] = whole
    return joined


def _match(a: Thing, b: Thing) -> float:
    """P(a and b are of one class) where b begins after a has ended, else 0."""
    if a.object_id == b.object_id:
        return 0.0
    ended, begun = _last_present(a), _first_present(b)
    if ended is None or begun is None or begun <= ended:
        return 0.0
    return float(a.class_probability @ b.class_probability)


def _last_present(thing: Thing) -> int | None:
    there = [k for k, p in zip(thing.keyframes, thing.presence, strict=True) if p > 0.5]
    return there[-1] if there else None


def _first_present(thing: Thing) -> int | None:
    there = [k for k, p in zip(thing.keyframes, thing.presence, strict=True) if p > 0.5]
    return there[0] if there else None


def _joined(a: Thing, b: Thing, recording: Recording, model: Model) -> Thing:
    """One object: seen as a until it vanished, as b from there on."""
    begun = _first_present(b)
    assert begun is not None
    sightings = {k: s for k, s in a.sightings.items() if k < begun} | {
        k: s for k, s in b.sightings.items() if k >= begun
    }
    boxes = {k: d for k, d in a.boxes.items() if k < begun} | {k: d for k, d in b.boxes.items() if k >= begun}
    return judge(a.object_id, boxes, sightings, recording, model)
