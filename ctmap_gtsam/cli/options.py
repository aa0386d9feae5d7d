"""The arguments and options that several commands share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sequences.errors import InputError

if TYPE_CHECKING:
    from ctmap_gtsam.config import Config

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run: a BOP dataset.", show_default=False)]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.", show_default=False)]
Scene = Annotated[
    int | None,
    typer.Option("--scene", metavar="N", help="The BOP scene to read, where the run's visits are not listed."),
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings as TOML; see `ctmap config`.")
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change one setting, such as keyframes.every=2; repeatable."),
]
Seed = Annotated[int | None, typer.Option("--seed", metavar="S", help="Short for --set seed=S.", show_default=False)]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON too.")]


def settings(file: Path | None, assignments: list[str] | None, seed: int | None = None) -> Config:
    """The settings that the options ask for."""
    from ctmap_gtsam.config import load_config

    return load_config(file, [*(assignments or []), *([] if seed is None else [f"seed={seed}"])])


def writable(folder: Path) -> Path:
    """The folder, where files can be put into it or it can be made; else InputError, before any work is done."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise InputError(f"can't be made: {existing} is a file", file=folder, remedy="choose another folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"can't be written: no permission in {existing}", file=folder, remedy="choose another folder")
    return folder
