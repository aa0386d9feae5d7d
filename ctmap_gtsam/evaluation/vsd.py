"""Visible Surface Discrepancy: how much of what can be seen of an object is where the estimate says it is.

Hodan, Matas, Obdrzalek, On Evaluation of 6D Object Pose Estimation (ECCV Workshops 2016), with the thresholds of Hodan
et al., BOP Challenge 2020 (ECCV Workshops 2020). Distances are from the camera's centre, not along its axis. It needs
no symmetries: poses that can't be told apart have no error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.evaluation.detection import matched_class
from ctmap_gtsam.evaluation.matching import Matching, ObjectFrames
from ctmap_gtsam.evaluation.silhouettes import Window, draw
from sequences.camera import Camera
from sequences.catalogue import Catalogue, Mesh, ObjectClass
from sequences.types import Frame, Run

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]

EVERY = 5
"""It is measured in every fifth frame of a visit, from the first on"""

TOLERANCE_M = 0.015
"""delta: a surface so far behind what was measured still counts as visible"""

SHARES = np.linspace(0.05, 0.5, 10)
"""Of the diameter: the misalignment tau that is tolerated. As thresholds of the error: theta"""


class Scene(NamedTuple):
    """What was measured in one frame."""

    camera: Camera
    distance: NDArray[np.float32]
    """(h, w) metres, 0 where there is none"""
    stretch: NDArray[np.float32]
    """(h, w) distance over depth"""


def vsd(scene: Floats, estimated: Floats, true: Floats, tau: Array) -> Array:
    """The error for each tolerance.

    Args:
        scene: (h, w) measured distance, metres, 0 where there is none: nothing is hidden there.
        estimated: (h, w) distance of the object's surface at the estimated pose, infinite where it isn't.
        true: (h, w) the same at the true pose.
        tau: (T,) metres.

    Returns:
        (T,) share of the pixels in which either is visible that only one sees, or both more than tau apart; 1 where
        nothing is visible.
    """
    seen = _visible(scene, true)
    # what hides the true object's surface can't hide the estimate's at the same pixel less than that (BOP's code)
    claimed = _visible(scene, estimated) | (seen & np.isfinite(estimated))
    both, either = seen & claimed, int((seen | claimed).sum())
    apart = np.abs(estimated[both] - true[both])
    right = (apart[:, None] < tau).sum(axis=0)
    return 1.0 - right / either if either else np.ones(len(tau))


def _visible(scene: Floats, surface: Floats) -> Bools:
    return np.isfinite(surface) & ((surface <= scene + TOLERANCE_M) | (scene == 0))


def recall(errors: Array) -> float:
    """Share of pairs (tau, theta) that a pose passes: errors (T,) for the tolerances -> 0 to 1."""
    return float((errors[:, None] < SHARES).mean())


def scenes(run: Run, step: int = 1) -> dict[int, Scene]:
    """What was measured in every EVERY-th frame of each visit, by frame; every `step`-th pixel each way."""
    return {frame.index: _scene(frame, step) for visit in run.visits for frame in visit.frames[::EVERY]}


def _scene(frame: Frame, step: int) -> Scene:
    camera = frame.camera.window(0, 0, -(-frame.camera.width // step), -(-frame.camera.height // step), step)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    stretch = np.linalg.norm(camera.backproject(u, v, np.ones(u.shape)), axis=-1).astype(np.float32)
    return Scene(camera, frame.read_depth()[::step, ::step] * stretch, stretch)


def vsd_recall(
    catalogue: Catalogue,
    measured: Mapping[int, Scene],
    truth: ObjectFrames,
    estimated: ObjectFrames,
    matching: Matching,
) -> Array:
    """(N, F) `recall` of each true object in each frame that was measured; NaN in others, and where it isn't asked.

    A true object whose match is absent, or has another class, has recall 0.

    Args:
        catalogue: the meshes.
        measured: from `scenes`.
        truth: in the true cameras.
        estimated: in the method's own.
        matching: of the two.
    """
    said = matched_class(estimated, matching)
    out = np.full(truth.visible.shape, np.nan)
    for f, scene in measured.items():
        asked = np.flatnonzero(truth.visible[:, f])
        out[asked, f] = 0.0
        for n in asked[said[asked, f] == truth.class_id[asked, f]]:
            poses = estimated.T_camera_object[matching.row[n], f], truth.T_camera_object[n, f]
            out[n, f] = _recall(catalogue[int(truth.class_id[n, f])], poses, scene)
    return out


def _recall(thing: ObjectClass, poses: tuple[Array, Array], scene: Scene) -> float:
    """Of one object, estimated and truly at poses (4, 4) in the camera."""
    part, surfaces = _surfaces(thing.mesh, poses, scene.camera)
    estimated, true = (surface * scene.stretch[part] for surface in surfaces)
    return recall(vsd(scene.distance[part], estimated, true, SHARES * thing.diameter_m))


def _surfaces(mesh: Mesh, poses: Sequence[Array], camera: Camera) -> tuple[Window, list[NDArray[np.float32]]]:
    """A part of the image that holds a mesh at several poses, and its depth there at each."""
    drawn = [draw(mesh, T, camera) for T in poses]
    windows = [window for window, depth in drawn if depth.size]
    rows, columns = (_hull([window[axis] for window in windows]) for axis in (0, 1))
    out = []
    for (r, c), depth in drawn:
        surface = np.full((rows.stop - rows.start, columns.stop - columns.start), np.inf, dtype=np.float32)
        if depth.size:
            top, left = r.start - rows.start, c.start - columns.start
            surface[top : top + depth.shape[0], left : left + depth.shape[1]] = depth
        out.append(surface)
    return (rows, columns), out


def _hull(slices: Sequence[slice]) -> slice:
    return slice(min((s.start for s in slices), default=0), max((s.stop for s in slices), default=0))
