"""Real and simulated depth side by side: curves, and pictures of one frame each."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.bench.realism.planes import Z_BINS_M, Patches
from ctmap_gtsam.bench.realism.residuals import Glance, autocorrelation, figures, finite, robust_sigma, standardised
from sequences.atomic import write_bytes
from sequences.simulation.config import FOCAL_PX
from sequences.simulation.sensor import BASELINE_M

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ctmap_gtsam.bench.realism import Measured

Array = NDArray[np.float64]

Line = Literal["-", "--"]

STYLES: dict[str, tuple[str, Line, str]] = {
    "ycb_desk": ("#08519c", "-", "ycb_desk, real (Xtion)"),
    "ycb_desk_twin": ("#08519c", "--", "its synthetic twin"),
    "visp_rbt": ("#a63603", "-", "visp_rbt, real (D435)"),
    "visp_rbt_twin": ("#a63603", "--", "its synthetic twin"),
    "tum_cabinet": ("#54278f", "-", "tum_cabinet, real (Kinect)"),
    "places": ("#238b45", "--", "simulated places (synthetic)"),
}
"""name -> colour, line, label; what is simulated is dashed"""
RESIDUAL_MM = 8.0  # at which the colours of a residual end
GREY_M = (0.3, 2.6)


def plot(measured: Sequence[Measured], out: Path) -> None:
    """Write `realism.png` (curves) and `realism-pictures.png` into a folder."""
    from matplotlib.figure import Figure

    curves = Figure(figsize=(15.0, 8.5), layout="constrained")
    panels = curves.subplots(2, 3).ravel()
    for draw, panel in zip((_spread, _tails, _correlation, _holes, _bias, _by_angle), panels, strict=True):
        draw(panel, measured)
    handles, labels = _legend(measured)
    curves.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    _save(curves, out / "realism.png")
    shown = [m for m in measured if m.picture is not None]
    pictures = Figure(figsize=(11.0, 2.9 * len(shown)), layout="constrained")
    for row, m in zip(pictures.subplots(len(shown), 3, squeeze=False), shown, strict=True):
        _pictures(row, m)
    _save(pictures, out / "realism-pictures.png")


def _save(figure: Any, path: Path) -> None:
    image = BytesIO()
    figure.savefig(image, format="png", dpi=110)
    write_bytes(path, image.getvalue())


def _legend(measured: Sequence[Measured]) -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    styles = [STYLES[m.name] for m in measured]
    handles = [Line2D([], [], color=colour, linestyle=line, linewidth=2) for colour, line, _ in styles]
    return handles, [label for _, _, label in styles]


def _spread(axes: Axes, measured: Sequence[Measured]) -> None:
    """Objects as points, planes as lines, the literature in grey."""
    z = np.linspace(0.4, 3.2, 50)
    khoshelham = 1.425e-3 * z**2  # Khoshelham and Elberink 2012, Equation 11 with their constants
    nguyen = 1.2e-3 + 1.9e-3 * (z - 0.4) ** 2  # Nguyen et al. 2012, the axial term
    axes.plot(z, 1e3 * khoshelham, color="0.75", linewidth=4, zorder=0)
    axes.plot(z, 1e3 * nguyen, color="0.85", linewidth=4, zorder=0)
    axes.text(0.62, 0.42, "Khoshelham 2012", color="0.4", fontsize=8)
    axes.text(0.62, 1.22, "Nguyen 2012", color="0.4", fontsize=8)
    for m in measured:
        colour, line, _ = STYLES[m.name]
        if m.patches is not None:
            axes.plot(*_plane_curve(m.patches), color=colour, linestyle=line, linewidth=2)
        for near in _by_distance(m.glances):
            whole = np.concatenate([finite(g.refitted) for g in near])
            face = colour if line == "-" else "white"
            axes.plot(np.mean([g.z for g in near]), 1e3 * robust_sigma(whole), "o", color=colour, markerfacecolor=face)
    axes.set(
        xscale="log", yscale="log", xlabel="depth, m", title="spread (lines: planes, dots: objects after refit), mm"
    )
    axes.set_xticks([0.5, 1.0, 2.0, 3.0], labels=["0.5", "1", "2", "3"])
    axes.set_yticks([1, 2, 5, 10, 20], labels=["1", "2", "5", "10", "20"])
    axes.minorticks_off()


def _plane_curve(patches: Patches) -> tuple[Array, Array]:
    """Depth, metres, and robust sigma, millimetres."""
    middle = np.array([np.sqrt(low * high) for low, high in pairwise(Z_BINS_M)])
    spread = np.array([patches.spread_px(low, high) for low, high in pairwise(Z_BINS_M)])
    known = np.isfinite(spread)
    return middle[known], (1e3 * spread * middle**2 / (FOCAL_PX * BASELINE_M))[known]


def _by_distance(some: Sequence[Glance]) -> list[list[Glance]]:
    bins = [[g for g in some if low <= g.z < high] for low, high in pairwise(Z_BINS_M)]
    return [near for near in bins if near]


def _tails(axes: Axes, measured: Sequence[Measured]) -> None:
    x = np.linspace(0.0, 10.0, 101)
    for m in measured:
        if m.glances:
            standard = np.concatenate([standardised(finite(g.refitted)) for g in m.glances])
            beyond = [(np.abs(standard) > limit).mean() for limit in x]
            colour, line, _ = STYLES[m.name]
            axes.plot(x, beyond, color=colour, linestyle=line, linewidth=2)
    from scipy.special import erfc

    axes.plot(x, erfc(x / np.sqrt(2.0)), color="0.75", linewidth=4, zorder=0)
    axes.text(2.9, 3e-4, "normal", color="0.4", fontsize=8)
    axes.set(yscale="log", ylim=(1e-4, 1.0), xlim=(0.0, 10.0), xlabel="robust sigmas of the object in its frame")
    axes.set_title("tails: share of pixels beyond")


def _correlation(axes: Axes, measured: Sequence[Measured]) -> None:
    lags = (1, 2, 3, 4, 6, 8, 12, 16)
    for m in measured:
        if m.glances:
            colour, line, _ = STYLES[m.name]
            values = autocorrelation(m.glances, lags)
            axes.plot(
                np.array(lags) / m.glances[0].scale, values, color=colour, linestyle=line, linewidth=2, marker="."
            )
    axes.axhline(0.0, color="0.8", zorder=0)
    axes.set(xlim=(0.0, 16.0), xlabel="pixels of the sensor apart", title="correlation of residuals over pixels")


def _holes(axes: Axes, measured: Sequence[Measured]) -> None:
    shown = [m for m in measured if m.glances]
    for k, m in enumerate(shown):
        colour, line, _ = STYLES[m.name]
        found = figures(m.glances)
        face, hatch = (colour, None) if line == "-" else ("white", "///")
        for group, figure in enumerate(("holes_interior", "holes_edge", "flying_edge")):
            x, height = group + 0.16 * (k - 2), 100.0 * found[figure]
            axes.bar(x, height, width=0.14, facecolor=face, edgecolor=colour, hatch=hatch)
    axes.set_xticks([0, 1, 2], labels=["no depth,\ninterior", "no depth,\nedge band", "10 mm off,\nedge band"])
    axes.set_title("holes and flying pixels, % of pixels")


def _bias(axes: Axes, measured: Sequence[Measured]) -> None:
    shown = [m for m in measured if m.glances]
    for k, m in enumerate(shown):
        colour, line, _ = STYLES[m.name]
        things = {name: j for j, name in enumerate(sorted({g.thing for g in m.glances}))}
        at = [k + 0.7 * (things[g.thing] + 0.5) / len(things) - 0.35 for g in m.glances]
        mean = [1e3 * float(np.nanmean(g.raw[g.interior])) for g in m.glances]
        axes.plot(at, mean, ".", color=colour, markerfacecolor=colour if line == "-" else "white", markersize=5)
    axes.axhline(0.0, color="0.8", zorder=0)
    axes.set_xticks(range(len(shown)), labels=[m.name.replace("_", "\n", 1) for m in shown], fontsize=8)
    axes.set_title("bias: mean residual of an object in a frame before the refit, mm")


def _by_angle(axes: Axes, measured: Sequence[Measured]) -> None:
    edges = np.cos(np.radians([72.0, 60.0, 50.0, 40.0, 30.0, 20.0, 0.0]))
    for m in measured:
        if m.glances:
            colour, line, _ = STYLES[m.name]
            angle, spread = [], []
            pixels = np.concatenate([_with_angle(g) for g in m.glances])
            for low, high in pairwise(edges):
                here = pixels[(pixels[:, 0] >= low) & (pixels[:, 0] < high), 1]
                if here.size > 500:
                    angle.append(np.degrees(np.arccos((low + high) / 2.0)))
                    spread.append(robust_sigma(here))
            axes.plot(angle, spread, color=colour, linestyle=line, linewidth=2, marker=".")
    axes.set(xlabel="angle of incidence, degrees", title="spread of disparity, pixels of the sensor", ylim=(0.0, None))


def _with_angle(g: Glance) -> Array:
    """(n, 2) cosine of the angle of incidence, and residual as disparity."""
    known = np.isfinite(g.refitted)
    return np.stack([g.cosine[known], g.refitted[known] * g.pixels_per_metre], axis=-1)


def _pictures(row: NDArray[Any], m: Measured) -> None:
    """Colour, depth, residual about the true surface."""
    p, label = m.picture, STYLES[m.name][2]
    assert p is not None
    hole = np.array([0.9, 0.3, 0.9])
    grey = np.clip((p.depth - GREY_M[0]) / (GREY_M[1] - GREY_M[0]), 0.0, 1.0)[..., None] ** 0.5 * np.ones(3)
    depth = np.where((p.depth > 0)[..., None], grey, hole)
    signed = np.clip(np.nan_to_num(1e3 * p.residual / RESIDUAL_MM), -1.0, 1.0)[..., None]
    tint = np.where(signed > 0, [0.85, 0.33, 0.05], [0.05, 0.33, 0.75])
    residual = 0.95 * (1.0 - np.abs(signed)) + tint * np.abs(signed)
    residual = np.where(np.isfinite(p.residual)[..., None], residual, np.where(p.ours[..., None], hole, 0.25))
    titles = (f"{label}", "depth (pink: none)", f"residual, blue nearer, orange further, ±{RESIDUAL_MM:g} mm")
    for axes, image, title in zip(row, (p.colour, depth, residual), titles, strict=True):
        axes.imshow(image, interpolation="nearest")
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
