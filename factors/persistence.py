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
move would be settled by the choice of metres or millimetres. Where no support is known, a moved object is within a
broad Gaussian of where it was, in any orientation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.mixture import LOG_2PI, LOG_ROTATIONS

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


def move_log_density(
    others: ArrayLike,
    area_m2: ArrayLike,
    log_face: ArrayLike,
    height_m: ArrayLike,
    tilt_rad: ArrayLike,
    *,
    height_sigma_m: float,
    tilt_sigma_rad: float,
    yaw_order: ArrayLike = 1,
) -> Array:
    """The log density of landing on one supporter, given a move.

    Args:
        others: (...) N - 1, how many places there are to be moved to, >= 1.
        area_m2: (...) of the supporter's surface; inf for a pose outside it gives -inf.
        log_face: (...) log probability that the object comes to rest on this face.
        height_m: (...) of the face above the surface.
        tilt_rad: (..., 2) rotation that would bring the face flat onto the surface.
        height_sigma_m: how exactly heights are known.
        tilt_sigma_rad: how exactly tilts are known.
        yaw_order: (...) how many turns about the vertical look the same; 0 = all do, which leaves no yaw to have a
            density.

    Returns:
        (...) nats, per rad^3 m^3 (per rad^2 m^3 for yaw_order 0).
    """
    order = np.asarray(yaw_order, dtype=np.float64)
    yaw = np.where(order > 0, np.log(np.maximum(order, 1.0)) - LOG_2PI, 0.0)
    place = -np.log(np.asarray(others, dtype=np.float64)) - np.log(np.asarray(area_m2, dtype=np.float64))
    height = _log_normal(np.asarray(height_m, dtype=np.float64)[..., None], height_sigma_m)
    tilt = _log_normal(np.asarray(tilt_rad, dtype=np.float64), tilt_sigma_rad)
    return place + yaw + np.asarray(log_face, dtype=np.float64) + height + tilt


def move_log_density_gradients(
    height_m: ArrayLike, tilt_rad: ArrayLike, *, height_sigma_m: float, tilt_sigma_rad: float
) -> tuple[Array, Array]:
    """Derivatives of `move_log_density` by height (...) and tilt (..., 2); it is flat along position and yaw."""
    height, tilt = np.asarray(height_m, dtype=np.float64), np.asarray(tilt_rad, dtype=np.float64)
    return -height / height_sigma_m**2, -tilt / tilt_sigma_rad**2


def unsupported_move_log_density(
    displacement_m: ArrayLike, *, sigma_m: float, log_rotations: float = LOG_ROTATIONS
) -> Array:
    """The log density of a move where no support is known.

    Args:
        displacement_m: (..., 3) from where the object was.
        sigma_m: how far things are carried.
        log_rotations: `Symmetry.log_quotient_rotations` of the object: every orientation is as likely.

    Returns:
        (...) nats; its derivative by the displacement is -displacement / sigma_m^2.
    """
    return _log_normal(np.asarray(displacement_m, dtype=np.float64), sigma_m) - log_rotations


def _log_normal(x: Array, sigma: float) -> Array:
    """Isotropic Gaussian over the last axis."""
    return -0.5 * (x**2).sum(axis=-1) / sigma**2 - x.shape[-1] * (np.log(sigma) + 0.5 * LOG_2PI)
