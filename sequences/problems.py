"""What is wrong with a recording: either the first problem is raised, or all of them are gathered.

The reader of `sequences.bop` is written once and wraps each thing it can do without (a frame, a class, a detection) in
`Checks.part`. `load_run` runs it strictly, `inspect_run` gathering, so both hold a recording to the same rules.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from sequences.errors import InputError

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a recording."""

    file: Path | None
    """the file that holds it"""
    field: str
    """where in the file: JSON path, image number"""
    message: str
    """what is wrong, in one sentence"""
    remedy: str
    """what the user can do about it"""
    severity: Severity = "error"
    """an error keeps the run from being loaded, a warning doesn't"""

    @classmethod
    def of(cls, error: InputError) -> Problem:
        """The problem that an InputError tells of."""
        return cls(error.file, error.field, error.message, error.remedy)

    def __str__(self) -> str:
        return f"{self.severity}: {InputError(self.message, file=self.file, field=self.field, remedy=self.remedy)}"


@dataclass
class Checks:
    """Where a reader's problems go."""

    strict: bool = True
    """raise the first error; else gather and read on without the part that holds it"""
    problems: list[Problem] = field(default_factory=list)
    """what was gathered, in the order of reading"""
    notes: list[str] = field(default_factory=list)
    """defaults that were derived because the data did not say, in words"""

    @contextmanager
    def part(self) -> Iterator[None]:
        """A part of the reading whose InputError is raised (strict) or gathered and swallowed."""
        try:
            yield
        except InputError as error:
            if self.strict:
                raise
            self.problems.append(Problem.of(error))

    def warn(self, message: str, *, file: Path, field: str, remedy: str) -> None:
        """Something odd that doesn't keep the run from being loaded."""
        self.problems.append(Problem(file, field, message, remedy, "warning"))

    def note(self, text: str) -> None:
        """A default that was derived."""
        self.notes.append(text)
