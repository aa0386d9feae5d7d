"""How much of a figure is chance: every metric on the real recordings over seeds, and with cameras localised badly.

Filters draw particles and everything draws first poses, so one run of one seed says little of a difference of a
millimetre. Where localisation is disturbed, the recorded camera poses get an error as the simulator's localisation has
it (Gauss-Markov, a draw for each seed), and the estimators are told its size; the truth is the recording's own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from ctmap_gtsam.comparing import run_methods
from ctmap_gtsam.config import Config
from ctmap_gtsam.evaluation.frames import FrameErrors
from ctmap_gtsam.evaluation.record import pooled, record
from sequences.bop import load_run
from sequences.errors import InputError
from sequences.progress import SILENT, Progress
from sequences.seeds import generator
from sequences.simulation.localisation import recorded_poses
from sequences.truth import load_truth
from sequences.types import LocalisationNoise, Run, Truth

METHODS = ("filter-ct", "smooth-ct")
DISTURBED = LocalisationNoise(rotation_rad=float(np.deg2rad(2.0)), translation_m=0.02)


def run(
    config: Config,
    progress: Progress = SILENT,
    runs: Sequence[Path] = (),
    methods: Sequence[str] = METHODS,
    seeds: int = 10,
    disturb: bool = False,
) -> dict[str, float | str | None]:
    """Measure.

    Args:
        config: settings; its seed is the first.
        progress: is told of each run and seed.
        runs: recordings with truth.
        methods: of `ctmap compare`.
        seeds: how many.
        disturb: whether localisation is disturbed, by 2 cm and 2 degrees.

    Returns:
        `<method>.<run>.<metric>.median`, `.low` and `.high` (the extremes) over the seeds that have the metric; metrics
        that none has are left out. Of two methods `<second> - <first>.<run>.mssd_mm_paired`, see `paired`.

    Raises:
        InputError: no run is given, or one has no truth.
    """
    if not runs:
        raise InputError("no recording is given", field="RUN", remedy="name folders of runs that have a truth")
    judged = [_with_truth(path) for path in runs]
    figures: dict[str, float | str | None] = {}
    with progress.stage("spread", total=len(judged) * seeds) as stage:
        for recording, truth in judged:
            told: dict[str, list[Mapping[str, float | None]]] = {name: [] for name in methods}
            ahead: dict[str, list[Mapping[str, float | None]]] = {f"{b} - {a}": [] for a, b in combinations(methods, 2)}
            for seed in range(config.seed, config.seed + seeds):
                shown = disturbed(recording, DISTURBED, seed) if disturb else recording
                outcomes = run_methods(shown, methods, replace(config, seed=seed), progress=progress)
                records = {name: record(shown, truth, name, outcomes[name].estimate) for name in methods}
                for name in methods:
                    told[name].append(pooled([records[name]]))
                for a, b in combinations(methods, 2):
                    ahead[f"{b} - {a}"].append({"mssd_mm_paired": paired(records[a].frames, records[b].frames)})
                stage.advance()
            for name, tables in (told | ahead).items():
                figures |= {f"{name}.{recording.name}.{key}": value for key, value in spread(tables).items()}
    return figures


def spread(tables: Sequence[Mapping[str, float | None]]) -> dict[str, float]:
    """`<metric>.median`, `.low` and `.high` of metrics over several tables, of those that say something."""
    out: dict[str, float] = {}
    for metric in tables[0]:
        values = [value for table in tables if (value := table.get(metric)) is not None and np.isfinite(value)]
        if values:
            out |= {
                f"{metric}.{name}": float(f(values)) for name, f in (("median", np.median), ("low", min), ("high", max))
            }
    return out


def paired(first: FrameErrors, second: FrameErrors) -> float | None:
    """By how much the second's MSSD is larger, mm: the median over object-frames where both have the true class.

    None where there is no such object-frame.
    """
    both = first.class_correct & second.class_correct & np.isfinite(first.mssd_m) & np.isfinite(second.mssd_m)
    return 1e3 * float(np.median((second.mssd_m - first.mssd_m)[both])) if both.any() else None


def disturbed(run: Run, noise: LocalisationNoise, seed: int) -> Run:
    """The run with an error on its recorded camera poses, drawn for each visit, which it says the size of."""
    visits = []
    for v, visit in enumerate(run.visits):
        rng = generator(seed, "spread.localisation", v, 0)
        times = np.array([frame.time_ns for frame in visit.frames], dtype=np.int64)
        poses = recorded_poses(np.stack([frame.T_world_camera for frame in visit.frames]), times, noise, rng)
        frames = tuple(replace(f, T_world_camera=T) for f, T in zip(visit.frames, poses, strict=True))
        visits.append(replace(visit, frames=frames))
    return replace(run, visits=tuple(visits), localisation=noise)


def _with_truth(path: Path) -> tuple[Run, Truth]:
    recording = load_run(path)
    truth = load_truth(recording)
    if truth is None:
        raise InputError(
            "the run has no truth", file=path, field="scene_gt.json", remedy="give runs with scene_gt.json"
        )
    return recording, truth
