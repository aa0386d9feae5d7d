"""Draw simulated places as the documentation shows them: colour, depth, and the truth over the colour.

Example: `.venv/bin/python tools/picture_places.py docs/places.png 0 1 2 3 4`
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ctmap_gtsam.config import load_config
from ctmap_gtsam.evaluation import truth_estimate
from ctmap_gtsam.reporting.maps import overlay
from sequences.bop import load_run
from sequences.simulation import simulate_place
from sequences.truth import load_truth

SETTINGS = (
    "simulation.motion.visits=1",
    "simulation.trajectory.frames=12",
    "simulation.trajectory.period_s=2.0",
    "simulation.trajectory.distance_m=1.8",  # further away than estimators like it, to see more of the room
)
WIDTH = 420  # of each picture, pixels
FARTHEST_M = 3.5


def pictures(seed: int) -> NDArray[np.uint8]:
    """A row of three pictures (h, 3 WIDTH, 3) of the image of a place that shows most things."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        simulate_place(path, load_config(assignments=SETTINGS).simulation, seed)
        run = load_run(path)
        truth = load_truth(run)
        assert truth is not None
        shown = np.zeros(len(run.frames))
        for thing in truth.objects:
            shown[thing.frames] += thing.visible_fraction > 0.3
        frame = run.frames[int(np.argmax(shown))]
        snapshot = truth_estimate(run, truth).at(frame.time_ns, frame.T_world_camera)
        row = (frame.read_colour(), coloured(frame.read_depth()), overlay(run, frame, snapshot))
        return np.hstack([cv2.resize(image, (WIDTH, WIDTH * 3 // 4), interpolation=cv2.INTER_AREA) for image in row])


def coloured(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Depth (h, w), metres, as RGB: near is bright, black is no measurement."""
    scaled = np.clip(255.0 * (1.0 - depth / FARTHEST_M), 0, 255).astype(np.uint8)
    image = cv2.cvtColor(cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    image[depth == 0] = 0
    return np.asarray(image, dtype=np.uint8)


if __name__ == "__main__":
    rows = [pictures(int(seed)) for seed in sys.argv[2:]]
    Image.fromarray(np.vstack(rows)).quantize(256).save(sys.argv[1], optimize=True)
