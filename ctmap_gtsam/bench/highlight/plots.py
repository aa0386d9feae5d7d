"""The figure: a row a story; the detector's boxes, T-Map's, CT-Map's, and CT-Map's poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ctmap_gtsam.bench.highlight.answers import Answer, Word
from ctmap_gtsam.estimate import Snapshot
from ctmap_gtsam.evaluation.silhouettes import Box
from sequences.atomic import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ctmap_gtsam.bench.highlight import Played

Window = tuple[float, float, float, float]
"""x, y, width, height of the part of the image that is shown, pixels"""

RIGHT, WRONG, MISSED = "#1b9e3e", "#d7191c", "#747b84"
SUBJECT = "#ffd400"
COLUMNS = (
    ("detector", "(a) detector"),
    ("filter-t", "(b) T-Map"),
    ("filter-ct", "(c) CT-Map"),
)
POSES = "(d) CT-Map, 6-DoF poses"
CAPTION = (
    "Simulated places (synthetic). Green: a box on a true thing of its class. Red: any other. Grey, dashed: no box is "
    "on a true thing. Yellow: the thing in question.\n"
    "What the detector says of that thing is set, what it says of all else is the simulator's. (b) to (d): the map at "
    "the end of the visit, seen from this image's camera;\nnumbers are P(exists) P(class). (d) leaves out furniture "
    "that is not in question; above it is the error of the pose of the thing in question."
)
WINDOW_SHARE = 0.62  # of the image's width, around a small thing; what fills most of it is shown whole
PANEL_IN, TITLE_IN, FOOT_IN = 4.2, 0.75, 0.75
FONT, DPI = 8.5, 100
PALETTE = 256  # colours of the file, a third of the size that all would have
GAP_PX = 3.0  # between a label and its box


def write_figure(path: Path, played: Sequence[Played]) -> None:
    """Write the figure as PNG."""
    from matplotlib.figure import Figure

    columns = len(COLUMNS) + 1
    height = len(played) * (0.75 * PANEL_IN + TITLE_IN) + FOOT_IN
    figure = Figure(figsize=(columns * PANEL_IN, height))
    grid = figure.subplots(len(played), columns, squeeze=False)
    figure.subplots_adjust(
        left=0.004, right=0.996, top=1.0 - TITLE_IN / height, bottom=FOOT_IN / height, wspace=0.015,
        hspace=TITLE_IN / (0.75 * PANEL_IN),
    )  # fmt: skip
    for row, one in zip(grid, played, strict=True):
        _draw_row(row, one)
    figure.text(0.005, 0.1 * FOOT_IN / height, CAPTION, fontsize=9.5, color="0.25", va="bottom", linespacing=1.35)
    drawn, small = BytesIO(), BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    with Image.open(drawn) as opened:
        image = opened.convert("RGB")
    few = image.resize((image.width // 4, image.height // 4), Image.Resampling.NEAREST)  # enough to choose colours by
    palette = few.quantize(PALETTE, kmeans=1)
    image.quantize(palette=palette, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    write_bytes(path, small.getvalue())


def _draw_row(row: NDArray[Any], one: Played) -> None:
    from ctmap_gtsam.reporting.maps import overlay

    window, true_name = _window(one), one.case.true_name
    colour = one.frame.read_colour()
    for axes, (method, title) in zip(row, COLUMNS, strict=False):
        answer = one.answers[method]
        _show(axes, colour, window)
        _draw_boxes(axes, answer, window)
        _title(axes, title, *_verdict(answer.word, true_name))
    ours = one.answers["filter-ct"]
    assert ours.map is not None  # it has poses
    _show(row[-1], overlay(one.run, one.frame, _without_furniture(one, ours.map, ours.row), labels=False), window)
    _title(row[-1], POSES, *_pose_verdict(ours.word))
    row[0].text(0.0, 1.13, one.story.told, transform=row[0].transAxes, fontsize=12.5, va="bottom")


def _without_furniture(one: Played, shown: Snapshot, subject: int) -> Snapshot:
    """Furniture would cover most of the image, so only that which the story is about is left."""
    movable = np.array([one.run.catalogue[int(c)].movable for c in shown.class_id], dtype=np.bool_)
    kept = movable | (shown.objects == subject)
    return replace(
        shown,
        objects=shown.objects[kept],
        class_id=shown.class_id[kept],
        score=shown.score[kept],
        T_world_object=shown.T_world_object[kept],
    )


def _show(axes: Axes, image: NDArray[np.uint8], window: Window) -> None:
    x, y, width, height = window
    axes.imshow(image, interpolation="lanczos", extent=(0.0, image.shape[1], image.shape[0], 0.0))
    axes.set_xlim(x, x + width)
    axes.set_ylim(y + height, y)
    axes.set_xticks([])
    axes.set_yticks([])


def _title(axes: Axes, title: str, verdict: str, colour: str) -> None:
    axes.text(0.0, 1.02, title, transform=axes.transAxes, fontsize=11, weight="bold", va="bottom")
    axes.text(1.0, 1.02, verdict, transform=axes.transAxes, fontsize=10, color=colour, ha="right", va="bottom")


def _verdict(word: Word, true_name: str) -> tuple[str, str]:
    if word.name is None:
        return f"{_plain(true_name)} missed", WRONG
    return f"{_plain(word.name)} {word.probability:.2f}", RIGHT if word.name == true_name else WRONG


def _pose_verdict(word: Word) -> tuple[str, str]:
    if word.position_m is None:
        return "no pose", WRONG
    turn = "" if word.rotation_rad is None else f", {np.rad2deg(word.rotation_rad):.1f}°"
    return f"off by {1e3 * word.position_m:.0f} mm{turn}", "0.25"


def _window(one: Played) -> Window:
    """What is shown: the surroundings of a small thing, else the whole image."""
    camera, (x, y, width, height) = one.frame.camera, one.case.box
    share = max(WINDOW_SHARE, 1.6 * width / camera.width, 1.6 * height / camera.height)
    if share >= 1.0:
        return (0.0, 0.0, float(camera.width), float(camera.height))
    shown = share * camera.width, share * camera.height
    left = np.clip(x + width / 2 - shown[0] / 2, 0.0, camera.width - shown[0])
    top = np.clip(y + height / 2 - shown[1] / 2, 0.0, camera.height - shown[1])
    return (float(left), float(top), *shown)


def _draw_boxes(axes: Axes, answer: Answer, window: Window) -> None:
    """Boxes, then labels, that of the thing first so that it has the best place."""
    labels: list[tuple[bool, str, Box, str]] = []
    for missed in answer.missed:
        _box(axes, missed.box, MISSED, missed.subject, dashed=True)
        labels.append((missed.subject, _plain(missed.name), missed.box, MISSED))
    for said in answer.boxes:
        colour = RIGHT if said.right else WRONG
        _box(axes, said.box, colour, said.subject)
        labels.append((said.subject, f"{_plain(said.name)} {said.score:.2f}", said.box, colour))
    taken: list[Box] = []
    for _, text, box, colour in sorted(labels, key=lambda one: (not one[0], one[2][2] * one[2][3])):
        shown = _within(box, window)
        if shown is not None:
            taken.append(_label(axes, text, shown, colour, window, taken))


def _box(axes: Axes, box: Box, colour: str, subject: bool, dashed: bool = False) -> None:
    from matplotlib.patches import Rectangle

    style: dict[str, Any] = {"fill": False, "linestyle": (0, (4, 3)) if dashed else "-", "joinstyle": "miter"}
    x, y, width, height = box
    if subject:
        axes.add_patch(Rectangle((x, y), width, height, fill=False, edgecolor=SUBJECT, linewidth=6.0, alpha=0.9))
    axes.add_patch(Rectangle((x, y), width, height, edgecolor=colour, linewidth=2.4, **style))


def _label(axes: Axes, text: str, box: Box, colour: str, window: Window, taken: Sequence[Box]) -> Box:
    """Write it at its box; returns the place it takes."""
    px = window[2] / (72.0 * PANEL_IN)  # image pixels a point
    size = (0.62 * FONT * len(text) * px + 5.0 * px, 1.65 * FONT * px)
    x, y, width, height = place = label_place(box, size, window, taken)
    axes.text(
        x + width / 2, y + height / 2, text, fontsize=FONT, ha="center", va="center",
        color="white",
        bbox={"boxstyle": "round,pad=0.18", "facecolor": colour, "edgecolor": "none", "alpha": 0.92},
    )  # fmt: skip
    return place


def label_place(box: Box, size: tuple[float, float], window: Window, taken: Sequence[Box]) -> Box:
    """Where a label of some size goes: near its box, inside the window, covering the least of other labels."""
    places = [_into(place, size, window) for place in _places(box, size)]
    return min(places, key=lambda at: sum(_shared(at, other) for other in taken))


def _places(box: Box, size: tuple[float, float]) -> list[tuple[float, float]]:
    """Where the label's corner may be, the best first: above and below, inside, at the sides."""
    x, y, width, height = box
    middle = x + width / 2 - size[0] / 2
    right, low = x + width - size[0], y + height
    above, below = y - size[1] - GAP_PX, low + GAP_PX
    steps = [k * size[1] for k in (1, 2, -1, -2)]
    return [
        *((at, above) for at in (middle, x, right)),
        *((at, below) for at in (middle, x, right)),
        *((at, y + GAP_PX) for at in (x + GAP_PX, right - GAP_PX)),
        *((at, low - size[1] - GAP_PX) for at in (x + GAP_PX, right - GAP_PX)),
        *((middle, above - step) for step in steps),
        *((middle, below + step) for step in steps),
    ]


def _into(place: tuple[float, float], size: tuple[float, float], window: Window) -> Box:
    x = min(max(place[0], window[0]), window[0] + window[2] - size[0])
    y = min(max(place[1], window[1]), window[1] + window[3] - size[1])
    return (x, y, *size)


def _within(box: Box, window: Window) -> Box | None:
    """The part of a box that is shown."""
    low = np.maximum(box[:2], window[:2])
    high = np.minimum(np.add(box[:2], box[2:]), np.add(window[:2], window[2:]))
    if (high <= low).any():
        return None
    return (float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1]))


def _shared(a: Box, b: Box) -> float:
    """Area."""
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    return max(width, 0.0) * max(height, 0.0)


def _plain(name: str) -> str:
    return name.replace("_", " ")
