"""Pictures of a comparison: maps over images, and errors and beliefs over time.

Every function returns what a notebook shows as it is: an image, or a matplotlib figure made without global state.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation.comparison import Comparison
from ctmap_gtsam.reporting.colours import FILTER, QUIET, SMOOTHER
from ctmap_gtsam.reporting.maps import jpeg, overlay

__all__ = ["belief_over_time", "error_over_time", "filter_over_time", "jpeg", "overlay", "svg"]

Array = NDArray[np.float64]

ERRORS = {
    "mssd_m": ("MSSD", "mm", 1e3),
    "adds_m": ("ADD-S", "mm", 1e3),
    "add_m": ("ADD", "mm", 1e3),
    "translation_m": ("translation error", "mm", 1e3),
    "rotation_rad": ("rotation error", "°", 180.0 / np.pi),
}
"""What `error_over_time` can draw: name, unit, units in one of ours"""

STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text: small, sharp and in the page's own font
    "svg.hashsalt": "ctmap",  # the same figure gives the same bytes
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9aa0a8",
    "axes.grid": True,
    "grid.color": "#e6e8eb",
    "grid.linewidth": 0.8,
    "xtick.color": "#50565e",
    "ytick.color": "#50565e",
    "legend.frameon": False,
}

_LINES = (FILTER, SMOOTHER, "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#1b1b1b", QUIET)


@dataclass(frozen=True)
class _Panel:
    """One object, (F,) values a method: NaN where nothing is asked, inf where there is no answer."""

    title: str
    errors: Mapping[str, Array]
    """in units of the axis"""
    beliefs: Mapping[str, Array]


def error_over_time(
    comparison: Comparison, methods: Sequence[str], error: str = "mssd_m", objects: Sequence[str] | None = None
) -> Figure:
    """One panel a true object: the error of each frame's own estimate, one line a method.

    Without truth, one panel an object of the reference method: how far the other methods' boxes are from its.

    Args:
        comparison: from `compare`.
        methods: those to draw, in this order.
        error: a key of ERRORS; without truth it is the distance, whatever is asked.
        objects: of `Comparison.labels`, those to draw; all where not given, and without truth.
    """
    name, unit, _ = ERRORS[error] if comparison.truth is not None else ("apart", "mm", 1e3)
    panels = _panels(comparison, methods, error, objects)
    figure, axes = _grid(comparison, panels)
    for ax, panel in zip(axes, panels, strict=True):
        _draw_errors(ax, comparison, panel, methods)
        ax.set_ylabel(f"{name}, {unit}")
    return figure


def belief_over_time(comparison: Comparison, methods: Sequence[str], objects: Sequence[str] | None = None) -> Figure:
    """One panel an object: P(exists) P(its true class), one line a method.

    Without truth, one panel an object of the reference method, and P of the class that it ends with.

    Args:
        comparison: from `compare`.
        methods: those to draw, in this order.
        objects: of `Comparison.labels`, those to draw; all where not given, and without truth.
    """
    panels = _panels(comparison, methods, "mssd_m", objects)
    figure, axes = _grid(comparison, panels)
    for ax, panel in zip(axes, panels, strict=True):
        for method, values in panel.beliefs.items():
            _line(ax, comparison, values, method, methods)
        ax.set_ylim(-0.04, 1.04)
        ax.set_ylabel("P(exists) P(class)")
    return figure


FILTERED = (
    ("effective_sample_size", "particles that count"),
    ("class_entropy", "class entropy, nats"),
    ("hypotheses_scored", "hypotheses scored"),
)
"""What `filter_over_time` draws of `Estimate.meta["diagnostics"]["objects"]`, and what its axes say"""


def filter_over_time(estimate: Estimate) -> Figure | None:
    """How a particle filter did at each keyframe: one panel each, one line an object; None where it says nothing of it.

    Args:
        estimate: of a method that keeps these diagnostics (docs/format.md).
    """
    told = estimate.meta.get("diagnostics", {}).get("objects", {})
    if not len(estimate.object_id) or any(name not in told for name, _ in FILTERED):
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.4, 2.4), layout=ConstrainedLayoutEngine(wspace=0.03))
        for column, (name, label) in enumerate(FILTERED):
            ax = figure.add_subplot(1, len(FILTERED), column + 1)
            for row, values in enumerate(told[name]):
                known = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
                if name == "hypotheses_scored":
                    known[known == 0.0] = np.nan
                colour = _LINES[row % len(_LINES)]
                ax.plot(known, color=colour, linewidth=1.1, marker="." if len(known) <= 40 else "", markersize=4)
            ax.set_yscale("symlog", linthresh=0.01) if name == "class_entropy" else ax.set_yscale("log")
            ax.yaxis.set_minor_locator(NullLocator())
            ax.set_title(label, loc="left", fontsize=10.5, fontweight="bold")
            ax.set_xlabel("keyframe; dashed: a new visit")
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            for k in np.flatnonzero(np.diff(estimate.keyframe_visit)):
                ax.axvline(k + 0.5, color=QUIET, linestyle=(0, (4, 3)), linewidth=1)
    return figure


def svg(figure: Figure) -> str:
    """The figure as an <svg> element, the same for the same figure."""
    buffer = io.StringIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def _panels(comparison: Comparison, methods: Sequence[str], error: str, objects: Sequence[str] | None) -> list[_Panel]:
    if comparison.truth is None:
        return _panels_of_reference(comparison, methods)
    scale, visible = ERRORS[error][2], comparison.truth.visible
    drawn = {m: e for m in methods if m in comparison.methods and (e := comparison.methods[m].errors) is not None}
    return [
        _Panel(
            title=label,
            errors={m: scale * getattr(e, error)[n] for m, e in drawn.items()},
            beliefs={m: np.where(visible[n], e.class_probability[n], np.nan) for m, e in drawn.items()},
        )
        for n, label in enumerate(comparison.labels)
        if objects is None or label in objects
    ]


def _panels_of_reference(comparison: Comparison, methods: Sequence[str]) -> list[_Panel]:
    """One an object of the reference method, which is the same in all agreements."""
    held = [agreement for name, agreement in comparison.agreement.items() if name in methods]
    panels = []
    for things in zip(*(agreement.objects for agreement in held), strict=True):
        one, reference = things[0], held[0].reference
        beliefs = {reference: np.where(one.visible, one.reference_probability, np.nan)}
        beliefs |= {
            a.other: np.where(t.visible, t.other_probability, np.nan) for a, t in zip(held, things, strict=True)
        }
        errors = {a.other: 1e3 * t.distance_m for a, t in zip(held, things, strict=True)}
        title = f"{comparison.class_names[one.final_class]} (object {one.reference_object} of {reference})"
        panels.append(_Panel(title, errors, beliefs))
    return panels


def _grid(comparison: Comparison, panels: Sequence[_Panel]) -> tuple[Figure, list[Axes]]:
    columns = min(max(len(panels), 1), 2 if len(panels) <= 4 else 3)
    rows = max(1, -(-len(panels) // columns))
    with mpl.rc_context(STYLE):
        layout = ConstrainedLayoutEngine(h_pad=0.08, hspace=0.04, wspace=0.03)
        figure = Figure(figsize=(10.4, (2.5 if columns < 3 else 2.1) * rows), layout=layout)
        axes = [figure.add_subplot(rows, columns, k + 1) for k in range(len(panels))]
    time = _times(comparison)
    for ax, panel in zip(axes, panels, strict=True):
        ax.set_title(panel.title.replace("_", " "), loc="left", fontsize=10.5, fontweight="bold")
        ax.set_xlabel("seconds" if _one_visit(comparison) else "frame; dashed: a new visit")
        margin = 0.015 * max(time[-1] - time[0], 1e-3)
        ax.set_xlim(time[0] - margin, time[-1] + margin)
        if not _one_visit(comparison):
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        for f in [] if _one_visit(comparison) else np.flatnonzero(np.diff(comparison.visit)):
            ax.axvline(f + 0.5, color=QUIET, linestyle=(0, (4, 3)), linewidth=1)
    return figure, axes


def _times(comparison: Comparison) -> Array:
    """(F,) what the horizontal axis shows: seconds, or frames where there are hours between visits."""
    return comparison.time_s if _one_visit(comparison) else np.arange(len(comparison.visit), dtype=np.float64)


def _one_visit(comparison: Comparison) -> bool:
    return len(np.unique(comparison.visit)) <= 1


def _line(ax: Axes, comparison: Comparison, values: Array, method: str, methods: Sequence[str]) -> None:
    time = _times(comparison)
    k = list(methods).index(method) if method in methods else len(_LINES) - 1
    # a gap between visits, and where nothing can be drawn
    broken = np.where(np.isfinite(values), values, np.nan)
    starts = np.flatnonzero(np.diff(comparison.visit)) + 1
    x, y = np.insert(time, starts, np.nan), np.insert(broken, starts, np.nan)
    few = np.isfinite(broken).sum() <= 40
    ax.plot(x, y, color=_LINES[k % len(_LINES)], linewidth=1.8, marker="o" if few else "", markersize=3.5, label=method)


def _draw_errors(ax: Axes, comparison: Comparison, panel: _Panel, methods: Sequence[str]) -> None:
    """Logarithmic; frames without an answer are marks in a strip above."""
    time = _times(comparison)
    finite = np.concatenate([v[np.isfinite(v)] for v in panel.errors.values()] or [np.zeros(0)])
    finite = finite[finite > 0]
    low, high = (finite.min(), finite.max()) if len(finite) else (1.0, 10.0)
    low, high = max(low, 1e-3 * high, 1e-2) / 1.5, max(high, 2.0 * low, 0.1) * 1.5
    missing = {m: np.isposinf(v) for m, v in panel.errors.items()}
    top = high * (high / low) ** (0.12 * len(missing)) if any(v.any() for v in missing.values()) else high
    ax.set_yscale("log")
    ax.set_ylim(low, top)
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if top / low < 50 else (1.0, 3.0)))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for method, values in panel.errors.items():
        _line(ax, comparison, np.where(np.isfinite(values), np.maximum(values, low), values), method, methods)
    if top > high:
        ax.axhspan(high, top, color="#f3f0ec", zorder=0)
        said = "× no answer, or another class"
        ax.text(1.0, 1.02, said, transform=ax.transAxes, ha="right", va="bottom", fontsize=8, color="#50565e")
        for k, (method, where) in enumerate(missing.items()):
            row = high * (top / high) ** ((len(missing) - k - 0.5) / len(missing))
            colour = _LINES[list(methods).index(method) % len(_LINES)]
            ax.plot(time[where], np.full(where.sum(), row), "x", color=colour, markersize=4)
