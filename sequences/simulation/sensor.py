"""What a PrimeSense-like camera measures of a scene: depth by structured light, and colour with a little noise.

Depth is measured as disparity against a projector beside the camera, z = f b / d, so whatever is constant in disparity
grows with z squared:

- noise of the disparity (Khoshelham and Elberink, Accuracy and resolution of Kinect depth data for indoor mapping
  applications, Sensors 12, 2012), correlated over neighbouring pixels since each is matched with a window, and larger
  where the surface is seen at a grazing angle (Nguyen, Izadi and Lovell, Modeling Kinect sensor noise for improved 3D
  reconstruction and tracking, 3DIMPVT 2012, whose term in the angle is applied to disparity here);
- quantisation of disparity to 1/8 pixel, after a shift of each sample to the side (Handa, Whelan, McDonald and Davison,
  A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM, ICRA 2014, after Barron and Malik, CVPR 2013);
- no measurement where the projector's light doesn't reach, at depth edges, at grazing angles and out of range.

Disparity is counted in pixels of the sensor, 640 across, whatever the size of the image: a smaller image is the same
sensor read at fewer pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from sequences.simulation.config import FOCAL_PX, SENSOR_WIDTH, SensorConfig

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

BASELINE_M = 0.075
RANGE_M = (0.35, 4.5)
GRAZING_RAD = 1.2  # from this angle of incidence on, less and less light comes back
EDGE_STEP = 0.02  # neighbours whose depths differ by this share are an edge


def measure_depth(exact: Depth, cosine: Array, bias: Array, config: SensorConfig, rng: np.random.Generator) -> Depth:
    """Depth as the sensor gives it.

    Args:
        exact: (h, w) true depth along z, metres, 0 where nothing is.
        cosine: (h, w) of the angle between line of sight and surface normal.
        bias: (h, w) added to the depth of each pixel, metres: an error that belongs to what is seen there.
        config: settings.
        rng: draws the noise.

    Returns:
        (h, w) metres, 0 = no measurement.
    """
    if config.depth_noise == 0.0:
        return exact
    scale = exact.shape[1] / SENSOR_WIDTH
    rows, columns = _shifted(exact.shape, config.depth_noise * config.lateral_sigma_px * scale, rng)
    z = exact[rows, columns].astype(np.float64)
    with np.errstate(divide="ignore"):
        disparity = np.where(z > 0.0, FOCAL_PX * BASELINE_M / (z + config.depth_noise * bias), 0.0)
    angle = np.arccos(np.clip(cosine[rows, columns], 0.0, 1.0))
    noise = _correlated(exact.shape, config.correlation_px * scale, rng)
    disparity += config.depth_noise * config.disparity_sigma_px * _grazing_factor(angle) * noise
    step = min(1.0, config.depth_noise) * config.quantisation_px
    if step > 0.0:
        disparity = np.rint(disparity / step) * step
    seen = (z > 0.0) & (disparity > 0.0) & lit_by_projector(exact) & ~_lost(exact, angle, config, rng)
    measured = np.where(seen, FOCAL_PX * BASELINE_M / np.where(seen, disparity, 1.0), 0.0)
    in_range = (measured > RANGE_M[0]) & (measured < RANGE_M[1])
    return np.where(in_range, measured, 0.0).astype(np.float32)


def _shifted(
    shape: tuple[int, ...], sigma: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each pixel the row and column that it is measured at."""
    rows, columns = np.indices(shape)
    dv, du = np.rint(sigma * rng.standard_normal((2, *shape))).astype(np.int64)
    return np.clip(rows + dv, 0, shape[0] - 1), np.clip(columns + du, 0, shape[1] - 1)


def _correlated(shape: tuple[int, ...], correlation_px: float, rng: np.random.Generator) -> Array:
    """Standard normal numbers (h, w), alike within some pixels: white noise, smoothed and scaled back."""
    white = rng.standard_normal(shape)
    if correlation_px <= 0.0:
        return white
    smooth = gaussian_filter(white, correlation_px)
    reach = np.arange(-32, 33)
    kernel = gaussian_filter((reach == 0).astype(float), correlation_px)
    return smooth / (kernel**2).sum()


def _grazing_factor(angle: Array) -> Array:
    """Growth of the noise with the angle of incidence, 1 where the surface faces the camera, after Nguyen et al."""
    return 1.0 + 0.07 * angle**2 / np.maximum(np.pi / 2.0 - angle, 0.05) ** 2


def lit_by_projector(depth: Depth) -> NDArray[np.bool_]:
    """Which pixels (h, w) the projector reaches, one baseline to the right of the camera.

    A point at column u meets the projector's column u - d. Whatever lies further right and meets the same column, or
    one to its left, has the larger disparity, so stands nearer and takes the light.
    """
    scale = depth.shape[1] / SENSOR_WIDTH
    with np.errstate(divide="ignore"):
        disparity = np.where(depth > 0.0, FOCAL_PX * BASELINE_M * scale / depth, 0.0)
    column = np.arange(depth.shape[1]) - disparity
    nearest_right = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(column <= nearest_right + 0.5)


def _lost(exact: Depth, angle: Array, config: SensorConfig, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Holes (h, w) that come in patches: along depth edges, and where surfaces are seen at a grazing angle."""
    patches = _correlated(exact.shape, 1.5 * exact.shape[1] / SENSOR_WIDTH, rng)
    low, high = minimum_filter(exact, 3), maximum_filter(exact, 3)
    edge = high - low > EDGE_STEP * np.maximum(high, 0.1)
    tendency = -3.3 + 2.6 * edge + 14.0 * np.maximum(angle - GRAZING_RAD, 0.0)
    return np.asarray(patches * config.depth_noise > -tendency)


def measure_colour(exact: NDArray[np.uint8], config: SensorConfig, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Colour (h, w, 3) with noise."""
    if config.colour_sigma == 0.0:
        return exact
    noise = np.float32(config.colour_sigma) * rng.standard_normal(exact.shape, dtype=np.float32)
    return np.clip(np.rint(exact + noise), 0, 255).astype(np.uint8)
