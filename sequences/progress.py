"""How long work says how far it is, without knowing who listens.

A function that takes a while has a parameter `progress: Progress = SILENT` and wraps its loops::

    with progress.stage("filter", total=len(keyframes)) as stage:
        for keyframe in keyframes:
            ...
            stage.advance()

The command line hands in `ctmap_gtsam.runtime.progress.RichProgress`, which draws on stderr.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Stage(Protocol):
    """One piece of work of known or unknown length."""

    def advance(self, n: int = 1) -> None:
        """Say that n more steps are done."""

    def spent(self, part: str, seconds: float) -> None:
        """Say that a part of the steps took so long; repeated calls add up. See `timed`."""


class Progress(Protocol):
    """Whoever listens. Stages may nest; each ends with its `with` block."""

    def stage(self, name: str, total: int | None = None) -> AbstractContextManager[Stage]:
        """Begin a piece of work of `total` steps, None where nobody knows how many."""


class SilentProgress:
    """Nobody listens."""

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """A stage that shows nothing."""
        yield _SilentStage()


class _SilentStage:
    def advance(self, n: int = 1) -> None:
        """Show nothing."""

    def spent(self, part: str, seconds: float) -> None:
        """Keep nothing."""


@contextmanager
def timed(stage: Stage, part: str) -> Iterator[None]:
    """Tell a stage how long the block takes. Seconds go to whoever listens and never into a result."""
    began = time.perf_counter()
    try:
        yield
    finally:
        stage.spent(part, time.perf_counter() - began)


SILENT_STAGE: Stage = _SilentStage()
"""A stage that nobody watches"""

SILENT = SilentProgress()
"""The default of every `progress` parameter"""
