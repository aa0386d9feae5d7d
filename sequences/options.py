"""Settings that say what they mean: a dataclass field with its sentence and its bounds."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def option(default: Any, doc: str, *, low: float | None = None, high: float | None = None) -> Any:
    """A dataclass field whose metadata holds `doc` (meaning and unit) and inclusive bounds, for `ctmap config`."""
    return field(default=default, metadata={"doc": doc, "low": low, "high": high})
