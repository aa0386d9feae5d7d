"""What an estimator says of a run: the one result type of filter, fixed lag and smoother.

Everything downstream (metrics, tables, plots, exports, notebooks) knows only this type. It imports no estimator.
On disk it is one .npz without pickle, described in docs/format.md, so that NumPy alone can read it. Two runs with the
same input, configuration and seed give the same bytes.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.atomic import write_npz
from sequences.errors import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SCHEMA = 1

EXISTS = 0.5
"""P(exists) above which an object is part of the map"""

_BROKEN = (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error)
"""What NumPy and we raise on files that aren't estimates"""


@dataclass(frozen=True)
class Modes:
    """The pose posterior: a mixture for each object and keyframe, as one long table of M rows."""

    object: Ints
    """(M,) row of Estimate.object_id"""
    keyframe: Ints
    """(M,) row of Estimate.keyframe_frame"""
    class_id: Ints
    """(M,) obj_id whose mesh frame the pose is in"""
    log_weight: Array
    """(M,) natural log; the modes of one object, keyframe and class sum to one"""
    T_world_object: Array
    """(M, 4, 4) metres"""
    covariance: Array
    """(M, 6, 6) of the right tangent [rotation rad, translation m] at the pose"""
    free_axes: Array
    """(M, 6, 3) orthonormal columns spanning the directions that the data left free; zero columns are unused"""


@dataclass(frozen=True)
class Moves:
    """What may have happened to an object while nobody looked, one row a gap."""

    object: Ints
    """(G,) row of Estimate.object_id"""
    gap: Ints
    """(G, 2) last keyframe before and first keyframe after the gap"""
    probability: Array
    """(G,) that the object was moved in the gap"""
    interval_ns: Ints
    """(G, 2) the earliest and the latest time of the move"""
    from_support: Ints
    """(G,) object row of the support before, -1 - k for anonymous surface k; see Estimate.meta["surfaces"]"""
    to_support: Ints
    """(G,) the same after"""


@dataclass(frozen=True)
class Ledger:
    """What each potential contributed, in nats (a larger value speaks for the estimate).

    The lines of Estimate.meta["graph_potentials"] are the factors of the smoother's graph, relative to their greatest
    value: their sum is minus the graph's energy.
    """

    object: Ints
    """(L,) row of Estimate.object_id; -1 where it is no object's, as a camera's localisation"""
    keyframe: Ints
    """(L,) row of Estimate.keyframe_frame"""
    potential: Ints
    """(L,) row of Estimate.meta["potentials"]"""
    other: Ints
    """(L,) the neighbour's row for context, else -1"""
    nats: Array
    """(L,) what it says at the reported pose and class"""


@dataclass(frozen=True)
class Estimate:
    """Objects and cameras over all keyframes: N objects, K keyframes, C classes."""

    object_id: Ints
    """(N,) name of each object, unique"""
    class_ids: Ints
    """(C,) obj_ids of the catalogue, ascending"""
    class_probability: Array
    """(N, K, C) P(class | exists) at each keyframe: given the past (filter) or the whole run (smoother)"""
    existence: Array
    """(N, K) P(the object exists)"""
    in_view: NDArray[np.bool_]
    """(N, K) whether the estimated object shows at least some pixels"""
    keyframe_frame: Ints
    """(K,) indices into Run.frames, ascending"""
    keyframe_time_ns: Ints
    """(K,)"""
    keyframe_visit: Ints
    """(K,) row of Run.visits"""
    T_world_camera: Array
    """(K, 4, 4) the method's own camera poses"""
    camera_covariance: Array
    """(K, 6, 6) of their right tangents"""
    modes: Modes
    moves: Moves
    ledger: Ledger
    meta: Mapping[str, Any] = field(default_factory=dict)
    """JSON: schema, method, config, seed, fingerprint, versions, potentials, graph_potentials, surfaces, diagnostics
    (no seconds: those would make two equal runs differ)"""

    def __post_init__(self) -> None:
        n, k, c = len(self.object_id), len(self.keyframe_frame), len(self.class_ids)
        expected = {"class_probability": (n, k, c), "existence": (n, k), "in_view": (n, k), "T_world_camera": (k, 4, 4)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"Estimate.{name} has shape {getattr(self, name).shape}, expected {shape}")

    @cached_property
    def best_class(self) -> Ints:
        """(N, K) obj_id of the most probable class."""
        return self.class_ids[np.argmax(self.class_probability, axis=-1)]

    @cached_property
    def best_mode(self) -> Ints:
        """(N, K) row of `modes` of the heaviest mode of the most probable class; -1 where the object has none."""
        best = np.full(self.existence.shape, -1, dtype=np.int64)
        m = self.modes
        right_class = m.class_id == self.best_class[m.object, m.keyframe]
        rows = np.flatnonzero(right_class)
        # ascending weight, so that the heaviest is written last; ties go to the earlier row
        order = rows[np.lexsort((-rows, m.log_weight[rows]))]
        best[m.object[order], m.keyframe[order]] = order
        return best

    @cached_property
    def pose(self) -> Array:
        """(N, K, 4, 4) T_world_object of the best mode; NaN where the object has none."""
        out = np.full((*self.existence.shape, 4, 4), np.nan)
        has = self.best_mode >= 0
        out[has] = self.modes.T_world_object[self.best_mode[has]]
        return out

    @cached_property
    def pose_covariance(self) -> Array:
        """(N, K, 6, 6) covariance of the best mode; NaN where the object has none."""
        out = np.full((*self.existence.shape, 6, 6), np.nan)
        has = self.best_mode >= 0
        out[has] = self.modes.covariance[self.best_mode[has]]
        return out

    @property
    def exists(self) -> NDArray[np.bool_]:
        """(N, K) objects that are more likely there than not, and have a pose."""
        return (self.existence > EXISTS) & (self.best_mode >= 0)

    def at(self, time_ns: int, T_world_camera: Array | None = None, least: float = EXISTS) -> Snapshot:
        """The map at any time of the run: objects are held from the last keyframe at or before it.

        Args:
            time_ns: UTC, nanoseconds. Before the first keyframe the map is that of the first.
            T_world_camera: the recorded camera pose (4, 4) at that time; where given together with the recorded pose
                of the keyframe (`meta["recorded_T_world_camera"]`), the estimated camera is carried by the recorded
                motion.
            least: objects that exist with less than this probability are left out.
        """
        k = max(int(np.searchsorted(self.keyframe_time_ns, time_ns, side="right")) - 1, 0)
        return self.at_keyframe(k, T_world_camera, least)

    def at_keyframe(self, k: int, T_world_camera: Array | None = None, least: float = EXISTS) -> Snapshot:
        """The map at keyframe k; see `at`."""
        camera = self.T_world_camera[k]
        recorded = self.meta.get("recorded_T_world_camera")
        if T_world_camera is not None and recorded is not None:
            camera = camera @ se3.inverse(np.asarray(recorded[k])) @ T_world_camera
        rows = np.flatnonzero((self.existence[:, k] > least) & (self.best_mode[:, k] >= 0))
        best = self.class_probability[rows, k].max(axis=-1) if len(rows) else np.zeros(0)
        return Snapshot(
            keyframe=k,
            objects=rows,
            class_id=self.best_class[rows, k],
            existence=self.existence[rows, k],
            score=self.existence[rows, k] * best,
            T_world_object=self.pose[rows, k],
            T_world_camera=camera,
        )

    def save(self, path: Path) -> None:
        """Write one .npz, whole or not at all, with fixed time stamps."""
        write_npz(path, _arrays(self))

    @classmethod
    def load(cls, path: Path) -> Estimate:
        """Read what `save` wrote. Raises InputError where the file isn't one or has another schema."""
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            meta = json.loads(str(arrays.pop("meta")))
            if meta.get("schema") == SCHEMA:
                return _unpack(arrays, meta)
        except _BROKEN as error:
            raise InputError(
                f"not an estimate ({error})", file=path, remedy="delete it and run the method again"
            ) from error
        raise InputError(
            f"estimate of schema {meta.get('schema')}, this version reads {SCHEMA}",
            file=path,
            field="meta.schema",
            remedy="delete it and run the method again",
        )


@dataclass(frozen=True)
class Snapshot:
    """The map at one time: n objects, each by its most probable class and heaviest mode."""

    keyframe: int
    objects: Ints
    """(n,) rows of Estimate.object_id"""
    class_id: Ints
    """(n,)"""
    existence: Array
    """(n,) P(exists)"""
    score: Array
    """(n,) P(exists) P(class)"""
    T_world_object: Array
    """(n, 4, 4)"""
    T_world_camera: Array
    """(4, 4)"""


def _unpack(arrays: dict[str, Any], meta: dict[str, Any]) -> Estimate:
    """Raises KeyError, TypeError or ValueError where an array is missing, unknown or of another shape."""
    parts = {
        name: kind(**{f.name: arrays.pop(f"{name}.{f.name}") for f in fields(kind)})
        for name, kind in {"modes": Modes, "moves": Moves, "ledger": Ledger}.items()
    }
    return Estimate(**arrays, **parts, meta=meta)


def _arrays(estimate: Estimate) -> dict[str, Any]:
    arrays: dict[str, Any] = {}
    for f in fields(estimate):
        value = getattr(estimate, f.name)
        if f.name == "meta":
            arrays["meta"] = np.array(json.dumps({**value, "schema": SCHEMA}, sort_keys=True, allow_nan=False))
        elif isinstance(value, Modes | Moves | Ledger):
            arrays |= {f"{f.name}.{g.name}": getattr(value, g.name) for g in fields(value)}
        else:
            arrays[f.name] = value
    return arrays
