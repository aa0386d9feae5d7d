"""Who was moved together: the instance level of the context (Equation 5), from how things stood in other visits.

That a pair stands as it did is no news where nobody touched it: that each of the two stayed is Equation 3's word, and
ten neighbours that nobody touched repeat it ten times. What the instance level says beyond it is of things that were
moved, and then of the partner that each was moved with: the mouse went with the keyboard, the lid with the pot.

So a pair counts that stands elsewhere than in another visit, both of it, and is held to how it stood in that one. Of
visits between which neither was moved one counts. And a thing has one partner at most, the one that by its last pose it
suits best: one fact for each thing, however many stood around it, and no circle of three. What it pays for is in
`factors.instance.among_log_ratio`: a thing that was moved and suits no one is charged for it.

Of the visit that is scored nothing is learned. Its poses, as they were believed before (at the keyframe before in the
filter, in the round before in the smoother), say who is whose partner, and no more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors.instance import (
    InstancePrior,
    InstanceRelation,
    among_log_ratio,
    instance_log_ratio,
    instance_relation,
)
from factors.symmetry import Symmetry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Stand:
    """How an object stood in a visit."""

    class_index: int
    T_world_centre: Array
    """(4, 4)"""


Stands = Mapping[int, Stand]
"""object -> how it stood in one visit"""


@dataclass(frozen=True, eq=False)
class Partner:
    """What an object was moved with, if with anything."""

    object_id: int
    """of the partner"""
    classes: tuple[int, int]
    """the object's class and the partner's, of which the relation is"""
    first: bool
    """whether the relation is from the object to the partner; else it is from the partner to the object"""
    relation: InstanceRelation
    candidates: int
    """how many neighbours of the object, or of the partner if those are more, were moved as well"""

    def log_ratio(self, own: Shape, T_own: Array, other: Shape, T_other: Array) -> Array:
        """log(phi_ins / phi_background) (...) nats of poses (..., 4, 4) of the classes that are known."""
        pair = [(T_own, own.symmetry), (T_other, other.symmetry)]
        (T_a, a), (T_b, b) = pair if self.first else pair[::-1]
        return among_log_ratio(instance_log_ratio(T_a, T_b, self.relation, a, b), self.candidates)

    def concerns(self, object_id: int, classes: tuple[int, int]) -> bool:
        """Whether the partner is this neighbour, and it and the object are of the classes that the relation is of."""
        return (object_id, classes) == (self.object_id, self.classes)

    @property
    def log_peak(self) -> float:
        """The greatest value of `log_ratio`."""
        return float(among_log_ratio(self.relation.log_peak, self.candidates))


Company = Mapping[int, Partner]
"""object -> its partner, of those that have one in some visit"""


def company(now: Stands, others: Sequence[Stands], up_world: Array | None, model: Model) -> dict[int, Partner]:
    """Who is whose partner in one visit.

    Args:
        now: what is believed of this visit, the classes that are most probable.
        others: what is known of other visits, in order of time.
        up_world: (3,); None = unknown, where no pair tells anything but what gravity does.
        model: potentials and shapes.
    """
    settings = model.config.context
    if not model.context or up_world is None or settings.relations.category_weight == 1.0:
        return {}
    away = {i: moved for i in sorted(now) if (moved := _moved_since(i, now[i], others, model))}
    pairs = []
    for i, j in combinations(away, 2):
        visits = _placements(i, j, sorted(away[i] & away[j]), others, model)
        if visits:
            pairs.append((i, j, visits))
    count = Counter(k for i, j, _ in pairs for k in (i, j))
    found = []
    for i, j, visits in pairs:
        symmetry = {k: model.shapes[now[k].class_index].symmetry for k in (i, j)}
        a, b = sorted((i, j), key=lambda k: (symmetry[k].free == 3, now[k].class_index, k))
        S_a, S_b = symmetry[a], symmetry[b]
        if S_a.free == 3:
            continue
        T_a, T_b = (np.stack([others[v][k].T_world_centre for v in visits]) for k in (a, b))
        relation = _learned(T_a.tobytes(), T_b.tobytes(), up_world.tobytes(), S_a, S_b, settings.instance)
        fits = instance_log_ratio(now[a].T_world_centre, now[b].T_world_centre, relation, S_a, S_b)
        found.append((float(fits), a, b, relation))
    out: dict[int, Partner] = {}
    for _, a, b, relation in sorted(found, key=lambda pair: (-pair[0], pair[1], pair[2])):
        if a not in out and b not in out:
            n = max(count[a], count[b])
            classes = now[a].class_index, now[b].class_index
            out[a] = Partner(b, classes, True, relation, n)
            out[b] = Partner(a, classes[::-1], False, relation, n)
    return out


def _moved_since(i: int, now: Stand, others: Sequence[Stands], model: Model) -> set[int]:
    """Positions of the visits in which an object that can be moved stood elsewhere, of the same class."""
    if not model.shapes[now.class_index].source.movable:
        return set()
    return {
        v
        for v, stands in enumerate(others)
        if i in stands and stands[i].class_index == now.class_index and _apart(stands[i], now, model)
    }


def _apart(a: Stand, b: Stand, model: Model) -> bool:
    apart = np.linalg.norm(a.T_world_centre[:3, 3] - b.T_world_centre[:3, 3])
    return bool(apart > model.config.context.moved_m)


def _placements(i: int, j: int, visits: Sequence[int], others: Sequence[Stands], model: Model) -> list[int]:
    """Of visits (positions, ascending) between which neither of a pair was moved the last."""
    kept: list[int] = []
    for v in visits:
        if kept and not any(_apart(others[kept[-1]][k], others[v][k], model) for k in (i, j)):
            kept.pop()
        kept.append(v)
    return kept


@lru_cache(maxsize=1024)
def _learned(T_a: bytes, T_b: bytes, up: bytes, S_a: Symmetry, S_b: Symmetry, prior: InstancePrior) -> InstanceRelation:
    """`instance_relation` of poses (n, 4, 4) in bytes: those of other visits stay the same for a whole visit."""
    A, B = (np.frombuffer(T, dtype=np.float64).reshape(-1, 4, 4) for T in (T_a, T_b))
    return instance_relation(A, B, S_a, S_b, np.frombuffer(up), prior)
