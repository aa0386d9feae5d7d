"""The smoother beside the filter against objects; what a keyframe costs in a short and in a long run."""

from __future__ import annotations

from ctmap_gtsam.bench.scaling.measuring import measure
from ctmap_gtsam.bench.scaling.sizes import FULL, Sizes, by_length, loops
from ctmap_gtsam.config import Config
from sequences.progress import SILENT, Progress


def run(config: Config, progress: Progress = SILENT, sizes: Sizes = FULL) -> dict[str, float]:
    """Measure.

    Returns:
        `smooth.seconds_per_keyframe_N_objects` and `smooth.over_filter_N_objects`, its seconds, the forward pass left
        out, over the filter's on the same run; `smooth.seconds_per_keyframe_L` and `smooth.peak_mb_L` of runs of two
        lengths, with their ratios `smooth.seconds_long_over_short` and `smooth.memory_long_over_short`, and
        `smooth.kb_per_keyframe`, by which the memory grows.
    """
    figures: dict[str, float] = {}
    objects = (*sizes.objects, sizes.length_objects)
    steps = 2 * len(sizes.objects) + 2
    with loops(objects, sizes.round_frames, config.seed, progress) as paths, progress.stage("smooth", steps) as stage:
        for n in sizes.objects:
            seconds = {}
            for method in ("filter", "smooth"):
                seconds[method] = measure(method, paths[n], sizes.keyframes, config).seconds
                stage.advance()
            figures[f"smooth.seconds_per_keyframe_{n}_objects"] = seconds["smooth"] / sizes.keyframes
            figures[f"smooth.over_filter_{n}_objects"] = seconds["smooth"] / seconds["filter"]
        costs = []
        for length in sizes.lengths:
            path = paths[sizes.length_objects]
            measure("filter", path, length, config)
            seen = measure("smooth", path, length, config)
            costs.append((seen.seconds / length, seen.peak_mb))
            stage.advance()
    short, long = costs
    return figures | by_length("smooth", short, long, sizes.lengths)
