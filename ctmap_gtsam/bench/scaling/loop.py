"""A table with a given number of things on it (synthetic), and a camera that goes round and round it.

One round is rendered and written as a run; a run of any length is that round again and again at later times, with the
same images. Every thing is in view from everywhere, though some stand behind others: the most there is to do a
keyframe. A repeated image has the noise of the first time, which no cost hangs on.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue, Mesh
from sequences.progress import SILENT, Progress
from sequences.rendering.scene import render_scene
from sequences.seeds import generator
from sequences.simulation.shapes import catalogue, household
from sequences.types import Detection, Frame, Run, Visit
from sequences.writing import RunWriter

Array = NDArray[np.float64]

CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
SOURCE = "bench-loop"
CLASSES = ("mug", "soup_can", "banana", "cereal_box", "bowl", "apple", "book", "teapot", "milk_carton", "sponge")
ROUND = 60  # images of one round, 6 degrees apart
STEP_S = 0.2
SPACING_M = 0.26
TABLE_M = 0.75  # height of the table
PITCH_RAD = 0.7
SURE = 0.8  # the detector's score for the right class
JITTER_PX = 1.0
NOISE = (0.001, 0.0015)  # of depth: floor, metres, and growth with squared depth, 1/m


def write_loop(folder: Path, objects: int, seed: int, frames: int = ROUND, progress: Progress = SILENT) -> None:
    """Write one round of a table with so many things, of ten classes in turn, as a run.

    Args:
        folder: for the run.
        objects: how many things.
        seed: every draw comes from it.
        frames: images of the round.
        progress: is told how far it is.
    """
    known = catalogue(tuple(s for s in household() if s.object_class.name in CLASSES))
    rng = generator(seed, "bench.loop")
    items, half = _laid(known, objects, rng)
    away = 0.75 + 1.5 * half
    with (
        RunWriter(folder, known, source=SOURCE, up_world=np.array([0.0, 0.0, 1.0])) as writer,
        progress.stage(f"render {objects} objects", total=frames) as stage,
    ):
        visit = writer.add_visit(1)
        for k in range(frames):
            T_world_camera = _looking(2.0 * np.pi * k / frames, away)
            depth, found = _seen(known, items, half, T_world_camera, rng)
            visit.add_frame(k + 1, round(k * STEP_S * 1e9), CAMERA, T_world_camera, depth, detections=found)
            stage.advance()


def looped(run: Run, keyframes: int) -> Run:
    """The frames of a one-visit run again and again, until there are so many; times go on."""
    (visit,) = run.visits
    frames = tuple(_again(visit.frames, k) for k in range(keyframes))
    return replace(run, visits=(Visit(visit.scene_id, frames, visit.T_world_visit),))


def _again(frames: tuple[Frame, ...], k: int) -> Frame:
    rounds, which = divmod(k, len(frames))
    lasting = frames[-1].time_ns - frames[0].time_ns + round(STEP_S * 1e9)
    frame = frames[which]
    return replace(frame, index=k, im_id=k + 1, time_ns=frame.time_ns + rounds * lasting)


def _laid(known: Catalogue, n: int, rng: np.random.Generator) -> tuple[list[tuple[int, Array]], float]:
    """Position in the catalogue and T_world_object of each thing, in rows; half the side of what they cover."""
    columns = int(np.ceil(np.sqrt(n)))
    half = 0.5 * SPACING_M * columns
    items = []
    for i in range(n):
        row, column = divmod(i, columns)
        c = i % len(known)
        low = known.classes[c].mesh.vertices[:, 2].min()
        spot = SPACING_M * np.array([column + 0.5, row + 0.5]) - half + rng.uniform(-0.03, 0.03, size=2)
        turn = se3.so3_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        items.append((c, se3.make(turn, np.array([*spot, TABLE_M - low]))))
    return items, half


def _looking(yaw: float, away: float) -> Array:
    """T_world_camera (4, 4) towards the middle of the table from a distance."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    R = se3.so3_exp(np.array([0.0, 0.0, yaw])) @ level @ se3.so3_exp(np.array([-PITCH_RAD, 0.0, 0.0]))
    return se3.make(R, np.array([0.0, 0.0, TABLE_M]) - away * R[:, 2])


def _seen(
    known: Catalogue, items: list[tuple[int, Array]], half: float, T_world_camera: Array, rng: np.random.Generator
) -> tuple[NDArray[np.float32], tuple[Detection, ...]]:
    """Depth (h, w), and a detection of each thing that shows."""
    T = se3.inverse(T_world_camera)
    drawn = [(known.classes[c].mesh, T @ pose) for c, pose in items]
    images = render_scene([*drawn, (_level(half + 0.1, TABLE_M), T), (_level(4.0, 0.0), T)], CAMERA)
    z = images.depth
    noise = (NOISE[0] + NOISE[1] * z**2) * rng.normal(size=z.shape)
    depth = np.where(z > 0, z + noise, 0.0).astype(np.float32)
    found = []
    for i, (c, _) in enumerate(items):
        rows, columns = np.nonzero(images.item == i)
        if len(rows) < 50:
            continue
        x, y = columns.min() - 0.5, rows.min() - 0.5
        box = np.array([x, y, columns.max() + 0.5 - x, rows.max() + 0.5 - y]) + JITTER_PX * rng.normal(size=4)
        scores = np.full(len(known) + 1, (1.0 - SURE) / len(known))
        scores[1 + c] = SURE
        found.append(Detection((float(box[0]), float(box[1]), float(box[2]), float(box[3])), scores))
    return depth, tuple(found)


def _level(half: float, height: float) -> Mesh:
    """A level square about the vertical axis."""
    corners = np.array([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), np.full((4, 3), 120, dtype=np.uint8))
