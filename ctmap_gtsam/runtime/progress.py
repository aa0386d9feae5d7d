"""Progress bars on stderr, so that stdout holds results alone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from sequences.progress import Stage


class RichProgress:
    """`sequences.progress.Progress` drawn by rich; to be used as a context manager.

    Where stderr is no terminal, each finished stage is one plain line with its seconds.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._bars = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._depth = 0

    def __enter__(self) -> RichProgress:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """A bar for as long as the block lasts, then one line that says how long it took."""
        label = "  " * self._depth + name
        task = self._bars.add_task(label, total=total)
        began = time.perf_counter()
        self._depth += 1
        try:
            yield _Bar(self._bars, task)
        finally:
            self._depth -= 1
            self._bars.remove_task(task)
        self._console.print(f"{label}  {time.perf_counter() - began:.1f} s", style="dim", highlight=False, markup=False)


class _Bar:
    def __init__(self, bars: Progress, task: TaskID) -> None:
        self._bars, self._task = bars, task

    def advance(self, n: int = 1) -> None:
        """Move the bar on by n steps."""
        self._bars.advance(self._task, n)
