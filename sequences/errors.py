"""The one kind of error a user can cause: it says where, what and how to mend it."""

from __future__ import annotations

from pathlib import Path


class InputError(Exception):
    """Bad input, reported without a traceback and with exit code 2 by the command line.

    Args:
        message: what is wrong, in one sentence.
        file: the file that holds it, if there is one.
        field: where in the file (JSON path, column, image number).
        remedy: what the user can do about it.
    """

    def __init__(self, message: str, *, file: Path | str | None = None, field: str = "", remedy: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.file = None if file is None else Path(file)
        self.field = field
        self.remedy = remedy

    def __str__(self) -> str:
        place = ": ".join(str(part) for part in (self.file, self.field) if part)
        text = f"{place}: {self.message}" if place else self.message
        return f"{text} Remedy: {self.remedy}" if self.remedy else text
