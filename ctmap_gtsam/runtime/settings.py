"""Any tree of frozen dataclasses made of `sequences.options.option` fields: read, checked, changed and written as TOML.

The leaves are bool, int, float, str, a Literal of those, a tuple of leaves or of dataclasses, or one of these `| None`
with default None (TOML has no null, so what is None is written as a comment). Numbers are finite. Wrong input raises
InputError naming the setting by its dotted path and, for an unknown one, the nearest that exists.
"""

from __future__ import annotations

import difflib
import math
import tomllib
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from inspect import cleandoc
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tomlkit

from sequences.errors import InputError

T = TypeVar("T")

_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


def merge(settings: T, changes: Mapping[str, Any], origin: Path | str | None = None) -> T:
    """The same tree with some settings changed.

    Args:
        settings: a tree of frozen dataclasses.
        changes: nested mappings of the values to change, as TOML or JSON give them.
        origin: where they come from, for the error message.

    Raises:
        InputError: for an unknown setting, or a value of the wrong type or out of bounds.
    """
    return _Merge(type(settings), origin).section(settings, changes, "")


def check(settings: Any) -> None:
    """Raise InputError where a leaf of the tree has the wrong type or is out of bounds."""
    for path, f, kind, value in _leaves(settings):
        _Merge(type(settings), None).leaf(f, kind, value, path)


def to_dict(settings: Any) -> dict[str, Any]:
    """Nested dicts as JSON takes them; `merge` of any tree of the type with them gives `settings` again."""
    return {f.name: _plain(getattr(settings, f.name)) for f in fields(settings)}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_dict(value)
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


def to_toml(settings: Any) -> str:
    """Commented TOML; `merge` of a tree of defaults with it gives `settings` again."""
    document = tomlkit.document()
    _fill(document, settings)
    return tomlkit.dumps(document)


def read_toml(path: Path) -> dict[str, Any]:
    """Nested dicts of a TOML file; InputError where it can't be read or isn't TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"can't be read ({error.strerror})", file=path, remedy="give the path of a TOML file"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8", file=path, remedy="save it as UTF-8") from error
    except ValueError as error:  # not TOML, or a number too long for Python
        raise InputError(f"is not TOML: {error}", file=path, remedy="see https://toml.io for the syntax") from error


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """`["filter.particles=500", ...]` -> nested dicts; a value that isn't TOML is taken as text.

    A later assignment replaces an earlier one.
    """
    out: dict[str, Any] = {}
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        names = [name.strip() for name in path.split(".")]
        if not equals or not all(names):
            raise InputError(
                f"{assignment!r} assigns nothing", field="--set", remedy="write --set section.setting=value"
            )
        parent = out
        for name in names[:-1]:
            parent = parent.setdefault(name, {})
            if not isinstance(parent, dict):
                raise InputError(
                    f"{assignment!r} names a setting inside {name!r}, which was given a value",
                    field="--set",
                    remedy="leave one of the two out",
                )
        parent[names[-1]] = _value(text.strip())
    return out


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except ValueError:  # not TOML, or a number too long for Python
        return text


class _Merge:
    """One merge into a tree of the type `root`; it knows where the values come from."""

    def __init__(self, root: type, origin: Path | str | None) -> None:
        self._root, self._origin = root, origin

    def section(self, settings: T, changes: Any, path: str) -> T:
        if not isinstance(changes, Mapping):
            raise self._error(f"is a section, not a setting: got {changes!r}", path, f"set one of {_names(settings)}")
        known = {f.name: (f, kind) for f, kind in _typed(type(settings))}
        new: dict[str, Any] = {}
        for name, value in changes.items():
            inner = f"{path}.{name}" if path else name
            if name not in known:
                raise self._error("no such setting", inner, self._suggestion(inner))
            f, kind = known[name]
            if is_dataclass(kind):
                new[name] = self.section(getattr(settings, name), value, inner)
            else:
                new[name] = self.leaf(f, kind, _tuples(value), inner)
        try:
            return replace(settings, **new)  # type: ignore[type-var]
        except ValueError as error:  # from a section's own __post_init__
            raise self._error(str(error), path, "change these settings together") from error

    def leaf(self, f: Field[Any], kind: Any, value: Any, path: str) -> Any:
        """The value as the type wants it."""
        if get_origin(kind) in (Union, types.UnionType):
            if value is None:
                return None
            kind = next(k for k in get_args(kind) if k is not types.NoneType)
        if is_dataclass(kind):
            return self.section(kind(), to_dict(value) if isinstance(value, kind) else value, path)  # type: ignore
        if get_origin(kind) is tuple:
            return self._tuple(f, kind, value, path)
        if get_origin(kind) is Literal:
            if value not in get_args(kind) or isinstance(value, bool):
                choices = ", ".join(repr(choice) for choice in get_args(kind))
                raise self._error(f"{value!r} is none of the choices", path, f"choose one of {choices}")
            return value
        return self._scalar(f, kind, value, path)

    def _tuple(self, f: Field[Any], kind: Any, value: Any, path: str) -> tuple[Any, ...]:
        inner = get_args(kind)
        if not isinstance(value, tuple):
            raise self._error(f"{value!r} is no list", path, "write it as [a, b, ...]")
        if inner[-1:] == (Ellipsis,):
            inner = (inner[0],) * len(value)
        if len(value) != len(inner):
            raise self._error(f"has {len(value)} values", path, f"give {len(inner)}")
        return tuple(self.leaf(f, k, v, f"{path}[{n}]") for n, (k, v) in enumerate(zip(inner, value, strict=True)))

    def _scalar(self, f: Field[Any], kind: type, value: Any, path: str) -> Any:
        wanted = f"give {_WORDS[kind]}{_bounds(f)}"
        fits = isinstance(value, kind) or (kind is float and isinstance(value, int))
        if not fits or (kind is not bool and isinstance(value, bool)):
            raise self._error(f"{value!r} is not {_WORDS[kind]}", path, wanted)
        if kind is float:
            value = _to_float(value)
            if not math.isfinite(value):
                raise self._error(f"{value!r} is not finite", path, wanted)
        low, high = f.metadata.get("low"), f.metadata.get("high")
        if (low is not None and value < low) or (high is not None and value > high):
            raise self._error(f"{value!r} is out of bounds", path, wanted)
        return value

    def _suggestion(self, path: str) -> str:
        known = list(_paths(self._root))
        last = {k.rsplit(".", 1)[-1]: k for k in reversed(known)}
        near = difflib.get_close_matches(path, known, n=1)
        near += [last[k] for k in difflib.get_close_matches(path.rsplit(".", 1)[-1], last, n=1)]
        return (f"did you mean {near[0]}? " if near else "") + "`ctmap config` lists every setting"

    def _error(self, message: str, path: str, remedy: str) -> InputError:
        return InputError(message, file=self._origin, field=path, remedy=remedy)


def _to_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number beyond the largest float
        return math.inf


_TYPED: dict[type, tuple[tuple[Field[Any], Any], ...]] = {}


def _typed(kind: type) -> tuple[tuple[Field[Any], Any], ...]:
    """Its fields and their types, which take a while to find."""
    if kind not in _TYPED:
        hints = get_type_hints(kind)
        _TYPED[kind] = tuple((f, hints[f.name]) for f in fields(kind))
    return _TYPED[kind]


def _leaves(settings: Any, path: str = "") -> Iterator[tuple[str, Field[Any], Any, Any]]:
    for f, kind in _typed(type(settings)):
        value, inner = getattr(settings, f.name), f"{path}{f.name}"
        if is_dataclass(kind):
            yield from _leaves(value, f"{inner}.")
        else:
            yield inner, f, kind, value


def _paths(kind: type, path: str = "") -> Iterator[str]:
    for f, inner in _typed(kind):
        if is_dataclass(inner):
            yield from _paths(inner, f"{path}{f.name}.")  # type: ignore[arg-type]
        else:
            yield f"{path}{f.name}"


def _names(settings: Any) -> str:
    return ", ".join(f.name for f in fields(settings))


def _bounds(f: Field[Any]) -> str:
    low, high = f.metadata.get("low"), f.metadata.get("high")
    if low is not None and high is not None:
        return f", from {low:g} to {high:g}"
    if low is not None:
        return f", at least {low:g}"
    return f", at most {high:g}" if high is not None else ""


def _fill(table: Any, settings: Any) -> None:
    sections = []
    for f, kind in _typed(type(settings)):
        value = getattr(settings, f.name)
        if is_dataclass(kind):
            sections.append((f.name, value))
            continue
        table.add(tomlkit.comment(_comment(f, kind)))
        if value is None:
            table.add(tomlkit.comment(f"{f.name} is not set"))
        else:
            table.add(f.name, _item(value))
    for name, value in sections:
        section = tomlkit.table()
        for line in cleandoc(type(value).__doc__ or "").splitlines():
            section.add(tomlkit.comment(line))
        _fill(section, value)
        table.add(tomlkit.nl())
        table.add(name, section)


def _item(value: Any) -> tomlkit.items.Item:
    """On one line: a list of tables of its own would swallow the settings after it."""
    if is_dataclass(value):
        table = tomlkit.inline_table()
        for f in fields(value):
            inner = getattr(value, f.name)
            if inner is not None:
                table.append(f.name, _item(inner))
        return table
    if isinstance(value, tuple):
        array = tomlkit.array()
        for inner in value:
            array.append(_item(inner))
        return array
    return tomlkit.item(value)


def _comment(f: Field[Any], kind: Any) -> str:
    parts = [" ".join(f.metadata.get("doc", "").split()) + _bounds(f)]
    if get_origin(kind) is Literal:
        parts.append("one of " + ", ".join(repr(choice) for choice in get_args(kind)))
    if f.default is not MISSING and f.default is not None:
        parts.append(f"default {_item(f.default).as_string()}")
    return "; ".join(part for part in parts if part)
