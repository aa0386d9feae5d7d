"""The smoother beside the filter against objects; what a keyframe costs in a short and in a long run."""

from __future__ import annotations

from pathlib import Path

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
        keep: a folder for what was measured, from which it goes on when it was stopped; None = nothing is kept. What
            `filter` has kept there is taken from it.

    Returns:
        `smooth.seconds_per_keyframe_N_objects` and `smooth.over_filter_N_objects`, its seconds, the forward pass left
        out, over the filter's on the same run; of runs of two lengths `smooth.over_filter_L_keyframes`,
        `smooth.seconds_per_keyframe_L` and `smooth.peak_mb_L`, with the ratios `smooth.seconds_long_over_short` and
        `smooth.memory_long_over_short`, and `smooth.kb_per_keyframe`, by which the memory grows. Seconds are CPU
        seconds.
    """
    figures: dict[str, float] = {}
    steps = 2 * len(sizes.objects) + 2
    with parts(keep, config, sizes.round_frames, progress) as runs, progress.stage("smooth", steps) as stage:
        for n in sizes.objects:
            seconds = {}
            for method in ("filter", "smooth"):
                seconds[method] = runs.measured(method, n, sizes.keyframes).seconds
                stage.advance()
            figures[f"smooth.seconds_per_keyframe_{n}_objects"] = seconds["smooth"] / sizes.keyframes
            figures[f"smooth.over_filter_{n}_objects"] = seconds["smooth"] / seconds["filter"]
        costs = []
        for length in sizes.lengths:
            filtered = runs.measured("filter", sizes.length_objects, length)
            seen = runs.measured("smooth", sizes.length_objects, length)
            figures[f"smooth.over_filter_{length}_keyframes"] = seen.seconds / filtered.seconds
            costs.append((seen.seconds / length, seen.peak_mb))
            stage.advance()
    short, long = costs
    return figures | by_length("smooth", short, long, sizes.lengths)
