"""How the filter did at each keyframe: how many particles count, how sure it is of classes, how much it rendered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.filtering.reporting import Reported

Array = NDArray[np.float64]


@dataclass
class Scored:
    """Hypotheses scored at each keyframe, by object."""

    keyframes: list[int] = field(default_factory=list)
    """of all, those that became no object among them"""
    objects: list[dict[int, int]] = field(default_factory=list)
    """object or new track -> how many"""

    def begin(self) -> None:
        """The next keyframe."""
        self.keyframes.append(0)
        self.objects.append({})

    def last(self, object_id: int) -> int:
        """How many an object had at the keyframe before."""
        return self.objects[-2].get(object_id, 0) if len(self.objects) > 1 else 0

    def add(self, object_id: int, count: int) -> None:
        """So many for an object."""
        self.keyframes[-1] += count
        self.objects[-1][object_id] = self.objects[-1].get(object_id, 0) + count


def diagnostics(objects: Sequence[int], reports: Sequence[Mapping[int, Reported]], scored: Scored) -> dict[str, Any]:
    """What goes into the estimate's meta data (docs/format.md).

    Args:
        objects: the rows of the estimate.
        reports: of each keyframe.
        scored: the same.
    """

    def table(value: Callable[[Reported], float]) -> list[list[float | None]]:
        return [[number(value(r[i])) if i in r and r[i].visible else None for r in reports] for i in objects]

    return {
        "hypotheses_scored": sum(scored.keyframes),
        "keyframes": {"hypotheses_scored": list(scored.keyframes)},
        "objects": {
            "effective_sample_size": table(lambda r: r.effective),
            "class_entropy": table(lambda r: entropy(r.class_probability)),
            "hypotheses_scored": [[counts.get(i, 0) for counts in scored.objects] for i in objects],
        },
    }


def entropy(probability: Array) -> float:
    """-sum p log p of probabilities (C,), nats."""
    p = probability[probability > 0.0]
    return float(-(p * np.log(p)).sum()) + 0.0


def number(value: float) -> float:
    """Four digits are enough to look at."""
    return float(f"{value:.4g}")
