"""Whether a method is as sure as it should be: of poses, and of what exists.

One sample an object-visit, at its end, since frames of one visit share their errors.

Poses: the normalised estimation error squared (NEES; Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
Tracking and Navigation, 2001, section 5.4) of T_world_object, ``r' C^-1 r`` with ``r = log(inv(T) T_true S)`` at the
symmetry S where it is least. Directions that a symmetry or the data leave free (the mode's `free_axes`) are projected
away; d directions remain, and the NEES of a calibrated method is chi-square with d degrees of freedom. Only samples of
the true class count, by the mode that the metrics take for *the* pose. The world frame is the truth's, since that is
where covariances are given, so an error of the localisation counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames
from ctmap_gtsam.evaluation.statistics import log_score, mean
from ctmap_gtsam.evaluation.visits import ends, last_frames
from factors.symmetry import Symmetry, residual
from sequences.catalogue import Catalogue
from sequences.types import Run, Truth

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LEVELS = {"coverage_50": 0.5, "coverage_80": 0.8, "coverage_95": 0.95}

POSE_CALIBRATION = (*LEVELS, "anees")
"""coverage_*: share of the true poses in the ellipsoid that should hold so many. anees: average NEES over degrees of
freedom, 1 for a calibrated method, more for one that is too sure"""

EXISTENCE = ("existence_log_score", "existence_brier_score")
"""Logarithmic and squared error of P(exists); lower is better"""

_FLOOR = 1e-12  # rad^2, m^2: no pose is known better than to a micrometre


@dataclass(frozen=True)
class PoseSamples:
    """Object-visits (n,) with a pose of the true class."""

    nees: Array
    """(n,)"""
    freedom: Ints
    """(n,) degrees of freedom, 3 to 6"""


@dataclass(frozen=True)
class ExistenceSamples:
    """What was said to exist (n,), and whether it did."""

    probability: Array
    """(n,) P(exists) at the end of a visit"""
    exists: Bools
    """(n,)"""


def pose_samples(run: Run, method: MethodMap, truth: Truth, objects: ObjectFrames, matching: Matching) -> PoseSamples:
    """NEES of each matched true object that is visible in a visit, at its end."""
    seen, final = last_frames(run, objects.visible), ends(run)
    there = last_frames(run, objects.present)
    rows = []
    for n, v in zip(*np.nonzero(seen >= 0), strict=True):
        row, thing = matching.row[n], truth.objects[n]
        if row >= 0 and method.objects.class_id[row, final[v]] == thing.obj_id:
            T_true = thing.T_world_object[np.searchsorted(thing.frames, there[n, v])]
            rows.append(_sample(method.estimate, int(row), int(method.held[final[v]]), T_true, run.catalogue))
    rows = [r for r in rows if r[1] > 0]
    return PoseSamples(
        nees=np.array([r[0] for r in rows], dtype=np.float64), freedom=np.array([r[1] for r in rows], dtype=np.int64)
    )


def nees(T: Array, covariance: Array, free_axes: Array, T_true: Array, symmetry: Symmetry) -> tuple[float, int]:
    """The NEES of one pose, and its degrees of freedom.

    Args:
        T: (4, 4) estimated.
        covariance: (6, 6) of its right tangent.
        free_axes: (6, f) columns that span directions left free by the data, zero columns allowed.
        T_true: (4, 4).
        symmetry: of the object; what it leaves free is taken away, too.
    """
    span, size, _ = np.linalg.svd(np.concatenate([free_axes, symmetry.free_axes], axis=1))
    basis = span[:, int((size > 1e-6).sum()) :]  # (6, d)
    weight = np.linalg.inv(basis.T @ covariance @ basis + _FLOOR * np.eye(basis.shape[1]))
    lines = Symmetry(axes=symmetry.axes, offsets=symmetry.offsets)
    twins = residual(T, T_true @ symmetry.discrete, lines) @ basis  # (S, d)
    return float(np.einsum("si,ij,sj->s", twins, weight, twins).min()), basis.shape[1]


def existence_samples(run: Run, method: MethodMap, objects: ObjectFrames, matching: Matching) -> ExistenceSamples:
    """P(exists) at the end of each visit, of true and of false objects.

    Of each matched true object: in visits in which the truth has it, from the first on in which it was visible, it
    exists; in others it doesn't. Objects that match nothing, but exist at some time, never do. What a method doesn't
    know of at all, with P(exists) = 0, counts where the object does exist.
    """
    final = ends(run)
    said = method.estimate.existence[:, method.held[final]]  # (M, V)
    n = np.flatnonzero(matching.row >= 0)
    present = (last_frames(run, objects.present) >= 0)[n]
    known = np.logical_or.accumulate(last_frames(run, objects.visible) >= 0, axis=1)[n]
    true = said[matching.row[n]]
    false = np.concatenate([true[~present], said[matching.unmatched].ravel()])
    there = true[present & known]
    false = false[false > 0]
    return ExistenceSamples(np.concatenate([there, false]), np.arange(len(there) + len(false)) < len(there))


def pose_calibration_metrics(samples: PoseSamples) -> dict[str, float | None]:
    """POSE_CALIBRATION over object-visits."""
    some = len(samples.nees) > 0
    inside = {name: samples.nees <= chi2.ppf(level, samples.freedom) for name, level in LEVELS.items()}
    anees = float(samples.nees.sum() / samples.freedom.sum()) if some else np.inf
    return {**{name: mean(share) for name, share in inside.items()}, "anees": anees if np.isfinite(anees) else None}


def existence_metrics(samples: ExistenceSamples) -> dict[str, float | None]:
    """EXISTENCE over samples."""
    p = samples.probability
    return {
        "existence_log_score": log_score(np.where(samples.exists, p, 1.0 - p)),
        "existence_brier_score": mean((p - samples.exists) ** 2),
    }


def _sample(estimate: Estimate, row: int, k: int, T_true: Array, catalogue: Catalogue) -> tuple[float, int]:
    mode = int(estimate.best_mode[row, k])
    free_axes, symmetry = estimate.modes.free_axes[mode], Symmetry.of(catalogue[int(estimate.modes.class_id[mode])])
    return nees(estimate.modes.T_world_object[mode], estimate.modes.covariance[mode], free_axes, T_true, symmetry)
