"""The benchmark as a whole: do what is missing, then make figures of all that is there."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctmap_gtsam.bench.paper import places as frozen
from ctmap_gtsam.bench.paper.agenda import Agenda, Failure, Say
from ctmap_gtsam.bench.paper.places import Identity
from ctmap_gtsam.bench.paper.protocol import CEILING, MAIN, SETTINGS, Place, Protocol, Variant, load_protocol
from ctmap_gtsam.bench.paper.results import Key, Results, curves_json, differences_json, rows_json
from ctmap_gtsam.bench.paper.units import Store, Unit
from ctmap_gtsam.config import Config, load_config
from ctmap_gtsam.runtime.pool import work_off
from ctmap_gtsam.runtime.settings import to_dict
from ctmap_gtsam.runtime.versions import versions
from sequences.atomic import write_json, write_text
from sequences.errors import InputError
from sequences.progress import SILENT, Progress

if TYPE_CHECKING:
    from ctmap_gtsam.evaluation.record import Record
    from ctmap_gtsam.methods import Method

SCHEMA = 1
RESULT, TABLES = "paper.json", "paper.md"
DRAWS = 1000
"""of places, for the intervals"""

_IMPORTS = (
    "ctmap_gtsam.bench.paper.units",
    "ctmap_gtsam.evaluation.record",
    "ctmap_gtsam.methods",
    "sequences.simulation.simulator",
)


@dataclass(frozen=True)
class Task:
    """What is wanted."""

    seeds: tuple[int, ...]
    """of the places"""
    passes: tuple[Variant, ...]
    methods: tuple[str, ...] | None = None
    """of those that a pass has, None for all"""
    repeats: int = 1
    """each method is run with so many seeds, from the settings' on"""
    protocol: Protocol = field(default_factory=load_protocol)


@dataclass(frozen=True)
class Workshop:
    """How it is done; none of this changes a figure."""

    workers: int | None = None
    """processes, one thread each, as many as there are cores where not given; with 0 all is done in this one"""
    keep_runs: bool = False
    registry: Mapping[str, Method] | None = None
    """the methods there are, `ctmap_gtsam.methods.METHODS` where not given"""
    manifest: Path = frozen.MANIFEST
    progress: Progress = SILENT
    say: Say = print

    def methods(self) -> Mapping[str, Method]:
        """The registry."""
        if self.registry is not None:
            return self.registry
        from ctmap_gtsam.methods import METHODS

        return METHODS


@dataclass(frozen=True)
class Outcome:
    """What came of it."""

    result: Mapping[str, Any]
    """the content of paper.json"""
    tables: str
    """Markdown"""
    failures: tuple[Failure, ...]


def run_paper(out: Path, config: Config, task: Task, workshop: Workshop | None = None) -> Outcome:
    """Do what is missing, then write paper.json, paper.md and the plots.

    Args:
        out: the folder of results; what it holds already of the same settings, places and code isn't done again.
        config: settings of methods and places; what the protocol draws replaces some of the places'.
        task: what is wanted.
        workshop: how it is done.

    Raises:
        InputError: there is no such method.
    """
    from ctmap_gtsam.bench.paper.plots import write_plots
    from ctmap_gtsam.bench.paper.tables import tables

    workshop = Workshop() if workshop is None else workshop
    store = Store(Path(out), config)
    there = [task.protocol.place(seed, config) for seed in task.seeds]
    _check_methods(task, workshop)
    began = time.perf_counter()
    failures = _do(store, {place: _wanted(place, config, task, workshop) for place in there}, workshop)
    seconds = time.perf_counter() - began
    result = {**_summarise(store, there, task, workshop, failures), "seconds": round(seconds, 1)}
    text = tables(result)
    write_json(store.root / RESULT, result)
    write_text(store.root / TABLES, text)
    write_plots(store.root, result)
    return Outcome(result, text, failures)


def freeze(out: Path, config: Config, protocol: Protocol, workshop: Workshop) -> tuple[Failure, ...]:
    """Simulate the reported set and write the manifest; it stays as it is where a place fails."""
    store = Store(Path(out), config)
    there = [protocol.place(seed, config) for seed in protocol.sets["reported"]]
    failures = _do(store, dict.fromkeys(there, ()), workshop)
    if not failures:
        frozen.write_manifest(_identities(store, there), workshop.manifest)
    return failures


def _do(store: Store, units: Mapping[Place, Sequence[Unit]], workshop: Workshop) -> tuple[Failure, ...]:
    agenda = Agenda(store, units, workshop.methods(), keep_runs=workshop.keep_runs)
    with workshop.progress.stage("places and methods", total=agenda.jobs) as stage:
        agenda.tell(lambda line: stage.advance())
        agenda.tell(workshop.say)
        work_off(agenda, os.cpu_count() or 1 if workshop.workers is None else workshop.workers, _IMPORTS)
    for place in units:
        if not workshop.keep_runs and not agenda.failures:
            shutil.rmtree(store.run(place), ignore_errors=True)
    return tuple(agenda.failures)


def _summarise(
    store: Store, there: Sequence[Place], task: Task, workshop: Workshop, failures: Sequence[Failure]
) -> dict[str, Any]:
    """All that is in the folder of these places, whatever was wanted this time."""
    records: dict[Key, dict[int, list[Record]]] = {}
    seconds: dict[Key, float] = {}
    skipped: dict[str, str] = {}
    for variant in task.protocol.variants.values():
        everything = Task(task.seeds, (variant,), None, task.repeats, task.protocol)
        for place in there:
            for unit in _wanted(place, store.config, everything, workshop):
                if unit.variant is not variant or (done := store.done(unit)) is None:
                    continue
                if done.status == "skipped":
                    skipped[unit.method] = done.reason
                    continue
                key = (variant.name, unit.method)
                records.setdefault(key, {}).setdefault(place.seed, []).append(store.record(unit))
                seconds[key] = seconds.get(key, 0.0) + done.seconds
    identities = _identities(store, there)
    results = Results(records, task.seeds, DRAWS, workshop.progress)
    rows = rows_json(results, task.seeds, seconds)
    oracles = [name for name, method in workshop.methods().items() if method.reads_truth]
    return {
        "schema": SCHEMA,
        "name": "paper",
        "synthetic": True,
        "set": task.protocol.set_of(task.seeds),
        "seeds": list(task.seeds),
        "frozen": _frozen(identities, task, workshop),
        "places": {str(p.seed): _about(p, identities.get(p.seed)) for p in there},
        "paper": dict(task.protocol.paper),
        "passes": {v.name: {"kind": v.kind, "summary": v.summary} for v in task.protocol.variants.values()},
        "draws": DRAWS,
        "figures": {f"{r['method']}.{k}": v for r in rows if r["pass"] == MAIN for k, v in r["figures"].items()},
        "rows": rows,
        "differences": differences_json(results, task.protocol),
        "curves": curves_json(results),
        "reads_truth": [*oracles, CEILING],
        "skipped": skipped,
        "failures": [{"job": f.job, "log": str(f.log), "reason": f.reason} for f in failures],
        "config": to_dict(store.config),
        "changed_settings": _changed(store.config),
        "code": asdict(store.source),
        "versions": versions(),
    }


def _wanted(place: Place, config: Config, task: Task, workshop: Workshop) -> tuple[Unit, ...]:
    """The units of a place: those of the passes wanted, those that they build on, those that they are held to."""
    registry = workshop.methods()
    every = (*registry, CEILING)
    needs = {method: registry[method].needs if method in registry else () for method in every}
    main = task.protocol.variants[MAIN]
    wanted: dict[tuple[str, str], Variant] = {}
    for variant in task.passes:
        for method in filter(_chosen(task.methods), variant.methods or every):
            wanted |= {(variant.name, one): variant for one in (*needs.get(method, ()), method)}
        wanted |= {(MAIN, method): main for method in variant.main}
    seeds = range(config.seed, config.seed + task.repeats)
    return tuple(Unit(v, place, m, s, needs[m]) for (_, m), v in wanted.items() if m in every for s in seeds)


def _chosen(methods: tuple[str, ...] | None) -> Callable[[str], bool]:
    return lambda method: methods is None or method in methods


def _check_methods(task: Task, workshop: Workshop) -> None:
    every = (*workshop.methods(), CEILING)
    if unknown := [name for name in task.methods or () if name not in every]:
        raise InputError(
            f"there is no method {', '.join(unknown)}", field="--methods", remedy=f"choose of {', '.join(every)}"
        )


def _identities(store: Store, there: Sequence[Place]) -> dict[int, Identity]:
    return {place.seed: found for place in there if (found := store.identity(place)) is not None}


def _frozen(identities: Mapping[int, Identity], task: Task, workshop: Workshop) -> dict[str, Any] | None:
    """Whether the places are those of the frozen set; None where no reported place is among them."""
    if task.protocol.set_of(task.seeds) != "reported":
        return None
    guard = frozen.guard(identities, workshop.manifest)
    complete = set(task.seeds) == set(task.protocol.sets["reported"]) and len(identities) == len(task.seeds)
    return {"holds": guard.holds, "complete": complete, "reason": guard.reason}


def _changed(config: Config) -> dict[str, Any]:
    """Settings, by their dotted paths, that aren't the benchmark's own."""
    own, now = (dict(_leaves(to_dict(replace(c, seed=0)))) for c in (load_config(SETTINGS), config))
    return {path: value for path, value in now.items() if own[path] != value}


def _leaves(settings: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", value


def _about(place: Place, identity: Identity | None) -> dict[str, Any]:
    simulation = place.simulation
    return {
        "objects": simulation.place.objects,
        "visits": simulation.motion.visits,
        "keyframes": simulation.motion.visits * simulation.trajectory.frames,
        "hashes": None if identity is None else asdict(identity),
    }
