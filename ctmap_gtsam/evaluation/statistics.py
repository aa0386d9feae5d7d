"""Means and medians that know when there is nothing to tell."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_PROBABILITY = 1e-3
"""Probabilities are taken to be at least this in a log score, so that one mistake made with certainty isn't all"""


def median(values: Array) -> float | None:
    """None where there are no values, or where half of them are infinite."""
    middle = float(np.median(values)) if len(values) else np.inf
    return middle if np.isfinite(middle) else None


def mean(values: NDArray[Any]) -> float | None:
    """None where there are no values."""
    return float(np.mean(values)) if len(values) else None


def log_score(probability: Array) -> float | None:
    """Mean of -log p of what came true, nats, p at least LEAST_PROBABILITY; lower is better."""
    return mean(-np.log(np.maximum(probability, LEAST_PROBABILITY)))
