"""A state between two rounds on disk, so that work that was stopped goes on from there.

What is kept is a tree of dataclasses, mappings, tuples, lists, arrays and plain values, in one .npz without pickle: the
tree as JSON, and the numbers of all arrays. It comes back as it was, to the last bit and in the same memory order,
since sums depend on that; so what goes on from it ends in the same bytes. It is no format for anybody else.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sequences.atomic import write_npz

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
        tree = _packed(state, arrays, {kind.__name__ for kind in self.kinds})
        flat = {
            f"numbers.{dtype}": np.concatenate([a.ravel(order="K") for a in arrays if a.dtype.str == dtype])
            for dtype in sorted({a.dtype.str for a in arrays})
        }
        text = json.dumps({"key": self.key, "state": tree})
        write_npz(self.path, {**flat, "tree": np.frombuffer(text.encode(), dtype=np.uint8)})

    def load(self) -> Any:
        """The state; None where there is none of this work, whole."""
        try:
            with np.load(self.path, allow_pickle=False) as archive:
                flat = {name.removeprefix("numbers."): archive[name] for name in archive.files}
            told = json.loads(flat.pop("tree").tobytes())
            if told["key"] != json.loads(json.dumps(self.key)):
                return None
            used = dict.fromkeys(flat, 0)
            return _unpacked(told["state"], flat, used, {kind.__name__: kind for kind in self.kinds})
        except _BROKEN:
            return None

    def remove(self) -> None:
        """When the work is done."""
        self.path.unlink(missing_ok=True)


def _packed(value: Any, arrays: list[np.ndarray[Any, Any]], kinds: Iterable[str]) -> Any:
    """JSON of a value; a list is [what it is, ...], so that all else can be a list as well."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return _packed(value.item(), arrays, kinds)
    if isinstance(value, np.ndarray):
        turned = value.flags.f_contiguous and not value.flags.c_contiguous
        arrays.append(value if turned else np.ascontiguousarray(value))
        return ["array", value.dtype.str, "F" if turned else "C", list(value.shape)]
    if isinstance(value, tuple | list):
        return [type(value).__name__, *(_packed(v, arrays, kinds) for v in value)]
    if isinstance(value, Mapping):
        return ["mapping", *([k, _packed(v, arrays, kinds)] for k, v in value.items())]
    name = type(value).__name__
    if is_dataclass(value) and name in kinds:
        return ["kept", name, *(_packed(getattr(value, f.name), arrays, kinds) for f in fields(value))]
    raise TypeError(f"a checkpoint can't hold a {name}")


def _unpacked(tree: Any, flat: Mapping[str, Any], used: dict[str, int], kinds: Mapping[str, type]) -> Any:
    if not isinstance(tree, list):
        return tree
    what, *rest = tree
    if what == "array":
        dtype, order, shape = rest
        begin, size = used[dtype], int(np.prod(shape, dtype=np.int64))
        used[dtype] = begin + size
        return flat[dtype][begin : begin + size].reshape(shape, order=order).copy(order="K")
    if what == "mapping":
        return {key: _unpacked(v, flat, used, kinds) for key, v in rest}
    if what == "kept":
        kind = kinds[rest[0]]
        names = [f.name for f in fields(kind)]
        values = [_unpacked(v, flat, used, kinds) for v in rest[1:]]
        return kind(**dict(zip(names, values, strict=True)))
    values = [_unpacked(v, flat, used, kinds) for v in rest]
    return tuple(values) if what == "tuple" else values
