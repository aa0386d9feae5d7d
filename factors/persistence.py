"""The prediction potential phi_p for an object out of view: it stayed, or somebody moved it (Equations 3 and 4).

The probability that an object is still where it was last seen, dt ago, is

    S(dt) = r1 + r2 exp(-dt / mu),          p(move) = 1 - S(dt)                          r1 = r2 = 0.5 in the paper

with a persistence mu of its class. S is the survival over a whole gap. The paper's filter draws stay or move from it at
every time step, so the outcome depends on how many steps there are: a gap with S = 0.80 at its end is survived with
probability 0.80, 0.28 or 1e-5 in 1, 10 or 100 steps. Here a step inside a gap has the conditional survival
S(dt_after) / S(dt_before), and the product over any partition of a gap is S of the whole.

Where a moved object goes: the paper draws another object j and a place on it. As a density of the new pose, in the unit
of the stay density (per rad^3 m^3), that is

    1/(N-1) . 1/Area_j . 1/2 pi . p(stable face) . N(height above the surface) N(tilt out of the face's normal)

in which position (2), yaw (1), height (1) and tilt (2) make the six dimensions. Without a common unit, stay against
move would be settled by the choice of metres or millimetres. Like every density over poses it is one over poses modulo
the object's symmetries: the sum over all poses that look the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import i0e

from factors.mixture import LOG_2PI, log_sum
from factors.symmetry import NONE, Symmetry

Array = NDArray[np.float64]


def stay_probability(dt_s: ArrayLike, mu_s: ArrayLike, r1: float = 0.5, r2: float = 0.5) -> Array:
    """Equation 3: S(dt) = r1 + r2 exp(-dt / mu).

    Args:
        dt_s: (...) seconds that the object went unobserved, >= 0.
        mu_s: (...) the class's persistence, seconds, > 0.
        r1: what stays in the end; r1, r2 >= 0, r1 + r2 <= 1.
        r2: what decays.
    """
    return r1 + r2 * np.exp(-np.asarray(dt_s, dtype=np.float64) / np.asarray(mu_s, dtype=np.float64))


def move_probability(dt_s: ArrayLike, mu_s: ArrayLike, r1: float = 0.5, r2: float = 0.5) -> Array:
    """Equation 4: 1 - S(dt), with all its digits for a short dt. Arguments as in `stay_probability`."""
    ratio = np.asarray(dt_s, dtype=np.float64) / np.asarray(mu_s, dtype=np.float64)
    return (1.0 - r1 - r2) - r2 * np.expm1(-ratio)


def stay_step(
    dt_before_s: ArrayLike, dt_after_s: ArrayLike, mu_s: ArrayLike, r1: float = 0.5, r2: float = 0.5
) -> Array:
    """Probability of staying through one step of a gap, given that it stayed until then: S(after) / S(before).

    Args:
        dt_before_s: (...) seconds from when the object was last seen to the step's beginning; 0 at the gap's start,
            where it is known to be there: S counts as 1 even where r1 + r2 < 1.
        dt_after_s: (...) the same to the step's end, >= dt_before_s.
        mu_s: (...) persistence, seconds.
        r1: as in `stay_probability`.
        r2: as in `stay_probability`.
    """
    return stay_probability(dt_after_s, mu_s, r1, r2) / _known(dt_before_s, mu_s, r1, r2)


def move_step(
    dt_before_s: ArrayLike, dt_after_s: ArrayLike, mu_s: ArrayLike, r1: float = 0.5, r2: float = 0.5
) -> Array:
    """1 - `stay_step`, with all its digits for a short step."""
    before, after = np.asarray(dt_before_s, dtype=np.float64), np.asarray(dt_after_s, dtype=np.float64)
    mu = np.asarray(mu_s, dtype=np.float64)
    lost = -r2 * np.exp(-before / mu) * np.expm1(-(after - before) / mu)
    lost = lost + np.where(before > 0, 0.0, 1.0 - r1 - r2)
    return lost / _known(before, mu, r1, r2)


def _known(dt_s: ArrayLike, mu_s: ArrayLike, r1: float, r2: float) -> Array:
    return np.where(np.asarray(dt_s) > 0, stay_probability(dt_s, mu_s, r1, r2), 1.0)


def facing_log_density(
    up: ArrayLike,
    faces_up: ArrayLike,
    log_face: ArrayLike,
    *,
    tilt_sigma_rad: ArrayLike,
    symmetry: Symmetry = NONE,
) -> Array:
    """The log density of the direction that is up, of an object that has come to rest on one of its stable faces.

    A mixture of von Mises-Fisher densities, which are Gaussians N(tilt) in the chord between two directions and have
    the mass 1 on the sphere. It is the same for all equivalent poses: the mean over the object's symmetries.

    Args:
        up: (..., 3) unit, against gravity, in the object's axes.
        faces_up: (R, 3) unit, what is up when it rests on each face.
        log_face: (R,) log probabilities that it comes to rest on each.
        tilt_sigma_rad: (...) how exactly tilts are known.
        symmetry: of the object.

    Returns:
        (...) nats, per steradian.
    """
    direction, kappa = np.asarray(up, dtype=np.float64), np.asarray(tilt_sigma_rad, dtype=np.float64)[..., None] ** -2.0
    faces, weight = np.asarray(faces_up, dtype=np.float64), np.asarray(log_face, dtype=np.float64)
    if symmetry.free == 3:
        return np.full(direction.shape[:-1], -np.log(4.0 * np.pi))
    images = np.swapaxes(symmetry.discrete[:, :3, :3], -1, -2) @ faces[:, None, :, None]
    faces, weight = images.reshape(-1, 3), np.repeat(weight, symmetry.order) - np.log(symmetry.order)
    if symmetry.free == 1:
        # the mean over all turns about the axis, in closed form
        axis = symmetry.free_rotations[:, 0]
        a, b = direction @ axis, faces @ axis
        across = np.sqrt(np.maximum(1.0 - a**2, 0.0))[..., None] * np.sqrt(np.maximum(1.0 - b**2, 0.0))
        exponent = kappa * (a[..., None] * b + across - 1.0) + np.log(i0e(kappa * across))
    else:
        exponent = kappa * (direction @ faces.T - 1.0)
    constant = np.log(kappa) - LOG_2PI - np.log1p(-np.exp(-2.0 * kappa))
    return log_sum(weight + constant + exponent)


def landing_log_density(
    others: ArrayLike,
    area_m2: ArrayLike,
    log_facing: ArrayLike,
    height_m: ArrayLike,
    *,
    height_sigma_m: ArrayLike,
    symmetry: Symmetry = NONE,
) -> Array:
    """The log density of landing on one supporter, given a move.

    Args:
        others: (...) N - 1, how many places there are to be moved to, >= 1.
        area_m2: (...) of the supporter's surface; inf for a pose outside it gives -inf.
        log_facing: (...) from `facing_log_density`: which face it rests on, and how flat.
        height_m: (...) of its lowest point above the surface.
        height_sigma_m: (...) how exactly heights are known.
        symmetry: of the object.

    Returns:
        (...) nats, per rad^3 m^3 of poses modulo the object's symmetries.
    """
    place = -np.log(np.asarray(others, dtype=np.float64)) - np.log(np.asarray(area_m2, dtype=np.float64))
    height, sigma = np.asarray(height_m, dtype=np.float64), np.asarray(height_sigma_m, dtype=np.float64)
    above = -0.5 * (height / sigma) ** 2 - np.log(sigma) - 0.5 * LOG_2PI
    # any yaw: a rotation is the direction that is up, 4 pi sr, and a turn about it; equivalent poses are one
    turned = np.log(4.0 * np.pi) - symmetry.log_quotient_rotations
    return np.asarray(place + turned + np.asarray(log_facing, dtype=np.float64) + above)
