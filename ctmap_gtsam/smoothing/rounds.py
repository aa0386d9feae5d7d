"""What a round asks the images for and hands to the graph: shared by the batch and the fixed lag."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.company import Company, Stand, company
from ctmap_gtsam.frontend.surroundings import Neighbour
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.association import Expected
from ctmap_gtsam.smoothing.belief import Thing
from ctmap_gtsam.smoothing.graph import Camera, Measured
from ctmap_gtsam.smoothing.modes import Recording, Wanted
from factors import symmetry

Array = NDArray[np.float64]

_ONE_WAY = (0.5, 0.1)  # rad, metres: what lies nearer to a start is not another way round
_MOST_FRESH = 2  # starts from the views beside, of a class


def expected_of(thing: Thing, keyframe: int) -> Expected | None:
    """What the map says of an object where boxes are assigned; None where it has no pose."""
    pose = thing.pose_near(thing.best_class, keyframe)
    if pose is None:
        return None
    return Expected(thing.best_class, pose[0], thing.class_probability, thing.solid * thing.presence_at(keyframe))


def wanted_of(thing: Thing, keyframe: int, model: Model, known: Callable[[int], Array]) -> Wanted | None:
    """What is believed of an object at a keyframe, and the modes of a sighting; None where it has no pose.

    Args:
        thing: the object.
        keyframe: where it is looked for.
        model: says which classes are possible.
        known: class index -> (n, 4, 4) T_world_centre of a sighting's modes, which are tried, too.
    """
    best = thing.best_class
    starts = {}
    for c in thing.possible(model):
        # what a keyframe has settled on may be wrong: the middle of its life has another say
        near = [thing.pose_near(c, keyframe), thing.anchor[None] if c == best and thing.anchor is not None else None]
        starts[c] = np.concatenate([*(n for n in near if n is not None), known(c)])
        # nor may a view have missed the way round that those next to it take it for
        beside = thing.modes_beside(c, keyframe)
        fresh = [T for T in beside if not symmetry.near(T, starts[c], model.shapes[c].symmetry, *_ONE_WAY).any()]
        starts[c] = np.concatenate([starts[c], *(T[None] for T in fresh[:_MOST_FRESH])])
    pose = thing.pose_near(best, keyframe)
    return None if pose is None else Wanted(starts, (best, pose[0]), frozenset(thing.likely()))


def neighbours_of(things: Mapping[int, Thing], keyframe: int, model: Model) -> tuple[Neighbour, ...]:
    """The objects that are surely there at a keyframe."""
    there = ((thing, thing.present_pose(keyframe)) for thing in things.values())
    return tuple(
        Neighbour(thing.object_id, model.shapes[thing.best_class], pose, thing.claim_at(keyframe))
        for thing, pose in there
        if pose is not None
    )


def company_of(
    things: Mapping[int, Thing], visits: Sequence[int], up_world: Array | None, model: Model
) -> dict[int, Company]:
    """Who was moved together, by visit: each visit is held to how things stood in all others.

    Args:
        things: the map.
        visits: (K,) of the keyframes.
        up_world: (3,); None = unknown.
        model: potentials and shapes.
    """
    stood: dict[int, dict[int, Stand]] = {visit: {} for visit in visits}
    for i, thing in sorted(things.items()):
        for k in sorted(thing.poses):
            pose = thing.present_pose(k)
            if pose is not None:
                stood[visits[k]][i] = Stand(thing.best_class, pose)
    return {
        visit: company(now, [stands for other, stands in stood.items() if other != visit], up_world, model)
        for visit, now in stood.items()
    }


def visits_of(recording: Recording) -> tuple[int, ...]:
    """(K,) the visit of each keyframe."""
    return tuple(recording.visit(k) for k in range(len(recording.keyframes)))


def camera_of(recording: Recording, keyframe: int) -> Camera:
    """As recorded."""
    return Camera(recording.T_world_camera(keyframe), recording.time_s(keyframe), recording.visit(keyframe))


def objects_of(
    things: Mapping[int, Thing], recording: Recording, model: Model
) -> dict[int, tuple[Shape, Sequence[Measured]]]:
    """What the graph takes: the class and the chosen modes of each object that exists and was measured."""
    chosen = {
        i: (model.shapes[thing.best_class], thing.measured(recording)) for i, thing in things.items() if thing.exists
    }
    return {i: entry for i, entry in chosen.items() if entry[1]}
