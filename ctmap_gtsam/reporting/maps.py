"""A map drawn over the picture it explains."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ctmap_gtsam.estimate import Snapshot
from ctmap_gtsam.reporting.colours import RGB, class_colours
from sequences import se3
from sequences.catalogue import Catalogue, Mesh
from sequences.rendering.scene import SceneImages, render_scene, shade
from sequences.types import Frame, Run

Array = NDArray[np.float64]
Image8 = NDArray[np.uint8]

OPACITY = 0.72
OPACITY_BEHIND = 0.18
BEHIND_M = 0.02
"""Where the camera measured something nearer than this in front of the mesh, the mesh is behind it"""


def overlay(run: Run, frame: Frame, snapshot: Snapshot, *, labels: bool = True) -> Image8:
    """The objects of a map, shaded in the colours of their classes, over the colour image of a frame.

    Args:
        run: for its catalogue.
        frame: the picture. Where its depth shows something in front of an object, that part of the object is faint.
        snapshot: the map, such as ``estimate.at(frame.time_ns, frame.T_world_camera)``.
        labels: write each object's class and score beside it.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    colours = class_colours(run.catalogue)
    poses = se3.inverse(snapshot.T_world_camera) @ snapshot.T_world_object
    items = [
        (_painted(run.catalogue[int(c)].mesh, colours[int(c)]), T)
        for c, T in zip(snapshot.class_id, poses, strict=True)
    ]
    image = np.ascontiguousarray(frame.read_colour())
    if not items:
        return image
    scene = render_scene(items, frame.camera)
    image = _blend(image, shade(items, frame.camera, scene), scene, frame.read_depth())
    image = _outline(image, scene, [colours[int(c)] for c in snapshot.class_id])
    if labels:
        image = _label(image, scene, [(_words(run.catalogue, c, s), colours[int(c)]) for c, s in _said(snapshot)])
    return image


def jpeg(image: Image8, quality: int = 88) -> bytes:
    """Encode (height, width, 3) RGB."""
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"an image of shape {image.shape} can't be written as JPEG")
    return data.tobytes()


def _painted(mesh: Mesh, colour: RGB) -> Mesh:
    return replace(mesh, colours=np.tile(np.array(colour, dtype=np.uint8), (len(mesh.vertices), 1)))


def _said(snapshot: Snapshot) -> Iterable[tuple[int, float]]:
    return zip(snapshot.class_id.tolist(), snapshot.score.tolist(), strict=True)


def _words(catalogue: Catalogue, obj_id: int, score: float) -> str:
    return f"{catalogue[obj_id].name.replace('_', ' ')} {score:.2f}"


def _blend(image: Image8, shaded: Image8, scene: SceneImages, depth: NDArray[np.float32]) -> Image8:
    behind = (depth > 0) & (depth < scene.depth - BEHIND_M)
    opacity = np.where(scene.item < 0, 0.0, np.where(behind, OPACITY_BEHIND, OPACITY))[..., None]
    return (image * (1.0 - opacity) + shaded * opacity + 0.5).astype(np.uint8)


def _outline(image: Image8, scene: SceneImages, colours: list[RGB]) -> Image8:
    """A line of the class's colour, with a white one outside it that keeps it apart from the picture."""
    out, width = image.copy(), max(1, round(image.shape[0] / 240))
    for k, colour in enumerate(colours):
        mask = (scene.item == k).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, contours, -1, (255, 255, 255), 2 * width, cv2.LINE_AA)
        cv2.drawContours(out, contours, -1, colour, width, cv2.LINE_AA)
    return out


def _label(image: Image8, scene: SceneImages, texts: list[tuple[str, RGB]]) -> Image8:
    """A pill of the class's colour above each object that shows."""
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    font = _font(max(12, image.shape[0] // 30))
    taken: list[tuple[float, float, float, float]] = []
    for k, (text, colour) in enumerate(texts):
        rows, columns = np.nonzero(scene.item == k)
        if len(rows) == 0:
            continue
        width, height = draw.textlength(text, font=font) + 12, 1.5 * font.size
        x = float(np.clip(columns.mean() - width / 2, 2, max(2, image.shape[1] - width - 2)))
        y = _free_row(float(np.clip(rows.min() - height - 4, 2, image.shape[0] - height - 2)), x, width, height, taken)
        taken.append((x, y, width, height))
        dark = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2] < 140
        draw.rounded_rectangle((x, y, x + width, y + height), radius=height / 3, fill=colour, outline="white", width=1)
        draw.text((x + 6, y + height / 2), text, font=font, fill="white" if dark else "black", anchor="lm")
    return np.asarray(picture)


def _free_row(y: float, x: float, width: float, height: float, taken: list[tuple[float, float, float, float]]) -> float:
    """Down from y, the first row where the label covers none of those that are there."""
    for tx, ty, tw, th in sorted(taken, key=lambda box: box[1]):
        if x < tx + tw and tx < x + width and y < ty + th and ty < y + height:
            y = ty + th + 2
    return y


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(str(folder / "DejaVuSans-Bold.ttf"), size)


def legend(catalogue: Catalogue, obj_ids: Iterable[int]) -> Mapping[str, RGB]:
    """Class name -> colour of the classes given, in their order, each once."""
    colours = class_colours(catalogue)
    return {catalogue[obj_id].name: colours[obj_id] for obj_id in dict.fromkeys(obj_ids)}
