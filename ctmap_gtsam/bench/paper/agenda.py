"""What is to be done, in which order: each place is simulated, then its units are done, then its run is deleted."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ctmap_gtsam.bench.paper.protocol import Place
from ctmap_gtsam.bench.paper.units import Store, Unit
from ctmap_gtsam.runtime.pool import Job

if TYPE_CHECKING:
    from ctmap_gtsam.methods import Method

Say = Callable[[str], None]


@dataclass(frozen=True)
class MakePlace:
    """Simulate a place."""

    store: Store
    place: Place

    def __call__(self) -> None:
        """Write its run."""
        self.store.make_place(self.place)

    def __str__(self) -> str:
        return f"{self.place.seed} simulate"

    @property
    def log(self) -> Path:
        """Where it says why it failed."""
        return self.store.log(str(self))


@dataclass(frozen=True)
class MakeUnit:
    """Do a unit."""

    store: Store
    unit: Unit
    registry: Mapping[str, Method]

    def __call__(self) -> None:
        """Write estimate and record."""
        self.store.make_unit(self.unit, self.registry)

    def __str__(self) -> str:
        return str(self.unit)

    @property
    def log(self) -> Path:
        """Where it says why it failed."""
        return self.store.log(str(self))


@dataclass(frozen=True)
class Failure:
    """A job that came to nothing."""

    job: str
    log: Path
    reason: str
    """the last line of the log"""


class Agenda:
    """`pool.Work`: places in their order, as many at once as there are workers."""

    def __init__(
        self,
        store: Store,
        units: Mapping[Place, Sequence[Unit]],
        registry: Mapping[str, Method],
        *,
        keep_runs: bool = False,
    ) -> None:
        """What is done already isn't done again.

        Args:
            store: the folder of results.
            units: what is wanted of each place; a place without units is simulated to know its hashes.
            registry: the methods there are.
            keep_runs: whether simulated runs stay when their units are done.
        """
        self._store = store
        self._registry = registry
        self._keep_runs = keep_runs
        self._listeners: list[Say] = []
        self._ended = 0
        self._units = units
        self._missing = {place: self._undone(some) for place, some in units.items()}
        self._made = {place for place in units if store.identity(place) is not None and store.run(place).is_dir()}
        self._identified = {place for place in units if store.identity(place) is not None}
        self._running: dict[Place, list[MakePlace | MakeUnit]] = {place: [] for place in units}
        self._began: dict[str, float] = {}
        self.failures: list[Failure] = []

    @property
    def jobs(self) -> int:
        """How many are to be done, as far as is known."""
        units = sum(len(units) for units in self._missing.values())
        return units + sum(self._needs_run(place) for place in self._missing)

    def tell(self, listener: Say) -> None:
        """Have someone told of each job that ended, in a line."""
        self._listeners.append(listener)

    def next(self) -> Job | None:
        """The first job of the first place that has any."""
        for place, missing in self._missing.items():
            job: MakePlace | MakeUnit
            if self._needs_run(place):
                if self._running[place]:
                    continue
                job = MakePlace(self._store, place)
            elif (unit := self._ready(place)) is not None:
                missing.remove(unit)
                job = MakeUnit(self._store, unit, self._registry)
            else:
                continue
            self._running[place].append(job)
            self._began[str(job)] = time.perf_counter()
            return job
        return None

    def ended(self, job: Job, failed: bool) -> None:
        """Note what it left."""
        assert isinstance(job, MakePlace | MakeUnit)
        place = job.place if isinstance(job, MakePlace) else job.unit.place
        self._running[place].remove(job)
        if isinstance(job, MakePlace):
            self._identified.add(place)
            self._made.add(place)
            # a simulator that gives other bytes than before makes what was done undone
            self._missing[place] = [] if failed else self._undone(self._units[place])
        if failed:
            self.failures.append(Failure(str(job), job.log, _last_line(job.log)))
        self._announce(job, failed)
        if not self._missing[place] and not self._running[place] and not self._keep_runs:
            shutil.rmtree(self._store.run(place), ignore_errors=True)

    def _ready(self, place: Place) -> Unit | None:
        """The first missing unit that waits for no other; what it needs may have failed, which it will notice."""
        missing = self._missing[place]
        running = [job.unit for job in self._running[place] if isinstance(job, MakeUnit)]
        waited_for = {(unit.variant, unit.method, unit.seed) for unit in (*missing, *running)}
        return next(
            (u for u in missing if not any((n.variant, n.method, n.seed) in waited_for for n in u.needed)), None
        )

    def _announce(self, job: MakePlace | MakeUnit, failed: bool) -> None:
        self._ended += 1
        of = self._ended + self.jobs + sum(map(len, self._running.values()))
        seconds = time.perf_counter() - self._began[str(job)]
        how = f"failed: {self.failures[-1].reason}  (see {job.log})" if failed else f"{seconds:.1f} s"
        for listener in self._listeners:
            listener(f"{self._ended}/{of}  {job}  {how}")

    def _needs_run(self, place: Place) -> bool:
        return place not in self._identified or (bool(self._missing[place]) and place not in self._made)

    def _undone(self, units: Sequence[Unit]) -> list[Unit]:
        return [unit for unit in units if self._store.done(unit) is None]


def _last_line(log: Path) -> str:
    try:
        lines = log.read_text(errors="replace").split("\n")
    except OSError:
        lines = []
    return next((line.strip() for line in reversed(lines) if line.strip()), "its process died without a word")
