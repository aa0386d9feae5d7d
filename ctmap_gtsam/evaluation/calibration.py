"""Whether a method is as sure as it should be: of poses, and of what exists.

One sample an object-visit, at its end, since frames of one visit share their errors.

Poses: what is believed of T_world_object is a mixture, the modes of the true class, each a Gaussian of ``r =
log(inv(T) T_true S)`` at the symmetry S where ``r' C^-1 r`` is least. Directions that a symmetry or the data leave
free (a mode's `free_axes`) are projected away; d directions remain. Coverage asks whether the truth lies in the
smallest region that holds a share of that belief (its highest-density region; Hyndman 1996), which for a single mode
is its ellipsoid. The normalised estimation error squared (NEES; Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4) is of the mode that the metrics take for *the* pose, with
the mixture's covariance about it (section 11.6 there), and has mean d if calibrated. Only samples of the true class
count. The world frame is the truth's, since that is where covariances are given, so an error of the localisation
counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.evaluation.matching import Matching, MethodMap, ObjectFrames
from ctmap_gtsam.evaluation.statistics import log_score, mean, median
from ctmap_gtsam.evaluation.visits import ends, last_frames
from factors.symmetry import Symmetry, nearest_image, residual
from sequences import se3
from sequences.catalogue import Catalogue
from sequences.types import Run, Truth

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LEVELS = {"coverage_50": 0.5, "coverage_80": 0.8, "coverage_95": 0.95}

POSE_CALIBRATION = (*LEVELS, "anees", "position_error_mm_median", "position_sigma_mm_median")
"""coverage_*: share of the true poses in the region that should hold so many. anees: average NEES over degrees of
freedom, 1 for a calibrated method, more for one that is too sure. position_*: the usual error, and the usual root mean
square error that the reported pose's own covariance claims; of one Gaussian, the same in all directions, the median
error is 0.89 of it"""

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
    mass: Array
    """(n,) of the belief, what is more probable than the truth: uniform on 0 to 1 if calibrated"""
    error_m: Array
    """(n,) of the reported position"""
    sigma_m: Array
    """(n,) root of the trace of its covariance, of the reported mode alone"""


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
    columns = np.array([r for r in rows if r[1] > 0], dtype=np.float64).reshape(-1, 5).T
    return PoseSamples(
        nees=columns[0], freedom=columns[1].astype(np.int64), mass=columns[2], error_m=columns[3], sigma_m=columns[4]
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
    basis = _held(free_axes, symmetry)
    weight = np.linalg.inv(basis.T @ covariance @ basis + _FLOOR * np.eye(basis.shape[1]))
    twins = residual(T, T_true @ symmetry.discrete, _lines(symmetry)) @ basis  # (S, d)
    return float(np.einsum("si,ij,sj->s", twins, weight, twins).min()), basis.shape[1]


def denser_mass(
    log_weight: Array, T: Array, covariance: Array, free_axes: Array, T_true: Array, symmetry: Symmetry
) -> float:
    """How much of a belief is more probable than the truth: 0 at its peak, near 1 far from all modes.

    Modes are taken for apart, each with a density of its own: where they overlap they are counted one by one.

    Args:
        log_weight: (n,) of the modes; need not be normalised.
        T: (n, 4, 4).
        covariance: (n, 6, 6) of their right tangents.
        free_axes: (n, 6, f) as in `nees`.
        T_true: (4, 4).
        symmetry: of the object.
    """
    held = _held(np.zeros((6, 0)), symmetry)
    log_peak = log_weight - 0.5 * np.linalg.slogdet(held.T @ covariance @ held + _FLOOR * np.eye(held.shape[1]))[1]
    samples = [nees(*mode, T_true, symmetry) for mode in zip(T, covariance, free_axes, strict=True)]
    distance, freedom = np.array([d for d, _ in samples]), np.array([f for _, f in samples])
    here = np.max(log_peak - 0.5 * distance)
    inside = chi2.cdf(2.0 * np.maximum(log_peak - here, 0.0), np.maximum(freedom, 1))
    return float(np.average(inside, weights=np.exp(log_weight - log_weight.max())))


def spread_about(best: int, log_weight: Array, T: Array, covariance: Array, symmetry: Symmetry) -> Array:
    """The second moment (6, 6) of a belief about one of its modes, in that one's right tangent; arrays as above."""
    g = nearest_image(np.broadcast_to(T[best], T.shape), T, symmetry)
    r = residual(np.broadcast_to(T[best], T.shape), g, _lines(symmetry))
    turn = se3.adjoint(se3.inverse(T[best]) @ g)
    weight = np.exp(log_weight - log_weight.max())
    moments = turn @ covariance @ np.swapaxes(turn, -1, -2) + r[:, :, None] * r[:, None, :]
    return np.asarray(np.average(moments, axis=0, weights=weight))


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
    inside = {name: samples.mass <= level for name, level in LEVELS.items()}
    anees = float(samples.nees.sum() / samples.freedom.sum()) if some else np.inf
    return {
        **{name: mean(share) for name, share in inside.items()},
        "anees": anees if np.isfinite(anees) else None,
        "position_error_mm_median": median(1e3 * samples.error_m),
        "position_sigma_mm_median": median(1e3 * samples.sigma_m),
    }


def existence_metrics(samples: ExistenceSamples) -> dict[str, float | None]:
    """EXISTENCE over samples."""
    p = samples.probability
    return {
        "existence_log_score": log_score(np.where(samples.exists, p, 1.0 - p)),
        "existence_brier_score": mean((p - samples.exists) ** 2),
    }


def _sample(estimate: Estimate, row: int, k: int, T_true: Array, catalogue: Catalogue) -> tuple[float, ...]:
    """NEES, degrees of freedom, `denser_mass`, and the position's error and standard deviation, metres."""
    m, best = estimate.modes, int(estimate.best_mode[row, k])
    rows = np.flatnonzero((m.object == row) & (m.keyframe == k) & (m.class_id == m.class_id[best]))
    symmetry = Symmetry.of(catalogue[int(m.class_id[best])])
    belief = m.log_weight[rows], m.T_world_object[rows], m.covariance[rows]
    covariance = spread_about(int(np.flatnonzero(rows == best)[0]), *belief, symmetry)
    error, freedom = nees(m.T_world_object[best], covariance, m.free_axes[best], T_true, symmetry)
    mass = denser_mass(*belief, m.free_axes[rows], T_true, symmetry)
    off = residual(m.T_world_object[best], T_true, symmetry)[3:]
    return error, freedom, mass, float(np.linalg.norm(off)), float(np.sqrt(np.trace(m.covariance[best][3:, 3:])))


def _held(free_axes: Array, symmetry: Symmetry) -> Array:
    """Orthonormal columns (6, d) of the directions that neither a symmetry nor free axes (6, f) leave free."""
    span, size, _ = np.linalg.svd(np.concatenate([free_axes, symmetry.free_axes], axis=1))
    return np.asarray(span[:, int((size > 1e-6).sum()) :])


def _lines(symmetry: Symmetry) -> Symmetry:
    """Its free axes alone."""
    return Symmetry(axes=symmetry.axes, offsets=symmetry.offsets)
