"""JSON whose values know where they stand, so that each error names its file and field."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sequences.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Node:
    """One value of a JSON file. Every method raises InputError where the value isn't what it asks for."""

    value: Any
    file: Path
    field: str = ""

    @classmethod
    def read(cls, file: Path, remedy: str) -> Node:
        """The root of a file. `remedy` says what to do where there is no such file."""
        try:
            return cls(json.loads(file.read_bytes()), file)
        except FileNotFoundError as error:
            raise InputError("the file is missing", file=file, field="(whole file)", remedy=remedy) from error
        except OSError as error:
            text = error.strerror or str(error)
            raise InputError(text, file=file, field="(whole file)", remedy="make it readable") from error
        except json.JSONDecodeError as error:
            place = f"line {error.lineno}, column {error.colno}"
            message = f"not valid JSON: {error.msg}"
            raise InputError(message, file=file, field=place, remedy="restore or rewrite the file") from error
        except UnicodeDecodeError as error:
            place = f"byte {error.start}"
            raise InputError("not UTF-8 text", file=file, field=place, remedy="restore or rewrite the file") from error

    def error(self, message: str, remedy: str) -> InputError:
        """An error about this value, to be raised."""
        return InputError(message, file=self.file, field=self.field or "(whole file)", remedy=remedy)

    def __getitem__(self, key: str) -> Node:
        """A member of an object, which must be there."""
        member = self.get(key)
        if member is None:
            raise self._at(key).error("missing", f"add {key}")
        return member

    def get(self, key: str) -> Node | None:
        """A member of an object; None where it is missing or null."""
        value = self._expect(dict, "an object").get(key)
        return None if value is None else self._at(key, value)

    def members(self) -> Iterator[tuple[str, Node]]:
        """The members of an object, in the file's order."""
        for key, value in self._expect(dict, "an object").items():
            yield key, self._at(key, value)

    def elements(self) -> list[Node]:
        """The elements of a list."""
        values = self._expect(list, "a list")
        return [Node(value, self.file, f"{self.field}[{k}]") for k, value in enumerate(values)]

    def text(self) -> str:
        """A string that isn't empty."""
        value: str = self._expect(str, "a string")
        if not value:
            raise self.error("empty", "give it a name")
        return value

    def flag(self) -> bool:
        """A truth value."""
        value: bool = self._expect(bool, "true or false")
        return value

    def integer(self) -> int:
        """A whole number."""
        if isinstance(self.value, bool) or not isinstance(self.value, int):
            raise self.error(f"{_shown(self.value)} is not a whole number", "write a whole number")
        return self.value

    def number(self) -> float:
        """A finite number."""
        return float(self.numbers(1, [self.value])[0])

    def positive(self) -> float:
        """A finite number above zero."""
        value = self.number()
        if value <= 0:
            raise self.error(f"{value:g} is not above zero", "write a value above zero")
        return value

    def numbers(self, n: int | None = None, values: list[Any] | None = None) -> Array:
        """A list (or, as BOP's older files have it, nested lists) of n finite numbers, flattened."""
        values = self._expect(list, "a list of numbers") if values is None else values
        try:
            array = np.array(values, dtype=np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise self.error(f"{_shown(self.value)} is not numeric", "write finite numbers") from error
        if n is not None and array.size != n:
            raise self.error(f"has {array.size} numbers, expected {n}", f"write {n} numbers")
        if not np.isfinite(array).all() or any(isinstance(v, str | bool) for v in values):
            raise self.error(f"{_shown(self.value)} is not numeric", "write finite numbers")
        return array

    def _at(self, key: str, value: Any = None) -> Node:
        return Node(value, self.file, f"{self.field}.{key}" if self.field else key)

    def _expect(self, kind: type, words: str) -> Any:
        if not isinstance(self.value, kind):
            raise self.error(f"{_shown(self.value)} is not {words}", f"write {words}")
        return self.value


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
