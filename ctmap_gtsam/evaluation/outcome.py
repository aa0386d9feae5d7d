"""What became of a method that was asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from ctmap_gtsam.estimate import Estimate


@dataclass(frozen=True)
class Outcome:
    """One method on one run."""

    status: Literal["ok", "skipped"]
    """skipped: it can't run here; `reason` and `remedy` say why and what would help"""
    seconds: float | None = None
    """wall-clock time of the method; None where it didn't run"""
    estimate: Estimate | None = None
    """None where it didn't run, and for the detector, which has no poses"""
    reason: str = ""
    remedy: str = ""
    reads_truth: bool = False
    """whether the method answers from the truth, so that no other is to be held to it"""
    stages: Mapping[str, float] = field(default_factory=dict)
    """seconds of each stage and of its parts ("stage: part"), where the method has any"""
