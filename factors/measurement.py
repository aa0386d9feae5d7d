"""The measurement potential phi_m: what a depth image, a box and a score vector say about one object.

**Depth.** The paper scores f = exp(-lambda SSD) over a box (Equation 4). A sum or mean over the pixels that a
hypothesis covers compares hypotheses on different data, so a small model hides inside a large one's surface; and
lambda has no unit. Here every pixel contributes the log-likelihood ratio

    log [ p(z | object's surface at r) / p(z | no object) ]                nats, 0 where r covers nothing

so that pixels outside a silhouette cost and gain nothing, and hypotheses of all sizes are compared on the same image.
Putting an object into a scene whose surface lies at the unknown z' ~ p_b makes the camera see min(z', r), with noise:

    p(z | no object) = (1 - w) p_b(z)                                            + w / range
    p(z | object)    = (1 - w) [ p_b(z) Phi((r - z)/s) + P_b(z' > r) N(z; r, s^2) ] + w / range

with sensor noise s = a + b r^2 and outlier weight w. Therefore an occluder in front of the object gives exactly 0 (not
being seen is no evidence), a surface where the object says one gains some nats, and seeing past the object costs
log[w / range / p(z | no object)], a bounded but large loss. p_b is uniform over the range where nothing is known. Where
the depth behind the object is known (the support plane, or the rest of the map), it is a Gaussian there with occluders
uniform in front of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
DepthParameters = tuple[float, float, float, float, float, float]

_CUT = 7.0  # standard deviations beyond which a Gaussian is nothing beside the outlier density
_INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)


@dataclass(frozen=True)
class DepthModel:
    """How a depth camera's number comes to be."""

    sigma_m: float = 0.003
    """noise floor a, metres: sensor, mesh and calibration together"""
    sigma_quadratic_per_m: float = 0.0015
    """growth b of the noise with squared depth, 1/m: triangulating sensors lose precision with z^2"""
    outlier_weight: float = 0.02
    """share w of pixels that say nothing (mixed pixels, speckle)"""
    range_m: float = 8.0
    """the depths a sensor can give are (0, range_m]"""
    occluder_weight: float = 0.15
    """chance that something unmodelled stands in front of a known background"""
    background_sigma_m: float = 0.005
    """how well a known background's depth is known beyond the sensor's own noise, metres"""

    def parameters(self) -> DepthParameters:
        """The constants that `pixel_log_ratio` takes: a, b, w, 1/range, occluder weight, background variance."""
        background_variance = self.background_sigma_m**2
        return (
            float(self.sigma_m),
            float(self.sigma_quadratic_per_m),
            float(self.outlier_weight),
            1.0 / self.range_m,
            float(self.occluder_weight),
            float(background_variance),
        )

    def sigma(self, depth_m: ArrayLike) -> Array:
        """Sensor noise s at depths (...), metres."""
        return self.sigma_m + self.sigma_quadratic_per_m * np.asarray(depth_m, dtype=np.float64) ** 2


_KERNEL = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "arcp", "nsz"}}


@numba.njit(**_KERNEL)
def _bell(x):
    """exp(-x^2 / 2); 0 beyond the cut."""
    return math.exp(-0.5 * x * x) if -_CUT < x < _CUT else 0.0


@numba.njit(**_KERNEL)
def _below(x, bell):
    """Standard normal distribution function at x, given `_bell(x)`: Abramowitz & Stegun 26.2.17, error below 1e-7.

    It costs a division, where erfc costs as much as the whole rest of a pixel.
    """
    t = 1.0 / (1.0 + 0.2316419 * abs(x))
    series = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = _INV_SQRT_2PI * bell * series
    return 1.0 - tail if x > 0.0 else tail


@numba.njit(**_KERNEL)
def pixel_log_ratio(z, rendered, background, parameters):
    """One pixel's log [p(z | object) / p(z | no object)] in nats: the one implementation, for other kernels to call.

    Args:
        z: measured depth, metres; 0 or NaN = no measurement, which gives 0.
        rendered: the object's depth there, metres; 0, NaN or inf = not covered, which gives 0.
        background: depth of what would be seen without the object, metres; 0, NaN or inf = unknown.
        parameters: `DepthModel.parameters()`.
    """
    if not (z > 0.0 and 0.0 < rendered < math.inf):
        return 0.0
    sigma_floor, sigma_quadratic, outlier, inverse_range, occluder, background_variance = parameters
    sigma = sigma_floor + sigma_quadratic * rendered * rendered
    inverse_sigma = 1.0 / sigma
    x = (z - rendered) * inverse_sigma
    if x < -_CUT:  # an occluder: both hypotheses say the same of it
        return 0.0
    if 0.0 < background < math.inf:
        tau = sigma_floor + sigma_quadratic * background * background
        variance = background_variance + tau * tau
        inverse_tau = 1.0 / math.sqrt(variance)
        inverse_background = 1.0 / background
        clean = (1.0 - occluder) * _INV_SQRT_2PI * inverse_tau * _bell((z - background) * inverse_tau)
        if z < background:
            clean += occluder * inverse_background
        gap = (rendered - background) / math.sqrt(variance + sigma * sigma)
        hidden = (1.0 - occluder) * _below(gap, _bell(gap)) + occluder * min(1.0, rendered * inverse_background)
    else:
        clean = inverse_range
        hidden = min(1.0, rendered * inverse_range)
    floor = outlier * inverse_range
    keep = 1.0 - outlier
    bell = _bell(x)
    with_object = keep * (clean * _below(-x, bell) + (1.0 - hidden) * _INV_SQRT_2PI * inverse_sigma * bell) + floor
    return math.log(with_object / (keep * clean + floor))


@numba.njit(**_KERNEL)
def _log_ratios(z, rendered, background, parameters, out):
    for i in range(z.shape[0]):
        out[i] = pixel_log_ratio(z[i], rendered[i], background[i], parameters)


def depth_log_ratio(
    z: ArrayLike, rendered: ArrayLike, background: ArrayLike = 0.0, model: DepthModel | None = None
) -> Array:
    """`pixel_log_ratio` over arrays that broadcast together.

    Args:
        z: (...) measured depth, metres; 0 or NaN = no measurement.
        rendered: (...) the object's depth, metres; 0, NaN or inf = not covered.
        background: (...) depth of what would be seen without the object; 0, NaN or inf = unknown.
        model: the sensor; None = the default `DepthModel`.

    Returns:
        (...) nats a pixel, to be summed over the image and tempered with kappa.
    """
    arrays = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (z, rendered, background)))
    flat = [np.ascontiguousarray(a).ravel() for a in arrays]
    out = np.empty(flat[0].size)
    _log_ratios(*flat, (model or DepthModel()).parameters(), out)
    return out.reshape(arrays[0].shape)
