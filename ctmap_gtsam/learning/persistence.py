"""mu of Equation 3 from moves that nobody saw happen.

Between two visits, dt apart, an object stayed with S(dt) = r1 + r2 exp(-dt / mu) or was moved at some time in between:
the move is censored to the interval. A gap says of mu

    p(gap | mu) = S(dt) p(what was seen | stayed) + (1 - S(dt)) p(what was seen | moved)

of which the truth knows one term to be zero, and an estimate their ratio: its P(moved), freed of the mu that it was
made with. The posterior is on a grid in log mu, flat between MIN_S and MAX_S; things of one category, or of one class,
share their mu. (Toris and Chernova, Temporal persistence modeling for object search, ICRA 2017, learn it so, too.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.learning.sources import Source, load_sources, same_place
from factors.persistence import stay_probability
from sequences.catalogue import Catalogue, ObjectClass
from sequences.errors import InputError
from sequences.types import Run, TrueObject, Truth
from sequences.writing import class_json

Array = NDArray[np.float64]

MIN_S, MAX_S = 10.0, 10 * 365.25 * 86400.0
"""between which mu is sought: ten seconds and ten years"""
LEVEL = 0.95
"""of the interval that is stated"""

_GRID = 2000
_SUREST = 1e-9  # no estimate is believed to be surer of a move, or of a stay


@dataclass(frozen=True)
class Gap:
    """An object that nobody looked at for a while."""

    obj_id: int
    """its class"""
    dt_s: float
    log_odds: float
    """log p(what was seen | moved) / p(what was seen | stayed), nats; infinite where the truth knows"""


@dataclass(frozen=True)
class Persistence:
    """What is known of mu of one or several classes that share it."""

    obj_ids: tuple[int, ...]
    mu_s: float
    """the posterior's median, seconds"""
    interval_s: tuple[float, float]
    """LEVEL of the posterior, as much on either side"""
    gaps: int
    moves: float
    """of these, expected by the posterior median"""


def gaps_of_truth(run: Run, truth: Truth) -> list[Gap]:
    """One gap for each movable object and pair of successive visits that the object was there at the beginning of.

    It was moved where scene_gt_moves.json says so, or where it isn't in its place any more when the next visit begins.
    """
    gaps = []
    for k, (before, after) in enumerate(zip(run.visits, run.visits[1:], strict=False)):
        if not before.frames or not after.frames:
            continue
        last, first = before.frames[-1], after.frames[0]
        taken = {m.inst_id for m in truth.moves if m.visit == k + 1 and m.kind in ("moved", "vanished")}
        # what happens in a visit is seen, or could be
        taken -= {m.inst_id for m in truth.moves if m.visit == k + 1 and m.time_ns >= first.time_ns}
        for thing in truth.objects:
            if run.catalogue[thing.obj_id].movable and last.index in thing.frames:
                moved = thing.inst_id in taken or _elsewhere(thing, last.index, first.index)
                odds = np.inf if moved else -np.inf
                gaps.append(Gap(thing.obj_id, (first.time_ns - last.time_ns) * 1e-9, odds))
    return gaps


def _elsewhere(thing: TrueObject, before: int, after: int) -> bool:
    """Whether an object that was there at one frame has another pose at a later one, or none."""
    a, b = (np.flatnonzero(thing.frames == f) for f in (before, after))
    if not len(b):
        return True
    return not same_place(thing.T_world_object[a[0]], thing.T_world_object[b[0]])


def gaps_of_estimate(run: Run, estimate: Estimate) -> list[Gap]:
    """The gaps of an estimate's objects that exist, freed of the prior that they were judged with.

    Raises:
        InputError: the estimate says nothing of the prior that it was made with.
    """
    try:
        r1 = float(estimate.meta["config"]["prediction"]["stay_limit"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{error!s} is missing", field="meta.config.prediction.stay_limit", remedy="make the estimate again"
        ) from None
    gaps = []
    moves = estimate.moves
    for row, (k, _), p, times in zip(moves.object, moves.gap, moves.probability, moves.interval_ns, strict=True):
        dt_s = float(times[1] - times[0]) * 1e-9
        known = run.catalogue[int(estimate.class_ids[np.argmax(estimate.class_probability[row, k])])]
        if not estimate.exists[row, k] or not known.movable or dt_s <= 0.0:
            continue
        moved = 1.0 - float(stay_probability(dt_s, known.persistence_s, r1, 1.0 - r1))
        surest = float(np.clip(p, _SUREST, 1.0 - _SUREST))
        gaps.append(Gap(known.obj_id, dt_s, float(logit(surest) - logit(moved))))
    return gaps


def learn(
    gaps: Iterable[Gap], catalogue: Catalogue, *, by: Callable[[ObjectClass], object], r1: float = 0.5
) -> tuple[Persistence, ...]:
    """mu of all movable classes of which there are gaps.

    Args:
        gaps: of any number of runs with one catalogue.
        catalogue: the classes.
        by: classes for which it gives the same share their mu.
        r1: what stays in the end, of Equation 3; r2 is the rest.

    Returns:
        One for each group, in the order of their first class.
    """
    shared: dict[object, list[int]] = {}
    for c in catalogue.classes:
        if c.movable:
            shared.setdefault(by(c), []).append(c.obj_id)
    gaps = list(gaps)
    found = []
    for obj_ids in shared.values():
        own = [gap for gap in gaps if gap.obj_id in obj_ids]
        if own:
            found.append(_posterior(own, tuple(obj_ids), r1))
    return tuple(found)


def _posterior(gaps: Sequence[Gap], obj_ids: tuple[int, ...], r1: float) -> Persistence:
    mu = np.geomspace(MIN_S, MAX_S, _GRID)
    dt, odds = np.array([g.dt_s for g in gaps]), np.array([g.log_odds for g in gaps])
    stay = stay_probability(dt[:, None], mu, r1, 1.0 - r1)
    with np.errstate(divide="ignore"):
        log_stay, log_move = np.log(stay), np.log1p(-stay)
    # the larger of the two terms is taken out, so that infinite odds leave one of them alone
    log_stay, log_move = log_stay - np.maximum(odds, 0.0)[:, None], log_move + np.minimum(odds, 0.0)[:, None]
    log_posterior = np.logaddexp(log_stay, log_move).sum(axis=0)
    cumulative = np.cumsum(np.exp(log_posterior - log_posterior.max()))
    cumulative /= cumulative[-1]
    low, middle, high = (float(np.interp(q, cumulative, mu)) for q in (0.5 - LEVEL / 2, 0.5, 0.5 + LEVEL / 2))
    k = int(np.searchsorted(mu, middle).clip(0, _GRID - 1))
    moved = np.exp(log_move[:, k] - np.logaddexp(log_stay[:, k], log_move[:, k]))
    return Persistence(obj_ids, middle, (low, high), len(gaps), float(moved.sum()))


def learn_from(
    runs: Sequence[Path], estimates: Sequence[Path] = (), *, by: str = "category"
) -> tuple[Catalogue, tuple[Persistence, ...]]:
    """mu from runs on disk.

    Args:
        runs: folders; an obj_id is the same class in all of them.
        estimates: files of `Estimate.save`, each used in place of the truth of the run that it is of.
        by: "category" or "class": whose classes share their mu.

    Returns:
        All classes of the runs, and what was learned.

    Raises:
        InputError: a file is broken; a run has neither truth nor estimate, or calls a class something else than another
            run does; an estimate is of none of the runs; there is no gap at all.
    """
    catalogue, sources = load_sources(runs, estimates)
    gaps = [gap for source in sources for gap in _gaps(source)]
    learned = learn(gaps, catalogue, by=lambda c: c.category if by == "category" else c.obj_id)
    if not learned:
        raise InputError(
            "nothing movable is seen in two visits", file=runs[0], field="visits", remedy="give runs of several visits"
        )
    return catalogue, learned


def _gaps(source: Source) -> list[Gap]:
    if isinstance(source.known, Estimate):
        return gaps_of_estimate(source.run, source.known)
    return gaps_of_truth(source.run, source.known)


def described(catalogue: Catalogue, learned: Sequence[Persistence]) -> Mapping[str, Any]:
    """The content of a catalogue.json in which what was learned stands; the other classes are as they were."""
    about = {str(c.obj_id): class_json(c) for c in catalogue.classes}
    for one in learned:
        for obj_id in one.obj_ids:
            about[str(obj_id)] |= {
                "persistence_s": one.mu_s,
                "persistence_interval_s": list(one.interval_s),
                "persistence_gaps": one.gaps,
            }
    return about
