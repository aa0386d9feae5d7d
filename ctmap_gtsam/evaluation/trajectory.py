"""How wrong a method's camera poses are: ATE and RPE.

Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems (IROS 2012). There a trajectory is first aligned with
the truth; here the world frame is given (the recorded localisation's), so nothing is aligned, and an offset of all
poses counts. Without scene_camera_gt.json the recorded poses are taken for the true ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.types import Run

Array = NDArray[np.float64]

TRAJECTORY = ("ate_mm", "ate_deg", "rpe_mm", "rpe_deg")
"""Root mean squares: of the absolute errors of all frames, and of the relative ones between neighbouring frames of a
visit"""


@dataclass(frozen=True)
class CameraErrors:
    """One method's cameras: F frames, P pairs of neighbouring frames in one visit."""

    translation_m: Array
    """(F,)"""
    rotation_rad: Array
    """(F,)"""
    relative_translation_m: Array
    """(P,)"""
    relative_rotation_rad: Array
    """(P,)"""


def camera_errors(run: Run, T_world_camera: Array, T_true: Array) -> CameraErrors:
    """Errors of camera poses (F, 4, 4), held to the true ones (F, 4, 4).

    Absolute: ``inv(T_true) T``; relative: ``inv(inv(T_true_i) T_true_j) (inv(T_i) T_j)`` with j the frame after i.
    """
    visit = np.array([frame.visit for frame in run.frames], dtype=np.int64)
    i = np.flatnonzero(visit[1:] == visit[:-1])
    motion, true_motion = (se3.inverse(T[i]) @ T[i + 1] for T in (T_world_camera, T_true))
    shift, turn = _size(se3.inverse(T_true) @ T_world_camera)
    relative_shift, relative_turn = _size(se3.inverse(true_motion) @ motion)
    return CameraErrors(shift, turn, relative_shift, relative_turn)


def trajectory_metrics(errors: CameraErrors) -> dict[str, float | None]:
    """TRAJECTORY over frames and pairs of them."""
    return {
        "ate_mm": _root_mean_square(1e3 * errors.translation_m),
        "ate_deg": _root_mean_square(np.rad2deg(errors.rotation_rad)),
        "rpe_mm": _root_mean_square(1e3 * errors.relative_translation_m),
        "rpe_deg": _root_mean_square(np.rad2deg(errors.relative_rotation_rad)),
    }


def _size(T: Array) -> tuple[Array, Array]:
    """Length of the translation and angle of the rotation of motions (n, 4, 4): (n,) each."""
    return np.linalg.norm(T[:, :3, 3], axis=-1), np.linalg.norm(se3.so3_log(T[:, :3, :3]), axis=-1)


def _root_mean_square(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
