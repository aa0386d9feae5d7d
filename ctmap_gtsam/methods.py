"""The one registry of methods: what can be run on a run, and what each needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.smoothing.smoother import smooth_run
from sequences.progress import Progress
from sequences.types import Run

Runner = Callable[[Run, Config, Progress], Estimate]


@dataclass(frozen=True)
class Method:
    """One row of a comparison."""

    name: str
    summary: str
    kind: Literal["estimate", "detections"]
    """estimate: `run` makes an Estimate; detections: the run's own boxes are the answer, and `run` is None"""
    run: Runner | None
    skip: Callable[[Run], str | None]
    """why the method can't run on a run, with the remedy; None where it can"""


def _needs_detections(run: Run) -> str | None:
    if any(frame.detections for frame in run.frames):
        return None
    return "the run has no detections; add scene_detections.json to its scenes"


def _filter(run: Run, config: Config, progress: Progress, *, context: bool) -> Estimate:
    return filter_run(run, config, context=context, progress=progress)


def _smooth(run: Run, config: Config, progress: Progress, *, context: bool) -> Estimate:
    return smooth_run(run, config, context=context, progress=progress)


METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        Method("detector", "the detector's boxes as they are", "detections", None, _needs_detections),
        Method("filter-t", "T-Map: the particle filter without context", "estimate",
               partial(_filter, context=False), _needs_detections),
        Method("filter-ct", "CT-Map: the particle filter, each frame seeing the past", "estimate",
               partial(_filter, context=True), _needs_detections),
        Method("smooth-t", "the factor-graph smoother without context", "estimate",
               partial(_smooth, context=False), _needs_detections),
        Method("smooth-ct", "the factor-graph smoother, each frame seeing the whole run", "estimate",
               partial(_smooth, context=True), _needs_detections),
    )
}  # fmt: skip
