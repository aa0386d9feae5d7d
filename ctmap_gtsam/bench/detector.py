"""What the simulated detector's knob is worth: mean average precision of its boxes on the benchmark's places.

The detector works from what shows in the images, so neither depth nor colour is made, and a place takes seconds. The
mAP is that of `evaluation.boxes` (IoU 0.5) over all images of all places, as in the benchmark's row "detector". CT-Map
(Zeng et al., IROS 2018, Table I) has 0.607 for its own detector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctmap_gtsam.bench.paper import load_protocol
from ctmap_gtsam.config import Config
from ctmap_gtsam.evaluation.boxes import JudgedBoxes, TrueBoxes, judge_boxes, mean_average_precision, pooled_boxes
from sequences.catalogue import Catalogue
from sequences.progress import SILENT, Progress
from sequences.simulation.config import DetectorConfig
from sequences.simulation.detections import Detector
from sequences.simulation.simulator import Watched, watch_place
from sequences.simulation.visibility import Box
from sequences.types import VISIBLE_FRACTION, Detection

PAPER = 0.607
KNOBS = (0.8, 0.9, 1.0, 1.1, 1.2)  # times the setting


def run(
    config: Config, progress: Progress = SILENT, seeds: Sequence[int] = tuple(range(20))
) -> dict[str, float | str | None]:
    """Measure.

    Args:
        config: its `simulation.detector` is what is judged, its other settings make the places.
        progress: is told of each place.
        seeds: of the places, drawn as the benchmark draws them.

    Returns:
        `detector.map_50_at_<noise>` for some settings of `simulation.detector.noise`, the set one among them, and
        `detector.noise_for_<mAP of the paper>`, by straight lines between them; None where that is not among them.
    """
    detectors = [replace(config.simulation.detector, noise=config.simulation.detector.noise * k) for k in KNOBS]
    protocol = load_protocol()
    judged: list[list[JudgedBoxes]] = [[] for _ in detectors]
    names: list[list[str]] = []
    with progress.stage("detector", total=len(seeds)) as stage:
        for seed in seeds:
            watched = watch_place(protocol.place(seed, config).simulation, seed)
            names.append([c.name for c in watched.classes.classes])
            for tables, table in zip(judged, judge(watched, detectors, seed), strict=True):
                tables.append(table)
            stage.advance()
    maps = [mean_average_precision(pooled_boxes(tables, names)) for tables in judged]
    figures: dict[str, float | str | None] = {
        f"detector.map_50_at_{d.noise:.3g}": value for d, value in zip(detectors, maps, strict=True)
    }
    known = [(value, d.noise) for d, value in zip(detectors, maps, strict=True) if value is not None]
    return figures | {f"detector.noise_for_{PAPER:g}": _where(PAPER, known)}


def judge(watched: Watched, configs: Sequence[DetectorConfig], seed: int) -> list[JudgedBoxes]:
    """Run some detectors over a place and match the boxes of each to the true ones."""
    rows = {inst_id: n for n, inst_id in enumerate(watched.obj_ids)}
    true: list[tuple[int, int, int, Box, float]] = []
    said: list[list[list[tuple[int, float, Box]]]] = [[] for _ in configs]
    frames = 0
    for v, (n, glimpses) in enumerate(watched.visits):
        detectors: list[Detector] = []
        for k, glimpse in enumerate(glimpses):
            size = (glimpse.around.camera.width, glimpse.around.camera.height)
            detectors = detectors or [Detector(watched.classes, size, c, seed, v, watched.obj_ids, n) for c in configs]
            true += [(frames, rows[s.inst_id], s.obj_id, s.box, s.fraction) for s in glimpse.visible if s.box[2] > 0]
            for boxes, detector in zip(said, detectors, strict=True):
                found = detector.detect(k, glimpse.recognisable, glimpse.around)
                boxes.append([_best(detection, watched.classes) for detection in found])
            frames += 1
    truth = TrueBoxes(
        frame=np.array([t[0] for t in true], dtype=np.int64),
        object=np.array([t[1] for t in true], dtype=np.int64),
        class_id=np.array([t[2] for t in true], dtype=np.int64),
        box=np.array([t[3] for t in true], dtype=np.float64).reshape(-1, 4),
        ignore=np.array([t[4] < VISIBLE_FRACTION for t in true], dtype=np.bool_),
    )
    return [judge_boxes(truth, boxes, watched.classes.obj_ids) for boxes in said]


def _best(detection: Detection, classes: Catalogue) -> tuple[int, float, Box]:
    best = int(np.argmax(detection.class_scores[1:]))
    return classes.obj_ids[best], float(detection.class_scores[1 + best]), detection.box


def _where(wanted: float, known: Sequence[tuple[float, float]]) -> float | None:
    """The knob (second of each pair) at which mAP (first) is as wanted."""
    values, knobs = np.array(sorted(known)).reshape(-1, 2).T
    inside = len(values) > 0 and values[0] <= wanted <= values[-1]
    return float(np.interp(wanted, values, knobs)) if inside else None
