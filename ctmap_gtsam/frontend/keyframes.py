"""Which frames the estimators use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.parameters import Keyframes
from sequences import se3
from sequences.types import Frame, Run


def select_keyframes(run: Run, rule: Keyframes) -> NDArray[np.int64]:
    """Indices (K,) into Run.frames, ascending. Each frame is judged by the past alone, so a longer run adds only."""
    chosen: list[int] = []
    last: Frame | None = None
    for position, frame in _positions(run):
        if last is None or frame.visit != last.visit or (position % rule.every == 0 and _moved(last, frame, rule)):
            chosen.append(frame.index)
            last = frame
    return np.array(chosen, dtype=np.int64)


def _positions(run: Run) -> list[tuple[int, Frame]]:
    """Every frame with its position in its visit."""
    return [(position, frame) for visit in run.visits for position, frame in enumerate(visit.frames)]


def _moved(last: Frame, frame: Frame, rule: Keyframes) -> bool:
    if rule.min_translation_m == 0.0 and rule.min_rotation_rad == 0.0:
        return True
    step = se3.local(last.T_world_camera, frame.T_world_camera)
    far = np.linalg.norm(step[3:]) >= rule.min_translation_m > 0.0
    turned = np.linalg.norm(step[:3]) >= rule.min_rotation_rad > 0.0
    return bool(far or turned)
