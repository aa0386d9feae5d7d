"""The filter: keyframes a second against objects and particles; what a keyframe costs late in a long run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctmap_gtsam.bench.scaling.measuring import Measured
from ctmap_gtsam.bench.scaling.parts import parts
from ctmap_gtsam.bench.scaling.sizes import FULL, Sizes, by_length
from ctmap_gtsam.config import Config
from sequences.progress import SILENT, Progress


def run(config: Config, progress: Progress = SILENT, sizes: Sizes = FULL, keep: Path | None = None) -> dict[str, float]:
    """Measure.

    Args:
        config: settings.
        progress: is told how far it is.
        sizes: of the runs.
        keep: a folder for what was measured, from which it goes on when it was stopped; None = nothing is kept.

    Returns:
        `filter.keyframes_per_s_N_objects`, of keyframes after all objects were begun, and `filter.start_s_N_objects`,
        seconds until then; `filter.keyframes_per_s_M_particles`; `filter.seconds_per_keyframe_L` and
        `filter.peak_mb_L` of runs of two lengths, all keyframes included, with their ratios
        `filter.seconds_long_over_short` and `filter.memory_long_over_short`, and `filter.kb_per_keyframe`, by which the
        memory grows; `filter.late_over_early`, seconds a keyframe at the end of the long run over those of as many
        keyframes near its beginning. Seconds are CPU seconds.
    """
    figures: dict[str, float] = {}
    steps = len(sizes.objects) + len(sizes.particles) + 2
    begun = 2 * config.frontend.start_after
    with parts(keep, config, sizes.round_frames, progress) as runs, progress.stage("filter", steps) as stage:
        for n in sizes.objects:
            seen = runs.measured("filter", n, sizes.keyframes)
            figures[f"filter.keyframes_per_s_{n}_objects"] = 1.0 / float(np.mean(seen.each_s[begun:]))
            figures[f"filter.start_s_{n}_objects"] = float(np.sum(seen.each_s[:begun]))
            figures[f"filter.found_{n}_objects"] = float(seen.objects)
            stage.advance()
        for m in sizes.particles:
            seen = runs.measured("filter", sizes.middle, sizes.keyframes, m)
            figures[f"filter.keyframes_per_s_{m}_particles"] = 1.0 / float(np.mean(seen.each_s[begun:]))
            stage.advance()
        both = []
        for length in sizes.lengths:
            both.append(runs.measured("filter", sizes.length_objects, length))
            stage.advance()
    short, long = both
    figures |= by_length("filter", _cost(short, sizes.lengths[0]), _cost(long, sizes.lengths[1]), sizes.lengths)
    figures["filter.late_over_early"] = _late_over_early(long, sizes.lengths[0] // 2)
    return figures


def _cost(measured: Measured, keyframes: int) -> tuple[float, float]:
    return measured.seconds / keyframes, measured.peak_mb


def _late_over_early(measured: Measured, n: int) -> float:
    """Of n keyframes each: the last ones, and those that come after as many others."""
    return float(np.mean(measured.each_s[-n:]) / np.mean(measured.each_s[n : 2 * n]))
