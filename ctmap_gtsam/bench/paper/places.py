"""The simulated places: made, told apart by hashes, and held to the frozen set.

manifest.json, beside this module, holds for each seed of the reported set what its place hashes to. Any change of the
simulator, of its settings or of a library beneath that changes a byte of a place shows here.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ctmap_gtsam.bench.paper.protocol import Place
from ctmap_gtsam.runtime.settings import to_dict
from sequences.atomic import write_json
from sequences.bop import load_run
from sequences.errors import InputError
from sequences.truth import truth_fingerprint

MANIFEST = Path(__file__).with_name("manifest.json")
SCHEMA = 1


@dataclass(frozen=True)
class Identity:
    """SHA-256 each: two places with the same are the same to the byte."""

    settings: str
    """of the simulator, as the place has them"""
    run: str
    """all that an estimator may read"""
    truth: str
    """the files that no estimator may read"""


@dataclass(frozen=True)
class Guard:
    """Whether places are those of the frozen set."""

    holds: bool
    differing: Mapping[int, str]
    """seed -> what of it differs, in words"""
    reason: str
    """why the set doesn't hold, in words; empty where it does"""


def simulate(folder: Path, place: Place) -> Identity:
    """Write the place's run into a folder; replaced where it is there. Raises InputError where things don't fit."""
    from sequences.simulation import simulate_place

    simulate_place(folder, place.simulation, place.seed)
    return identify(folder, place)


def identify(folder: Path, place: Place) -> Identity:
    """What a place's run hashes to."""
    run = load_run(folder)
    return Identity(settings=hash_of(to_dict(place.simulation)), run=run.fingerprint, truth=truth_fingerprint(run))


def hash_of(value: Any) -> str:
    """SHA-256 of what JSON can write."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def write_manifest(places: Mapping[int, Identity], path: Path = MANIFEST) -> None:
    """Freeze a set."""
    write_json(path, {"schema": SCHEMA, "places": {str(seed): asdict(place) for seed, place in places.items()}})


def guard(found: Mapping[int, Identity], path: Path = MANIFEST) -> Guard:
    """Hold places to the manifest.

    Args:
        found: seed -> what its place hashes to.
        path: the manifest.

    Raises:
        InputError: the manifest can't be read.
    """
    try:
        text = path.read_text()
    except FileNotFoundError:
        return Guard(False, {}, "no set has been frozen yet")
    try:
        frozen = {int(seed): Identity(**about) for seed, about in json.loads(text)["places"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"is no manifest of places ({error})", file=path, remedy="restore it, or make it anew with --freeze"
        ) from error
    differing = {}
    for seed, place in found.items():
        if seed not in frozen:
            differing[seed] = "not of the set"
        elif place != frozen[seed]:
            expected = asdict(frozen[seed])
            differing[seed] = ", ".join(name for name, value in asdict(place).items() if value != expected[name])
    if differing:
        words = "; ".join(f"{seed}: {what}" for seed, what in sorted(differing.items()))
        return Guard(False, differing, f"places that differ from it: {words}")
    return Guard(True, {}, "")
