"""CT-Map as a smoother: rounds of modes, trellis and graph until the map settles; each frame sees the whole run.

A round is a pure step from one map to the next: gather modes on the images, starting from the map; solve each object's
trellis; solve one graph of all poses; and the smoothed map is what the next round starts from.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.company import Company, Partner
from ctmap_gtsam.frontend.proposer import PoseModes, Proposer
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.runtime.checkpoint import Checkpoint
from ctmap_gtsam.runtime.settings import to_dict
from ctmap_gtsam.runtime.sources import code
from ctmap_gtsam.smoothing.association import Expected, associate
from ctmap_gtsam.smoothing.belief import Thing, judge
from ctmap_gtsam.smoothing.discrete import Posterior, Stage
from ctmap_gtsam.smoothing.graph import Contributions, Smoothed, SmootherGraph, build, smooth
from ctmap_gtsam.smoothing.identity import join_moved, merge_duplicates
from ctmap_gtsam.smoothing.modes import Boxes, Recording, Sighting, Wanted, gather, record
from ctmap_gtsam.smoothing.rounds import (
    camera_of,
    company_of,
    expected_of,
    neighbours_of,
    objects_of,
    visits_of,
    wanted_of,
)
from ctmap_gtsam.smoothing.seeding import Seed, careful, seeds
from ctmap_gtsam.smoothing.solver import Solution
from ctmap_gtsam.smoothing.writing import write
from factors.instance import InstanceRelation
from factors.symmetry import residual
from sequences.progress import SILENT, Progress
from sequences.types import Detection, Run

Array = NDArray[np.float64]
Look = Callable[[SmootherGraph, Smoothed], object]
"""Who looks at the last round's graph and its solution"""

_SETTLED = (0.002, 0.0002)  # rad, metres: poses that move less from round to round have settled


@dataclass(frozen=True)
class Map:
    """What a round hands to the next."""

    things: Mapping[int, Thing]
    smoothed: Smoothed
    energy: Mapping[str, float]
    """graph error by kind of factor, nats"""
    factors: Mapping[str, int]
    """number of factors by kind"""
    company: Mapping[int, Company]
    """visit -> who was moved together before it, by the round before"""

    def to_start_from(self) -> dict[int, Thing]:
        """What the next round asks for."""
        return {i: thing.to_start_from() for i, thing in self.things.items()}


@dataclass(frozen=True)
class Rounds:
    """How far it is: all that the next round, or the estimate, is made from."""

    current: Map
    energies: list[dict[str, float]]
    """of each round so far"""
    hypotheses_scored: int
    settled: bool
    """whether the last round changed nothing of note"""


@dataclass(frozen=True)
class Found:
    """What a round found in the images: what its map is made from."""

    boxes: Mapping[int, Boxes]
    """object -> its detections"""
    sightings: Mapping[int, Mapping[int, Sighting]]
    """object -> keyframe -> modes"""
    company: Mapping[int, Company]
    """visit -> who was moved together before it"""


@dataclass(frozen=True)
class Outline:
    """What of an object tells whether a round changed anything."""

    best_class: int
    exists: bool
    anchor: Array | None
    """(4, 4)"""


def outlines(things: Mapping[int, Thing]) -> dict[int, Outline]:
    """Of all objects of a map."""
    return {i: Outline(thing.best_class, thing.exists, thing.anchor) for i, thing in things.items()}


_KEPT = (
    *(Rounds, Map, Smoothed, Contributions, Solution, Thing, Detection, Sighting, PoseModes, Stage, Posterior),
    *(Partner, InstanceRelation),
)
"""what `Rounds` is made of"""


def smooth_run(
    run: Run,
    forward: Estimate,
    config: Config | None = None,
    *,
    progress: Progress | None = None,
    look: Look | None = None,
    keep: Path | None = None,
) -> Estimate:
    """The factor-graph smoother over a run, from the hypotheses of a forward pass.

    Args:
        run: from `sequences.bop.load_run`.
        forward: what a filter says of the run; it names objects, classes and poses to begin with, and nothing else.
            With a T-Map's the smoother knows nothing of relations between objects either.
        config: settings; None = the defaults.
        progress: who is told how far it is.
        look: is handed the last round's graph and its solution, such as for `export.graph`.
        keep: a file in which the last round is kept while the next is made. If it is there already, of the same run,
            forward pass, settings and code, work goes on from it, and ends in the same bytes.

    Returns:
        The estimate p(o_t | z_1:T) at the forward pass's keyframes.

    Raises:
        ValueError: `forward` is of another run.
    """
    if forward.meta.get("fingerprint") != run.fingerprint:
        raise ValueError(f"the forward pass is of another run than {run.name}")
    config = config or Config()
    told = progress or SILENT
    model = Model(run.catalogue, config, context=not str(forward.meta["method"]).endswith("-t"))
    proposer = Proposer(model)
    recording = record(run, forward.keyframe_frame, model, told)
    checkpoint = None if keep is None else Checkpoint(keep, _key(run, forward, config), _KEPT)
    state: Rounds | None = None if checkpoint is None else checkpoint.load()
    if state is None:
        found = _first_look(recording, proposer, seeds(forward, model), told)
        del forward  # of a long run it is as much as what was found in the images
        state = _stepped(_solve(recording, model, found), None, [], proposer, checkpoint)
        del found
    proposer.hypotheses_scored = state.hypotheses_scored
    while not _enough(state, config):
        # of all that was kept of a long run, nothing is held any longer than the next step asks for it
        things, energies = state.current.to_start_from(), state.energies
        del state
        found = _next_look(recording, proposer, things, told, f"round {len(energies) + 1}")
        before = outlines(things)
        del things
        state = _stepped(_solve(recording, model, found), before, energies, proposer, checkpoint)
        del found
    current = state.current
    if look is not None:
        built = _graph(recording, model, current.things, current.company)
        look(built, smooth(built, model, len(recording.keyframes)))
    estimate = write(recording, model, current.things, current.smoothed, _diagnostics(proposer, state))
    if checkpoint is not None:
        checkpoint.remove()
    return estimate


def _stepped(
    following: Map,
    before: Mapping[int, Outline] | None,
    energies: list[dict[str, float]],
    proposer: Proposer,
    checkpoint: Checkpoint | None,
) -> Rounds:
    """The state after a round, which is kept; None = before it there was no map."""
    settled = before is not None and _settled(before, outlines(following.things), proposer.model)
    state = Rounds(following, [*energies, dict(following.energy)], proposer.hypotheses_scored, settled)
    if checkpoint is not None:
        checkpoint.save(state)
    return state


def _enough(state: Rounds, config: Config) -> bool:
    """At most `smoother.rounds` after the first, and as many as it takes to settle, but for two."""
    after_first = len(state.energies) - 1
    return after_first >= config.smoother.rounds or (state.settled and after_first >= 2)


def _key(run: Run, forward: Estimate, config: Config) -> dict[str, object]:
    numbers = hashlib.sha256()
    for array in (forward.class_probability, forward.existence, *vars(forward.modes).values()):
        numbers.update(np.ascontiguousarray(array).tobytes())
    return {
        "method": forward.meta["method"],
        "forward": numbers.hexdigest(),
        "config": to_dict(config),
        "fingerprint": run.fingerprint,
        "code": code().estimating,
    }


def _first_look(recording: Recording, proposer: Proposer, seeds: Mapping[int, Seed], progress: Progress) -> Found:
    """Every object of the forward pass starts from all poses that it ever was believed to have."""
    model = proposer.model

    def expected(i: int, k: int) -> Expected:
        return Expected(seeds[i].best_class, seeds[i].expected(k), seeds[i].class_probability, 1.0)

    def wanted(i: int, k: int) -> Wanted:
        probed = careful(seeds[i].poses, seeds[i].class_probability)
        return Wanted(seeds[i].starts(k), (seeds[i].best_class, seeds[i].expected(k)), probed)

    boxes = associate(recording, model, seeds, expected)

    visits = visits_of(recording)
    seen = {j: Counter(visits[k] for k in own) for j, own in boxes.items()}

    def around(k: int) -> Surroundings:
        # of two things in one place, the one with more boxes in this visit has it
        there = (seed.neighbour(k, float(seen[j][visits[k]]), model) for j, seed in seeds.items())
        return Surroundings(tuple(n for n in there if n is not None), recording.place.surfaces)

    return Found(boxes, gather(recording, proposer, wanted, boxes, around, progress, "round 1"), {})


def _next_look(
    recording: Recording, proposer: Proposer, things: Mapping[int, Thing], progress: Progress, name: str
) -> Found:
    """Start from the smoothed map; every object's background is the map of the others."""
    model = proposer.model
    visits = visits_of(recording)
    company = company_of(things, visits, recording.place.up_world, model)

    def expected(i: int, k: int) -> Expected | None:
        return expected_of(things[i], k)

    def wanted(i: int, k: int) -> Wanted | None:
        thing = things[i]
        return wanted_of(thing, k, model, lambda c: thing.modes_at(c, k))

    def around(k: int) -> Surroundings:
        return Surroundings(neighbours_of(things, k, model), recording.place.surfaces, company[visits[k]])

    boxes = associate(recording, model, things, expected)
    return Found(boxes, gather(recording, proposer, wanted, boxes, around, progress, name), company)


def _solve(recording: Recording, model: Model, found: Found) -> Map:
    """Trellis for every object, identities over gaps, then one graph."""
    boxes, sightings, company = found.boxes, found.sightings, found.company
    things = {i: judge(i, boxes[i], sightings[i], recording, model) for i in boxes if sightings[i]}
    things = join_moved(merge_duplicates(things, recording, model), recording, model)
    built = _graph(recording, model, things, company)
    smoothed = smooth(built, model, len(recording.keyframes))
    things = {i: thing.with_poses(smoothed.objects.get(i, {})) for i, thing in things.items()}
    # the arrays are all that anybody needs from here on, and GTSAM's values can't be kept
    smoothed = replace(smoothed, solution=replace(smoothed.solution, values=None))
    return Map(things, smoothed, smoothed.contributions.energy, built.count(), company)


def _graph(
    recording: Recording, model: Model, things: Mapping[int, Thing], company: Mapping[int, Company]
) -> SmootherGraph:
    """The graph of all that is."""
    cameras = [camera_of(recording, k) for k in range(len(recording.keyframes))]
    objects = objects_of(things, recording, model)
    return build(model, cameras, recording.run.localisation, objects, company=company, place=recording.place)


def _settled(a: Mapping[int, Outline], b: Mapping[int, Outline], model: Model) -> bool:
    """Whether nothing of note changed from one round to the next."""
    if a.keys() != b.keys():
        return False
    for i, after in b.items():
        before = a[i]
        if after.best_class != before.best_class or after.exists != before.exists:
            return False
        if after.anchor is None or before.anchor is None:
            continue
        r = residual(before.anchor, after.anchor, model.shapes[after.best_class].symmetry)
        if np.linalg.norm(r[:3]) > _SETTLED[0] or np.linalg.norm(r[3:]) > _SETTLED[1]:
            return False
    return True


def _diagnostics(proposer: Proposer, state: Rounds) -> dict[str, object]:
    solution = state.current.smoothed.solution
    return {
        "hypotheses_scored": proposer.hypotheses_scored,
        "rounds": len(state.energies),
        "energy_by_round": state.energies,
        "factors": dict(state.current.factors),
        "solver": {"end": solution.end, "trace": list(solution.trace)},
    }
