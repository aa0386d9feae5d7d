"""CT-Map as a smoother: rounds of modes, trellis and graph until the map settles; each frame sees the whole run.

A round is a pure step from one map to the next: gather modes on the images, starting from the map; solve each object's
trellis; solve one graph of all poses; and the smoothed map is what the next round starts from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.association import Track
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.belief import LIKELY, POSSIBLE, Thing, judge
from ctmap_gtsam.smoothing.graph import Camera, Smoothed, build, smooth
from ctmap_gtsam.smoothing.identity import join_moved, merge_duplicates
from ctmap_gtsam.smoothing.modes import Found, Recording, Sighting, Wanted, gather, in_world, record, seed
from ctmap_gtsam.smoothing.writing import write
from factors.symmetry import residual
from sequences.progress import SILENT, Progress
from sequences.types import Run

Array = NDArray[np.float64]

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
    run: Run, config: Config | None = None, *, context: bool = True, progress: Progress | None = None
) -> Estimate:
    """The factor-graph smoother over a run.

    Args:
        run: from `sequences.bop.load_run`.
        config: settings; None = the defaults.
        context: False for the smoother of T-Map, which knows nothing of relations between objects.
        progress: who is told how far it is.

    Returns:
        The estimate p(o_t | z_1:T) at every keyframe.
    """
    config = config or Config()
    told = progress or SILENT
    model = Model(run.catalogue, config, context=context)
    proposer = Proposer(model)
    recording = record(run, select_keyframes(run, config.keyframes), model, told)
    current = _first_round(recording, proposer, told)
    energies = [dict(current.energy)]
    for number in range(config.smoother.rounds):
        following = _next_round(recording, proposer, current, told, f"round {number + 2}")
        settled = _settled(current, following, model)
        current = following
        energies.append(dict(current.energy))
        if settled and number + 1 >= 2:
            break
    return write(recording, model, current.things, current.smoothed, _diagnostics(proposer, current, energies))


def _first_round(recording: Recording, proposer: Proposer, progress: Progress) -> Map:
    """Every track is an object; it starts from what full searches found of it."""
    found = seed(recording, proposer, progress)
    wishes = {i: _wish(f) for i, f in found.items()}
    tracks = {t.track_id: (t,) for t in recording.tracks}
    sightings = gather(recording, proposer, lambda i, _: wishes[i], tracks, lambda _i, _k: (), progress, "round 1")
    return _solve(recording, proposer.model, tracks, sightings)


def _wish(found: Found) -> Wanted:
    """All that the searches found of the classes that are still possible."""
    best = int(np.argmax(found.log_likelihood))
    starts = {c: found.poses[c] for c in found.within(POSSIBLE)}
    expected = (best, found.poses[best][0]) if len(found.poses[best]) else None
    return Wanted(starts, expected, frozenset(found.within(LIKELY)))


def _next_round(recording: Recording, proposer: Proposer, current: Map, progress: Progress, name: str) -> Map:
    """Start from the smoothed map; every object's background is the map of the others."""
    model = proposer.model
    tracks = {i: thing.tracks for i, thing in current.things.items()}

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

    sightings = gather(recording, proposer, wanted, tracks, neighbours, progress, name)
    return _solve(recording, model, tracks, sightings)


def _neighbour(thing: Thing, keyframe: int, model: Model) -> Neighbour | None:
    """An object that is surely there at a keyframe."""
    pose = thing.present_pose(keyframe)
    if pose is None:
        return None
    return Neighbour(thing.object_id, model.shapes[thing.best_class], pose, thing.log_evidence)


def _solve(
    recording: Recording,
    model: Model,
    tracks: Mapping[int, tuple[Track, ...]],
    sightings: Mapping[int, Mapping[int, Sighting]],
) -> Map:
    """Trellis for every object, identities over gaps, then one graph."""
    things = {i: judge(i, tracks[i], sightings[i], recording, model) for i in tracks if sightings[i]}
    things = join_moved(merge_duplicates(things, model), recording, model)
    cameras = [
        Camera(recording.T_world_camera(k), recording.time_s(k), recording.run.frames[int(f)].visit)
        for k, f in enumerate(recording.keyframes)
    ]
    objects = {
        i: (model.shapes[thing.best_class], thing.measured(recording)) for i, thing in things.items() if thing.exists
    }
    objects = {i: entry for i, entry in objects.items() if entry[1]}
    built = build(model, cameras, recording.run.localisation, objects)
    smoothed = smooth(built, model, objects, len(cameras))
    things = {i: thing.with_poses(smoothed.objects.get(i, {})) for i, thing in things.items()}
    return Map(things, smoothed, built.energy(smoothed.solution.values), built.count())


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
