"""What paper.json says, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ctmap_gtsam.bench.paper.protocol import CEILING, MAIN
from ctmap_gtsam.bench.paper.results import TABLE_I
from ctmap_gtsam.reporting.tables import COLUMNS, MORE_COLUMNS, NOTHING, Column

OWN_FRAMES = "map_50"
"""mAP of each frame's own estimate"""

POSES = ("last_seen_2cm_10deg", "last_seen_5cm_15deg", "pose_2cm_10deg", "pose_5cm_15deg")

SHOWN = ("class_accuracy", "class_accuracy_last_half")
"""Figures whose differences are shown beside those of mAP"""


def tables(result: Mapping[str, Any]) -> str:
    """All tables, with what has to be said of them."""
    parts = [heading(result), table_i(result), poses(result), further(result)]
    parts += [one for one in (differences(result), *changed(result), missing(result)) if one]
    return "\n\n".join(parts) + "\n"


def heading(result: Mapping[str, Any]) -> str:
    """What was done, and whether it may be reported."""
    seeds = result["seeds"]
    lines = [
        "# The paper's benchmark, on simulated places (synthetic)",
        f"{len(seeds)} places, seeds {_spans(seeds)}; intervals hold 95 % of {result['draws']} draws of places.",
    ]
    if result["set"] is None or result["set"] == "tuning":
        lines.append("These are not the seeds whose figures are reported.")
    elif not result["frozen"]["holds"]:
        lines.append(f"**This is not the frozen set**: {result['frozen']['reason']}.")
    elif not result["frozen"]["complete"]:
        lines.append("These are some of the frozen set's places, not all.")
    if result["changed_settings"]:
        changed = ", ".join(f"{path}={value}" for path, value in result["changed_settings"].items())
        lines.append(f"The settings are not the benchmark's own: {changed}.")
    return "\n\n".join(lines)


def table_i(result: Mapping[str, Any]) -> str:
    """mAP beside the paper's Table I."""
    paper = result["paper"]
    cells = []
    for row in _rows(result, MAIN):
        gap = row["gap_closed"]
        told = gap is not None and row["method"] not in ("detector", CEILING)
        cells.append(
            (
                said(row["method"], result),
                _figure(row, TABLE_I),
                f"{paper[row['method']]:.3f}" if row["method"] in paper else "",
                _with_interval(gap["value"], gap["interval"], 100, ".0f") if told else "",
                _figure(row, OWN_FRAMES),
                f"{row['places']}",
            )
        )
    header = ("", "mAP, paper's protocol", "paper", "gap closed, %", "mAP, each frame's own", "places")
    return _table(header, cells)


def poses(result: Mapping[str, Any]) -> str:
    """Points of the curves of pose accuracy; the paper gives its own as a picture alone."""
    rows = [row for row in _rows(result, MAIN) if row["figures"].get(POSES[0]) is not None]
    cells = [(said(row["method"], result), *(_figure(row, key, ".1f", 100.0) for key in POSES)) for row in rows]
    header = (
        "poses within, %",
        *(f"{_within(key)}, {'last seen' if 'seen' in key else 'all frames'}" for key in POSES),
    )
    return _table(header, cells)


def further(result: Mapping[str, Any]) -> str:
    """The other metrics of the main pass."""
    rows = _rows(result, MAIN)
    parts = []
    for group in (COLUMNS, MORE_COLUMNS):
        columns = [c for c in group if c.key not in (TABLE_I, OWN_FRAMES, *POSES)]
        columns = [c for c in columns if any(row["figures"].get(c.key) is not None for row in rows)]
        cells = [(said(row["method"], result), *(c.text(row["figures"].get(c.key)) for c in columns)) for row in rows]
        parts.append(_table(("", *(_title(c) for c in columns)), cells))
    return "\n\n".join(parts)


def differences(result: Mapping[str, Any]) -> str:
    """What is held to what within the main pass."""
    return _differences([d for d in result["differences"] if d["row"][0] == d["to"][0] == MAIN])


def changed(result: Mapping[str, Any]) -> list[str]:
    """One part for each pass in which the model was changed."""
    parts = []
    for name, about in result["passes"].items():
        rows = _rows(result, name)
        if name == MAIN or not rows:
            continue
        cells = [(r["method"], _figure(r, TABLE_I), _figure(r, OWN_FRAMES), f"{r['places']}") for r in rows]
        parts += [
            f"## {name}\n\n{about['summary']}",
            _table(("", "mAP, paper's protocol", "mAP, each frame's own", "places"), cells),
            _differences([d for d in result["differences"] if d["row"][0] == name]),
        ]
    return parts


def missing(result: Mapping[str, Any]) -> str:
    """What isn't there, and why."""
    lines = [f"- {name} was skipped: {reason}" for name, reason in result["skipped"].items()]
    lines += [
        f"- {' '.join((row['pass'], row['method']))} lacks the places {_spans(row['missing'])}"
        for row in result["rows"]
        if row["missing"]
    ]
    lines += [f"- {f['job']} failed: {f['reason']} ({f['log']})" for f in result["failures"]]
    return "\n".join(lines)


def said(method: str, result: Mapping[str, Any]) -> str:
    """A row's name, marked where it knows what nobody could."""
    return f"{method} (reads the truth)" if method in result["reads_truth"] and method != CEILING else method


def _differences(found: Sequence[Mapping[str, Any]]) -> str:
    columns = [c for c in COLUMNS if c.key in SHOWN]
    cells = [
        (
            f"{_name(d['row'])} − {_name(d['to'], d['row'])}",
            *(_figure(d, key, "+.3f") for key in (TABLE_I, OWN_FRAMES)),
            *(_figure(d, c.key, "+.1f", c.scale) for c in columns),
        )
        for d in found
    ]
    header = ("", "mAP, paper's protocol", "mAP, each frame's own", *(_title(c) for c in columns))
    return _table(header, cells) if cells else ""


def _within(key: str) -> str:
    centimetres, degrees = key.split("_")[-2:]
    return f"{centimetres.removesuffix('cm')} cm and {degrees.removesuffix('deg')}°"


def _name(key: Sequence[str], beside: Sequence[str] | None = None) -> str:
    if beside is not None and beside[0] != key[0]:
        return f"{key[1]} of {key[0]}"
    return key[1]


def _rows(result: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    return [row for row in result["rows"] if row["pass"] == name]


def _figure(row: Mapping[str, Any], key: str, style: str = ".3f", scale: float = 1.0) -> str:
    return _with_interval(row["figures"].get(key), row["intervals"].get(key), scale, style)


def _with_interval(value: float | None, span: Sequence[float] | None, scale: float, style: str) -> str:
    if value is None:
        return NOTHING
    text = format(scale * value, style)
    return text if span is None else f"{text} ({scale * span[0]:{style}} to {scale * span[1]:{style}})"


def _title(column: Column) -> str:
    return f"{column.title} {column.unit}".rstrip()


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _spans(seeds: Sequence[int]) -> str:
    """Such as 100-103, 107."""
    spans: list[list[int]] = []
    for seed in sorted(seeds):
        if spans and seed == spans[-1][-1] + 1:
            spans[-1] = [spans[-1][0], seed]
        else:
            spans.append([seed])
    return ", ".join("-".join(map(str, span)) for span in spans)
