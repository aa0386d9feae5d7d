"""Which objects are one.

Two of one class in one place are one thing. And what left one place and what came to another may be
the same thing, moved: an object that is gone from some keyframe on and one of the same class that was not there before
are joined by a global assignment of what vanished to what appeared.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import one_place_m
from ctmap_gtsam.smoothing.belief import Thing, judge
from ctmap_gtsam.smoothing.modes import Recording

Array = NDArray[np.float64]

_SAME_CLASS = 0.5  # least P(both are of one class) for a join


def duplicates(things: Mapping[int, Thing], model: Model) -> dict[int, int]:
    """Of things of one class in one place, present at one time: object -> the one with most evidence there."""
    kept: list[Thing] = []
    out = {}
    for thing in sorted(things.values(), key=lambda t: (-t.log_evidence, t.object_id)):
        twin = next((other for other in kept if _same(other, thing, model)), None)
        if twin is None:
            kept.append(thing)
        else:
            out[thing.object_id] = twin.object_id
    return out


def merge_duplicates(things: Mapping[int, Thing], recording: Recording, model: Model) -> dict[int, Thing]:
    """Things without duplicates: one of two that are one, and it is the one with more evidence that stays.

    But what either was before, elsewhere, is kept, and the other with it: it is for `join_moved` to say whose past that
    is.
    """
    left = dict(sorted(things.items()))
    for i, j in duplicates(things, model).items():
        for own, twin in ((i, j), (j, i)):
            part = _elsewhere_before(things[own], things[twin], recording, model)
            if part is not None:
                left[own] = part
                break
        else:
            del left[i]
    return left


def _elsewhere_before(thing: Thing, twin: Thing, recording: Recording, model: Model) -> Thing | None:
    """The life of a thing in another place, before it came to be where its twin is; None where it had none."""
    met = min(_shared(thing, twin))
    boxes = {k: d for k, d in thing.boxes.items() if k < met}
    if not boxes:
        return None
    before, after = thing.pose_near(thing.best_class, max(boxes)), twin.pose_near(twin.best_class, met)
    if before is None or after is None or _in_one_place(before[0], after[0], thing, twin, model):
        return None
    own = judge(thing.object_id, boxes, {k: s for k, s in thing.sightings.items() if k < met}, recording, model)
    return own if own.exists else None


def _same(a: Thing, b: Thing, model: Model) -> bool:
    if not (a.exists and b.exists) or a.best_class != b.best_class:
        return False
    shared = _shared(a, b)
    if not shared:
        return False
    k = shared[len(shared) // 2]
    T_a, T_b = a.pose_near(a.best_class, k), b.pose_near(b.best_class, k)
    return T_a is not None and T_b is not None and _in_one_place(T_a[0], T_b[0], a, b, model)


def _shared(a: Thing, b: Thing) -> list[int]:
    """Keyframes at which both are there, ascending."""
    there = ({k for k, p in zip(t.keyframes, t.presence, strict=True) if p > 0.5} for t in (a, b))
    return sorted(set.intersection(*there))


def _in_one_place(T_a: Array, T_b: Array, a: Thing, b: Thing, model: Model) -> bool:
    apart = np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])
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
