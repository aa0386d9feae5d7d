"""`ctmap compare`: run methods on a run, judge them, write everything into one folder (docs/format.md).

Estimates are stored as soon as they are there, so that a comparison that was stopped goes on from where it was. All
other files are made in memory and written at the end, each whole, summary.json last: it names the others by SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from ctmap_gtsam.runtime.settings import to_dict
from ctmap_gtsam.runtime.sources import code
from ctmap_gtsam.runtime.versions import versions
from sequences.atomic import write_json, write_text
from sequences.bop import load_run
from sequences.errors import InputError
from sequences.progress import SILENT, Progress
from sequences.types import Run

if TYPE_CHECKING:
    from ctmap_gtsam.methods import Method

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
    """Run methods one after another, in the order of the registry.

    Args:
        run: the recording.
        methods: names, all of the registry where not given.
        config: their settings.
        store: a folder of estimates; what lies there already, of the same run, settings and code, is taken instead.
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
    chosen = [method for name, method in registry.items() if methods is None or name in methods]
    outcomes = {}
    with progress.stage("methods", total=len(chosen)) as stage:
        for method in chosen:
            outcomes[method.name] = _run_method(run, method, config, store, progress)
            stage.advance()
    return outcomes


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
        told = {"status": outcome.status, "seconds": outcome.seconds}
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
            return Outcome("ok", about["seconds"], Estimate.load(self.path))
        except (OSError, ValueError, KeyError, TypeError, InputError):
            return None

    def save(self, estimate: Estimate, seconds: float) -> None:
        estimate.save(self.path)
        digest = hashlib.sha256(self.path.read_bytes()).hexdigest()
        write_json(self.about, {"seconds": seconds, "sha256": digest, **self.key})


def _run_method(run: Run, method: Method, config: Config, store: Path | None, progress: Progress) -> Outcome:
    obstacle = method.skip(run)
    if obstacle is not None:
        return Outcome("skipped", reason=obstacle)
    if method.kind == "detections":
        return Outcome("ok", 0.0)
    key = {"method": method.name, "config": to_dict(config), "fingerprint": run.fingerprint, "code": code().estimating}
    stored = _Stored(store, method.name, json.loads(json.dumps(key))) if store is not None else None
    if stored is not None and (found := stored.load()) is not None:
        return found
    assert method.run is not None
    start = time.perf_counter()
    estimate = method.run(run, config, progress)
    seconds = time.perf_counter() - start
    if stored is not None:
        stored.save(estimate, seconds)
    return Outcome("ok", seconds, estimate)


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
    if told["status"] == "skipped":
        return Outcome("skipped", reason=told["reason"], remedy=told["remedy"])
    estimate = None if name == DETECTOR else Estimate.load(out / ESTIMATES / f"{name}.npz")
    return Outcome("ok", told["seconds"], estimate)
