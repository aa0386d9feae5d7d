"""Progress bars on stderr, so that stdout holds results alone; and how long each stage took."""

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

from sequences.progress import Progress as Listener
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
        bar = _Bar(self._bars, task)
        began = time.perf_counter()
        self._depth += 1
        try:
            yield bar
        finally:
            self._depth -= 1
            self._bars.remove_task(task)
        line = f"{label}  {time.perf_counter() - began:.1f} s"
        if bar.parts:
            line += f" ({', '.join(f'{part} {seconds:.1f}' for part, seconds in bar.parts.items())})"
        self._console.print(line, style="dim", highlight=False, markup=False, soft_wrap=True)


class _Bar:
    def __init__(self, bars: Progress, task: TaskID) -> None:
        self._bars, self._task = bars, task
        self.parts: dict[str, float] = {}

    def advance(self, n: int = 1) -> None:
        """Move the bar on by n steps."""
        self._bars.advance(self._task, n)

    def spent(self, part: str, seconds: float) -> None:
        """Add to what a part took, which is said in the end."""
        self.parts[part] = self.parts.get(part, 0.0) + seconds


class Stopwatch:
    """`sequences.progress.Progress` that hands all on to another and keeps how long each stage and part took."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self.seconds: dict[str, float] = {}
        """stage, and "stage: part", in the order in which they ended"""

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """The listener's stage, timed. Stages of one name add up."""
        began = time.perf_counter()
        with self._listener.stage(name, total) as stage:
            yield _Watched(stage, self.seconds, name)
        _add(self.seconds, name, time.perf_counter() - began)


class _Watched:
    def __init__(self, stage: Stage, seconds: dict[str, float], name: str) -> None:
        self._stage, self._seconds, self._name = stage, seconds, name

    def advance(self, n: int = 1) -> None:
        """Hand it on."""
        self._stage.advance(n)

    def spent(self, part: str, seconds: float) -> None:
        """Keep it and hand it on."""
        _add(self._seconds, f"{self._name}: {part}", seconds)
        self._stage.spent(part, seconds)


def _add(seconds: dict[str, float], name: str, more: float) -> None:
    seconds[name] = seconds.get(name, 0.0) + more
