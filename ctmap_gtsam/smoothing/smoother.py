"""CT-Map as a smoother: rounds of modes, trellis and graph until the map settles; each frame sees the whole run.

A round is a pure step from one map to the next: gather modes on the images, starting from the map; solve each object's
trellis; solve one graph of all poses; and the smoothed map is what the next round starts from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.association import Expected, associate
from ctmap_gtsam.smoothing.belief import Thing, judge
from ctmap_gtsam.smoothing.graph import Camera, Measured, Smoothed, SmootherGraph, build, smooth
from ctmap_gtsam.smoothing.identity import join_moved, merge_duplicates
from ctmap_gtsam.smoothing.modes import Boxes, Recording, Sighting, Wanted, gather, in_world, record
from ctmap_gtsam.smoothing.seeding import Seed, seeds
from ctmap_gtsam.smoothing.writing import write
from factors.symmetry import residual
from sequences.progress import SILENT, Progress
from sequences.types import Run

Array = NDArray[np.float64]
Objects = Mapping[int, tuple[Shape, Sequence[Measured]]]
Look = Callable[[SmootherGraph, Smoothed], object]
"""Who looks at the last round's graph and its solution"""

_LIKELY = 1e-3  # classes less probable than this in the forward pass are not probed with care in the first round
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


def smooth_run(
    run: Run,
    forward: Estimate,
    config: Config | None = None,
    *,
    progress: Progress | None = None,
    look: Look | None = None,
) -> Estimate:
    """The factor-graph smoother over a run, from the hypotheses of a forward pass.

    Args:
        run: from `sequences.bop.load_run`.
        forward: what a filter says of the run; it names objects, classes and poses to begin with, and nothing else.
            With a T-Map's the smoother knows nothing of relations between objects either.
        config: settings; None = the defaults.
        progress: who is told how far it is.
        look: is handed the last round's graph and its solution, such as for `export.graph`.

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
    current = _first_round(recording, proposer, seeds(forward, model), told)
    energies = [dict(current.energy)]
    for number in range(config.smoother.rounds):
        following = _next_round(recording, proposer, current, told, f"round {number + 2}")
        settled = _settled(current, following, model)
        current = following
        energies.append(dict(current.energy))
        if settled and number + 1 >= 2:
            break
    if look is not None:
        look(_graph(recording, model, current.things)[0], current.smoothed)
    return write(recording, model, current.things, current.smoothed, _diagnostics(proposer, current, energies))


def _first_round(recording: Recording, proposer: Proposer, seeds: Mapping[int, Seed], progress: Progress) -> Map:
    """Every object of the forward pass starts from all poses that it ever was believed to have."""
    model = proposer.model

    def expected(i: int, k: int) -> Expected:
        return Expected(seeds[i].best_class, seeds[i].expected(k), seeds[i].class_probability, 1.0)

    def wanted(i: int, k: int) -> Wanted:
        likely = frozenset(c for c in seeds[i].poses if seeds[i].class_probability[c] > _LIKELY)
        return Wanted(seeds[i].starts(k), (seeds[i].best_class, seeds[i].expected(k)), likely | {seeds[i].best_class})

    boxes = associate(recording, model, seeds, expected)
    sightings = gather(recording, proposer, wanted, boxes, lambda _i, _k: (), progress, "round 1")
    return _solve(recording, model, boxes, sightings)


def _next_round(recording: Recording, proposer: Proposer, current: Map, progress: Progress, name: str) -> Map:
    """Start from the smoothed map; every object's background is the map of the others."""
    model = proposer.model

    def expected(i: int, k: int) -> Expected | None:
        thing = current.things[i]
        pose = thing.pose_near(thing.best_class, k)
        if pose is None:
            return None
        there = thing.solid * thing.presence_at(k)
        return Expected(thing.best_class, pose[0], thing.class_probability, there)

    def wanted(i: int, k: int) -> Wanted | None:
        thing = current.things[i]
        best = thing.best_class
        starts = {}
        for c in thing.possible(model):
            # what a keyframe has settled on may be wrong: the middle of its life has another say
            near = [thing.pose_near(c, k), thing.anchor[None] if c == best and thing.anchor is not None else None]
            sighting = thing.sightings.get(k)
            if sighting is not None:
                near.append(in_world(sighting, c, recording.T_world_camera(k)))
            starts[c] = np.concatenate([n for n in near if n is not None] or [np.zeros((0, 4, 4))])
        pose = thing.pose_near(best, k)
        if pose is None:
            return None
        return Wanted(starts, (best, pose[0]), frozenset(thing.likely()))

    def neighbours(i: int, k: int) -> tuple[Neighbour, ...]:
        there = [_neighbour(thing, k, model) for thing in current.things.values()]
        return Surroundings(tuple(n for n in there if n is not None), ()).without(i).neighbours

    boxes = associate(recording, model, current.things, expected)
    sightings = gather(recording, proposer, wanted, boxes, neighbours, progress, name)
    return _solve(recording, model, boxes, sightings)


def _neighbour(thing: Thing, keyframe: int, model: Model) -> Neighbour | None:
    """An object that is surely there at a keyframe."""
    pose = thing.present_pose(keyframe)
    if pose is None:
        return None
    return Neighbour(thing.object_id, model.shapes[thing.best_class], pose, thing.log_evidence)


def _solve(
    recording: Recording,
    model: Model,
    boxes: Mapping[int, Boxes],
    sightings: Mapping[int, Mapping[int, Sighting]],
) -> Map:
    """Trellis for every object, identities over gaps, then one graph."""
    things = {i: judge(i, boxes[i], sightings[i], recording, model) for i in boxes if sightings[i]}
    things = join_moved(merge_duplicates(things, model), recording, model)
    built, objects = _graph(recording, model, things)
    smoothed = smooth(built, model, objects, len(recording.keyframes))
    things = {i: thing.with_poses(smoothed.objects.get(i, {})) for i, thing in things.items()}
    return Map(things, smoothed, built.energy(smoothed.solution.values), built.count())


def _graph(recording: Recording, model: Model, things: Mapping[int, Thing]) -> tuple[SmootherGraph, Objects]:
    """The graph of all that is, and what each object was taken for."""
    cameras = [
        Camera(recording.T_world_camera(k), recording.time_s(k), recording.run.frames[int(f)].visit)
        for k, f in enumerate(recording.keyframes)
    ]
    objects = {
        i: (model.shapes[thing.best_class], thing.measured(recording)) for i, thing in things.items() if thing.exists
    }
    objects = {i: entry for i, entry in objects.items() if entry[1]}
    return build(model, cameras, recording.run.localisation, objects), objects


def _settled(a: Map, b: Map, model: Model) -> bool:
    """Whether nothing of note changed from one round to the next."""
    if a.things.keys() != b.things.keys():
        return False
    for i, thing in b.things.items():
        before = a.things[i]
        if thing.best_class != before.best_class or thing.exists != before.exists:
            return False
        if thing.anchor is None or before.anchor is None:
            continue
        r = residual(before.anchor, thing.anchor, model.shapes[thing.best_class].symmetry)
        if np.linalg.norm(r[:3]) > _SETTLED[0] or np.linalg.norm(r[3:]) > _SETTLED[1]:
            return False
    return True


def _diagnostics(proposer: Proposer, current: Map, energies: list[dict[str, float]]) -> dict[str, object]:
    solution = current.smoothed.solution
    return {
        "hypotheses_scored": proposer.hypotheses_scored,
        "rounds": len(energies),
        "energy_by_round": energies,
        "factors": dict(current.factors),
        "solver": {"end": solution.end, "trace": list(solution.trace)},
    }
