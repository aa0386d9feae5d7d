"""Residuals of objects that look the same from several poses.

An object's symmetries form a group G of motions g with "T g looks like T". What can be known is the coset T G, so the
residual between two poses is the shortest one between their cosets:

    r(T_a, T_b) = log(T_a^-1 T_b g*),     g* = argmin_g of its length

A discrete group is the best of |S| residuals. A rotation about a line (axis u through point p) is removed in closed
form: the swing-twist decomposition R = swing . twist(u) has a swing with no component along u, and it is the smallest
rotation on the coset. Residual, Jacobian and degrees of freedom then lose that direction, and densities are over the
quotient SE(3)/G: a uniform pose has density |S| / (8 pi^2 V), and 1 / (4 pi V) with one free axis (8 pi^2 / 2 pi).

Every compact group of motions has a fixed point. About that centre all symmetries are pure rotations; a covariance that
is isotropic there is invariant under G, so that energies don't depend on which of the equivalent poses an object is
written in. Tangents are those of the object frame: [rotation, translation], right perturbation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors._shortest import distinct as compiled_distinct
from factors._shortest import moments as compiled_moments
from factors._shortest import near as compiled_near
from factors._shortest import shortest, shortest_jacobians
from factors.mixture import LOG_2PI, LOG_ROTATIONS, normalised
from factors.motions import filled
from sequences import se3
from sequences.catalogue import ObjectClass

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_STILL = 1e-9  # a step of the mean, rad or metres, that none need follow


def _axis_turns() -> Array:
    signed = [np.diag(s)[list(p)] for p in permutations(range(3)) for s in product((1.0, -1.0), repeat=3)]
    return np.stack([R for R in signed if np.linalg.det(R) > 0.0])


AXIS_TURNS = _axis_turns()
"""(24, 3, 3) rotations that carry a frame's axes into each other"""


def _identity() -> Array:
    return np.eye(4)[None]


def _no_axes() -> Array:
    return np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The symmetries of one object, in its own frame."""

    discrete: Array = field(default_factory=_identity)
    """(S, 4, 4) metres, identity first"""
    axes: Array = field(default_factory=_no_axes)
    """(A, 3) unit vectors: any rotation about these lines leaves the object as it is"""
    offsets: Array = field(default_factory=_no_axes)
    """(A, 3) a point on each line, metres"""

    @classmethod
    def of(cls, object_class: ObjectClass) -> Symmetry:
        """The symmetries that a catalogue gives a class."""
        lines = object_class.symmetries_continuous
        return cls(
            discrete=np.asarray(object_class.symmetries_discrete, dtype=np.float64).reshape(-1, 4, 4),
            axes=np.array([line.axis for line in lines], dtype=np.float64).reshape(-1, 3),
            offsets=np.array([line.offset for line in lines], dtype=np.float64).reshape(-1, 3),
        )

    @cached_property
    def centre(self) -> Array:
        """(3,) the fixed point of all symmetries that lies nearest to the object's origin, metres."""
        rotations, shifts = self.discrete[:, :3, :3], self.discrete[:, :3, 3]
        across = np.eye(3) - self.axes[:, :, None] * self.axes[:, None, :]
        rows = np.concatenate([(rotations - np.eye(3)).reshape(-1, 3), across.reshape(-1, 3)])
        right = np.concatenate([-shifts.ravel(), (across @ self.offsets[:, :, None]).ravel()])
        return np.linalg.lstsq(rows, right, rcond=1e-6)[0]

    @cached_property
    def T_object_centre(self) -> Array:
        """(4, 4) the object's axes moved to the centre."""
        return se3.make(np.eye(3), self.centre)

    @cached_property
    def free_rotations(self) -> Array:
        """(3, f) orthonormal rotation axes about the centre that change nothing: none, one, or all (a ball)."""
        if len(self.axes) == 0:
            return np.zeros((3, 0))
        parallel = np.abs(self.axes @ self.axes[0]) > 1.0 - 1e-6
        return np.ascontiguousarray(self.axes[:1].T) if parallel.all() else np.eye(3)

    @property
    def free(self) -> int:
        """How many directions of the pose have no meaning: 0, 1 or 3."""
        return self.free_rotations.shape[1]

    @property
    def order(self) -> int:
        """|S|, how many discrete images there are."""
        return len(self.discrete)

    @cached_property
    def generators(self) -> Array:
        """(6, f) tangents of the object frame along which it looks the same: [u, p x u]."""
        u = self.free_rotations
        return np.concatenate([u, np.cross(self.centre, u, axisb=0, axisc=0)]) if self.free else np.zeros((6, 0))

    @cached_property
    def free_axes(self) -> Array:
        """(6, f) orthonormal columns that span `generators`."""
        return np.linalg.qr(self.generators)[0]

    @cached_property
    def reader(self) -> Array:
        """(f, 6): a tangent -> its rotation along the free directions."""
        return np.concatenate([self.free_rotations, np.zeros((3, self.free))]).T

    @cached_property
    def lift(self) -> Array:
        """(6, 6 - f): reduced coordinates of a residual -> the residual."""
        basis = np.zeros((6, 6 - self.free))
        basis[:3, :-3] = _complement(self.free_rotations)
        basis[3:, -3:] = np.eye(3)
        return se3.adjoint(self.T_object_centre) @ basis

    @cached_property
    def projection(self) -> Array:
        """(6 - f, 6): a residual -> its reduced coordinates; `projection @ lift` is the identity."""
        to_centre = se3.adjoint(se3.inverse(self.T_object_centre))
        return np.linalg.pinv(to_centre @ self.lift) @ to_centre

    def reduced_covariance(self, covariance: ArrayLike) -> Array:
        """(..., 6, 6) of the object's tangent -> (..., 6 - f, 6 - f) of the reduced coordinates."""
        return self.projection @ np.asarray(covariance, dtype=np.float64) @ self.projection.T

    def reduced_information(self, information: ArrayLike) -> Array:
        """(..., 6, 6) of the object's tangent -> (..., 6 - f, 6 - f) of the reduced coordinates."""
        return self.lift.T @ np.asarray(information, dtype=np.float64) @ self.lift

    @property
    def log_quotient_rotations(self) -> float:
        """The log of the volume of SO(3)/G: 8 pi^2 / |S|, 1/2 pi of that for a free axis, 1 for a ball."""
        if self.free == 3:
            return 0.0
        return LOG_ROTATIONS - self.free * LOG_2PI - float(np.log(self.order))


def _complement(directions: Array) -> Array:
    """Orthonormal columns (n, n - f) that span what `directions` (n, f), orthonormal, leave."""
    full = np.linalg.qr(np.concatenate([directions, np.eye(len(directions))], axis=1))[0]
    return np.eye(len(directions)) if directions.shape[1] == 0 else full[:, directions.shape[1] :]


NONE = Symmetry()


def residual(T_a: ArrayLike, T_b: ArrayLike, symmetry: Symmetry = NONE, information: ArrayLike | None = None) -> Array:
    """The shortest log(T_a^-1 T_b g) over the symmetries g.

    Args:
        T_a: (..., 4, 4), broadcasts against `T_b`.
        T_b: (..., 4, 4).
        symmetry: of the object that both poses belong to.
        information: (..., 6, 6) of the object's tangent, to choose g by r^T L r; None = by the angle of rotation.

    Returns:
        (..., 6) in the object's tangent. Free directions carry nothing: see `Symmetry.projection`.
    """
    A, B = np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64)
    # one pose for all need not be repeated
    pairs = (np.ascontiguousarray(A), np.ascontiguousarray(B)) if A.ndim == 2 else _pairs(A, B)
    return _shortest(*pairs, symmetry, information)[0]


def near(
    T: ArrayLike, others: ArrayLike, symmetry: Symmetry, rotation_rad: float, translation_m: float
) -> NDArray[np.bool_]:
    """Whether poses (..., 4, 4) are the pose T (4, 4) but for less than a turn and a shift: (...)."""
    pose, poses = np.ascontiguousarray(T, np.float64).reshape(4, 4), np.ascontiguousarray(others, np.float64)
    out = np.empty(poses.shape[:-2], dtype=np.bool_)
    group = symmetry.discrete, symmetry.free_rotations, symmetry.centre
    compiled_near(pose, _flat(poses), *group, rotation_rad, translation_m, out.reshape(-1))
    return out


def distinct(
    poses: ArrayLike, order: Ints, most: int, symmetry: Symmetry, rotation_rad: float, translation_m: float
) -> list[int]:
    """Rows of poses (n, 4, 4), the first `most` in an order (m,) that are not `near` one that was taken before."""
    T, kept = np.ascontiguousarray(poses, dtype=np.float64), np.empty(len(order), dtype=np.int64)
    group = symmetry.discrete, symmetry.free_rotations, symmetry.centre
    number = compiled_distinct(T, order, most, *group, rotation_rad, translation_m, kept)
    return [int(row) for row in kept[:number]]


def moments(
    T: ArrayLike, poses: ArrayLike, log_weights: ArrayLike, symmetry: Symmetry, residuals: Array, steps: int
) -> tuple[Array, Array]:
    """Mean (4, 4) and covariance (6, 6) of weighted poses, each taken in its image nearest to the mean.

    Args:
        T: (4, 4) where the mean is looked for.
        poses: (n, 4, 4).
        log_weights: (n,) of any scale.
        symmetry: of the object.
        residuals: (n, 6) `residual` of the poses from T; afterwards from the mean.
        steps: towards the mean, at most; what lies within a turn needs fewer than five.
    """
    mean, covariance = np.array(T, dtype=np.float64)[None], np.empty((6, 6))
    group = symmetry.discrete, symmetry.free_rotations, symmetry.centre
    weights = np.exp(normalised(log_weights))
    near_poses = np.ascontiguousarray(poses, dtype=np.float64)
    compiled_moments(mean, near_poses, weights, *group, steps, _STILL, residuals, covariance)
    return mean[0], covariance


def residual_jacobians(
    T_a: ArrayLike, T_b: ArrayLike, symmetry: Symmetry = NONE, information: ArrayLike | None = None
) -> tuple[Array, Array, Array]:
    """`residual` with its derivatives with respect to right perturbations of both poses.

    The g of a continuous symmetry moves with the poses, which takes the free direction out of both derivatives.

    Returns:
        r (..., 6), d r / d T_a (..., 6, 6), d r / d T_b (..., 6, 6).
    """
    A, B = _pairs(T_a, T_b)
    r, g, _ = _shortest(A, B, symmetry, information)
    J = np.empty((2, *r.shape, 6))
    shortest_jacobians(
        _flat(A), _flat(B), r.reshape(-1, 6), _flat(g), symmetry.generators, symmetry.reader, *J.reshape(2, -1, 6, 6)
    )
    return r, J[0], J[1]


def reduced_residual_jacobians(
    T_a: ArrayLike, T_b: ArrayLike, symmetry: Symmetry = NONE, information: ArrayLike | None = None
) -> tuple[Array, Array, Array]:
    """`residual_jacobians` in the 6 - f coordinates that mean something: (..., 6 - f), (..., 6 - f, 6) twice."""
    r, J_a, J_b = residual_jacobians(T_a, T_b, symmetry, information)
    if symmetry is NONE:
        return r, J_a, J_b
    P = symmetry.projection
    return (P @ r[..., None])[..., 0], P @ J_a, P @ J_b


def best_symmetry(T_a: ArrayLike, T_b: ArrayLike, discrete: ArrayLike, information: ArrayLike | None = None) -> Ints:
    """Which discrete symmetry s makes log(T_a^-1 T_b s) shortest: (..., 4, 4), (..., 4, 4), (S, 4, 4) -> (...).

    `information` as in `residual`.
    """
    symmetry = Symmetry(discrete=np.asarray(discrete, dtype=np.float64))
    return _shortest(*_pairs(T_a, T_b), symmetry, information)[2]


def nearest_image(T_a: ArrayLike, T_b: ArrayLike, symmetry: Symmetry) -> Array:
    """T_b g, the pose (..., 4, 4) that looks like T_b and lies nearest to T_a."""
    A, B = _pairs(T_a, T_b)
    return B @ _shortest(A, B, symmetry, None)[1]


def gauge_residual(T_reference: ArrayLike, T: ArrayLike, symmetry: Symmetry) -> tuple[Array, Array]:
    """What holds a free direction in place, so that elimination has something to divide by.

    Divide it by a weak sigma of pi: it says nothing, and the direction is to be reported as free.

    Returns:
        (..., f) the free rotation's part of log(T_reference^-1 T), rad, and its Jacobian (..., f, 6) with respect to T.
    """
    r, _, J = residual_jacobians(T_reference, T)
    return (symmetry.reader @ r[..., None])[..., 0], symmetry.reader @ J


def _pairs(T_a: ArrayLike, T_b: ArrayLike) -> tuple[Array, Array]:
    A, B = np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64)
    if A.shape != B.shape:
        shape = np.broadcast(A, B).shape
        A, B = filled(A, shape), filled(B, shape)
    return np.ascontiguousarray(A), np.ascontiguousarray(B)


def _flat(T: Array) -> Array:
    return T.reshape(-1, *T.shape[-2:])


def _shortest(A: Array, B: Array, symmetry: Symmetry, information: ArrayLike | None) -> tuple[Array, Array, Ints]:
    """The residual (..., 6), the g (..., 4, 4) that gives it, and which discrete one (...) it holds.

    Args:
        A: (..., 4, 4), or one pose (4, 4).
        B: (..., 4, 4).
        symmetry: of the object.
        information: as in `residual`.
    """
    batch = B.shape[:-2]
    metric = np.empty((0, 6, 6))
    if information is not None:
        metric = np.asarray(information, dtype=np.float64)
        if metric.ndim > 2:
            metric = np.broadcast_to(metric, (*batch, 6, 6))
        metric = np.array(metric, order="C").reshape(-1, 6, 6)  # a copy, for the same reason as in _pairs
    r, g, chosen = np.empty((*batch, 6)), np.empty((*batch, 4, 4)), np.empty(batch, dtype=np.int64)
    shortest(
        _flat(A),
        _flat(B),
        symmetry.discrete,
        symmetry.free_rotations,
        symmetry.centre,
        metric,
        r.reshape(-1, 6),
        _flat(g),
        chosen.reshape(-1),
    )
    return r, g, chosen
