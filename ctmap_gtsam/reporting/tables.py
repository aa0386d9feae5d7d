"""The tables of a report: what is in a column, how it is written, which way is better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ctmap_gtsam.evaluation.agreement import Agreement, ObjectAgreement
from ctmap_gtsam.evaluation.comparison import Comparison
from ctmap_gtsam.evaluation.outcome import Outcome

NOTHING = "–"

MOVED_M = 0.01
"""A pose that hindsight puts further off than this is worth pointing at"""


@dataclass(frozen=True)
class Column:
    """One metric in a table."""

    key: str
    title: str
    unit: str
    style: str
    """of format()"""
    better: Literal["low", "high", ""]
    meaning: str
    scale: float = 1

    def text(self, value: float | None) -> str:
        """The value as it is written."""
        return NOTHING if value is None else format(self.scale * value, self.style)


COLUMNS = (
    Column("class_accuracy", "class", "%", ".1f", "high", "share of object-frames with the right class", 100),
    Column("class_accuracy_last_half", "class, late", "%", ".1f", "high", "the same, second half of the run", 100),
    Column("mssd_mm_median", "MSSD", "mm", ".1f", "low", "furthest surface point, best symmetry; median"),
    Column("adds_mm_median", "ADD-S", "mm", ".1f", "low", "mean distance to the nearest surface point; median"),
    Column("translation_mm_median", "position", "mm", ".1f", "low", "between the boxes' centres; median"),
    Column("rotation_deg_median", "rotation", "°", ".1f", "low", "angle, up to symmetry; median"),
    Column("map_50", "mAP", "%", ".1f", "high", "mean average precision of each frame's boxes, IoU 0.5", 100),
    Column(
        "map_50_paper", "mAP, end", "%", ".1f", "high", "the same of each visit's last map, in all of its frames", 100
    ),
    Column("missed_objects", "missed", "", "d", "low", "true objects without a match"),
    Column("false_positive_objects", "false", "", "d", "low", "objects that match nothing true"),
    Column("existing_objects_final", "at end", "", "d", "", "objects in the last map"),
    Column("hypotheses_scored", "hypotheses", "", ",d", "", "poses rendered and scored against depth"),
)
"""What a comparison is told by"""

OBJECT_COLUMNS = COLUMNS[:6]

MORE_COLUMNS = (
    Column("pose_2cm_10deg", "2 cm, 10°", "%", ".1f", "high", "share of object-frames posed within both", 100),
    Column("pose_5cm_15deg", "5 cm, 15°", "%", ".1f", "high", "the same", 100),
    Column("last_seen_2cm_10deg", "end, 2 cm", "%", ".1f", "high",
           "the same of each visit's last map, where each object was last seen", 100),
    Column("last_seen_5cm_15deg", "end, 5 cm", "%", ".1f", "high", "the same within 5 cm and 15°", 100),
    Column("adds_auc", "AUC", "%", ".1f", "high", "area under the curve of ADD-S up to 10 cm", 100),
    Column("bop_recall", "BOP", "%", ".1f", "high", "mean of BOP's average recalls of VSD, MSSD and MSPD", 100),
    Column("ate_mm", "ATE", "mm", ".1f", "low", "root mean square error of the camera's positions"),
    Column("identity_switches", "switches", "", "d", "low", "true objects that become another object of the map"),
    Column("moves_recall", "moves", "%", ".0f", "high", "share of the moves between visits that were found", 100),
    Column("moves_recall_seen", "seen", "%", ".0f", "high",
           "the same of the moves that can be seen: not of alike things that took each other's places", 100),
    Column("false_moves", "false moves", "", "d", "low", "moves claimed of what stayed"),
    Column("coverage_95", "coverage", "%", ".0f", "", "share of true poses in the regions that should hold 95 %", 100),
    Column("class_log_score", "log score", "nats", ".2f", "low", "-log P of the true class; mean"),
    Column("class_log_score_confusable", "of look-alikes", "nats", ".2f", "low",
           "the same of classes whose mesh is like another one's"),
)  # fmt: skip
"""What else a method is judged by"""


@dataclass(frozen=True)
class Cell:
    """One cell."""

    text: str
    best: bool = False


@dataclass(frozen=True)
class Row:
    """One method, or one object by one method."""

    name: str
    cells: Sequence[Cell]
    note: str = ""
    """why there are no cells"""


def known_columns(comparison: Comparison, columns: Sequence[Column] = COLUMNS) -> list[Column]:
    """Those of some columns in which any method has a figure."""
    metrics = [score.metrics for score in comparison.methods.values()]
    return [column for column in columns if any(m.get(column.key) is not None for m in metrics)]


def method_rows(comparison: Comparison, outcomes: Mapping[str, Outcome], columns: Sequence[Column]) -> list[Row]:
    """One row a method: the columns, then seconds; the best of those with poses marked, oracles left aside."""
    rows = []
    for name, outcome in outcomes.items():
        if outcome.status == "skipped":
            rows.append(Row(name, (), f"skipped: {outcome.reason} {outcome.remedy}".strip()))
            continue
        seconds = Cell(NOTHING if outcome.seconds is None else f"{outcome.seconds:.1f}")
        rows.append(Row(name, [*_method_cells(comparison, outcomes, name, columns), seconds]))
    return rows


def more_rows(comparison: Comparison, outcomes: Mapping[str, Outcome], columns: Sequence[Column]) -> list[Row]:
    """One row a method that ran: the columns, marked as in `method_rows`."""
    return [
        Row(name, _method_cells(comparison, outcomes, name, columns))
        for name, outcome in outcomes.items()
        if outcome.status == "ok"
    ]


def stage_rows(outcomes: Mapping[str, Outcome]) -> list[tuple[str, str]]:
    """What each method says that its stages took, and the parts of each: method, words."""
    rows = []
    for name, outcome in outcomes.items():
        whole = {stage: seconds for stage, seconds in outcome.stages.items() if ": " not in stage}
        said = []
        for stage, seconds in whole.items():
            parts = {s.removeprefix(f"{stage}: "): t for s, t in outcome.stages.items() if s.startswith(f"{stage}: ")}
            inner = f" ({', '.join(f'{part} {t:.1f}' for part, t in parts.items())})" if parts else ""
            said.append(f"{stage} {seconds:.1f}{inner}")
        if said:
            rows.append((name, ", ".join(said)))
    return rows


def _method_cells(
    comparison: Comparison, outcomes: Mapping[str, Outcome], name: str, columns: Sequence[Column]
) -> list[Cell]:
    competing = [n for n, o in outcomes.items() if o.estimate is not None and not o.reads_truth]
    rivals = [comparison.methods[n].metrics for n in competing] if name in competing else []
    return _cells(columns, comparison.methods[name].metrics, rivals)


def object_rows(comparison: Comparison, methods: Sequence[str]) -> list[tuple[str, list[Row]]]:
    """For each true object, one row a method: OBJECT_COLUMNS."""
    out = []
    for label in comparison.labels:
        metrics = {name: comparison.methods[name].metrics["objects"][label] for name in methods}
        rivals = list(metrics.values())
        out.append((label, [Row(name, _cells(OBJECT_COLUMNS, one, rivals)) for name, one in metrics.items()]))
    return out


def _cells(columns: Sequence[Column], metrics: Mapping[str, Any], rivals: Sequence[Mapping[str, Any]]) -> list[Cell]:
    return [Cell(text := c.text(metrics.get(c.key)), text == _best(c, rivals)) for c in columns]


def _best(column: Column, metrics: Sequence[Mapping[str, Any]]) -> str | None:
    """The best value as it is written, so that what looks equal is equally best; None where all are."""
    values = [m[column.key] for m in metrics if m.get(column.key) is not None]
    if not column.better or not values:
        return None
    written = {column.text(value) for value in values}
    chosen = column.text(min(values) if column.better == "low" else max(values))
    return chosen if len(written) > 1 else None


AGREEMENT_COLUMNS = (
    Column("class_agreement", "same class", "%", ".1f", "", "share of the reference's object-frames", 100),
    Column("distance_mm_median", "apart", "mm", ".1f", "", "between the boxes' centres; median"),
    Column("rotation_deg_median", "turned", "°", ".1f", "", "angle, up to symmetry; median"),
    Column("objects_without_match", "lacks", "", "d", "", "objects of the reference that it doesn't have"),
    Column("objects_only_here", "adds", "", "d", "", "objects that the reference doesn't have"),
)


def agreement_rows(comparison: Comparison) -> list[Row]:
    """One row a method held to the reference: AGREEMENT_COLUMNS."""
    rows = []
    for name, agreement in comparison.agreement.items():
        metrics = {k: v if np.isfinite(v) else None for k, v in agreement.metrics().items()}
        rows.append(Row(name, [Cell(column.text(metrics[column.key])) for column in AGREEMENT_COLUMNS]))
    return rows


@dataclass(frozen=True)
class Change:
    """What hindsight changed about one object."""

    name: str
    final_class: int
    before: str
    """what the other method said, in words"""
    moved: str
    """how far its pose was off, in words"""
    changed: bool
    """whether there is anything to see"""


def changes(comparison: Comparison, agreement: Agreement) -> list[Change]:
    """One an object of the reference, those that changed most first."""
    found = [_change(comparison, agreement, thing) for thing in agreement.objects]
    return sorted(found, key=lambda change: not change.changed)


def _change(comparison: Comparison, agreement: Agreement, thing: ObjectAgreement) -> Change:
    name = f"{comparison.class_names[thing.final_class]} (object {thing.reference_object})".replace("_", " ")
    if thing.other_object is None:
        return Change(name, thing.final_class, f"{agreement.other} has no such object", NOTHING, True)
    visible = thing.visible
    differs = visible & (thing.reference_class != thing.other_class)
    distance = thing.distance_m[visible & np.isfinite(thing.distance_m)]
    moved = f"{1e3 * np.median(distance):.1f} mm, at most {1e3 * distance.max():.1f} mm" if len(distance) else NOTHING
    far = len(distance) > 0 and distance.max() > MOVED_M
    return Change(name, thing.final_class, _before(comparison, thing, differs), moved, bool(differs.any()) or far)


def _before(comparison: Comparison, thing: ObjectAgreement, differs: np.ndarray) -> str:
    if not differs.any():
        return "the same class in every frame"
    said, count = np.unique(thing.other_class[differs], return_counts=True)
    words = [
        f"{'not there' if obj_id < 0 else comparison.class_names[int(obj_id)].replace('_', ' ')} ({n})"
        for obj_id, n in sorted(zip(said, count, strict=True), key=lambda pair: -pair[1])
    ]
    since = thing.first_agreement
    end = "never settles" if since is None else f"settles at frame {since}"
    return f"{differs.sum()} of {thing.visible.sum()} frames differ: {', '.join(words)}; {end}"
