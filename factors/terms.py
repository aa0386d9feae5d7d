"""What a graph holds, as numbers: residuals of one form, for one factor or for thousands in one call.

A graph of N poses has several N factors but few forms of them. Evaluated one by one, a residual that costs a few
microseconds costs some hundred of calls and small arrays. So each form stands here once, over arrays with a batch shape
(...): () is one factor, which `factors.custom` wraps for GTSAM; (n,) is n of them, which a solver linearises at once.

Each form gives the whitened residual r of its values and the Jacobians for right perturbations of poses and for
additions to vectors; its energy is 1/2 r^T r = c - log potential, with c the potential's `mixture.log_constant`, or
for context its peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from factors import context, instance, measurement, mixture
from factors.symmetry import NONE, Symmetry, gauge_residual, reduced_residual_jacobians, residual_jacobians
from sequences import se3

Array = NDArray[np.float64]
Linearised = tuple[Array, tuple[Array, ...]]
"""Whitened residual (..., m) and for each value its Jacobian (..., m, 6)"""


class Terms(Protocol):
    """Factors of one form, without their keys."""

    @property
    def rows(self) -> int:
        """m, the residual's dimension."""

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """At values (..., 4, 4) of poses or (..., 6) of vectors, one for each key."""

    def __getitem__(self, index: int | slice) -> Terms:
        """One of a batch (n,): batch shape (); or some of them."""


@dataclass(frozen=True, eq=False)
class Modes:
    """Measurement modes; see `measurement.mode_residual`.

    Keys: T_world_camera, T_world_object, and where there is one the bias (6,) in the object's tangent.
    """

    T_camera_mode: Array
    """(..., 4, 4)"""
    information: Array
    """(..., 6, 6) in the object's tangent; its flat directions stay free"""
    symmetry: Symmetry = NONE

    @cached_property
    def whitener(self) -> Array:
        """R (..., 6 - f, 6): 0 rows where the information is flat."""
        return mixture.square_root(self.symmetry.reduced_information(self.information)) @ self.symmetry.projection

    @property
    def rows(self) -> int:
        """See `Terms`."""
        return 6 - self.symmetry.free

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """See `Terms`."""
        camera, placed, *bias = values
        r, J_camera, J_object = measurement.mode_residual_jacobians(
            camera, placed, self.T_camera_mode, bias[0] if bias else None, self.symmetry, self.information
        )
        R = self.whitener
        return (R @ r[..., None])[..., 0], (R @ J_camera, R @ J_object, *(-R for _ in bias))

    def __getitem__(self, index: int | slice) -> Modes:
        """See `Terms`."""
        return replace(self, T_camera_mode=self.T_camera_mode[index], information=self.information[index])


@dataclass(frozen=True, eq=False)
class Predictions:
    """phi_p between an object's poses at two times; see `factors.prediction`. Keys: T_world_object, before and after.

    For an object without symmetry GTSAM's BetweenFactorPose3 of the identity says the same.
    """

    sigma: Array
    """(..., 6, 6) from `prediction.covariance`"""
    symmetry: Symmetry = NONE
    T_reference: Array | None = None
    """(..., 4, 4) near the pose before: that pose is turned about its free axes to be nearest to it. The residual turns
    with those axes otherwise, its energy doesn't; Gauss-Newton then takes a free turn for a stiff one"""

    @cached_property
    def information(self) -> Array:
        """(..., 6, 6), to choose a symmetry by."""
        return np.asarray(np.linalg.inv(self.sigma), dtype=np.float64)

    @cached_property
    def whitener(self) -> Array:
        """R (..., 6 - f, 6 - f)."""
        information = np.linalg.inv(self.symmetry.reduced_covariance(self.sigma))
        return np.swapaxes(np.linalg.cholesky(information), -1, -2)

    @property
    def rows(self) -> int:
        """See `Terms`."""
        return 6 - self.symmetry.free

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """See `Terms`."""
        before, after = values
        turned: Array | None = None
        if self.T_reference is not None:
            s, _, J = residual_jacobians(self.T_reference, before, self.symmetry)
            before, turned = se3.retract(self.T_reference, s), se3.right_jacobian(s) @ J
        r, J_a, J_b = reduced_residual_jacobians(before, after, self.symmetry, self.information)
        R = self.whitener
        return (R @ r[..., None])[..., 0], (R @ (J_a if turned is None else J_a @ turned), R @ J_b)

    def __getitem__(self, index: int | slice) -> Predictions:
        """See `Terms`."""
        reference = None if self.T_reference is None else self.T_reference[index]
        return replace(self, sigma=self.sigma[index], T_reference=reference)


@dataclass(frozen=True, eq=False)
class Drifts:
    """Localisation's error from keyframe to keyframe, e_b = rho e_a + noise with e = log(recorded^-1 T_world_camera).

    Keys: T_world_camera, before and after. GTSAM's between factor knows no error that decays.
    """

    recorded_a: Array
    """(..., 4, 4) T_world_camera as recorded, before"""
    recorded_b: Array
    """(..., 4, 4) after"""
    rho: Array
    """(...)"""
    sigma: Array
    """(..., 6) of the noise"""

    @property
    def rows(self) -> int:
        """See `Terms`."""
        return 6

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """See `Terms`."""
        e_a, _, J_a = residual_jacobians(self.recorded_a, values[0])
        e_b, _, J_b = residual_jacobians(self.recorded_b, values[1])
        rho, weight = self.rho[..., None], 1.0 / self.sigma[..., None]
        return (e_b - rho * e_a) / self.sigma, (-rho[..., None] * weight * J_a, weight * J_b)

    def __getitem__(self, index: int | slice) -> Drifts:
        """See `Terms`."""
        return Drifts(self.recorded_a[index], self.recorded_b[index], self.rho[index], self.sigma[index])


@dataclass(frozen=True, eq=False)
class Gauges:
    """What holds symmetric objects' free directions near reference poses; see `symmetry.gauge_residual`.

    Key: T_world_object.
    """

    T_reference: Array
    """(..., 4, 4)"""
    symmetry: Symmetry
    sigma_rad: float = np.pi

    @property
    def rows(self) -> int:
        """See `Terms`."""
        return self.symmetry.free

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """See `Terms`."""
        r, J = gauge_residual(self.T_reference, values[0], self.symmetry)
        return r / self.sigma_rad, (J / self.sigma_rad,)

    def __getitem__(self, index: int | slice) -> Gauges:
        """See `Terms`."""
        return replace(self, T_reference=self.T_reference[index])


@dataclass(frozen=True, eq=False)
class Standings:
    """That a thing stands flat: directions of it are level, with a Gaussian error of the sine. Key: T_world_object."""

    level: Array
    """(m, 3) unit vectors of the object's frame, one set for all"""
    up: Array
    """(3,) unit vector, world frame"""
    sigma_rad: Array
    """(...)"""
    keyframes: Array
    """(...) over how many keyframes this one fact is spread"""

    @property
    def rows(self) -> int:
        """See `Terms`."""
        return len(self.level)

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """See `Terms`."""
        up = np.swapaxes(values[0][..., :3, :3], -1, -2) @ self.up
        weight = 1.0 / (self.sigma_rad * np.sqrt(self.keyframes))
        # R exp(w) turns what is up by -w in the object's frame: its change is up x w
        turned = np.cross(self.level, up[..., None, :])
        J = np.concatenate([turned, np.zeros_like(turned)], axis=-1)
        return weight[..., None] * (up @ self.level.T), (weight[..., None, None] * J,)

    def __getitem__(self, index: int | slice) -> Standings:
        """See `Terms`."""
        return replace(self, sigma_rad=self.sigma_rad[index], keyframes=self.keyframes[index])


@dataclass(frozen=True, eq=False)
class Contexts:
    """phi_c between two objects at one time; see `factors.context`. Keys: T_world_object of one and of the other."""

    centres: Array
    """(..., 2, 3) of each, object frames, between which the distance is taken"""
    pair: context.PairMixture
    """of their classes, (...)"""
    instance: Array
    """(...) log(phi_ins / phi_background), nats"""
    keyframes: Array
    """(...) over how many keyframes this one fact is spread"""

    @property
    def rows(self) -> int:
        """See `Terms`."""
        return 1

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """See `Terms`."""
        a, b = self.centres[..., 0, :], self.centres[..., 1, :]
        distance, J_a, J_b = context.pair_distance_jacobians(values[0], values[1], a, b)
        e, slope, _ = context.context_residual(distance, self.pair, self.instance)
        share = 1.0 / np.sqrt(self.keyframes)
        by_distance = (share * slope)[..., None, None]
        return (share * e)[..., None], (by_distance * J_a[..., None, :], by_distance * J_b[..., None, :])

    def __getitem__(self, index: int | slice) -> Contexts:
        """See `Terms`."""
        return Contexts(self.centres[index], self.pair[index], self.instance[index], self.keyframes[index])


@dataclass(frozen=True, eq=False)
class Partners:
    """phi_c between two objects that may have been moved together; see `factors.instance`. Keys as of `Contexts`."""

    pair: context.PairMixture
    """of their classes, (...)"""
    relation: instance.InstanceRelation
    """from the first to the second, one for all"""
    symmetries: tuple[Symmetry, Symmetry]
    """of both, about the origins of their frames, between which the distance is taken"""
    candidates: Array
    """(...) as of `instance.among_log_ratio`"""
    keyframes: Array
    """(...) over how many keyframes this one fact is spread"""

    @property
    def rows(self) -> int:
        """See `Terms`."""
        return 1 + len(self.relation.precision)

    @cached_property
    def whitener(self) -> Array:
        """(d, d) root of the precision."""
        return np.asarray(np.linalg.cholesky(self.relation.precision).T)

    def linearised(self, values: Sequence[Array]) -> Linearised:
        """See `Terms`."""
        nowhere = np.zeros(3)
        distance, *by_distance = context.pair_distance_jacobians(values[0], values[1], nowhere, nowhere)
        peak = instance.among_log_ratio(self.relation.log_peak, self.candidates)
        e, slope, _ = context.context_residual(distance, self.pair, peak)
        x, *J = instance.instance_residual_jacobians(values[0], values[1], self.relation, *self.symmetries)
        x = (self.whitener @ x[..., None])[..., 0]
        J = [self.whitener @ own for own in J]
        w2, k = self.pair.instance_weight, self.relation.freedom
        left = replace(self.pair, strangers=self.pair.strangers + w2 * (1.0 - 1.0 / self.candidates))
        log_gain = np.log(w2 / self.candidates) + self.relation.log_peak
        square = (x * x).sum(axis=-1)
        f, by_q, by_d = context.falling_residual(distance, left, square, k, 0.5 * (k + x.shape[-1]), log_gain)
        share = 1.0 / np.sqrt(self.keyframes)
        jacobians = []
        for own, d in zip(J, by_distance, strict=True):
            by_f = 2.0 * by_q[..., None] * (x[..., None, :] @ own)[..., 0, :] + by_d[..., None] * d
            falling = f[..., None, None] * own + x[..., None] * by_f[..., None, :]
            rows = [slope[..., None, None] * d[..., None, :], falling]
            jacobians.append(share[..., None, None] * np.concatenate(rows, axis=-2))
        return share[..., None] * np.concatenate([e[..., None], f[..., None] * x], axis=-1), tuple(jacobians)

    def __getitem__(self, index: int | slice) -> Partners:
        """See `Terms`."""
        return replace(self, pair=self.pair[index], candidates=self.candidates[index], keyframes=self.keyframes[index])
