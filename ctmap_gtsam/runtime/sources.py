"""Hashes of the source: what was made by other code is another result."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import factors
import sequences

_OURS, _FACTORS, _SEQUENCES = Path(__file__).parents[1], Path(factors.__path__[0]), Path(sequences.__path__[0])
_NOT_ESTIMATING = {"bench", "cli", "comparing.py", "evaluation", "export", "reporting"}


@dataclass(frozen=True)
class Code:
    """SHA-256 each."""

    simulating: str
    """of the source that makes simulated runs"""
    estimating: str
    """of the source that estimates"""
    judging: str
    """of the source that holds estimates to the truth"""


@cache
def code() -> Code:
    """The source as it is on disk when this is first asked."""
    return Code(
        simulating=_digest(_SEQUENCES),
        estimating=_digest(_OURS, _FACTORS, _SEQUENCES, without=_NOT_ESTIMATING),
        judging=_digest(_OURS / "evaluation", _SEQUENCES),
    )


def _digest(*roots: Path, without: Collection[str] = ()) -> str:
    """Over names and contents of all modules, but for those that `without` names directly below our own package."""
    digest = hashlib.sha256()
    for root in roots:
        for path in sorted(root.rglob("*.py")):
            relative = path.relative_to(root)
            if root != _OURS or relative.parts[0] not in without:
                digest.update(f"{root.name}/{relative.as_posix()}\0".encode() + path.read_bytes())
    return digest.hexdigest()
