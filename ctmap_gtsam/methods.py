"""The one registry of methods: what can be run on a run, and what each needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from ctmap_gtsam.baselines import oracle, registration
from ctmap_gtsam.baselines.cameras import cameras_of_known_objects
from ctmap_gtsam.baselines.copying import copy_back
from ctmap_gtsam.baselines.detected import register_detections
from ctmap_gtsam.baselines.fusion import static_fusion
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.backward import traced_back
from ctmap_gtsam.filtering.filter import Forward, filtered, forward
from ctmap_gtsam.filtering.literal import literal_filter_run
from ctmap_gtsam.smoothing.lagged import lagged_run
from ctmap_gtsam.smoothing.smoother import Look, smooth_run
from sequences.progress import Progress
from sequences.types import Run

Runner = Callable[..., Estimate]
"""(run, config, progress, *estimates of what it needs) -> its own"""


@dataclass(frozen=True)
class Reading:
    """How a method's estimate is read off a pass over the run; methods with the same `make` can share one."""

    make: Callable[..., Any]
    """(run, config, progress=, keep_past=) -> the pass"""
    keep_past: bool
    """whether the pass has to keep its past; one that does says the same to who doesn't need it"""
    read: Callable[[Run, Any, Progress], Estimate]

    def alone(self, run: Run, config: Config, progress: Progress) -> Estimate:
        """The estimate off a pass of its own."""
        return self.read(run, self.make(run, config, progress=progress, keep_past=self.keep_past), progress)


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
    needs: tuple[str, ...] = ()
    """methods on whose estimates it builds, and which can run wherever it can; `comparing.run_methods` runs them"""
    reads_truth: bool = False
    """it answers from what nobody knows outside a benchmark, and is shown as such"""
    resumes: bool = False
    """`run` takes `keep`: a file in which it keeps how far it is, or None"""
    reading: Reading | None = None
    """where the estimate is read off a pass that others may share; `run` makes one of its own"""


def _needs_detections(run: Run) -> str | None:
    if any(frame.detections for frame in run.frames):
        return None
    return "the run has no detections; add scene_detections.json to its scenes"


def _needs_open3d(run: Run) -> str | None:
    return _needs_detections(run) or registration.obstacle()


def _needs_truth(run: Run) -> str | None:
    return oracle.obstacle(run) or registration.obstacle()


def _filtered(run: Run, state: Forward, _progress: Progress) -> Estimate:
    return filtered(run, state)


def _literal(run: Run, config: Config, progress: Progress, *, context: bool) -> Estimate:
    return literal_filter_run(run, config, context=context, progress=progress)


def _smooth(
    run: Run,
    config: Config,
    progress: Progress,
    forward: Estimate,
    look: Look | None = None,
    keep: Path | None = None,
) -> Estimate:
    return smooth_run(run, forward, config, progress=progress, look=look, keep=keep)


def _lagged(run: Run, config: Config, progress: Progress, forward: Estimate, *, lag: int | None) -> Estimate:
    return lagged_run(run, forward, config, lag=lag, progress=progress)


_FORWARD_T, _FORWARD_CT = (partial(forward, context=context) for context in (False, True))
_FILTER_T = Reading(_FORWARD_T, keep_past=False, read=_filtered)
_FILTER_CT = Reading(_FORWARD_CT, keep_past=False, read=_filtered)
_BACKWARD_CT = Reading(_FORWARD_CT, keep_past=True, read=traced_back)

METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        Method("detector", "the detector's boxes as they are", "detections", None, _needs_detections),
        Method("icp", "ICP in each keyframe's detected boxes", "estimate",
               partial(register_detections, kind="icp"), _needs_open3d),
        Method("fpfh", "FPFH and RANSAC in each keyframe's detected boxes", "estimate",
               partial(register_detections, kind="fpfh"), _needs_open3d),
        Method("icp-oracle", "ICP in true boxes of the true class, where each object is last seen: reads the truth",
               "estimate", partial(oracle.register_truth, kind="icp"), _needs_truth, reads_truth=True),
        Method("fpfh-oracle", "FPFH and RANSAC in the same: reads the truth",
               "estimate", partial(oracle.register_truth, kind="fpfh"), _needs_truth, reads_truth=True),
        Method("cameras-oracle", "the cameras by the smoother's graph of one who knows the objects: reads the truth",
               "estimate", cameras_of_known_objects, oracle.obstacle, reads_truth=True),
        Method("static-fusion", "one pose an object and visit, fused from all keyframes: nothing moves, no context",
               "estimate", static_fusion, _needs_detections),
        Method("paper-t", "T-Map to the letter of the paper", "estimate",
               partial(_literal, context=False), _needs_detections),
        Method("paper-ct", "CT-Map to the letter of the paper: Algorithm 1 with its own potentials", "estimate",
               partial(_literal, context=True), _needs_detections),
        Method("filter-t", "T-Map: the particle filter without context", "estimate",
               _FILTER_T.alone, _needs_detections, reading=_FILTER_T),
        Method("filter-ct", "CT-Map: the particle filter, each frame seeing the past", "estimate",
               _FILTER_CT.alone, _needs_detections, reading=_FILTER_CT),
        Method("ffbsi-ct", "trajectories drawn back through filter-ct's particles: a smoother without a graph",
               "estimate", _BACKWARD_CT.alone, _needs_detections, reading=_BACKWARD_CT),
        Method("last-copied-back", "filter-ct's last map of each visit in all of the visit's frames", "estimate",
               copy_back, _needs_detections, needs=("filter-ct",)),
        Method("lag0-ct", "the smoother with a lag of 0: its factors and trellis, each frame seeing the past",
               "estimate", partial(_lagged, lag=0), _needs_detections, needs=("filter-ct",)),
        Method("lag-ct", "the smoother with a fixed lag, each frame seeing `smoother.lag` keyframes more",
               "estimate", partial(_lagged, lag=None), _needs_detections, needs=("filter-ct",)),
        Method("smooth-t", "the factor-graph smoother without context, from filter-t's objects", "estimate",
               _smooth, _needs_detections, needs=("filter-t",), resumes=True),
        Method("smooth-ct", "the factor-graph smoother from filter-ct's objects, each frame seeing the whole run",
               "estimate", _smooth, _needs_detections, needs=("filter-ct",), resumes=True),
    )
}  # fmt: skip
