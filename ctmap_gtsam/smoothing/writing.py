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
        _write_thing(tables, row, thing, recording, model, smoothed)
        _write_moves(tables, row, thing, recording, model.config.prediction.significant_period_s)
        _write_ledger(tables, row, thing)
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


def _write_thing(
    tables: Tables, row: int, thing: Thing, recording: Recording, model: Model, smoothed: Smoothed
) -> None:
    shape = model.shapes[thing.reported_class]
    free = shape.symmetry.free_axes
    for k in range(len(recording.keyframes)):
        tables.class_probability[row, k] = thing.class_probability
        presence = thing.presence_at(k)
        tables.existence[row, k] = thing.solid * presence
        held = thing.held(k)
        if held is None:
            continue
        T, covariance = held
        camera = recording.run.frames[int(recording.keyframes[k])].camera
        seen = outlook(shape, np.linalg.inv(smoothed.T_world_camera[k]) @ T, camera)
        tables.in_view[row, k] = seen.share > 0.0
        tables.mode(
            row,
            k,
            shape.source.obj_id,
            thing.chosen_log_weight(k),
            shape.to_object(T),
            shape.covariance_to_object(covariance),
            shape.free_axes_to_object(free),
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


def _write_ledger(tables: Tables, row: int, thing: Thing) -> None:
    """What each potential says at the mode that the best path goes through; the score vectors' word on the class."""
    c = thing.reported_class
    for k, stage, state in zip(thing.keyframes, thing.stages[c], thing.posteriors[c].path, strict=True):
        modes = thing.sightings[k].modes[c]
        if modes is None or state >= len(stage.log_evidence):
            continue
        depth = float(modes.depth_log_ratio[state])
        tables.note(row, k, "depth", depth)
        tables.note(row, k, "detection", float(modes.log_likelihood[state]) - depth)
        tables.note(row, k, "context", float(stage.log_evidence[state] - modes.log_likelihood[state]))
    if thing.keyframes:
        tables.note(row, thing.keyframes[0], "class", float(thing.score_evidence[c]))


def _write_moves(tables: Tables, row: int, thing: Thing, recording: Recording, significant_period_s: float) -> None:
    """A line for every gap between views that is long enough to hold a move, or that probably held one."""
    posterior = thing.posteriors.get(thing.reported_class)
    if posterior is None:
        return
    frames = recording.run.frames
    for i, (a, b) in enumerate(zip(thing.keyframes, thing.keyframes[1:], strict=False)):
        times = [frames[int(recording.keyframes[k])].time_ns for k in (a, b)]
        if posterior.moved[i] < 0.5 and (times[1] - times[0]) * 1e-9 < significant_period_s:
            continue
        tables.move(row, (a, b), float(posterior.moved[i]), (times[0], times[1]))
