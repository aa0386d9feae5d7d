"""How long work says how far it is, without knowing who listens.

A function that takes a while has a parameter `progress: Progress = SILENT` and wraps its loops::

    with progress.stage("filter", total=len(keyframes)) as stage:
        for keyframe in keyframes:
            ...
            stage.advance()

The command line hands in `ctmap_gtsam.runtime.progress.RichProgress`, which draws on stderr.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Stage(Protocol):
    """One piece of work of known or unknown length."""

    def advance(self, n: int = 1) -> None:
        """Say that n more steps are done."""


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


SILENT = SilentProgress()
"""The default of every `progress` parameter"""
