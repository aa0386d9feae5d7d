"""A state between two rounds on disk, so that work that was stopped goes on from there.

What is kept is a tree of dataclasses, mappings, tuples, lists, arrays and plain values, in one zip archive: the tree as
JSON, and the numbers of all arrays in the order in which the tree names them. Both are written and read piece by piece:
of a long run a state is the most there is in memory, and it isn't held twice. It comes back as it was, to the last bit
and in the same memory order, since sums depend on that; so what goes on from it ends in the same bytes. It is no format
for anybody else.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from sequences.atomic import replacing

_TREE, _NUMBERS = "tree.json", "numbers."
_BROKEN = (OSError, EOFError, ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class Checkpoint:
    """One file that holds the last state of some work."""

    path: Path
    key: Mapping[str, Any]
    """JSON: all that the work depends on; a state of other work isn't taken"""
    kinds: tuple[type, ...]
    """the dataclasses that a state may hold"""

    def save(self, state: Any) -> None:
        """Replace what is there, whole or not at all. Raises TypeError for what a state may not hold."""
        arrays: list[np.ndarray[Any, Any]] = []
        with replacing(self.path) as stream, zipfile.ZipFile(stream, "w") as archive:
            with archive.open(_TREE, "w", force_zip64=True) as out:
                out.write(f'{{"key": {json.dumps(self.key)}, "state": '.encode())
                for text in _packed(state, arrays, {kind.__name__ for kind in self.kinds}):
                    out.write(text.encode())
                out.write(b"}")
            for dtype in sorted({a.dtype.str for a in arrays}):
                with archive.open(_NUMBERS + dtype, "w", force_zip64=True) as out:
                    for array in arrays:
                        if array.dtype.str == dtype:
                            out.write(array.tobytes(order="F" if _is_turned(array) else "C"))

    def load(self) -> Any:
        """The state; None where there is none of this work, whole."""
        try:
            with zipfile.ZipFile(self.path) as archive, ExitStack() as opened:
                told = json.loads(archive.read(_TREE))
                if told["key"] != json.loads(json.dumps(self.key)):
                    return None
                names = [name for name in archive.namelist() if name.startswith(_NUMBERS)]
                numbers = {name.removeprefix(_NUMBERS): opened.enter_context(archive.open(name)) for name in names}
                state = _unpacked(told["state"], numbers, {kind.__name__: kind for kind in self.kinds})
                # where a stream ends, its checksum is looked at
                return None if any(stream.read(1) for stream in numbers.values()) else state
        except _BROKEN:
            return None

    def remove(self) -> None:
        """When the work is done."""
        self.path.unlink(missing_ok=True)


def _is_turned(array: np.ndarray[Any, Any]) -> bool:
    """Whether it is in Fortran's order and not in C's."""
    return array.flags.f_contiguous and not array.flags.c_contiguous


def _packed(value: Any, arrays: list[np.ndarray[Any, Any]], kinds: Collection[str]) -> Iterator[str]:
    """JSON of a value; a list is [what it is, ...], so that all else can be a list as well."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        yield json.dumps(value)
    elif isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("a checkpoint can't hold an array of objects")
        arrays.append(value)
        yield json.dumps(["array", value.dtype.str, "F" if _is_turned(value) else "C", list(value.shape)])
    elif isinstance(value, tuple | list):
        yield from _listed([type(value).__name__], value, arrays, kinds)
    elif isinstance(value, Mapping):
        yield '["mapping"'
        for key, v in value.items():
            yield f", [{json.dumps(key)}, "
            yield from _packed(v, arrays, kinds)
            yield "]"
        yield "]"
    elif is_dataclass(value) and type(value).__name__ in kinds:
        own = (getattr(value, f.name) for f in fields(value))
        yield from _listed(["kept", type(value).__name__], own, arrays, kinds)
    else:
        raise TypeError(f"a checkpoint can't hold a {type(value).__name__}")


def _listed(
    what: list[str], values: Iterable[Any], arrays: list[np.ndarray[Any, Any]], kinds: Collection[str]
) -> Iterator[str]:
    yield json.dumps(what)[:-1]
    for value in values:
        yield ", "
        yield from _packed(value, arrays, kinds)
    yield "]"


def _unpacked(tree: Any, numbers: Mapping[str, IO[bytes]], kinds: Mapping[str, type]) -> Any:
    if not isinstance(tree, list):
        return tree
    what, *rest = tree
    if what == "array":
        dtype, order, shape = rest
        size = np.dtype(dtype).itemsize * int(np.prod(shape, dtype=np.int64))
        return np.ndarray(shape, dtype, numbers[dtype].read(size), order=order).copy(order="K")
    if what == "mapping":
        return {key: _unpacked(v, numbers, kinds) for key, v in rest}
    if what == "kept":
        kind = kinds[rest[0]]
        names = [f.name for f in fields(kind)]
        values = [_unpacked(v, numbers, kinds) for v in rest[1:]]
        return kind(**dict(zip(names, values, strict=True)))
    values = [_unpacked(v, numbers, kinds) for v in rest]
    return tuple(values) if what == "tuple" else values
