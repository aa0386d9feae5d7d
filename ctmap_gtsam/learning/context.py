"""The relations of Equation 5's category level from how things stand in a set of places.

A pair is a relative position. What is learned of pairs of one category, of two categories or of two classes is held to
how pairs of other categories stand in the same places, whatever that is like: rooms are no planes, things stand on
furniture. With h(d) the density of their distances ("strangers"), a related pair's is

    p(d) = h(d) [1 - w + w exp(-(d - m)^2 / 2 s^2) / B(m, s)],        B(m, s) = mean of exp(-(d - m)^2 / 2 s^2) over h

of which h cancels, so that it need not be known: the ratio is that of `factors.context`, with the area that gives
strangers their true mean, Z(m, s) / B(m, s). Pairs that stand as strangers do teach w = 0.

The posterior of (w, m, s) is on a grid. A priori there is no relation with probability 1/2, else w is what it would be
after `PRIOR_PAIRS` pairs that stood anywhere. A pair of categories or of classes has a relation of its own where that
explains its pairs better than what holds for it anyway, by more than the odds of `OWN` against it.

Pairs are not independent: n things have n - 1 relative positions, not n (n - 1) / 2, so each pair counts by the ratio;
and two things that both stood still since the visit before are no new pair.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logsumexp

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.learning.sources import Source, load_sources, same_place
from ctmap_gtsam.shapes import centre_of
from factors.context import CategoryRelations, Relation, plane_integral
from sequences import se3
from sequences.catalogue import Catalogue
from sequences.errors import InputError
from sequences.types import Run, Truth

Array = NDArray[np.float64]
Names = tuple[str, str]

LEVEL = 0.95
"""of the intervals that are stated"""
PRIOR_PAIRS = 4.0
"""as if so many pairs of the kind had stood anywhere"""
OWN = 0.05
"""prior probability that a pair of categories, or of classes, has a relation of its own"""
LEAST = 2.0
"""independent pairs below which no relation of their own is thought of"""
SURE_CLASS = 0.9
"""objects of an estimate whose class is less probable are left out"""

_STRANGERS = 4.0  # pairs spread over the default area that are joined to the strangers: few say little of h
_W = (np.arange(50) + 0.5) / 50  # strength
_M = np.round(np.linspace(0.0, 1.2, 13), 3)  # usual distance, metres
_S = np.round(np.geomspace(0.06, 0.8, 10), 3)  # its standard deviation, metres
_GRID_M, _GRID_S = (grid.ravel() for grid in np.meshgrid(_M, _S, indexing="ij"))
_PLANE = np.array([plane_integral(m, s) for m, s in zip(_GRID_M, _GRID_S, strict=True)])


@dataclass(frozen=True)
class Standing:
    """An object that stands somewhere in a visit."""

    obj_id: int
    T_world_object: Array
    """(4, 4)"""


@dataclass(frozen=True)
class Pair:
    """Two objects of one place, as they stood for a while."""

    place: int
    """which place"""
    obj_ids: tuple[int, int]
    distance_m: float
    """between their centres"""
    weight: float
    """how much of an independent observation it is"""


@dataclass(frozen=True)
class Learned:
    """What is known of one relation."""

    names: Names | None
    """classes or categories, ascending; None for all pairs of one category"""
    relation: Relation
    strength: tuple[float, float]
    """LEVEL of the posterior of the strength, as much on either side"""
    distance_m: tuple[float, float]
    """the same of the usual distance"""
    sigma_m: tuple[float, float]
    """the same of its standard deviation"""
    pairs: int
    independent: float
    """so many of them, each counted by its weight"""
    places: int
    log_evidence: float
    """of there being a relation against none, nats"""

    @property
    def related(self) -> float:
        """P(there is a relation)."""
        return float(expit(self.log_evidence))


def standings_of_truth(run: Run, truth: Truth) -> list[dict[int, Standing]]:
    """For each visit what stands in it at its end, by inst_id."""
    out = []
    for visit in run.visits:
        frames = [frame.index for frame in visit.frames]
        own = {o.inst_id: (o, np.flatnonzero(np.isin(o.frames, frames))) for o in truth.objects}
        out.append({i: Standing(o.obj_id, o.T_world_object[at[-1]]) for i, (o, at) in own.items() if len(at)})
    return out


def standings_of_estimate(estimate: Estimate) -> list[dict[int, Standing]]:
    """The same of an estimate's objects that exist and are sure of their class, by row.

    An estimate made with context has been drawn a little towards what it believed of relations.
    """
    out = []
    for visit in np.unique(estimate.keyframe_visit):
        k = int(np.flatnonzero(estimate.keyframe_visit == visit)[-1])
        sure = estimate.exists[:, k] & (estimate.class_probability[:, k].max(axis=-1) >= SURE_CLASS)
        rows = np.flatnonzero(sure)
        out.append({int(n): Standing(int(estimate.best_class[n, k]), estimate.pose[n, k]) for n in rows})
    return out


def pairs_of(place: int, visits: Sequence[Mapping[int, Standing]], catalogue: Catalogue) -> list[Pair]:
    """All pairs of a place's visits; two that both stood still since the visit before are the same pair still."""
    pairs, before = [], dict[int, Standing]()
    for standing in visits:
        still = {i for i, s in standing.items() if i in before and _untouched(before[i], s)}
        centres = {
            i: se3.transform(s.T_world_object, centre_of(catalogue[s.obj_id])[None])[0] for i, s in standing.items()
        }
        members: defaultdict[str, int] = defaultdict(int)
        for s in standing.values():
            members[catalogue[s.obj_id].category] += 1
        for i, j in combinations(sorted(standing), 2):
            if not (i in still and j in still):
                obj_ids = (standing[i].obj_id, standing[j].obj_id)
                weight = _independent(catalogue[obj_ids[0]].category, catalogue[obj_ids[1]].category, members)
                pairs.append(Pair(place, obj_ids, float(np.linalg.norm(centres[i] - centres[j])), weight))
        before = dict(standing)
    return pairs


def _untouched(before: Standing, after: Standing) -> bool:
    return before.obj_id == after.obj_id and same_place(before.T_world_object, after.T_world_object)


def _independent(a: str, b: str, members: Mapping[str, int]) -> float:
    """Relative positions that are independent, a pair: of n things n - 1, of n beside m n + m - 1."""
    n, m = members[a], members[b]
    return 2.0 / n if a == b else (n + m - 1.0) / (n * m)


def learn(pairs: Iterable[Pair], catalogue: Catalogue) -> tuple[Learned, ...]:
    """The relations of all pairs of one category, then those of single pairs of categories and classes that differ.

    Raises:
        InputError: there are no pairs of things of one category, or none of two.
    """
    table = _Table(list(pairs), catalogue)
    same = table.one_category & table.comparable
    if not same.any():
        raise InputError(
            "no place has two movable things of one category, and others to compare them with",
            field="category",
            remedy="learn from runs with more things, or give the classes their categories",
        )
    found = [table.fit(None, same)]
    own: dict[Names, Learned] = {}
    for level in (table.categories, table.classes):
        position = {names: k for k, names in enumerate(sorted(set(level)))}
        number = np.array([position[names] for names in level])
        for names, k in position.items():
            rows = number == k
            if table.weight[rows].sum() < LEAST:
                continue
            one = table.fit(names, rows)
            anyway = own.get(table.categories[int(np.flatnonzero(rows)[0])])
            if anyway is None and table.one_category[rows].all():
                anyway = found[0]
            if table.gain(one, anyway, rows) > np.log((1.0 - OWN) / OWN):
                own[names] = one
    return (*found, *own.values())


class _Table:
    """All pairs, and how strangers of the same kind stand: of two movable things, of a thing and furniture, ..."""

    def __init__(self, pairs: Sequence[Pair], catalogue: Catalogue) -> None:
        classes = [(catalogue[a], catalogue[b]) for a, b in (p.obj_ids for p in pairs)]
        self.categories = [_ascending(a.category, b.category) for a, b in classes]
        self.classes = [_ascending(a.name, b.name) for a, b in classes]
        self.one_category = np.array([a.category == b.category != "" for a, b in classes], dtype=bool)
        self.place = np.array([p.place for p in pairs])
        self.weight = np.array([p.weight for p in pairs])
        distance = np.array([p.distance_m for p in pairs])
        self.bell = _bell(distance[:, None], _GRID_M, _GRID_S)
        self.distance = distance
        self.kind = np.array([int(a.movable) + int(b.movable) for a, b in classes])
        self.comparable = np.isin(self.kind, self.kind[~self.one_category])

    def mean_bell(self, rows: NDArray[np.bool_]) -> Array:
        """B(m, s) (G,) of the strangers that pairs `rows` are held to, those pairs themselves left out."""
        strangers = ~self.one_category & ~rows & (self.kind == self.kind[rows][0])
        weight = self.weight * strangers
        planar = _PLANE / CategoryRelations().area_m2
        return (weight @ self.bell + _STRANGERS * planar) / (weight.sum() + _STRANGERS)

    def fit(self, names: Names | None, rows: NDArray[np.bool_]) -> Learned:
        """The posterior of one relation from pairs `rows`; of the commonest kind, if they are of several."""
        rows = self._of_one_kind(rows)
        places, independent = len(np.unique(self.place[rows])), float(self.weight[rows].sum())
        comparable, mean = bool(self.comparable[rows].all()), self.mean_bell(rows)
        log_likelihood = np.zeros((len(_W), len(_GRID_M)))
        # nothing to hold them to says nothing of them
        if comparable:
            ratio = self.bell[rows] / mean
            for k, w in enumerate(_W):
                log_likelihood[k] = self.weight[rows] @ np.log1p(w * (ratio - 1.0))
        log_prior = np.log(PRIOR_PAIRS + 1.0) + PRIOR_PAIRS * np.log1p(-_W) - np.log(len(_W) * len(_GRID_M))
        log_joint = log_likelihood + log_prior[:, None]
        log_evidence = float(logsumexp(log_joint)) if comparable else -np.inf
        related = float(expit(log_evidence))
        posterior = np.exp(log_joint - logsumexp(log_joint))
        best = int(np.argmax(posterior.sum(axis=0)))
        strength = related * float(posterior[:, best] @ _W) / float(posterior[:, best].sum())
        by_grid = posterior.sum(axis=0).reshape(len(_M), len(_S))
        m, s = float(_GRID_M[best]), float(_GRID_S[best])
        return Learned(
            names=names,
            relation=Relation(_rounded(strength), m, s, _rounded(_PLANE[best] / mean[best])),
            strength=_interval(np.concatenate([[0.0], _W]), [1.0 - related, *(related * posterior.sum(axis=1))]),
            distance_m=_interval(_M, by_grid.sum(axis=1)),
            sigma_m=_interval(_S, by_grid.sum(axis=0)),
            pairs=int(rows.sum()),
            independent=independent,
            places=places,
            log_evidence=log_evidence,
        )

    def gain(self, own: Learned, anyway: Learned | None, rows: NDArray[np.bool_]) -> float:
        """Nats by which a relation of their own explains pairs `rows` better than what holds for them anyway."""
        rows = self._of_one_kind(rows)
        relation = Relation(strength=0.0) if anyway is None else anyway.relation
        if not self.comparable[rows].all():
            # no evidence: what isn't known to be related isn't, and others' relation isn't theirs
            return float("inf") if relation.strength > 0.0 else float("-inf")
        bell = _bell(self.distance[rows], relation.distance_m, relation.sigma_m)
        ratio = 1.0 + relation.strength * (bell / relation.mean_bell(CategoryRelations().area_m2) - 1.0)
        alone = np.logaddexp(0.0, own.log_evidence) - np.log(2.0)  # either is as likely
        return float(alone - self.weight[rows] @ np.log(ratio))

    def _of_one_kind(self, rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return rows & (self.kind == np.bincount(self.kind[rows]).argmax())


def _ascending(a: str, b: str) -> Names:
    return (a, b) if a <= b else (b, a)


def _bell(distance: Array, m: Array | float, s: Array | float) -> Array:
    return np.asarray(np.exp(-0.5 * ((distance - m) / s) ** 2))


def _interval(values: Array, probability: Sequence[float] | Array) -> tuple[float, float]:
    cumulative = np.cumsum(probability) / np.sum(probability)
    low, high = (int(np.searchsorted(cumulative, q)) for q in (0.5 - LEVEL / 2, 0.5 + LEVEL / 2))
    return float(values[low]), float(values[min(high, len(values) - 1)])


def _rounded(value: float) -> float:
    """To three digits: the grids aren't finer."""
    return float(f"{value:.3g}")


def learn_from(runs: Sequence[Path], estimates: Sequence[Path] = ()) -> tuple[Learned, ...]:
    """The relations from runs on disk, each a place; the parameters and errors are those of `load_sources` and `learn`.

    Places of which nothing but the names of the folders differ count as often as they are given.
    """
    catalogue, sources = load_sources(runs, estimates)
    pairs = [pair for place, source in enumerate(sources) for pair in pairs_of(place, _standings(source), catalogue)]
    return learn(pairs, catalogue)


def _standings(source: Source) -> list[dict[int, Standing]]:
    if isinstance(source.known, Estimate):
        return standings_of_estimate(source.known)
    return standings_of_truth(source.run, source.known)


def relations_of(learned: Sequence[Learned]) -> CategoryRelations:
    """What was learned, as the model takes it; w1 is not learned."""
    same, *others = learned
    area = same.relation.area_m2 or CategoryRelations().area_m2
    pairs = tuple((*one.names, one.relation) for one in others if one.names is not None)
    return CategoryRelations(same_category=same.relation, pairs=pairs, area_m2=area)


def described(learned: Sequence[Learned]) -> str:
    """TOML for `--config`: the settings that were learned, and how well each is known."""
    relations = relations_of(learned)
    text = [
        "# written by `ctmap train context`; the intervals hold 95 % of the posterior",
        "[context.relations]",
        f"area_m2 = {relations.area_m2}",
        "pairs = [",
        *(line for one in learned[1:] for line in (f"  # {_known(one)}", f"  {_entry(one)},")),
        "]",
        "",
        "[context.relations.same_category]",
        f"# {_known(learned[0])}",
        *_lines(learned[0].relation),
    ]
    return "\n".join(text) + "\n"


def _known(one: Learned) -> str:
    if np.isneginf(one.log_evidence):
        return f"nothing of two categories to hold its {one.pairs} pairs to: no relation"
    ranges = (f"{name} {low:g} to {high:g}" for name, (low, high) in _intervals(one).items())
    return f"{', '.join(ranges)}; {one.pairs} pairs, as {one.independent:.1f}, in {one.places} places"


def _intervals(one: Learned) -> dict[str, tuple[float, float]]:
    return {"strength": one.strength, "distance_m": one.distance_m, "sigma_m": one.sigma_m}


def _lines(relation: Relation) -> list[str]:
    return [
        f"{f.name} = {getattr(relation, f.name)}" for f in fields(relation) if getattr(relation, f.name) is not None
    ]


def _entry(one: Learned) -> str:
    assert one.names is not None  # learned[0] alone has none
    a, b = (json.dumps(name, ensure_ascii=False) for name in one.names)
    return f"[{a}, {b}, {{ {', '.join(_lines(one.relation))} }}]"
