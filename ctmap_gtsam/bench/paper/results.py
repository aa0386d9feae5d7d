"""From records to figures: every row, its intervals over places, and the differences that are to be shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.bench.paper.bootstrap import draws, interval, redrawn
from ctmap_gtsam.bench.paper.protocol import CEILING, MAIN, Protocol, Variant
from ctmap_gtsam.evaluation.record import DETECTOR, Record, pooled, pose_curve
from sequences.progress import SILENT, Progress

Array = NDArray[np.float64]
Key = tuple[str, str]
"""pass and method"""

TABLE_I = "map_50_paper"
"""The metric of the paper's Table I"""

WITHIN_M = np.linspace(0.0, 0.1, 41)
WITHIN_DEG = np.array([5.0, 10.0, 20.0, 45.0])
"""Thresholds of the curves of pose accuracy"""

BY_PLACE = (TABLE_I, "map_50", "class_accuracy", "mssd_mm_median")
"""Figures that are kept of single places"""


@dataclass(frozen=True)
class Row:
    """One method in one pass, over the places that have it."""

    figures: Mapping[str, float | None]
    drawn: Mapping[str, Array]
    """(B,) the same of each draw of places"""

    def intervals(self) -> dict[str, list[float] | None]:
        """Lowest and highest of each figure."""
        return {name: _interval(values) for name, values in self.drawn.items()}


class Results:
    """Records of P places, in each row of those places that have it."""

    def __init__(
        self,
        records: Mapping[Key, Mapping[int, Sequence[Record]]],
        seeds: Sequence[int],
        times: int,
        progress: Progress = SILENT,
    ) -> None:
        """Records by row and seed of the place; `times` is the number of draws."""
        self._records = records
        self._seeds = tuple(seeds)
        self._times = times
        self._rows: dict[tuple[Key, tuple[int, ...]], Row] = {}
        self._progress = progress

    @property
    def keys(self) -> tuple[Key, ...]:
        """The rows that have a place at all."""
        return tuple(key for key, by_seed in self._records.items() if by_seed)

    def seeds(self, key: Key) -> tuple[int, ...]:
        """The places that a row has."""
        return tuple(seed for seed in self._seeds if seed in self._records.get(key, {}))

    def by_place(self, key: Key) -> dict[int, dict[str, float | None]]:
        """The figures of single places."""
        return {seed: pooled(self._records[key][seed]) for seed in self.seeds(key)}

    def curve(self, key: Key, *, last_seen: bool) -> Array | None:
        """Pose accuracy at WITHIN_DEG (rows) and WITHIN_M (columns); None where a method has no poses."""
        records = [r for some in self._records[key].values() for r in some]
        if not all(r.posed for r in records):
            return None
        return pose_curve(records, WITHIN_M, np.deg2rad(WITHIN_DEG)[:, None], last_seen=last_seen)

    def row(self, key: Key, seeds: tuple[int, ...] | None = None) -> Row:
        """A row over all the places that it has, or over some of them."""
        seeds = self.seeds(key) if seeds is None else seeds
        if (key, seeds) not in self._rows:
            by_seed = self._records[key]
            places = [by_seed[seed] if seed in seeds else () for seed in self._seeds]
            with self._progress.stage(f"draw places for {' '.join(key)}") as stage:
                drawn = redrawn(pooled, places, self._drawn) if len(seeds) > 1 else {}  # one place tells no spread
                self._rows[key, seeds] = Row(pooled([r for some in places for r in some]), drawn)
                stage.advance()
        return self._rows[key, seeds]

    def difference(self, key: Key, to: Key) -> tuple[tuple[int, ...], Row] | None:
        """A row minus another over the places that both have, with their seeds; None where there is no such place."""
        seeds = tuple(seed for seed in self.seeds(key) if seed in self.seeds(to))
        if not seeds:
            return None
        a, b = self.row(key, seeds), self.row(to, seeds)
        figures = {name: _minus(value, b.figures.get(name)) for name, value in a.figures.items()}
        return seeds, Row(figures, {name: a.drawn[name] - b.drawn[name] for name in a.drawn if name in b.drawn})

    def gap_closed(self, key: Key, metric: str) -> tuple[float, list[float] | None] | None:
        """The share of the way from the detector to the ceiling that a row has gone, and its interval."""
        ends = [(MAIN, DETECTOR), (MAIN, CEILING)]
        seeds = tuple(seed for seed in self.seeds(key) if all(seed in self.seeds(end) for end in ends))
        if not seeds:
            return None
        row, low, high = (self.row(k, seeds) for k in (key, *ends))
        values = [one.figures.get(metric) for one in (row, low, high)]
        if any(value is None for value in values) or values[2] == values[1]:
            return None
        at, start, end = (float(value) for value in values if value is not None)
        if metric not in row.drawn:
            return (at - start) / (end - start), None
        span = high.drawn[metric] - low.drawn[metric]
        share = np.divide(
            row.drawn[metric] - low.drawn[metric], span, out=np.full_like(span, np.nan), where=span != 0.0
        )
        return (at - start) / (end - start), _interval(share)

    @cached_property
    def _drawn(self) -> NDArray[np.int64]:
        return draws(len(self._seeds), self._times)


def rows_json(results: Results, seeds: Sequence[int], seconds: Mapping[Key, float]) -> list[dict[str, Any]]:
    """Each row as JSON has it."""
    out = []
    for key in results.keys:
        row, gap = results.row(key), results.gap_closed(key, TABLE_I)
        out.append(
            {
                "pass": key[0],
                "method": key[1],
                "places": len(results.seeds(key)),
                "missing": [seed for seed in seeds if seed not in results.seeds(key)],
                "figures": dict(row.figures),
                "intervals": row.intervals(),
                "by_place": {
                    str(seed): {name: figures.get(name) for name in BY_PLACE}
                    for seed, figures in results.by_place(key).items()
                },
                "gap_closed": None if gap is None else {"value": gap[0], "interval": gap[1]},
                "seconds": round(seconds[key], 1),
            }
        )
    return out


def curves_json(results: Results) -> dict[str, Any]:
    """The paper's pose figure, of the main pass: {"last_seen" | "own_frames": {method: one list an angle}}."""
    out: dict[str, Any] = {"within_m": WITHIN_M.round(4).tolist(), "within_deg": WITHIN_DEG.tolist()}
    for name, last_seen in (("last_seen", True), ("own_frames", False)):
        drawn = {key[1]: results.curve(key, last_seen=last_seen) for key in results.keys if key[0] == MAIN}
        out[name] = {
            method: np.where(np.isfinite(curve), curve, 0.0).round(5).tolist()
            for method, curve in drawn.items()
            if curve is not None
        }
    return out


def differences_json(results: Results, protocol: Protocol) -> list[dict[str, Any]]:
    """Each difference that is to be shown, as JSON has it."""
    out = []
    for key, to in _pairs(protocol, results.keys):
        found = results.difference(key, to)
        if found is not None:
            seeds, row = found
            out.append(
                {
                    "row": list(key),
                    "to": list(to),
                    "places": len(seeds),
                    "figures": dict(row.figures),
                    "intervals": row.intervals(),
                }
            )
    return out


def _pairs(protocol: Protocol, there: Sequence[Key]) -> list[tuple[Key, Key]]:
    """Within each pass, the main one standing in where it is said to; and across, each changed row and the main one."""
    pairs: list[tuple[Key, Key]] = []
    for variant in protocol.variants.values():
        pairs += [((variant.name, method), _held_to(variant, to)) for method, to in protocol.pairs]
        if variant.name != MAIN:
            pairs += [((variant.name, method), (MAIN, method)) for method in variant.methods or ()]
    return [(a, b) for a, b in pairs if a in there and b in there]


def _held_to(variant: Variant, method: str) -> Key:
    return (MAIN if method in variant.main else variant.name, method)


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _interval(values: Array) -> list[float] | None:
    found = interval(values)
    return None if found is None else list(found)
