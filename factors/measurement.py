"""The measurement potential phi_m: what a depth image, a box and a score vector say about one object.

**Depth.** The paper scores f = exp(-lambda SSD) over a box (Equation 6). A sum or mean over the pixels that a
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

Neighbouring pixels err together (calibration, mesh, pose), so that their sum counts the same evidence many times. It is
tempered with kappa, one over the number of pixels whose noise is correlated, which `correlated_pixels` fits from
residuals.

**Detection.** The paper's g = sum_k h l f takes scores and overlaps for likelihoods; a hypothesis gains by leaving its
box, since it then has fewer terms and is judged by f alone. In a clutter model the detections S_t of an object that is
seen with probability p_D v (v its visible fraction) have the likelihood ratio, against being all false alarms,

    (1 - p_D v) + p_D v sum_k [ l(box_k) / u(box_k) ] [ p(s_k | c) / p(s_k | clutter) ] / (false alarms an image)

with normalised densities l of boxes around the rendered one, and u uniform over boxes of the image. A missed detection
costs log(1 - p_D v), a fully hidden object pays nothing.

**Class.** A detector is wrong the same way for many frames: its answers in a visit hang on one persistent belief d, and
log sum_d pi(d | c) prod_t p(s_t | d) saturates at the log ratios of pi, however many frames repeat it.

**In the graph** the depth image's likelihood is held by modes: Gaussians in the pose relative to the camera, found and
measured on the score itself. Their errors within one visit are correlated, which a bias b shared by the visit carries:

    r = log(T_camera_mode^-1 T_world_camera^-1 T_world_object) - b,        -1/2 r^T L r + 1/2 log det(L / 2 pi)

At the mode this equals the mixture's energy in `factors.mixture`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.mixture import gaussian_log_density, log_sum
from factors.symmetry import NONE, Symmetry, residual, residual_jacobians
from sequences import se3

Array = NDArray[np.float64]
DepthParameters = tuple[float, float, float, float, float, float]

_CUT = 7.0  # standard deviations beyond which a Gaussian is nothing beside the outlier density
_INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)
_HALF_EXPONENT = _CUT**2 / 512.0  # the middle of x^2 / 256 over the cut, and exp of minus it
_CENTRE = math.exp(-_HALF_EXPONENT)
_FAR_M = 1e9


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
        """The constants that `pixel_ratio` takes: a, b, w, 1/range, occluder weight, background variance."""
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


# kernels see finite numbers only, so that minimum, maximum and choice are one instruction each
_KERNEL = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz", "nnan", "ninf"},
}


@numba.njit(**_KERNEL)
def _bell(x):
    """exp(-x^2 / 2), within 1e-10 of its value; 0 beyond the cut.

    The exponent is halved seven times and centred, so that Taylor's seventh power suffices: half the cost of `exp`.
    """
    e = _HALF_EXPONENT - x * x * (1.0 / 256.0)
    p = 1.0 + e * (1.0 / 6.0) * (1.0 + e * (1.0 / 7.0))
    p = 1.0 + e * (1.0 / 4.0) * (1.0 + e * (1.0 / 5.0) * p)
    p = _CENTRE * (1.0 + e * (1.0 + e * (1.0 / 2.0) * (1.0 + e * (1.0 / 3.0) * p)))
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p * p if -_CUT < x < _CUT else 0.0


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
def pixel_without_object(z, background, parameters):
    """What a pixel says without the object: the part of `pixel_ratio` that all hypotheses of an image share.

    Args:
        z: measured depth, metres; 0 = no measurement.
        background: depth of what would be seen without the object, metres; 0 = unknown.
        parameters: `DepthModel.parameters()`.

    Returns:
        p_b(z), 1/m; 1 / p(z | no object), metres, 0 without a measurement; the background's depth and its variance, 0
        where it is unknown; 1 / the depth up to which things can be; the depth up to which a surface is surely
        before the background.
    """
    sigma_floor, sigma_quadratic, outlier, inverse_range, occluder, background_variance = parameters
    if not z > 0.0:
        return 0.0, 0.0, 0.0, 0.0, inverse_range, _FAR_M
    if background > 0.0:
        tau = sigma_floor + sigma_quadratic * background * background
        variance = background_variance + tau * tau
        inverse_tau = 1.0 / math.sqrt(variance)
        inverse_depth = 1.0 / background
        clean = (1.0 - occluder) * _INV_SQRT_2PI * inverse_tau * _bell((z - background) * inverse_tau)
        if z < background:
            clean += occluder * inverse_depth
        before = background - _CUT * math.sqrt(variance + tau * tau)
    else:
        clean, background, variance, inverse_depth, before = inverse_range, 0.0, 0.0, inverse_range, _FAR_M
    inverse_density = 1.0 / ((1.0 - outlier) * clean + outlier * inverse_range)
    return clean, inverse_density, background, variance, inverse_depth, before


@numba.njit(**_KERNEL)
def pixel_reach(rendered, parameters):
    """How far from a surface at depth `rendered` its measurement can be, metres: less is an occluder, more past it."""
    return _CUT * (parameters[0] + parameters[1] * rendered * rendered)


@numba.njit(**_KERNEL)
def pixel_past(without, parameters):
    """`pixel_ratio` where the object is seen past: only an outlier explains the measurement."""
    return parameters[2] * parameters[3] * without[1]


@numba.njit(**_KERNEL)
def pixel_ratio(z, rendered, without, parameters):
    """One pixel's p(z | object) / p(z | no object): the one implementation, for other kernels to multiply.

    Args:
        z: measured depth, metres; 0 = no measurement, which gives 1.
        rendered: the object's depth there, metres; 0 = not covered, which gives 1.
        without: of `pixel_without_object` for this pixel.
        parameters: `DepthModel.parameters()`.
    """
    if not (z > 0.0 and rendered > 0.0):
        return 1.0
    reach = pixel_reach(rendered, parameters)
    if z < rendered - reach:  # an occluder: both hypotheses say the same of it
        return 1.0
    if z > rendered + reach:
        return pixel_past(without, parameters)
    _, _, outlier, inverse_range, occluder, _ = parameters
    clean, inverse_density, background, variance, inverse_depth, before = without
    sigma = reach * (1.0 / _CUT)
    inverse_sigma = 1.0 / sigma
    # P_b(z' < r): something stands before the object, or the background does
    hidden = (occluder if background > 0.0 else 1.0) * min(1.0, rendered * inverse_depth)
    if rendered > before:
        gap = (rendered - background) / math.sqrt(variance + sigma * sigma)
        hidden += (1.0 - occluder) * _below(gap, _bell(gap))
    x = (z - rendered) * inverse_sigma
    bell = _bell(x)
    surface = clean * _below(-x, bell) + (1.0 - hidden) * _INV_SQRT_2PI * inverse_sigma * bell
    return ((1.0 - outlier) * surface + outlier * inverse_range) * inverse_density


@numba.njit(**_KERNEL)
def _log_ratios(z, rendered, background, parameters, out):
    for i in range(z.shape[0]):
        without = pixel_without_object(z[i], background[i], parameters)
        out[i] = math.log(pixel_ratio(z[i], rendered[i], without, parameters))


def depth_log_ratio(
    z: ArrayLike, rendered: ArrayLike, background: ArrayLike = 0.0, model: DepthModel | None = None
) -> Array:
    """Log of `pixel_ratio` over arrays that broadcast together.

    Args:
        z: (...) measured depth, metres; 0 or NaN = no measurement.
        rendered: (...) the object's depth, metres; 0, NaN or inf = not covered.
        background: (...) depth of what would be seen without the object; 0, NaN or inf = unknown.
        model: the sensor; None = the default `DepthModel`.

    Returns:
        (...) nats a pixel, to be summed over the image and tempered with kappa.
    """
    arrays = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (z, rendered, background)))
    flat = [np.where(np.isfinite(a), a, 0.0).ravel() for a in arrays]
    out = np.empty(flat[0].size)
    _log_ratios(*flat, (model or DepthModel()).parameters(), out)
    return out.reshape(arrays[0].shape)


def tempered(log_ratio_sum: ArrayLike, kappa: ArrayLike) -> Array:
    """A sum (...) of pixel log ratios times kappa: the evidence of an image whose pixels err together."""
    return np.asarray(kappa, dtype=np.float64) * np.asarray(log_ratio_sum, dtype=np.float64)


def correlated_pixels(residuals: ArrayLike) -> float:
    """How many pixels share one piece of noise: Var(sum of residuals) / sum of Var. 1 / it is kappa.

    The autocorrelation is summed over rings of growing distance until one isn't positive any more (Geyer's initial
    positive sequence, Statistical Science 1992, in two dimensions). No mean is taken off: a bias over a whole
    image is noise that all its pixels share, and gives their full number.

    Args:
        residuals: (..., h, w) of depth at true poses, of expectation zero; NaN where nothing was compared.

    Returns:
        A number from 1 to the mean number of compared pixels an image.

    Raises:
        ValueError: where no residual is finite and different from zero.
    """
    images = np.asarray(residuals, dtype=np.float64)
    number = int(np.prod(images.shape[:-2]))
    return correlated_pixels_of(lag_products(images), np.isfinite(images).sum() / number)


def lag_products(residuals: ArrayLike) -> Array:
    """Products of all pairs of pixels, added over images and by their distance: (R,), rounded to 0, 1, ... pixels.

    Args:
        residuals: (..., h, w); NaN where nothing was compared.
    """
    images = np.asarray(residuals, dtype=np.float64)
    images = images.reshape(-1, *images.shape[-2:])
    height, width = images.shape[1:]
    values = np.where(np.isfinite(images), images, 0.0)
    # zero padding keeps lags from wrapping round
    spectrum = np.fft.rfft2(values, s=(2 * height, 2 * width))
    products = np.fft.irfft2((spectrum * spectrum.conj()).sum(axis=0).real, s=(2 * height, 2 * width))
    lag_v, lag_u = np.fft.fftfreq(2 * height, 0.5 / height), np.fft.fftfreq(2 * width, 0.5 / width)
    ring = np.rint(np.hypot(lag_v[:, None], lag_u[None, :])).astype(np.int64)
    return np.asarray(np.bincount(ring.ravel(), weights=products.ravel()), dtype=np.float64)


def correlated_pixels_of(products: ArrayLike, most: float) -> float:
    """`correlated_pixels` from the sums (R,) of `lag_products`, and the mean number of compared pixels an image."""
    by_ring = np.asarray(products, dtype=np.float64)
    power = float(by_ring[0])
    if not power > 0.0:
        raise ValueError("correlated_pixels needs residuals that are finite and not all zero")
    ended = np.flatnonzero(by_ring <= 1e-9 * power)
    total = by_ring[: ended[0]].sum() if len(ended) else by_ring.sum()
    return float(np.clip(total / power, 1.0, most))


def box_iou(a: ArrayLike, b: ArrayLike) -> Array:
    """Intersection over union (...) of boxes (..., 4), COCO xywh; 0 where both are empty."""
    intersection, area_a, area_b = _overlap(a, b)
    union = area_a + area_b - intersection
    return np.where(union > 0, intersection / np.where(union > 0, union, 1.0), 0.0)


def box_overlap_min(a: ArrayLike, b: ArrayLike) -> Array:
    """The paper's l: intersection over the smaller area (...) of boxes (..., 4), COCO xywh; 0 where one is empty."""
    intersection, area_a, area_b = _overlap(a, b)
    smaller = np.minimum(area_a, area_b)
    return np.where(smaller > 0, intersection / np.where(smaller > 0, smaller, 1.0), 0.0)


def _overlap(a: ArrayLike, b: ArrayLike) -> tuple[Array, Array, Array]:
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    low = np.maximum(p[..., :2], q[..., :2])
    high = np.minimum(p[..., :2] + p[..., 2:], q[..., :2] + q[..., 2:])
    return np.prod(np.maximum(high - low, 0.0), axis=-1), np.prod(p[..., 2:], axis=-1), np.prod(q[..., 2:], axis=-1)


def box_log_ratio(
    box_detected: ArrayLike,
    box_rendered: ArrayLike,
    sigma_rel: float,
    image_size: tuple[float, float],
    outlier: float = 0.0,
) -> Array:
    """log[(1 - o) l(detected | rendered) / u + o]: heavy-tailed about the rendered edges, against any box of the image.

    Each edge has a Laplace density with standard deviation `sigma_rel` of the rendered box's width (left and right
    edges) or height (top and bottom), at least a pixel. A false alarm's box has two corners anywhere: u = 4 / (W H)^2.

    Args:
        box_detected: (..., 4) COCO xywh, pixels.
        box_rendered: (..., 4) box of the rendered pixels that are visible; NaN or one without area has l = 0.
        sigma_rel: of a detector's edges, relative to the box.
        image_size: width, height in pixels.
        outlier: o, the share of boxes that have nothing to do with their objects.
    """
    found, drawn = np.asarray(box_detected, dtype=np.float64), np.asarray(box_rendered, dtype=np.float64)
    pairs = np.empty((2, *np.broadcast(found, drawn).shape))
    pairs[0], pairs[1] = found, drawn
    out = np.empty(pairs.shape[1:-1])
    log_clutter = _log_clutter(image_size)
    _box_log_ratios(*pairs.reshape(2, -1, 4), float(sigma_rel), log_clutter, float(outlier), out.reshape(-1))
    return out


def _log_clutter(image_size: tuple[float, float]) -> float:
    """The log of u, the density of a false alarm's box."""
    return math.log(4.0) - 2.0 * math.log(image_size[0] * image_size[1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_add(a, b):
    """The log of exp(a) + exp(b); -inf of two that are."""
    high, low = max(a, b), min(a, b)
    return high if low == -np.inf else high + math.log1p(math.exp(low - high))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box_ratio(found, drawn, sigma_rel, log_clutter, outlier):
    """`box_log_ratio` of two boxes, (x, y, w, h) each."""
    log_outlier = math.log(outlier)
    if not (drawn[2] > 0.0 and drawn[3] > 0.0):
        return log_outlier
    log_density = 0.0
    for axis in range(2):
        scale = max(sigma_rel * drawn[2 + axis], 1.0) / math.sqrt(2.0)
        low = abs(found[axis] - drawn[axis])
        high = abs(found[axis] + found[2 + axis] - drawn[axis] - drawn[2 + axis])
        log_density += -2.0 * math.log(2.0 * scale) - (low + high) / scale
    return _log_add(math.log1p(-outlier) + log_density - log_clutter, log_outlier)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box_log_ratios(found, drawn, sigma_rel, log_clutter, outlier, out):
    for n in range(len(out)):
        a = found[n, 0], found[n, 1], found[n, 2], found[n, 3]
        b = drawn[n, 0], drawn[n, 1], drawn[n, 2], drawn[n, 3]
        out[n] = _box_ratio(a, b, sigma_rel, log_clutter, outlier)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _found(visible, fit, p_found, outlier):
    """The log of o (1 - p_D v) + p_D v l / u."""
    seen = p_found * visible
    return _log_add(math.log(outlier) + math.log1p(-seen), math.log(seen) + fit)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _detected(found, covered, visible, corners, sigma_rel, log_clutter, outlier, p_found, out):
    for n in range(len(out)):
        x, y = corners[n, 0], corners[n, 1]
        drawn = x, y, corners[n, 2] - x, corners[n, 3] - y
        share = visible[n] / covered[n] if covered[n] > 0.0 else 0.0
        out[n] = _found(share, _box_ratio(found, drawn, sigma_rel, log_clutter, outlier), p_found, outlier)


def detected_log_potential(
    box_detected: tuple[float, float, float, float],
    covered: Array,
    visible: Array,
    corners: Array,
    sigma_rel: float,
    image_size: tuple[float, float],
    outlier: float,
    p_found: float,
) -> Array:
    """The log of o (1 - p_D v) + p_D v l / u, (K,) nats: of a track's own box in a view.

    v is the share of a silhouette that is seen, and l / u the `box_log_ratio` of its box. That the track's box came
    from elsewhere is as rare for what hides as for what shows.

    Args:
        box_detected: x, y, w, h, pixels.
        covered: (K,) samples of each silhouette.
        visible: (K,) of those, samples that are seen.
        corners: (K, 4) x0, y0, x1, y1 of what is seen, pixels; NaN where nothing is.
        sigma_rel: of a detector's edges, relative to the box.
        image_size: width, height in pixels.
        outlier: o, the share of a track's boxes that have nothing to do with their thing.
        p_found: p_D, how often what is seen whole is found.
    """
    out = np.empty(len(covered))
    u = _log_clutter(image_size)
    _detected(box_detected, covered, visible, corners, sigma_rel, u, outlier, p_found, out)
    return out


def class_log_ratio(scores: ArrayLike, class_prior: ArrayLike | None = None, floor: float = 0.05) -> Array:
    """log[p(s | c) / p(s | clutter)] from a detector's belief s over background and classes.

    By Bayes p(s | c) is proportional to s_c / prior_c. A score of exactly 0 is a rounding, not a certainty: the belief
    is mixed with the prior, which bounds the ratio.

    Args:
        scores: (..., C + 1) background first; sums to 1.
        class_prior: (C + 1,) belief that the detector was trained with; None = uniform.
        floor: weight of the prior in the mix.

    Returns:
        (..., C) nats; uniform scores give 0.
    """
    s = np.asarray(scores, dtype=np.float64)
    prior = np.full(s.shape[-1], 1.0 / s.shape[-1]) if class_prior is None else np.asarray(class_prior, np.float64)
    log_likelihood = np.log((1.0 - floor) * s / prior + floor)
    return log_likelihood[..., 1:] - log_likelihood[..., :1]


def confusion(classes: int, p_right: float) -> Array:
    """(C, C) log pi(d | c): the detector's persistent belief is right with p_right, else any other class."""
    wrong = (1.0 - p_right) / max(classes - 1, 1)
    with np.errstate(divide="ignore"):
        return np.log(np.where(np.eye(classes, dtype=bool), p_right if classes > 1 else 1.0, wrong))


def persistent_class_log_evidence(belief_log_likelihoods: ArrayLike, log_confusion: ArrayLike) -> Array:
    """The log of sum_d pi(d | c) prod_t p(s_t | d): what a visit's detections say about the class, together.

    Args:
        belief_log_likelihoods: (..., D) sum over the visit's detections of log p(s_t | d), up to a constant.
        log_confusion: (C, D) log pi(d | c); its rows sum to one.

    Returns:
        (..., C) nats. Classes differ by no more than the largest log ratio within a column of pi.
    """
    return log_sum(np.asarray(belief_log_likelihoods, dtype=np.float64)[..., None, :] + np.asarray(log_confusion))


def paper_log_similarity(squared_difference_sum: ArrayLike, lambda_per_m2: float) -> Array:
    """The literal log f = -lambda SSD (Equation 6), of sums (...) of squared depth differences, m^2."""
    return -lambda_per_m2 * np.asarray(squared_difference_sum, dtype=np.float64)


def paper_log_potential(
    class_scores: ArrayLike, overlaps: ArrayLike, log_similarity: ArrayLike, in_view: ArrayLike, delta: float
) -> Array:
    """The literal log phi_m: delta out of view; f alone where nothing is detected; else g = sum_k h l f.

    Args:
        class_scores: (..., K) h, each detection's score of the object's class; K = 0 where nothing is detected.
        overlaps: (..., K) l from `box_overlap_min`.
        log_similarity: (...) from `paper_log_similarity`.
        in_view: (...) whether the object is in the field of view.
        delta: the constant for objects that aren't, > 0.
    """
    h, overlap = np.asarray(class_scores, dtype=np.float64), np.asarray(overlaps, dtype=np.float64)
    with np.errstate(divide="ignore"):
        matched = np.log((h * overlap).sum(axis=-1)) if h.shape[-1] else np.zeros(h.shape[:-1])
    return np.where(in_view, matched + np.asarray(log_similarity, dtype=np.float64), np.log(delta))


def mode_residual(
    T_world_camera: ArrayLike,
    T_world_object: ArrayLike,
    T_camera_mode: ArrayLike,
    bias: ArrayLike | None = None,
    symmetry: Symmetry = NONE,
    information: ArrayLike | None = None,
) -> Array:
    """A measurement mode as the graph holds it: r = log(T_camera_mode^-1 T_world_camera^-1 T_world_object g) - b.

    Args:
        T_world_camera: (..., 4, 4).
        T_world_object: (..., 4, 4).
        T_camera_mode: (..., 4, 4) the object's pose in the camera's frame where the score has a mode.
        bias: (..., 6) error of the visit in the object's tangent, None = 0. Modes that share one must be
            written in the same of the object's equivalent poses: `symmetry.nearest_image`.
        symmetry: g of it is the one that makes r shortest.
        information: (..., 6, 6) of the mode, to choose g by; None = by angle.

    Returns:
        (..., 6) in the object's tangent; free directions carry nothing, see `Symmetry.projection`.
    """
    seen = se3.inverse(np.asarray(T_world_camera, dtype=np.float64)) @ np.asarray(T_world_object, dtype=np.float64)
    r = residual(T_camera_mode, seen, symmetry, information)
    return r if bias is None else r - np.asarray(bias, dtype=np.float64)


def mode_residual_jacobians(
    T_world_camera: ArrayLike,
    T_world_object: ArrayLike,
    T_camera_mode: ArrayLike,
    bias: ArrayLike | None = None,
    symmetry: Symmetry = NONE,
    information: ArrayLike | None = None,
) -> tuple[Array, Array, Array]:
    """`mode_residual` (..., 6) and its derivatives (..., 6, 6) by right perturbations of camera and object.

    The derivative by the bias is minus the identity.
    """
    camera, placed = np.asarray(T_world_camera, dtype=np.float64), np.asarray(T_world_object, dtype=np.float64)
    r, _, J_object = residual_jacobians(T_camera_mode, se3.inverse(camera) @ placed, symmetry, information)
    J_camera = -J_object @ se3.adjoint(se3.inverse(placed) @ camera)
    return (r if bias is None else r - np.asarray(bias, dtype=np.float64)), J_camera, J_object


def mode_log_potential(
    T_world_camera: ArrayLike,
    T_world_object: ArrayLike,
    T_camera_mode: ArrayLike,
    information: ArrayLike,
    bias: ArrayLike | None = None,
    symmetry: Symmetry = NONE,
) -> Array:
    """-1/2 r^T L r + 1/2 log det(L / 2 pi) in nats (...), for a mode's information L (..., 6, 6); see `mode_residual`.

    A direction in which L is flat makes it -inf: give such a direction the weak information of its stated interval.
    """
    r = mode_residual(T_world_camera, T_world_object, T_camera_mode, bias, symmetry, information)
    reduced = (symmetry.projection @ r[..., None])[..., 0]
    return gaussian_log_density(reduced, symmetry.reduced_information(information))
