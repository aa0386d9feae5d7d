"""How the robot looks around: it drives an arc around the table while its head pans to the shelf and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.seeds import generator
from sequences.simulation.config import TrajectoryConfig
from sequences.simulation.place import Place

Array = NDArray[np.float64]


def camera_path(place: Place, config: TrajectoryConfig, seed: int, visit: int) -> tuple[NDArray[np.int64], Array]:
    """The true path of one visit.

    Args:
        place: where.
        config: settings.
        seed: the run's.
        visit: position of the visit, 0-based; each goes its own way.

    Returns:
        Times (n,) since the visit's start, nanoseconds, and T_world_camera (n, 4, 4).
    """
    rng = generator(seed, "simulation.trajectory", keyframe=visit)
    s = np.arange(config.frames) / max(config.frames - 1, 1)
    s_there = s if rng.random() < 0.5 else 1.0 - s
    first = np.radians(-8.0 + rng.uniform(-6.0, 6.0))
    azimuth = place.side * (first + np.radians(config.arc_deg) * s_there)
    radius = config.radius_m * (1.0 + 0.06 * np.sin(2 * np.pi * s + rng.uniform(0, 2 * np.pi)))
    table, shelf = place.table.T_world_object[:3, 3], place.shelf.T_world_object[:3, 3]
    height = config.height_m + 0.02 * np.sin(2 * np.pi * 0.8 * s + rng.uniform(0, 2 * np.pi))
    eye = np.stack([table[0] + radius * np.sin(azimuth), table[1] - radius * np.cos(azimuth), height], axis=-1)
    swing = 0.15 * np.sin(2 * np.pi * 1.5 * s + rng.uniform(0, 2 * np.pi))
    on_table = np.stack([table[0] + swing, np.full_like(s, table[1]), np.full_like(s, 0.78)], axis=-1)
    on_shelf = np.array([shelf[0], shelf[1], 0.85])
    share = config.pan * np.sin(np.pi * s)[:, None] ** 2
    times = np.rint(np.arange(config.frames) * config.period_s * 1e9).astype(np.int64)
    return times, _look_at(eye, on_table + share * (on_shelf - on_table))


def _look_at(eye: Array, target: Array) -> Array:
    """Level cameras (n, 4, 4) at `eye` (n, 3), metres, that look at `target` (n, 3)."""
    forward = target - eye
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return se3.make(np.stack([right, np.cross(forward, right), forward], axis=-1), eye)
