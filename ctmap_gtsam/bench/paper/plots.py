"""What paper.json says, as pictures: each a .png and a .svg beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctmap_gtsam.bench.paper.protocol import CEILING, MAIN
from ctmap_gtsam.bench.paper.results import TABLE_I
from ctmap_gtsam.bench.paper.tables import said

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def write_plots(folder: Path, result: Mapping[str, Any]) -> None:
    """Write all there is to draw."""
    import io

    import matplotlib as mpl

    from ctmap_gtsam.reporting.plot import STYLE, svg
    from sequences.atomic import write_bytes, write_text

    with mpl.rc_context(STYLE):
        drawn = {
            "table-i": table_i(result),
            "pose-accuracy": pose_accuracy(result),
            "places": by_place(result),
            "changes": changes(result),
        }
        for name, figure in drawn.items():
            if figure is None:
                continue
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=150)
            write_bytes(folder / f"{name}.png", buffer.getvalue())
            write_text(folder / f"{name}.svg", svg(figure))


def table_i(result: Mapping[str, Any]) -> Figure | None:
    """mAP of each row of the main pass with its interval, and the paper's."""
    rows = [row for row in result["rows"] if row["pass"] == MAIN and row["figures"].get(TABLE_I) is not None]
    if not rows:
        return None
    figure, (ax,) = _figure((1, 1), (7.2, 0.9 + 0.34 * len(rows)))
    for y, row in enumerate(rows):
        _dot(ax, y, row["figures"][TABLE_I], row["intervals"].get(TABLE_I), _colour(row["method"]))
        paper = result["paper"].get(row["method"])
        if paper is not None:
            ax.plot([paper], [y], marker="D", color="none", markeredgecolor="#1b1b1b", markersize=6.5)
    ax.plot([], [], "o", color="#50565e", label="here, with 95 % over places")
    ax.plot([], [], "D", color="none", markeredgecolor="#1b1b1b", label="the paper, on its own sequences")
    ax.set_xlim(0.0, 1.02)
    ax.set_xlabel("mAP by the paper's protocol")
    _name_rows(ax, [said(row["method"], result) for row in rows])
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=8)
    return figure


def pose_accuracy(result: Mapping[str, Any]) -> Figure | None:
    """The paper's pose figure: accuracy over both thresholds, at the last-seen frames and over all frames."""
    curves = result["curves"]
    kinds = {"last_seen": "where last seen (the paper's)", "own_frames": "all frames, each one's own"}
    if not curves["last_seen"]:
        return None
    angles, within = curves["within_deg"], [1e2 * m for m in curves["within_m"]]
    figure, panels = _figure((len(kinds), len(angles)), (10.4, 5.2))
    for ax, (kind, n) in zip(panels, ((kind, n) for kind in kinds for n in range(len(angles))), strict=True):
        for method, values in curves[kind].items():
            if method == CEILING:
                continue
            dashed = "--" if method in result["reads_truth"] else "-"
            ax.plot(within, values[n], dashed, color=_colour(method), linewidth=1.6, label=said(method, result))
        ax.set_xlim(0.0, within[-1])
        ax.set_ylim(0.0, 1.02)
        if kind == "last_seen":
            ax.set_title(f"within {angles[n]:g}°", loc="left", fontsize=10)
        else:
            ax.set_xlabel("and within, cm")
        if n == 0:
            ax.set_ylabel(f"share of objects,\n{kinds[kind]}")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8)
    return figure


def by_place(result: Mapping[str, Any]) -> Figure | None:
    """mAP of each place, one line a row: which places are hard, and for whom."""
    rows = [row for row in result["rows"] if row["pass"] == MAIN and row["method"] in _LINES]
    seeds = [str(seed) for seed in result["seeds"]]
    order = _from_hard_to_easy(rows, seeds)
    if not order:
        return None
    figure, (ax,) = _figure((1, 1), (9.0, 4.2))
    for row in rows:
        values = [row["by_place"].get(seed, {}).get(TABLE_I) for seed in order]
        ax.plot(
            range(len(order)),
            [float("nan") if v is None else v for v in values],
            marker="o",
            markersize=3.5,
            linewidth=1.2,
            color=_colour(row["method"]),
            label=row["method"],
        )
    ax.set_xticks(range(len(order)), order)
    ax.set_ylim(0.0, 1.02)
    ax.set_xlabel("seed of the place, the detector's worst first")
    ax.set_ylabel("mAP by the paper's protocol")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    return figure


def changes(result: Mapping[str, Any]) -> Figure | None:
    """How far each change of the model moves a row's mAP."""
    found = [d for d in result["differences"] if d["to"][0] == MAIN != d["row"][0] and d["to"][1] == d["row"][1]]
    found = [d for d in found if d["figures"].get(TABLE_I) is not None]
    if not found:
        return None
    figure, (ax,) = _figure((1, 1), (7.2, 0.9 + 0.3 * len(found)))
    for y, d in enumerate(found):
        _dot(ax, y, d["figures"][TABLE_I], d["intervals"].get(TABLE_I), _colour(d["row"][1]))
    ax.axvline(0.0, color="#50565e", linewidth=1)
    ax.set_xlabel("mAP by the paper's protocol, minus the same with nothing changed")
    _name_rows(ax, [f"{d['row'][0]}: {d['row'][1]}" for d in found])
    return figure


_COLOURS = {
    "detector": "#8a8f98",
    "icp": "#cc79a7",
    "fpfh": "#117733",
    "icp-oracle": "#cc79a7",
    "fpfh-oracle": "#117733",
    "static-fusion": "#8c564b",
    "filter-t": "#e69f00",
    "filter-ct": "#d55e00",
    "ffbsi-ct": "#44aa99",
    "last-copied-back": "#332288",
    "smooth-t": "#56b4e9",
    "smooth-ct": "#0072b2",
    CEILING: "#1b1b1b",
}


_LINES = ("detector", "filter-t", "filter-ct", "smooth-t", "smooth-ct", CEILING)


def _colour(method: str) -> str:
    return _COLOURS.get(method, "#b9bdc4")


def _figure(shape: tuple[int, int], size: tuple[float, float]) -> tuple[Figure, Sequence[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle("simulated places (synthetic)", x=0.995, ha="right", fontsize=8, color="#50565e")
    return figure, [figure.add_subplot(*shape, k + 1) for k in range(shape[0] * shape[1])]


def _dot(ax: Axes, y: float, value: float, span: Sequence[float] | None, colour: str) -> None:
    if span is not None:
        ax.plot(span, [y, y], color=colour, linewidth=2.2, solid_capstyle="butt")
    ax.plot([value], [y], "o", color=colour, markersize=6)


def _name_rows(ax: Axes, names: Sequence[str]) -> None:
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.grid(axis="y", visible=False)


def _from_hard_to_easy(rows: Sequence[Mapping[str, Any]], seeds: Sequence[str]) -> list[str]:
    by = next((row["by_place"] for row in rows if row["method"] == "detector"), rows[0]["by_place"] if rows else {})
    return sorted((s for s in seeds if s in by), key=lambda s: by[s].get(TABLE_I) or 0.0)
