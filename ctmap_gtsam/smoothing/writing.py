"""The smoothed map as an `Estimate`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import Tables, build_estimate
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.place import describe
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.belief import Thing
from ctmap_gtsam.smoothing.graph import Smoothed
from ctmap_gtsam.smoothing.modes import Recording

Array = NDArray[np.float64]

_REPORTED = 1e-3  # modes and classes less probable than this are left out


def write(
    recording: Recording, model: Model, things: Mapping[int, Thing], smoothed: Smoothed, diagnostics: dict[str, object]
) -> Estimate:
    """Every object at every keyframe: smoothed where measured, held between."""
    kept = [thing for _, thing in sorted(things.items()) if thing.reported_class in thing.posteriors]
    tables = Tables(len(kept), len(recording.keyframes), len(model.catalogue))
    for row, thing in enumerate(kept):
        for k in range(len(recording.keyframes)):
            write_at(tables, row, k, thing, recording, model, smoothed.T_world_camera[k])
        note_class(tables, row, thing)
    return build_estimate(
        recording.run,
        model.config,
        "smooth-ct" if model.context else "smooth-t",
        recording.keyframes,
        [thing.object_id for thing in kept],
        tables,
        smoothed.T_world_camera,
        smoothed.camera_covariance,
        {"diagnostics": diagnostics, **describe(recording.place)},
    )


def write_at(
    tables: Tables, row: int, k: int, thing: Thing, recording: Recording, model: Model, T_world_camera: Array
) -> None:
    """All that is said of an object at a keyframe.

    Args:
        tables: written to.
        row: of the object.
        k: the keyframe.
        thing: the object.
        recording: the run.
        model: potentials.
        T_world_camera: (4, 4) smoothed.
    """
    tables.class_probability[row, k] = thing.class_probability
    tables.existence[row, k] = thing.solid * thing.presence_at(k)
    _write_pose(tables, row, k, thing, recording, model, T_world_camera)
    if k in thing.sightings:
        _write_move(tables, row, k, thing, recording, model.config.prediction.significant_period_s)
        _write_ledger(tables, row, k, thing)


def _write_pose(
    tables: Tables, row: int, k: int, thing: Thing, recording: Recording, model: Model, T_world_camera: Array
) -> None:
    held = thing.held(k)
    if held is None:
        return
    T, covariance = held
    shape = model.shapes[thing.reported_class]
    camera = recording.run.frames[int(recording.keyframes[k])].camera
    tables.in_view[row, k] = outlook(shape, np.linalg.inv(T_world_camera) @ T, camera).share > 0.0
    tables.mode(
        row,
        k,
        shape.source.obj_id,
        thing.chosen_log_weight(k),
        shape.to_object(T),
        shape.covariance_to_object(covariance),
        shape.free_axes_to_object(shape.symmetry.free_axes),
    )
    _write_alternatives(tables, row, k, thing, model)


def _write_alternatives(tables: Tables, row: int, k: int, thing: Thing, model: Model) -> None:
    """Other modes of the reported class, and of other classes that are still possible, as the trellis weighs them."""
    for c, posterior in thing.posteriors.items():
        if thing.class_probability[c] < _REPORTED or k not in thing.sightings:
            continue
        i = thing.keyframes.index(k)
        stage, marginal = thing.stages[c][i], posterior.modes[i]
        present = max(1.0 - marginal[-1], 1e-300)
        shape = model.shapes[c]
        for state in range(len(stage.log_evidence)):
            share = marginal[state] / present
            if share < _REPORTED or (c == thing.reported_class and state == posterior.path[i]):
                continue
            tables.mode(
                row,
                k,
                shape.source.obj_id,
                float(np.log(share)),
                shape.to_object(stage.T_world_centre[state]),
                shape.covariance_to_object(stage.covariance[state]),
                shape.free_axes_to_object(shape.symmetry.free_axes),
            )


def _write_ledger(tables: Tables, row: int, k: int, thing: Thing) -> None:
    """What each potential says at the mode that the best path goes through."""
    c, i = thing.reported_class, thing.keyframes.index(k)
    modes, stage, state = thing.sightings[k].modes[c], thing.stages[c][i], thing.posteriors[c].path[i]
    if modes is None or state >= len(stage.log_evidence):
        return
    depth = float(modes.depth_log_ratio[state])
    tables.note(row, k, "depth", depth)
    tables.note(row, k, "detection", float(modes.log_likelihood[state]) - depth)
    tables.note(row, k, "context", float(stage.log_evidence[state] - modes.log_likelihood[state]))


def note_class(tables: Tables, row: int, thing: Thing) -> None:
    """The score vectors' word on the class, in the ledger of the first keyframe in view."""
    if thing.keyframes:
        tables.note(row, thing.keyframes[0], "class", float(thing.score_evidence[thing.reported_class]))


def _write_move(
    tables: Tables, row: int, k: int, thing: Thing, recording: Recording, significant_period_s: float
) -> None:
    """A line for the gap before a view if it is long enough to hold a move, or probably held one."""
    i = thing.keyframes.index(k) - 1
    if i < 0:
        return
    gap = (thing.keyframes[i], k)
    moved = float(thing.posteriors[thing.reported_class].moved[i])
    begin, end = (recording.run.frames[int(recording.keyframes[j])].time_ns for j in gap)
    if moved >= 0.5 or (end - begin) * 1e-9 >= significant_period_s:
        tables.move(row, gap, moved, (begin, end))
