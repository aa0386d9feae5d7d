"""Rows become an `Estimate`: the long tables that filter and smoother fill in any order."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate, Ledger, Modes, Moves
from ctmap_gtsam.runtime import settings
from ctmap_gtsam.runtime.versions import versions
from sequences.types import LocalisationNoise, Run

Array = NDArray[np.float64]

GRAPH_POTENTIALS = ("localisation", "bias", "measurement", "prediction", "context", "standing", "gauge")
"""those that are factors of the smoother's graph, relative to their greatest value: their sum is minus its energy"""

POTENTIALS = (
    *GRAPH_POTENTIALS,
    *("depth", "detection", "class", "persistence", "surroundings", "clutter", "witness", "evidence"),
)
"""see docs/format.md"""

NO_SUPPORT = -(1 << 31)
"""of Estimate.moves: not known"""


@dataclass
class Tables:
    """What an estimator writes down while it works. Objects and keyframes are named by their rows."""

    objects: int
    keyframes: int
    classes: int
    class_probability: Array = field(init=False)
    existence: Array = field(init=False)
    in_view: NDArray[np.bool_] = field(init=False)
    modes: list[tuple[Any, ...]] = field(default_factory=list)
    moves: list[tuple[Any, ...]] = field(default_factory=list)
    ledger: tuple[array[Any], ...] = field(default_factory=lambda: tuple(array(kind) for kind in "qqqqd"))
    """columns of numbers: a keyframe has dozens of lines, and a line's tuple is four times as large as what it says"""

    def __post_init__(self) -> None:
        # an object nobody has an opinion of yet has any class
        self.class_probability = np.full((self.objects, self.keyframes, self.classes), 1.0 / self.classes)
        self.existence = np.zeros((self.objects, self.keyframes))
        self.in_view = np.zeros((self.objects, self.keyframes), dtype=bool)

    def grow(self) -> int:
        """Make room for one object more: its row."""
        one = Tables(1, self.keyframes, self.classes)
        for name in ("class_probability", "existence", "in_view"):
            setattr(self, name, np.concatenate([getattr(self, name), getattr(one, name)]))
        self.objects += 1
        return self.objects - 1

    def mode(
        self, row: int, keyframe: int, class_id: int, log_weight: float, T: Array, covariance: Array, free: Array
    ) -> None:
        """Add a pose mode: T_world_object (4, 4), covariance (6, 6) and free axes (6, f <= 3) of its right tangent."""
        axes = np.zeros((6, 3))
        axes[:, : free.shape[1]] = free
        self.modes.append((row, keyframe, class_id, log_weight, T, covariance, axes))

    def move(self, row: int, gap: tuple[int, int], probability: float, times_ns: tuple[int, int]) -> None:
        """Add P(moved) for the gap between two keyframes, with the times between which it would have been."""
        self.moves.append((row, gap, probability, times_ns, NO_SUPPORT, NO_SUPPORT))

    def note(self, row: int, keyframe: int, potential: str, nats: float, other: int = -1) -> None:
        """Add a line of the ledger; row -1 is no object's, other -1 no neighbour's."""
        for column, number in zip(self.ledger, (row, keyframe, POTENTIALS.index(potential), other, nats), strict=True):
            column.append(number)


def build_estimate(
    run: Run,
    config: Config,
    method: str,
    keyframes: NDArray[np.int64],
    object_ids: Sequence[int],
    tables: Tables,
    T_world_camera: Array,
    camera_covariance: Array,
    extra: Mapping[str, Any],
) -> Estimate:
    """Put the tables together; `extra` goes into the meta data."""
    frames = [run.frames[int(i)] for i in keyframes]
    meta = {
        "method": method,
        "config": settings.to_dict(config),
        "seed": config.seed,
        "fingerprint": run.fingerprint,
        "run": run.name,
        "versions": versions(),
        "potentials": list(POTENTIALS),
        "graph_potentials": list(GRAPH_POTENTIALS),
        "recorded_T_world_camera": [frame.T_world_camera.tolist() for frame in frames],
        **extra,
    }
    return Estimate(
        object_id=np.array(object_ids, dtype=np.int64),
        class_ids=np.array(run.catalogue.obj_ids, dtype=np.int64),
        class_probability=tables.class_probability,
        existence=tables.existence,
        in_view=tables.in_view,
        keyframe_frame=keyframes,
        keyframe_time_ns=np.array([frame.time_ns for frame in frames], dtype=np.int64),
        keyframe_visit=np.array([frame.visit for frame in frames], dtype=np.int64),
        T_world_camera=T_world_camera,
        camera_covariance=camera_covariance,
        modes=Modes(*_columns(tables.modes, (np.int64,) * 3 + (np.float64,) * 4, ((),) * 4 + ((4, 4), (6, 6), (6, 3)))),
        moves=Moves(*_columns(tables.moves, _MOVE_TYPES, ((), (2,), (), (2,), (), ()))),
        ledger=Ledger(*(np.array(column, dtype=column.typecode) for column in tables.ledger)),
        meta=meta,
    )


def localisation_covariance(noise: LocalisationNoise) -> Array:
    """(6, 6) of the recorded camera pose's right tangent."""
    return np.diag(np.repeat([noise.rotation_rad, noise.translation_m], 3) ** 2)


_MOVE_TYPES = (np.int64, np.int64, np.float64, np.int64, np.int64, np.int64)


def _columns(rows: list[tuple[Any, ...]], kinds: Sequence[Any], shapes: Sequence[tuple[int, ...]]) -> list[Any]:
    """Rows -> arrays, one a column, with the right shape where there are no rows."""
    return [
        np.array([row[i] for row in rows], dtype=kind).reshape(len(rows), *shape)
        for i, (kind, shape) in enumerate(zip(kinds, shapes, strict=True))
    ]
