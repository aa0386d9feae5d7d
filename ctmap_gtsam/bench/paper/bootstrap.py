"""Intervals over places: the percentile bootstrap (Efron and Tibshirani, An Introduction to the Bootstrap, 1993).

Places are drawn with replacement, the same draws for all rows: the interval of a difference is that of the paired
differences, which knows that a hard place is hard for both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sequences.seeds import generator

Array = NDArray[np.float64]
Item = TypeVar("Item")

LEVEL = 0.95
LEAST_SHARE = 0.9
"""An interval is given where at least so many of the draws have a figure"""


def draws(places: int, times: int) -> NDArray[np.int64]:
    """(times, places) positions of places, drawn with replacement; the same whenever asked."""
    return generator(0, "bench.paper.bootstrap", object_id=places).integers(0, places, (times, places))


def redrawn(
    figures: Callable[[Sequence[Item]], Mapping[str, float | None]],
    places: Sequence[Sequence[Item]],
    drawn: NDArray[np.int64],
) -> dict[str, Array]:
    """Figures of each draw.

    Args:
        figures: of any items together.
        places: the items of each place; a place that has none takes no part.
        drawn: (B, P) from `draws`.

    Returns:
        name -> (B,), NaN where a draw has no such figure.
    """
    found = [figures(items) if (items := [i for k in row for i in places[k]]) else {} for row in drawn]
    names = dict.fromkeys(name for one in found for name in one)
    return {name: np.array([_number(one.get(name)) for one in found]) for name in names}


def interval(values: Array) -> tuple[float, float] | None:
    """The central LEVEL of draws (B,); None where too few of them have a figure."""
    finite = values[np.isfinite(values)]
    if len(finite) < max(1.0, LEAST_SHARE * len(values)):
        return None
    low, high = np.quantile(finite, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return float(low), float(high)


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)
