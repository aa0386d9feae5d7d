"""One estimator on one run in a process of its own: seconds a keyframe, and the most memory it ever held.

Seconds are those that the process had a core for, all threads together: other programs on the machine count little.
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ctmap_gtsam.bench.scaling.loop import looped
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.smoothing.smoother import smooth_run
from sequences.bop import load_run

WARM = 4  # keyframes of a first run, which loads kernels and builds what is built once


@dataclass(frozen=True)
class Measured:
    """What one run took, CPU seconds."""

    seconds: float
    """all of it"""
    each_s: tuple[float, ...]
    """of each step of the first stage: the filter's keyframes"""
    peak_mb: float
    """most memory held at once, megabytes; by the process alone, not by those that the filter has beside it"""
    objects: int
    """in the estimate"""


def forward(folder: Path, keyframes: int) -> Path:
    """Beside a round: what the filter said last of so many keyframes, for the smoother to begin with."""
    return folder / f"filter-ct-{keyframes}.npz"


def measure(method: str, folder: Path, keyframes: int, config: Config) -> Measured:
    """Run an estimator on so many keyframes of a loop, in a fresh process.

    Args:
        method: "filter" or "smooth".
        folder: one round, by `loop.write_loop`. The filter leaves its estimate there (`forward`), and the smoother
            begins from it.
        keyframes: of the run.
        config: settings.

    Raises:
        RuntimeError: the process died.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(there, method, folder, keyframes, config))
    process.start()
    there.close()
    try:
        measured: Measured = here.recv()
        return measured
    except EOFError:
        process.join()
        raise RuntimeError(f"{method} on {keyframes} keyframes ended with code {process.exitcode}") from None
    finally:
        process.join()


def _work(connection: Connection, method: str, folder: Path, keyframes: int, config: Config) -> None:
    round_, smooth = load_run(folder), method == "smooth"
    warm = filter_run(looped(round_, WARM), config)
    if smooth:
        smooth_run(looped(round_, WARM), warm, config)
    begins = forward(folder, keyframes)
    run = looped(round_, keyframes)
    clock = _Clock()
    if smooth:  # which holds what it begins with no longer than it needs it
        estimate = smooth_run(run, Estimate.load(begins), config, progress=clock)
    else:
        estimate = filter_run(run, config, progress=clock)
    seconds = time.process_time() - clock.began
    each = tuple(float(s) for s in np.diff([clock.began, *clock.ticks]))
    measured = Measured(seconds, each, peak_mb(), len(estimate.object_id))
    if not smooth:
        estimate.save(begins)
    connection.send(measured)


@dataclass
class _Clock:
    """A progress that notes when each step of the first stage ended."""

    began: float = field(default_factory=time.process_time)
    ticks: list[float] = field(default_factory=list)
    _first: bool = True

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[_Ticks]:
        """A stage; the first one is timed."""
        ticks, self._first = (self.ticks if self._first else []), False
        yield _Ticks(ticks)


@dataclass(frozen=True)
class _Ticks:
    ticks: list[float]

    def advance(self, n: int = 1) -> None:
        """Note the time."""
        self.ticks.append(time.process_time())

    def spent(self, part: str, seconds: float) -> None:
        """Parts are not told apart."""


def peak_mb() -> float:
    """The most memory that this process ever held, megabytes."""
    status = Path("/proc/self/status")
    if status.is_file():  # getrusage begins with what the process held that started this one
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return float(line.split()[1]) / 1024.0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 2**20 if sys.platform == "darwin" else most / 1024.0


def with_particles(config: Config, particles: int) -> Config:
    """The same settings with so many particles an object."""
    return replace(config, filter=replace(config.filter, particles=particles))
