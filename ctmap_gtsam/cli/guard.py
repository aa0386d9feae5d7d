"""What the user can mend is one clean message and an exit code, never a traceback."""

from __future__ import annotations

import errno
import shlex
from typing import Any

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperGroup

from sequences.errors import InputError

EXIT_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells have it

_ARGUMENTS = "ctmap.arguments"


class GuardedGroup(TyperGroup):
    """A group of commands that reports `InputError`, files that can't be written and Ctrl-C."""

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **extra: Any) -> Any:
        """As typer's, keeping the arguments for `invoke`."""
        arguments = list(args)
        context = super().make_context(info_name, args, *rest, **extra)
        context.meta[_ARGUMENTS] = arguments
        return context

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except InputError as error:
            show(error)
            raise typer.Exit(EXIT_INPUT) from error
        except OSError as error:
            if error.errno is None or error.errno == errno.EPIPE:
                raise
            show(_unusable_file(error))
            raise typer.Exit(EXIT_INPUT) from error
        except KeyboardInterrupt as error:
            command = shlex.join([ctx.info_name or "ctmap", *ctx.meta[_ARGUMENTS]])
            _stderr().print(
                Text(f"\nStopped. No file was left half-written; what was finished is kept.\nRun again: {command}")
            )
            raise typer.Exit(EXIT_INTERRUPTED) from error


def show(error: InputError) -> None:
    """Print the error on stderr: what is wrong, in which file and field, and the remedy."""
    lines = Text.assemble(("error: ", "bold red"), error.message)
    for name, value in (("file", error.file), ("field", error.field), ("remedy", error.remedy)):
        if value:
            lines.append(f"\n  {name + ':':<8}", style="bold").append(str(value))
    _stderr().print(lines)


def _unusable_file(error: OSError) -> InputError:
    return InputError(
        f"{error.strerror or error}",
        file=error.filename,
        remedy="free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "choose a path that can be used",
    )


def _stderr() -> Console:
    return Console(stderr=True, soft_wrap=True, highlight=False)
