"""`ctmap compare`: run methods on a run, judge them, write everything into one folder (docs/format.md).

Estimates are stored as soon as they are there, so that a comparison that was stopped goes on from where it was. All
other files are made in memory and written at the end, each whole, summary.json last: it names the others by SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation.comparison import Comparison, compare
from ctmap_gtsam.evaluation.outcome import Outcome
from ctmap_gtsam.evaluation.record import DETECTOR
from ctmap_gtsam.evaluation.views import views
from ctmap_gtsam.export import bop_csv, coco_detections, coco_results
from ctmap_gtsam.reporting.report import render
from ctmap_gtsam.runtime.progress import Stopwatch
from ctmap_gtsam.runtime.settings import to_dict
from ctmap_gtsam.runtime.sources import code
from ctmap_gtsam.runtime.versions import versions
from sequences.atomic import write_json, write_text
from sequences.bop import load_run
from sequences.errors import InputError
from sequences.progress import SILENT, Progress
from sequences.truth import truth_fingerprint
from sequences.types import Run

if TYPE_CHECKING:
    from ctmap_gtsam.methods import Method, Reading

SCHEMA = 1
SUMMARY, REPORT, ESTIMATES = "summary.json", "report.html", "estimates"


def compare_run(
    run_path: Path | str,
    out: Path | str,
    config: Config,
    methods: Sequence[str] | None = None,
    scene: int | None = None,
    progress: Progress = SILENT,
    registry: Mapping[str, Method] | None = None,
) -> Comparison:
    """Run methods on a recorded run and write what came out.

    Args:
        run_path: the run's folder; nothing is written there.
        out: the folder for the results.
        config: settings of all methods.
        methods: names, all of the registry where not given.
        scene: as `load_run` takes it.
        progress: who listens.
        registry: the methods there are, `ctmap_gtsam.methods.METHODS` where not given.

    Returns:
        The comparison that the report shows.

    Raises:
        InputError: the run can't be used, or there is no such method; then nothing is written.
    """
    run, out = load_run(run_path, scene=scene), Path(out)
    outcomes = run_methods(run, methods, config, store=out / ESTIMATES, progress=progress, registry=registry)
    with progress.stage("judge and report") as stage:
        comparison = compare(run, _estimates(outcomes), detector=_with_detector(outcomes))
        _write(out, run, scene, config, outcomes, comparison)
        stage.advance()
    return comparison


def run_methods(
    run: Run,
    methods: Sequence[str] | None,
    config: Config,
    store: Path | None = None,
    progress: Progress = SILENT,
    registry: Mapping[str, Method] | None = None,
) -> dict[str, Outcome]:
    """Run methods one after another, in the order of the registry; what they build on runs before them, once.

    Args:
        run: the recording.
        methods: names, all of the registry where not given.
        config: their settings.
        store: a folder of estimates; what lies there already, of the same run, settings and code, is taken instead.
            Methods that work in rounds keep the last one there while they run, to go on from it when they were stopped.
        progress: who listens.
        registry: the methods there are, `ctmap_gtsam.methods.METHODS` where not given.

    Raises:
        InputError: there is no such method.
    """
    if registry is None:
        from ctmap_gtsam.methods import METHODS

        registry = METHODS
    unknown = [name for name in methods or () if name not in registry]
    if unknown:
        raise InputError(
            f"there is no method {', '.join(unknown)}", field="--methods", remedy=f"choose of {', '.join(registry)}"
        )
    chosen = list(registry) if methods is None else [name for name in registry if name in methods]
    session = _Session(run, config, registry, store, progress, _with_needs(chosen, registry))
    outcomes: dict[str, Outcome] = {}
    with progress.stage("methods", total=len(chosen)) as stage:
        for name in chosen:
            outcomes[name] = session.outcome(name)
            stage.advance()
    return outcomes


def _with_needs(names: Sequence[str], registry: Mapping[str, Method]) -> frozenset[str]:
    """Methods and all that they build on."""
    return frozenset(names).union(*(_with_needs(registry[name].needs, registry) for name in names))


def report(out: Path | str) -> Path:
    """Write report.html again from what `compare_run` left in a folder; returns its path.

    Raises:
        InputError: the folder holds no comparison, or its run has gone or changed.
    """
    out = Path(out)
    summary = _read_summary(out / SUMMARY)
    about = summary["run"]
    run = load_run(about["path"], scene=about["scene"])
    if run.fingerprint != about["fingerprint"]:
        raise InputError(
            f"the run {about['path']} has changed since", file=out / SUMMARY, remedy="run `ctmap compare` again"
        )
    outcomes = {name: _outcome(out, name, told) for name, told in summary["methods"].items()}
    comparison = compare(run, _estimates(outcomes), detector=_with_detector(outcomes))
    page = render(run, comparison, outcomes, seed=summary["seed"], versions=summary["versions"])
    write_text(out / REPORT, page)
    return out / REPORT


def summarise(
    run: Run, scene: int | None, config: Config, outcomes: Mapping[str, Outcome], comparison: Comparison
) -> dict[str, Any]:
    """The content of summary.json but for `files`: numbers, or null where there is none."""
    methods: dict[str, Any] = {}
    for name, outcome in outcomes.items():
        told = {
            "status": outcome.status,
            "seconds": outcome.seconds,
            "stages": dict(outcome.stages),
            "reads_truth": outcome.reads_truth,
        }
        if outcome.status == "skipped":
            methods[name] = {**told, "metrics": {}, "reason": outcome.reason, "remedy": outcome.remedy}
        else:
            methods[name] = {**told, "metrics": _plain(comparison.methods[name].metrics)}
    return {
        "schema": SCHEMA,
        "methods": methods,
        "agreement": {
            "reference": comparison.reference,
            "methods": {name: _plain(a.metrics()) for name, a in comparison.agreement.items()},
        },
        "run": {"name": run.name, "path": str(run.path.resolve()), "scene": scene, "fingerprint": run.fingerprint},
        "has_truth": comparison.truth is not None,
        "seed": config.seed,
        "config": to_dict(config),
        "versions": versions(),
    }


@dataclass(frozen=True)
class _Stored:
    """A method's estimate on disk, and beside it what it was made from and how long that took."""

    folder: Path
    method: str
    key: dict[str, Any]

    @property
    def path(self) -> Path:
        return self.folder / f"{self.method}.npz"

    @property
    def about(self) -> Path:
        return self.folder / f"{self.method}.json"

    def load(self) -> Outcome | None:
        """None where there is none of the same key, whole."""
        try:
            about = json.loads(self.about.read_text())
            digest = hashlib.sha256(self.path.read_bytes()).hexdigest()
            if about["sha256"] != digest or any(about[name] != value for name, value in self.key.items()):
                return None
            return Outcome("ok", about["seconds"], Estimate.load(self.path), stages=about["stages"])
        except (OSError, ValueError, KeyError, TypeError, InputError):
            return None

    def save(self, estimate: Estimate, seconds: float, stages: Mapping[str, float]) -> None:
        estimate.save(self.path)
        digest = hashlib.sha256(self.path.read_bytes()).hexdigest()
        write_json(self.about, {"seconds": seconds, "stages": dict(stages), "sha256": digest, **self.key})


@dataclass(frozen=True)
class _Pass:
    """A pass over the run that several methods read their estimates off."""

    state: Any
    seconds: float
    stages: Mapping[str, float]


@dataclass(frozen=True)
class _Session:
    """Methods that run on one run with the same settings, each once."""

    run: Run
    config: Config
    registry: Mapping[str, Method]
    store: Path | None
    progress: Progress
    wanted: frozenset[str]
    """all that are to run, what others build on among them"""
    _outcomes: dict[str, Outcome] = field(default_factory=dict)
    _passes: dict[Any, _Pass] = field(default_factory=dict)
    """by who made them; those that a method still waits for"""

    def outcome(self, name: str) -> Outcome:
        """What becomes of a method, after what becomes of those that it builds on."""
        if name not in self._outcomes:
            method = self.registry[name]
            self._outcomes[name] = replace(self._run(method), reads_truth=method.reads_truth)
        return self._outcomes[name]

    def _run(self, method: Method) -> Outcome:
        obstacle = method.skip(self.run)
        if obstacle is not None:
            return Outcome("skipped", reason=obstacle)
        if method.kind == "detections":
            return Outcome("ok", 0.0)
        stored = self._stored(method)
        if stored is not None and (found := stored.load()) is not None:
            return found
        outcome = self._made(method) if method.reading is None else self._read(method, method.reading)
        if stored is not None:
            assert outcome.estimate is not None
            assert outcome.seconds is not None
            stored.save(outcome.estimate, outcome.seconds, outcome.stages)
        return outcome

    def _made(self, method: Method) -> Outcome:
        """Of a method that runs by itself, after those that it builds on."""
        assert method.run is not None
        needed = [self.outcome(name) for name in method.needs]
        start, watch = time.perf_counter(), Stopwatch(self.progress)
        kept = {"keep": self.store and self.store / f".{method.name}.rounds.npz"} if method.resumes else {}
        estimate = method.run(self.run, self.config, watch, *(one.estimate for one in needed), **kept)
        # what it takes alone
        seconds = time.perf_counter() - start + sum(one.seconds or 0.0 for one in needed)
        return Outcome("ok", seconds, estimate, stages=watch.seconds)

    def _read(self, method: Method, reading: Reading) -> Outcome:
        """Of a method that reads its estimate off a pass, which is made once for all that do."""
        others = [r for name in self.wanted if name != method.name and (r := self._waits(name, reading.make))]
        if reading.make not in self._passes:
            start, watch = time.perf_counter(), Stopwatch(self.progress)
            keep_past = any(r.keep_past for r in (reading, *others))
            state = reading.make(self.run, self.config, progress=watch, keep_past=keep_past)
            self._passes[reading.make] = _Pass(state, time.perf_counter() - start, watch.seconds)
        made = self._passes[reading.make]
        if not others:
            del self._passes[reading.make]  # it holds all particles
        start, watch = time.perf_counter(), Stopwatch(self.progress)
        estimate = reading.read(self.run, made.state, watch)
        seconds = made.seconds + time.perf_counter() - start
        return Outcome("ok", seconds, estimate, stages={**made.stages, **watch.seconds})

    def _waits(self, name: str, make: Any) -> Reading | None:
        """How a method that has no estimate yet will read it off the same pass; None where it won't."""
        method = self.registry[name]
        reading = method.reading
        if reading is None or reading.make is not make or name in self._outcomes:
            return None
        stored = self._stored(method)
        return reading if method.skip(self.run) is None and (stored is None or stored.load() is None) else None

    def _stored(self, method: Method) -> _Stored | None:
        """Where its estimate would lie, and all that it is made from."""
        if self.store is None:
            return None
        key = {
            "method": method.name,
            "config": to_dict(self.config),
            "fingerprint": self.run.fingerprint,
            "code": code().estimating,
        }
        if method.reads_truth:
            key["truth"] = truth_fingerprint(self.run)
        return _Stored(self.store, method.name, json.loads(json.dumps(key)))


def _estimates(outcomes: Mapping[str, Outcome]) -> dict[str, Estimate]:
    return {name: outcome.estimate for name, outcome in outcomes.items() if outcome.estimate is not None}


def _with_detector(outcomes: Mapping[str, Outcome]) -> bool:
    return DETECTOR in outcomes and outcomes[DETECTOR].status == "ok"


def _write(
    out: Path, run: Run, scene: int | None, config: Config, outcomes: Mapping[str, Outcome], comparison: Comparison
) -> None:
    texts = {}
    for name, outcome in outcomes.items():
        if outcome.status == "skipped":
            continue
        if outcome.estimate is None:
            texts[f"{name}.json"] = _json(coco_detections(run))
            continue
        each = outcome.seconds / len(run.frames) if outcome.seconds is not None and run.frames else None
        seen = views(run, outcome.estimate)
        texts[f"{name}.csv"] = bop_csv(seen, each)
        texts[f"{name}.json"] = _json(coco_results(seen, each))
    texts[REPORT] = render(run, comparison, outcomes, seed=config.seed, versions=versions())
    files = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    texts[SUMMARY] = _json({**summarise(run, scene, config, outcomes, comparison), "files": files})
    for name, text in texts.items():
        write_text(out / name, text)


def _json(value: Any) -> str:
    return json.dumps(value, indent=1, allow_nan=False) + "\n"


def _plain(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Python's own numbers; None for what JSON has no number for."""
    out: dict[str, Any] = {}
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            out[name] = _plain(value)
        elif value is None or not np.isfinite(value):
            out[name] = None
        else:
            out[name] = int(value) if isinstance(value, int | np.integer) else float(value)
    return out


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(path.read_text())
    except OSError as error:
        raise InputError("holds no comparison", file=path, remedy="run `ctmap compare RUN --out DIR` first") from error
    except ValueError as error:
        raise InputError(f"is not JSON ({error})", file=path, remedy="run `ctmap compare` again") from error
    if not isinstance(summary, dict) or summary.get("schema") != SCHEMA:
        raise InputError(
            f"is not a summary of schema {SCHEMA}", file=path, field="schema", remedy="run `ctmap compare` again"
        )
    return summary


def _outcome(out: Path, name: str, told: Mapping[str, Any]) -> Outcome:
    reads_truth = told.get("reads_truth", False)
    if told["status"] == "skipped":
        return Outcome("skipped", reason=told["reason"], remedy=told["remedy"], reads_truth=reads_truth)
    estimate = None if name == DETECTOR else Estimate.load(out / ESTIMATES / f"{name}.npz")
    return Outcome("ok", told["seconds"], estimate, reads_truth=reads_truth, stages=told.get("stages", {}))
