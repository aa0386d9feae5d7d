"""Files and folders are written whole or not at all: beside the target first, then renamed over it."""

from __future__ import annotations

import ctypes
import io
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np


def write_bytes(path: Path, data: bytes) -> None:
    """Replace `path` by `data` in one step; a killed process leaves the old file or the new, never half.

    Raises OSError where the folder can't be written.
    """
    write_together({path: data})


def write_together(files: Mapping[Path, bytes]) -> None:
    """Replace several files: all are written beside their targets before the first takes its place.

    Raises OSError where one can't be written; then none has changed.
    """
    ready: dict[Path, Path] = {}
    try:
        for path, data in files.items():
            with _beside(Path(path)) as (stream, made):
                ready[made] = Path(path)
                stream.write(data)
        for made, target in ready.items():
            os.replace(made, target)
    except BaseException:
        for made in ready:
            made.unlink(missing_ok=True)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A stream into a file beside `path` that takes its place where the block ends in good order, else is gone.

    Raises OSError where the folder can't be written.
    """
    path = Path(path)
    with _beside(path) as (stream, made):
        yield stream
    try:
        os.replace(made, path)
    except BaseException:
        made.unlink(missing_ok=True)
        raise


@contextmanager
def _beside(path: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """A stream into a new file beside `path`, and that file: whole on the disk where the block ends, else gone."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    made = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            yield stream, made
            stream.flush()
            os.fsync(stream.fileno())
        made.chmod(0o666 & ~_umask())
    except BaseException:
        made.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """UTF-8, as `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """JSON with indent 1; NaN and infinity are refused (ValueError), since JSON has none."""
    write_bytes(path, json_bytes(value))


def json_bytes(value: Any) -> bytes:
    """What `write_json` writes."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Arrays as one compressed .npz without pickle, whole or not at all; the same arrays give the same bytes."""
    with replacing(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name in sorted(arrays):
            data = io.BytesIO()
            np.lib.format.write_array(data, np.asanyarray(arrays[name]), allow_pickle=False)
            # np.savez stamps the time of day; what an entry's own info doesn't say of compression counts as none
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            archive.writestr(entry, data.getvalue(), zipfile.ZIP_DEFLATED)


def replace_folder(new: Path, target: Path) -> None:
    """Put the folder `new` in the place of the folder `target`, which is deleted if it is there.

    Linux and macOS exchange the two in one step. Elsewhere a process killed between two renames leaves the old folder
    whole, but beside the target under a hidden name. Raises OSError.
    """
    if not target.exists() or not any(target.iterdir()):
        new.replace(target)
    elif _exchange(new, target):
        shutil.rmtree(new)
    else:
        old = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}.old-"))
        target.replace(old)
        new.replace(target)
        shutil.rmtree(old)


def _exchange(a: Path, b: Path) -> bool:
    """Swap the names of two folders in one step; False where the system can't."""
    if os.name != "posix":
        return False
    here, swap = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux; RENAME_SWAP of macOS is 2 as well
    library = ctypes.CDLL(None)
    if hasattr(library, "renameat2"):
        return bool(library.renameat2(here, os.fsencode(a), here, os.fsencode(b), swap) == 0)
    if hasattr(library, "renamex_np"):
        return bool(library.renamex_np(os.fsencode(a), os.fsencode(b), swap) == 0)
    return False


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
