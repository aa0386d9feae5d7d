"""The unit of work and of resuming: one method with one seed on one place, in the main pass or with the model changed.

In the folder of results, for a place 100 and the method filter-ct with seed 0:

    places/000100/place.json                  what the place hashes to; its run lies beside until all its units are done
    units/main/000100/filter-ct-0.npz         the estimate
    units/main/000100/filter-ct-0.record.npz  what any metric needs of it
    units/main/000100/filter-ct-0.json        what both were made from, and their hashes; written last

What was made from other settings, places or code than those asked for counts as missing.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from ctmap_gtsam.bench.paper.places import Identity, hash_of, simulate
from ctmap_gtsam.bench.paper.protocol import CEILING, Place, Variant
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation.ceiling import truth_estimate
from ctmap_gtsam.evaluation.record import Record, record
from ctmap_gtsam.runtime.settings import to_dict
from ctmap_gtsam.runtime.sources import Code, code
from sequences.atomic import write_json
from sequences.bop import load_run, load_truth
from sequences.catalogue import Catalogue
from sequences.progress import SILENT
from sequences.seeds import generator
from sequences.types import Run, Truth

if TYPE_CHECKING:
    from ctmap_gtsam.methods import Method

_RECORD = ".record.npz"


@dataclass(frozen=True)
class Unit:
    """One method with one seed on one place."""

    variant: Variant
    place: Place
    method: str
    seed: int
    """of the method's draws"""
    needs: tuple[str, ...] = ()
    """methods on whose estimates it builds"""

    @property
    def needed(self) -> tuple[Unit, ...]:
        """The units that are to be done before."""
        return tuple(replace(self, method=method, needs=()) for method in self.needs)

    def __str__(self) -> str:
        variant = "" if self.variant.kind == "main" else f"{self.variant.name} "
        return f"{variant}{self.place.seed} {self.method}-{self.seed}"


@dataclass(frozen=True)
class Done:
    """What is known of a unit that is finished."""

    status: str
    """ok or skipped"""
    reason: str
    """why it was skipped"""
    seconds: float
    """of processor time that the estimate took, on one thread"""


@dataclass(frozen=True)
class Store:
    """A folder of results."""

    root: Path
    config: Config
    """settings of the main pass; the simulator's are each place's own"""
    source: Code = field(default_factory=code)
    """what all is made and judged by: jobs have the code of when their parent began (see `pool`)"""

    def run(self, place: Place) -> Path:
        """The folder of a place's run."""
        return self._place(place) / "run"

    def log(self, job: str) -> Path:
        """Where a job that failed says why."""
        return self.root / "logs" / f"{quote(job, safe=' ')}.log".replace(" ", "_")

    def identity(self, place: Place) -> Identity | None:
        """What a place that was made hashes to; None where it wasn't, or with other settings or code."""
        about = _read(self._place(place) / "place.json")
        if about.get("key") != self._place_key(place):
            return None
        return Identity(**about["identity"])

    def make_place(self, place: Place) -> None:
        """Simulate a place. Raises InputError where things don't fit."""
        identity = simulate(self.run(place), place)
        about = {"key": self._place_key(place), "identity": asdict(identity)}
        write_json(self._place(place) / "place.json", about)

    def done(self, unit: Unit) -> Done | None:
        """None where the unit is yet to be done, wholly or in part."""
        identity = self.identity(unit.place)
        about = _read(self._file(unit, ".json"))
        if (
            identity is None
            or about.get("key") != self.key(unit, identity)
            or about.get("judged") != self.source.judging
        ):
            return None
        if about["status"] == "ok" and about.get("record") != _hash(self._file(unit, _RECORD)):
            return None
        return Done(about["status"], about["reason"], about["seconds"])

    def record(self, unit: Unit) -> Record:
        """What the metrics need of a unit that is done."""
        return Record.load(self._file(unit, _RECORD))

    def settings(self, unit: Unit) -> Config:
        """The settings that a unit's method gets."""
        config = replace(self.config, seed=unit.seed, simulation=unit.place.simulation)
        return unit.variant.settings(config)

    def key(self, unit: Unit, identity: Identity) -> dict[str, Any]:
        """All that a unit's estimate depends on."""
        return {
            "method": unit.method,
            "config": to_dict(self.settings(unit)),
            "persistence": unit.variant.persistence,
            "shuffled": unit.variant.shuffled,
            "place": asdict(identity),
            "code": self.source.estimating,
        }

    def make_unit(self, unit: Unit, registry: Mapping[str, Method]) -> None:
        """Estimate and judge; an estimate that is there already is only judged."""
        run = load_run(self.run(unit.place))
        truth, identity = load_truth(run), self.identity(unit.place)
        assert truth is not None
        assert identity is not None
        key = self.key(unit, identity)
        about = self._estimated(unit, key)
        if about is None:
            about = self._estimate(unit, key, run, truth, registry)
        if about["status"] == "ok":
            estimate = None if about["estimate"] is None else Estimate.load(self._file(unit, ".npz"))
            record(run, truth, unit.method, estimate).save(self._file(unit, _RECORD))
            about |= {"record": _hash(self._file(unit, _RECORD))}
        write_json(self._file(unit, ".json"), about | {"judged": self.source.judging})

    def _estimated(self, unit: Unit, key: Mapping[str, Any]) -> dict[str, Any] | None:
        about = _read(self._file(unit, ".json"))
        if about.get("key") != key or about["estimate"] != _hash(self._file(unit, ".npz")):
            return None
        return {name: about[name] for name in ("key", "status", "reason", "seconds", "estimate")}

    def _estimate(
        self, unit: Unit, key: Mapping[str, Any], run: Run, truth: Truth, registry: Mapping[str, Method]
    ) -> dict[str, Any]:
        about: dict[str, Any] = {"key": key, "status": "ok", "reason": "", "seconds": 0.0, "estimate": None}
        began = time.process_time()
        estimate, reason = self._run(unit, run, truth, registry)
        if reason is not None:
            return about | {"status": "skipped", "reason": reason}
        if estimate is not None:
            about["seconds"] = round(time.process_time() - began, 3)
            estimate.save(self._file(unit, ".npz"))
            about["estimate"] = _hash(self._file(unit, ".npz"))
            # so that what took minutes is kept if judging it fails
            write_json(self._file(unit, ".json"), about)
        return about

    def _run(
        self, unit: Unit, run: Run, truth: Truth, registry: Mapping[str, Method]
    ) -> tuple[Estimate | None, str | None]:
        """The estimate, None for the detector's boxes; and the reason why there is neither."""
        if unit.method == CEILING:
            return truth_estimate(run, truth), None
        method, seen = registry[unit.method], seen_by(run, unit)
        obstacle = method.skip(seen)
        if obstacle is not None or method.run is None:
            return None, obstacle
        needed = [Estimate.load(self._file(one, ".npz")) for one in unit.needed]
        return method.run(seen, self.settings(unit), SILENT, *needed), None

    def _place(self, place: Place) -> Path:
        return self.root / "places" / f"{place.seed:06d}"

    def _file(self, unit: Unit, suffix: str) -> Path:
        folder = self.root / "units" / quote(unit.variant.name, safe="") / f"{unit.place.seed:06d}"
        return folder / f"{unit.method}-{unit.seed}{suffix}"

    def _place_key(self, place: Place) -> dict[str, Any]:
        return {"seed": place.seed, "settings": hash_of(to_dict(place.simulation)), "code": self.source.simulating}


def seen_by(run: Run, unit: Unit) -> Run:
    """The run with the catalogue that the unit's model has."""
    variant = unit.variant
    classes = run.catalogue.classes
    order = list(range(len(classes)))
    if variant.shuffled:
        order = [int(k) for k in generator(unit.place.seed, "bench.paper.shuffled").permutation(len(classes))]
    changed = tuple(
        replace(c, category=classes[k].category, persistence_s=variant.persistence * c.persistence_s)
        for c, k in zip(classes, order, strict=True)
    )
    return replace(run, catalogue=Catalogue(changed))


def _read(path: Path) -> dict[str, Any]:
    """Empty where the file isn't there, whole."""
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def _hash(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None
