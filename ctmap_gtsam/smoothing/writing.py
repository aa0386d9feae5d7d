"""The smoothed map as an `Estimate`."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import GRAPH_POTENTIALS, Tables, build_estimate
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.place import describe
from ctmap_gtsam.frontend.proposer import FLAT_M
from ctmap_gtsam.frontend.standing import with_supports
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.alternatives import Exchanges, Mode, Ways, elsewhere, exchanges, other_ways, ways_round
from ctmap_gtsam.smoothing.belief import Held, Thing
from ctmap_gtsam.smoothing.discrete import Stage
from ctmap_gtsam.smoothing.graph import Contributions, Smoothed
from ctmap_gtsam.smoothing.modes import Recording

Array = NDArray[np.float64]

_REPORTED = 1e-3  # modes and classes less probable than this are left out
_MOST_FREE = 3  # columns that an Estimate has for free axes
_LEAST = 1e-12  # weight of the reported pose, whatever rounding takes


def write(
    recording: Recording, model: Model, things: Mapping[int, Thing], smoothed: Smoothed, diagnostics: dict[str, object]
) -> Estimate:
    """Every object at every keyframe: smoothed where measured, held between."""
    kept = [thing for _, thing in sorted(things.items()) if thing.reported_class in thing.posteriors]
    told = Told(recording, model, things, exchanges(things, recording, model))
    tables = Tables(len(kept), len(recording.keyframes), len(model.catalogue))
    for row, thing in enumerate(kept):
        for k in range(len(recording.keyframes)):
            write_at(tables, row, k, thing, told, smoothed.T_world_camera[k])
        note_class(tables, row, thing)
    rows = {thing.object_id: row for row, thing in enumerate(kept)}
    note_graph(tables, rows, smoothed.contributions, range(len(recording.keyframes)))
    estimate = build_estimate(
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
    return with_supports(estimate, model, [recording.place.surfaces] * len(recording.keyframes))


@dataclass(frozen=True)
class Told:
    """What is written down beside the object in question."""

    recording: Recording
    model: Model
    things: Mapping[int, Thing]
    exchanges: Exchanges
    _ways: dict[tuple[int, int], Ways] = field(default_factory=dict, repr=False, compare=False)

    def other_ways(self, thing: Thing, visit: int, own: Array) -> Ways:
        """Those of an object in a visit (`alternatives`), worked out once, with the first pose that is asked."""
        key = thing.object_id, visit
        if key not in self._ways:
            self._ways[key] = other_ways(thing, visit, own, self.recording, self.model)
        return self._ways[key]


def write_at(tables: Tables, row: int, k: int, thing: Thing, told: Told, T_world_camera: Array) -> None:
    """All that is said of an object at a keyframe.

    Args:
        tables: written to.
        row: of the object.
        k: the keyframe.
        thing: the object.
        told: the run, and the whole map.
        T_world_camera: (4, 4) smoothed.
    """
    tables.class_probability[row, k] = thing.class_probability
    tables.existence[row, k] = thing.solid * thing.presence_at(k)
    _write_pose(tables, row, k, thing, told, T_world_camera)
    if k in thing.sightings:
        _write_move(tables, row, k, thing, told.recording, told.model.config.prediction.significant_period_s)
        _write_ledger(tables, row, k, thing, told.model)


def _write_pose(tables: Tables, row: int, k: int, thing: Thing, told: Told, T_world_camera: Array) -> None:
    held = thing.held(k)
    if held is None:
        return
    own = _mode(thing, held, told)
    recording, model, c = told.recording, told.model, thing.reported_class
    shape = model.shapes[c]
    tables.in_view[row, k] = _share_in_view(shape, own.T_world_centre, T_world_camera, recording, k) > 0.0
    for mode in _belief(thing, k, held, own, told):
        if mode.share >= _REPORTED or mode.T_world_centre is own.T_world_centre:
            _write_mode(tables, row, k, shape, mode)
    for other_class in thing.posteriors:
        if other_class != c and thing.class_probability[other_class] >= _REPORTED and k in thing.sightings:
            _write_class(tables, row, k, thing, other_class, recording, model)


def _mode(thing: Thing, held: Held, told: Told) -> Mode:
    """The reported pose, which all of the belief is in at first."""
    covariance = held.covariance
    if not held.smoothed:
        stage = thing.stages[thing.reported_class][held.view]
        shape = told.model.shapes[thing.reported_class]
        covariance = covariance + _shared(stage, shape, held.T_world_centre, told.recording, told.model)
    return Mode(1.0, held.T_world_centre, covariance)


def _belief(thing: Thing, k: int, held: Held, own: Mode, told: Told) -> Iterator[Mode]:
    """The modes of the reported class, the reported pose last: it is the heaviest of them."""
    recording, model, c = told.recording, told.model, thing.reported_class
    # what a single view takes for another pose, within its own scatter, is none
    seen = _alternatives(thing, c, held.view, recording, model)
    others = [mode for mode in seen if not own.says_the_same(mode, model.shapes[c])]
    own = replace(own, share=max(1.0 - sum(mode.share for mode in others), _LEAST))
    visit = recording.visit(thing.keyframes[held.view])
    ways = told.other_ways(thing, visit, own.T_world_centre)
    own, turned = ways_round(own, others, model.shapes[c], ways, model.config.smoother.surface_nats)
    shares = told.exchanges.at(thing.object_id, recording.visit(k))
    there = ((i, told.things[i]) for i in shares if told.things[i].presence_at(k) > 0.5)
    places = {i: _mode(other, at, told) for i, other in there if (at := other.held(k)) is not None}
    own, modes = elsewhere(own, turned, shares, places)
    # and it may be none of these: as in a view, so in all views of a visit, which err alike
    missed = model.config.smoother.unmeasured
    yield Mode(missed, own.T_world_centre, np.diag(model.anywhere))
    for mode in (*modes, own):
        yield mode.times(1.0 - missed)


def _share_in_view(shape: Shape, T: Array, T_world_camera: Array, recording: Recording, k: int) -> float:
    camera = recording.run.frames[int(recording.keyframes[k])].camera
    return outlook(shape, np.linalg.inv(T_world_camera) @ T, camera).share


def _write_class(tables: Tables, row: int, k: int, thing: Thing, c: int, recording: Recording, model: Model) -> None:
    """The modes of a class that is still possible, as its own trellis weighs them."""
    i = thing.view_at(k)
    for mode in _modes(thing, c, i, recording, model):
        if mode.share >= _REPORTED:
            _write_mode(tables, row, k, model.shapes[c], mode)


def _alternatives(thing: Thing, c: int, i: int, recording: Recording, model: Model) -> list[Mode]:
    """The modes of a view that the best path doesn't go through."""
    path = thing.posteriors[c].path[i]
    return [mode for state, mode in enumerate(_modes(thing, c, i, recording, model)) if state != path]


def _modes(thing: Thing, c: int, i: int, recording: Recording, model: Model) -> list[Mode]:
    """The modes of class c at the i-th view, with all that a camera gets wrong in their covariances."""
    stage = thing.stages[c][i]
    return [
        Mode(share, T, covariance + _shared(stage, model.shapes[c], T, recording, model))
        for share, T, covariance in zip(
            thing.shares(c, i).tolist(), stage.T_world_centre, stage.covariance, strict=True
        )
    ]


def _shared(stage: Stage, shape: Shape, T_world_centre: Array, recording: Recording, model: Model) -> Array:
    """(6, 6) what a single view doesn't say of its own error: localisation's, and the depth's bias."""
    away = float(np.linalg.norm(recording.T_world_camera(stage.keyframe)[:3, 3] - T_world_centre[:3, 3]))
    return np.diag(model.shared_variance(shape, recording.run.localisation, away))


def _write_mode(tables: Tables, row: int, k: int, shape: Shape, mode: Mode) -> None:
    tables.mode(
        row,
        k,
        shape.source.obj_id,
        float(np.log(mode.share)),
        shape.to_object(mode.T_world_centre),
        shape.covariance_to_object(mode.covariance),
        shape.free_axes_to_object(free_axes(shape, mode.covariance)),
    )


def free_axes(shape: Shape, covariance: Array) -> Array:
    """Orthonormal columns (6, f <= 3) of the motions that a pose leaves free: its symmetry's, and those left so wide.

    Wide is what a view's score is as far as it is probed where it shows nothing.

    Args:
        shape: the class.
        covariance: (6, 6) of the right tangent in the centre frame.
    """
    unit = np.repeat([1.0 / shape.radius_m, 1.0], 3)
    own = shape.symmetry.free_axes
    # in the unit in which a turn moves the surface by as much as a shift
    rest = np.linalg.svd(own / unit[:, None])[0][:, own.shape[1] :]
    variance, axes = np.linalg.eigh(rest.T @ (covariance / unit[:, None] / unit) @ rest)
    wide = (rest @ axes[:, variance >= FLAT_M**2])[:, ::-1] * unit[:, None]
    return np.asarray(np.linalg.qr(np.concatenate([own, wide[:, : _MOST_FREE - own.shape[1]]], axis=1))[0])


def _write_ledger(tables: Tables, row: int, k: int, thing: Thing, model: Model) -> None:
    """What the trellis weighs at the states that the best path goes through."""
    c, i = thing.reported_class, thing.view_at(k)
    tables.note(row, k, "clutter", -thing.sightings[k].log_clutter)
    if i:
        tables.note(row, k, "persistence", _log_persistence(thing, c, i, model))
    modes, stage, state = thing.sightings[k].modes[c], thing.stages[c][i], thing.posteriors[c].path[i]
    if modes is None or state >= len(stage.log_evidence):
        return
    depth = float(modes.depth_log_ratio[state])
    tables.note(row, k, "depth", depth)
    tables.note(row, k, "detection", float(modes.log_likelihood[state]) - depth)
    tables.note(row, k, "surroundings", float(stage.log_evidence[state] - modes.log_likelihood[state]))
    tables.note(row, k, "witness", float(modes.witness[state]))


def _log_persistence(thing: Thing, c: int, i: int, model: Model) -> float:
    """That an object of class c stayed from the view before its i-th, or left or came, or wasn't there at either."""
    (a, b), path = thing.stages[c][i - 1 : i + 1], thing.posteriors[c].path
    stay, leave, remain = model.log_transitions(model.shapes[c].source, b.time_s - a.time_s)
    gone = [path[i - 1] > len(a.log_evidence), path[i] > len(b.log_evidence)]
    if all(gone):
        return remain
    return leave if any(gone) or not thing.posteriors[c].stayed(i) else stay


def note_graph(tables: Tables, rows: Mapping[int, int], graph: Contributions, keyframes: Container[int]) -> None:
    """What the graph's factors say, in the ledger: those of some keyframes.

    Args:
        tables: written to.
        rows: object -> its row.
        graph: of the solution; what a window carries on from before it is no factor of a keyframe.
        keyframes: of which factors are written.
    """
    columns = graph.kind, graph.object, graph.keyframe, graph.other, graph.nats
    for kind, i, k, j, nats in zip(*columns, strict=True):
        if kind in GRAPH_POTENTIALS and int(k) in keyframes:
            tables.note(rows.get(int(i), -1), int(k), kind, float(nats), rows.get(int(j), -1))


def note_class(tables: Tables, row: int, thing: Thing) -> None:
    """The score vectors' word on the class, in the ledger of the first keyframe in view."""
    if thing.keyframes:
        tables.note(row, thing.keyframes[0], "class", float(thing.score_evidence[thing.reported_class]))


def _write_move(
    tables: Tables, row: int, k: int, thing: Thing, recording: Recording, significant_period_s: float
) -> None:
    """A line for the gap before a view if it is long enough to hold a move, or probably held one."""
    i = thing.view_at(k) - 1
    if i < 0:
        return
    gap = (thing.keyframes[i], k)
    moved = float(thing.posteriors[thing.reported_class].moved[i])
    begin, end = (recording.run.frames[int(recording.keyframes[j])].time_ns for j in gap)
    if moved >= 0.5 or (end - begin) * 1e-9 >= significant_period_s:
        tables.move(row, gap, moved, (begin, end))
