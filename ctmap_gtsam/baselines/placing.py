"""Placements become an `Estimate`: what all baselines say of an object is a class and one pose, or nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import Tables, build_estimate, localisation_covariance
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.visibility import outlook
from ctmap_gtsam.shapes import Shape
from sequences.types import Frame, Run

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """Where an object is said to be."""

    class_probability: Array
    """(C,) of sum 1; the pose is of the most probable class"""
    T_world_object: Array
    """(4, 4)"""
    covariance: Array
    """(6, 6) of its right tangent"""

    @property
    def best_class(self) -> int:
        """Position in the catalogue."""
        return int(np.argmax(self.class_probability))


def certainly(index: int, classes: int) -> Array:
    """(C,) a class probability without a doubt."""
    return np.eye(classes)[index]


def seen_as(scores: Array) -> Array:
    """(C,) class probability of score vectors (n, C + 1) together: their mean, the background left out.

    Uniform where all is background.
    """
    mean = scores[:, 1:].mean(axis=0)
    total = float(mean.sum())
    return mean / total if total > 0.0 else np.full(len(mean), 1.0 / len(mean))


def estimate_of(
    run: Run,
    config: Config,
    method: str,
    keyframes: NDArray[np.int64],
    placements: Mapping[int, Sequence[Placement | None]],
    shapes: Sequence[Shape],
    extra: Mapping[str, Any] | None = None,
    cameras: tuple[Array, Array] | None = None,
) -> Estimate:
    """Put placements together; what is placed exists, what isn't doesn't.

    Args:
        run: the recording.
        config: the settings that made them.
        method: its name.
        keyframes: (K,) indices into Run.frames.
        placements: object_id -> one for each keyframe, None where it isn't in the map.
        shapes: one a class, in the catalogue's order.
        extra: more meta data.
        cameras: T_world_camera (K, 4, 4) and covariances (K, 6, 6); None = as recorded.
    """
    objects = sorted(placements)
    tables = Tables(len(objects), len(keyframes), len(shapes))
    frames = [run.frames[int(f)] for f in keyframes]
    for row, name in enumerate(objects):
        for k, placement in enumerate(placements[name]):
            if placement is not None:
                _write(tables, row, k, placement, shapes[placement.best_class], frames[k])
    return build_estimate(
        run,
        config,
        method,
        keyframes,
        objects,
        tables,
        *(cameras or _recorded(run, frames)),
        extra or {},
    )


def _recorded(run: Run, frames: Sequence[Frame]) -> tuple[Array, Array]:
    """Recorded cameras, and what is said of their error."""
    covariance = np.tile(localisation_covariance(run.localisation), (len(frames), 1, 1))
    return np.stack([frame.T_world_camera for frame in frames]), covariance


def in_view(shape: Shape, T_world_object: Array, frame: Frame) -> bool:
    """Whether an object at a pose (4, 4) reaches the image, were nothing before it."""
    return outlook(shape, frame.T_camera_world @ shape.to_centre(T_world_object), frame.camera).share > 0.0


def _write(tables: Tables, row: int, k: int, placement: Placement, shape: Shape, frame: Frame) -> None:
    tables.class_probability[row, k] = placement.class_probability
    tables.existence[row, k] = 1.0
    tables.in_view[row, k] = in_view(shape, placement.T_world_object, frame)
    free = shape.free_axes_to_object(shape.symmetry.free_axes)
    # a free direction has the circle's variance
    covariance = placement.covariance + np.pi**2 * free @ free.T
    tables.mode(row, k, shape.source.obj_id, 0.0, placement.T_world_object, covariance, free)
