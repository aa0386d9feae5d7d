"""The smoother's graph for people: a table of its factors, Graphviz's DOT, g2o, and a picture.

Everything is a function of a `SmootherGraph` and of values of its variables, such as `Smoothed.solution.values`.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ctmap_gtsam.smoothing.graph import Edges, SmootherGraph, Variable
from sequences import se3
from sequences.atomic import write_together

Array = NDArray[np.float64]

HEADER = ("factor", "kind", "name", "keys", "error_nats")
COLOURS = {
    "localisation": "#1b1b1b",
    "bias": "#8a8f98",
    "measurement": "#0072b2",
    "prediction": "#009e73",
    "context": "#cc79a7",
    "standing": "#56b4e9",
    "gauge": "#e69f00",
}
_SCALE = Normalize(0.0, 10.0)  # nats, of the picture's colours
_MAP = colormaps["viridis_r"]
_TANGENT = np.array([3, 4, 5, 0, 1, 2])  # g2o has translations first


def write_graph(folder: Path, built: SmootherGraph, values: Any) -> tuple[Path, ...]:
    """Write factors.csv, graph.dot, graph.g2o and graph.png; returns their paths.

    Args:
        folder: is made.
        built: from `smoothing.graph.build`.
        values: gtsam.Values of its variables.
    """
    image = io.BytesIO()
    picture(built, values).savefig(image, format="png", dpi=150)
    files = {
        folder / "factors.csv": factor_table(built, values).encode(),
        folder / "graph.dot": dot(built, values).encode(),
        folder / "graph.g2o": g2o(built, values).encode(),
        folder / "graph.png": image.getvalue(),
    }
    write_together(files)
    return tuple(files)


def factor_table(built: SmootherGraph, values: Any) -> str:
    """CSV, one line a factor: number, kind, name, keys apart by blanks, error in nats (but for constants).

    Keys are x<keyframe> for a camera, o<object>k<keyframe> for an object, b<object>v<visit> for the error of a visit.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(HEADER)
    for i, (label, error) in enumerate(zip(built.labels, built.errors(values).tolist(), strict=True)):
        keys = " ".join(str(Variable.of(key)) for key in label.keys)
        table.writerow((i, label.kind, label.name, keys, f"{error:.9g}"))
    return text.getvalue()


def dot(built: SmootherGraph, values: Any) -> str:
    """Variables as circles, factors as squares of their kind's colour, placed as in the picture: `neato -n -Tsvg`.

    Squares have tooltips that say what the factor is and its error.
    """
    lines = ["graph smoother {", "  node [fontsize=9];"]
    keys = list(built.initial.keys())
    places = _places([Variable.of(key) for key in keys])
    at = {}
    for key in keys:
        variable = Variable.of(key)
        at[key] = np.array(places[variable])
        lines.append(f'  "{variable}" [shape=circle, pos="{_pos(at[key])}"];')
    for i, (label, error) in enumerate(zip(built.labels, built.errors(values).tolist(), strict=True)):
        # beside its variables, for the factors of one variable would lie on top of it
        where = np.mean([at[key] for key in label.keys], axis=0) + (0.25 if len(label.keys) == 1 else 0.0)
        style = f'shape=square, label="", width=0.12, style=filled, fillcolor="{COLOURS.get(label.kind, "white")}"'
        lines.append(f'  f{i} [{style}, pos="{_pos(where)}", tooltip="{label.kind}, {label.name}: {error:.4g} nats"];')
        lines += [f'  f{i} -- "{Variable.of(key)}";' for key in label.keys]
    return "\n".join([*lines, "}"]) + "\n"


def _shades(errors: Array) -> list[tuple[float, float, float, float]]:
    return [(float(r), float(g), float(b), float(a)) for r, g, b, a in _MAP(_SCALE(errors))]


def g2o(built: SmootherGraph, values: Any) -> str:
    """Poses and the factors between two of them in g2o's format (Kuemmerle et al., ICRA 2011).

    They are VERTEX_SE3:QUAT and EDGE_SE3:QUAT. Comments say which number is which variable, and how many factors are
    left out. g2o knows no factors of one pose, no error of localisation that decays, no context and no symmetry: the
    first camera is fixed, an edge leads to that of the equivalent poses which is nearest at the values, without
    information along free axes, and the error of a visit is taken as it is at the values.
    """
    poses = [key for key in built.initial.keys() if Variable.of(key).kind != "b"]  # noqa: SIM118 (not a mapping)
    poses.sort(key=lambda key: Variable.of(key).kind != "x")  # cameras first
    number = {key: i for i, key in enumerate(poses)}
    found = built.edges(values)
    held = Counter(edges.kind for edges in found for _ in edges.T)
    left_out = {kind: n - held[kind] for kind, n in built.count().items() if n > held[kind]}
    lines = ["# left out: " + (", ".join(f"{n} {kind}" for kind, n in left_out.items()) or "nothing")]
    lines += [f"# {i} {Variable.of(key)}" for key, i in number.items()]
    lines += [f"VERTEX_SE3:QUAT {i} {_pose(values.atPose3(key).matrix())}" for key, i in number.items()]
    lines += ["FIX 0"] if poses else []
    lines += [line for edges in found for line in _edge_lines(edges, number)]
    return "\n".join(lines) + "\n"


def _edge_lines(edges: Edges, number: Mapping[int, int]) -> list[str]:
    upper = np.triu_indices(6)
    out = []
    for (a, b), T, information in zip(edges.keys.tolist(), edges.T, edges.information, strict=True):
        weights = " ".join(f"{x:.12g}" for x in information[np.ix_(_TANGENT, _TANGENT)][upper])
        out.append(f"EDGE_SE3:QUAT {number[a]} {number[b]} {_pose(T)} {weights}")
    return out


def _pose(T: Array) -> str:
    return " ".join(f"{x:.15g}" for x in (*T[:3, 3], *se3.quaternion(T[:3, :3])))


def _pos(where: Array) -> str:
    return f"{60.0 * where[0]:.0f},{60.0 * where[1]:.0f}"


def _places(variables: list[Variable]) -> dict[Variable, tuple[float, float]]:
    """Keyframes to the right, objects downwards below the cameras; the errors of visits to the left."""
    line = _lines(variables)
    visits = {v.index for v in variables if v.kind == "b"}
    return {
        v: (float(v.index - len(visits) - 1 if v.kind == "b" else v.index), float(-line[v.row] - 0.3 * (v.kind == "b")))
        for v in variables
    }


def _lines(variables: list[Variable]) -> dict[int | None, int]:
    """Object (None: the cameras) -> its line from above."""
    rows = sorted({v.row for v in variables if v.row is not None})
    return {None: 0, **{row: i + 1 for i, row in enumerate(rows)}}


def picture(built: SmootherGraph, values: Any) -> Figure:
    """Keyframes as columns, the cameras and below them the objects as rows, factors coloured by their error.

    A dot is a measurement (in the first row: a prior), a line between dots a prediction (localisation that drifts), so
    that a line that is broken off is a move or nothing seen. A bar below an object's row is the error of a visit, from
    its first measurement to its last. Thin lines between rows are context, a ring is a gauge.
    """
    variables = [[Variable.of(key) for key in label.keys] for label in built.labels]
    line = _lines([v for those in variables for v in those])
    errors = built.errors(values)
    columns = 1 + max((v.index for those in variables for v in those if v.kind != "b"), default=0)
    figure = Figure(
        figsize=(float(np.clip(0.13 * columns + 3.0, 7.0, 30.0)), 1.4 + 0.36 * len(line)), layout="constrained"
    )
    axes = figure.add_subplot()
    dots: list[tuple[float, float, float, bool]] = []
    strokes: list[tuple[list[tuple[float, float]], float, float]] = []
    spans: dict[Variable, list[int]] = {}
    bias: dict[Variable, float] = {}
    for label, those, error in zip(built.labels, variables, errors.tolist(), strict=True):
        at = [(float(v.index), float(line[v.row])) for v in those if v.kind != "b"]
        if label.kind == "bias":
            bias[those[0]] = error
        elif label.kind == "measurement" or len(at) == 1:
            dots.append((*at[1 if label.kind == "measurement" else 0], error, label.kind == "gauge"))
            for v in those[2:]:
                spans.setdefault(v, []).append(those[1].index)
        else:
            strokes.append((at, error, 0.5 if label.kind == "context" else 2.0))
    strokes += [
        ([(min(ks) - 0.3, line[v.row] + 0.32), (max(ks) + 0.3, line[v.row] + 0.32)], bias.get(v, 0.0), 3.0)
        for v, ks in spans.items()
    ]
    if strokes:
        shades = _shades(np.array([error for _, error, _ in strokes]))
        widths = [width for *_, width in strokes]
        axes.add_collection(LineCollection([at for at, *_ in strokes], colors=shades, linewidths=widths, zorder=1))
    for ring in (True, False):
        x, y, error = np.array([d[:3] for d in dots if d[3] is ring]).reshape(-1, 3).T
        shade = _shades(error)
        axes.scatter(
            x, y, s=34 if ring else 13, facecolors="none" if ring else shade, edgecolors=shade, linewidths=0.8, zorder=2
        )
    axes.set_yticks(
        list(line.values()), ["camera", *(f"{built.objects[row]} {row}" for row in line if row is not None)]
    )
    axes.set(xlim=(-1, columns), ylim=(len(line) - 0.4, -0.6), xlabel="keyframe")
    axes.tick_params(labelsize=8, length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.grid(axis="y", color="#e6e8eb", linewidth=0.8, zorder=0)
    axes.set_axisbelow(True)
    told = ", ".join(f"{n} {kind}" for kind, n in built.count().items())
    axes.set_title(f"{told}; {errors.sum():.4g} nats", fontsize=9, loc="left")
    figure.colorbar(ScalarMappable(_SCALE, _MAP), ax=axes, label="error, nats", extend="max", pad=0.01, fraction=0.03)
    return figure
