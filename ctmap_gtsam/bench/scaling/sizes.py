"""Which runs are measured."""

from __future__ import annotations

from dataclasses import dataclass

from ctmap_gtsam.bench.scaling.loop import ROUND


@dataclass(frozen=True)
class Sizes:
    """Numbers of objects, of particles and of keyframes; a figure each."""

    objects: tuple[int, ...]
    particles: tuple[int, ...]
    """tried with the number of objects that is nearest to ten"""
    lengths: tuple[int, int]
    """keyframes of the short and of the long run"""
    length_objects: int
    """in these two"""
    keyframes: int
    """of all other runs"""
    round_frames: int = ROUND

    @property
    def middle(self) -> int:
        """The number of objects that particles are varied with."""
        return min(self.objects, key=lambda n: (abs(n - 10), n))


FULL = Sizes((5, 10, 20, 40), (100, 300, 1000), (100, 2000), 5, 40)
QUICK = Sizes((2, 5), (100, 300), (30, 120), 2, 15, round_frames=30)


def by_length(
    name: str, short: tuple[float, float], long: tuple[float, float], lengths: tuple[int, int]
) -> dict[str, float]:
    """Figures of a short and of a long run, each (seconds a keyframe, megabytes), and their ratios.

    The ratio of memory has in both what a process holds before it has seen an image; what a keyframe adds is
    `name.kb_per_keyframe`.
    """
    out: dict[str, float] = {}
    for n, (seconds, mb) in zip(lengths, (short, long), strict=True):
        out |= {f"{name}.seconds_per_keyframe_{n}": seconds, f"{name}.peak_mb_{n}": mb}
    out[f"{name}.seconds_long_over_short"] = long[0] / short[0]
    out[f"{name}.memory_long_over_short"] = long[1] / short[1]
    out[f"{name}.kb_per_keyframe"] = 1024.0 * (long[1] - short[1]) / (lengths[1] - lengths[0])
    return out
