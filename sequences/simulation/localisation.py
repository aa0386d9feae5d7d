"""What localisation says of the camera: the truth with a Gauss-Markov error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.types import LocalisationNoise

Array = NDArray[np.float64]


def recorded_poses(
    T_world_camera: Array, times_ns: NDArray[np.int64], noise: LocalisationNoise, rng: np.random.Generator
) -> Array:
    """True poses (n, 4, 4) at times (n,) -> recorded ones, T exp(e_t).

    e_t is a stationary first-order Gauss-Markov process (Maybeck, Stochastic Models, Estimation and Control, vol. 1,
    1979): from one frame to the next e <- a e + sqrt(1 - a^2) w, a = exp(-dt / correlation time), w of the stated
    covariance.
    """
    sigma = np.repeat([noise.rotation_rad, noise.translation_m], 3)
    draws = sigma * rng.standard_normal((len(times_ns), 6))
    keep = np.exp(-np.diff(times_ns) * 1e-9 / noise.correlation_time_s)
    errors = draws.copy()
    for k, a in enumerate(keep, start=1):
        errors[k] = a * errors[k - 1] + np.sqrt(1.0 - a * a) * draws[k]
    return se3.retract(T_world_camera, errors)
