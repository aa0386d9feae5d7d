"""What a PrimeSense-like camera measures of a scene: depth by structured light, and colour with a little noise.

Depth is measured as disparity against a projector beside the camera, z = f b / d, so whatever is constant in disparity
grows with z squared:

- noise of the disparity (Khoshelham and Elberink, Accuracy and resolution of Kinect depth data for indoor mapping
  applications, Sensors 12, 2012), alike over neighbouring pixels since each is matched with a window, larger where the
  surface is seen at a grazing angle (Nguyen, Izadi and Lovell, Modeling Kinect sensor noise for improved 3D
  reconstruction and tracking, 3DIMPVT 2012, whose term in the angle is applied to disparity here), and larger where
  little light comes back;
- the window itself, which rounds edges and hollows, and depth taken from a little to the side, which frays
  silhouettes, before disparity is rounded to 1/8 pixel (Handa, Whelan, McDonald and Davison, A benchmark for RGB-D
  visual odometry, 3D reconstruction and SLAM, ICRA 2014, after Barron and Malik, CVPR 2013);
- a smooth distortion that is the camera's own (Teichman, Miller and Thrun, Unsupervised intrinsic calibration of depth
  sensors via SLAM, RSS 2013; Herrera, Kannala and Heikkila, PAMI 34, 2012, who state it in disparity as here);
- no measurement where the projector's light doesn't reach, at depth edges, out of range, and, in patches, where too
  little light comes back (dark, grazing and distant surfaces) or too much (where a glossy surface mirrors the
  projector): the kinds of hole that Mallick, Das and Majumdar tell apart (Characterizations of noise in Kinect depth
  images: a review, IEEE Sensors Journal 14, 2014). The light that comes back follows Landau, Choo and Beling
  (Simulating Kinect infrared and depth images, IEEE Transactions on Cybernetics 46, 2016): albedo, cosine, 1 / z^2.

What belongs to a surface and is the same from every side (`View.error_m`) is `sequences.simulation.surfaces`'.

Lengths in the settings are counted in pixels of the sensor, 640 across, whatever the image: a smaller image is the same
sensor read at fewer pixels. `ctmap bench realism` holds all of this to recordings by real sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter

from sequences.camera import Camera
from sequences.seeds import generator
from sequences.simulation.config import FOCAL_PX, SENSOR_WIDTH, SensorConfig

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Depth = NDArray[np.float32]

BASELINE_M = 0.075
RANGE_M = (0.35, 4.5)
GRAZING_RAD = 1.2  # from this angle of incidence on, less and less light comes back
EDGE_STEP = 0.02  # neighbours whose depths differ by this share are an edge
WINDOW_REACH_PX = 0.35  # the window rounds steps of disparity up to about here; across larger ones one side wins
DIM = 0.04  # light that comes back, as a share of a white surface's at 1 m, below which measuring gets hard
MIRROR_RAD = 0.16  # how far from the mirror direction a glossy surface still dazzles the sensor


@dataclass(frozen=True)
class View:
    """What lies before the sensor, pixel by pixel."""

    camera: Camera
    depth: Depth
    """(h, w) true depth along z, metres, 0 where nothing is"""
    normal: Field
    """(h, w, 3) unit normal of the surface, towards the camera, camera frame"""
    albedo: Field
    """(h, w) share of the near infrared light that it scatters, 0 to 1"""
    gloss: Field
    """(h, w) share that it mirrors, 0 to 1"""
    error_m: Field
    """(h, w) added to the depth: an error that belongs to what is seen there"""


class DepthSensor:
    """One depth camera, with the distortion that is its own.

    Args:
        camera: of its images.
        config: settings.
        seed: the run's.
    """

    def __init__(self, camera: Camera, config: SensorConfig, seed: int) -> None:
        self._config = config
        self._scale = camera.fx / FOCAL_PX  # pixels of the image a pixel of the sensor
        rng = generator(seed, "simulation.distortion")
        self._distortion = config.distortion_px * _smooth_field(camera, config.distortion_length_px, rng)

    def measure(self, view: View, rng: np.random.Generator) -> Depth:
        """Depth (h, w) as the sensor gives it, metres, 0 = no measurement; `rng` draws the noise."""
        c, scale = self._config, self._scale
        amount = c.depth_noise
        if amount == 0.0:
            return view.depth
        at = _frayed(view.depth.shape, amount * c.lateral_sigma_px * scale, scale, rng)
        z = view.depth[at].astype(np.float64)
        near = np.where(z > 0.0, z + amount * view.error_m[at], 1.0)
        disparity = np.where(z > 0.0, FOCAL_PX * BASELINE_M / near, 0.0)
        disparity = _rounded(disparity, c.window_px * scale)
        cosine, mirror = _angles(view, at)
        light = _returned_light(z, cosine, view.albedo[at], view.gloss[at])
        noise = _patches(z.shape, c.correlation_px * scale, rng) * np.exp(
            0.5 * c.unevenness * _patches(z.shape, 3.0 * c.correlation_px * scale, rng)
        )
        sigma = c.disparity_sigma_px * _grazing_factor(np.arccos(cosine)) * np.sqrt(1.0 + DIM / light)
        disparity += amount * (sigma * noise + self._distortion)
        step = min(1.0, amount) * c.quantisation_px
        if step > 0.0:
            disparity = np.rint(disparity / step) * step
        edge = _edges(view.depth, max(1, round(scale * c.edge_px)))
        tendency = _tendency_to_be_lost(edge, np.arccos(cosine), mirror, light, view.gloss[at])
        lost = amount * _patches(z.shape, 1.5 * scale, rng) > -tendency
        seen = (z > 0.0) & (disparity > 0.0) & lit_by_projector(view.depth, scale) & ~lost
        measured = np.where(seen, FOCAL_PX * BASELINE_M / np.where(seen, disparity, 1.0), 0.0)
        in_range = (measured > RANGE_M[0]) & (measured < RANGE_M[1])
        return np.where(in_range, measured, 0.0).astype(np.float32)


def _smooth_field(camera: Camera, length_px: float, rng: np.random.Generator) -> Array:
    """(h, w) standard normal numbers that change over so many pixels of the sensor, the same however it is read."""
    knot = length_px / 2.0
    reach = int(np.ceil(SENSOR_WIDTH / knot)) + 4
    knots = _patches((reach, reach), 2.0 / np.sqrt(2.0), rng)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    at = np.stack([y, x]) * FOCAL_PX / knot + reach / 2.0
    return np.asarray(map_coordinates(knots, at, order=3, mode="nearest"))


def _frayed(
    shape: tuple[int, ...], sigma: float, length: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each pixel the row and column that it is measured at: neighbours go astray together."""
    rows, columns = np.indices(shape)
    dv, du = (np.rint(sigma * _patches(shape, length, rng)).astype(np.int64) for _ in range(2))
    return np.clip(rows + dv, 0, shape[0] - 1), np.clip(columns + du, 0, shape[1] - 1)


def _patches(shape: tuple[int, ...], length: float, rng: np.random.Generator) -> Array:
    """Standard normal numbers (h, w), alike within some pixels: white noise, smoothed and scaled back."""
    white = rng.standard_normal(shape)
    if length <= 0.0:
        return white
    smooth = gaussian_filter(white, length)
    reach = np.arange(-int(4 * length) - 1, int(4 * length) + 2)
    kernel = gaussian_filter((reach == 0).astype(float), length)
    return np.asarray(smooth / (kernel**2).sum())


def _rounded(disparity: Array, window_px: float) -> Array:
    """The mean over the window, wherever what it holds is one surface: edges and hollows lose their sharpness."""
    if window_px <= 0.0:
        return disparity
    change = gaussian_filter(disparity, window_px, truncate=2.0) - disparity
    return disparity + change * np.exp(-0.5 * (change / WINDOW_REACH_PX) ** 2)


def _angles(view: View, at: tuple[NDArray[np.int64], NDArray[np.int64]]) -> tuple[Array, Array]:
    """(h, w) cosine of the angle of incidence, and the angle between normal and mirror direction, rad."""
    camera, z = view.camera, view.depth[at]
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    point = camera.backproject(u, v, np.where(z > 0.0, z, 1.0))
    to_camera = -point / np.linalg.norm(point, axis=-1, keepdims=True)
    to_projector = np.array([BASELINE_M, 0.0, 0.0]) - point
    half = to_camera + to_projector / np.linalg.norm(to_projector, axis=-1, keepdims=True)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    normal = view.normal[at]
    cosine = np.clip(np.einsum("hwk,hwk->hw", normal, to_camera), 1e-3, 1.0)
    return cosine, np.arccos(np.clip(np.einsum("hwk,hwk->hw", normal, half), -1.0, 1.0))


def _returned_light(z: Array, cosine: Array, albedo: Field, gloss: Field) -> Array:
    """(h, w) how much of the projector's light comes back, 1 from white paper that faces the sensor at 1 m.

    A glossy surface sends light away that meets it at an angle.
    """
    scattered = albedo * (1.0 - gloss * (1.0 - cosine))
    return np.maximum(scattered * cosine / np.maximum(z, 0.1) ** 2, 1e-4)


def _grazing_factor(angle: Array) -> Array:
    """Growth of the noise with the angle of incidence, 1 where the surface faces the camera, after Nguyen et al."""
    return 1.0 + 0.07 * angle**2 / np.maximum(np.pi / 2.0 - angle, 0.05) ** 2


def lit_by_projector(depth: Depth, scale: float = 1.0) -> NDArray[np.bool_]:
    """Which pixels (h, w) the projector reaches, one baseline to the right of the camera.

    A point at column u meets the projector's column u - d. Whatever lies further right and meets the same column, or
    one to its left, has the larger disparity, so stands nearer and takes the light.

    Args:
        depth: (h, w) metres, 0 where nothing is.
        scale: pixels of the image a pixel of the sensor.
    """
    with np.errstate(divide="ignore"):
        disparity = np.where(depth > 0.0, FOCAL_PX * BASELINE_M * scale / depth, 0.0)
    column = np.arange(depth.shape[1]) - disparity
    nearest_right = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(column <= nearest_right + 0.5)


def _edges(depth: Depth, reach: int) -> NDArray[np.bool_]:
    """Pixels (h, w) with a step of depth within so many pixels."""
    low, high = minimum_filter(depth, 2 * reach + 1), maximum_filter(depth, 2 * reach + 1)
    return np.asarray(high - low > EDGE_STEP * reach * np.maximum(high, 0.1))


def _tendency_to_be_lost(edge: NDArray[np.bool_], angle: Array, mirror: Array, light: Array, gloss: Field) -> Array:
    """(h, w) in standard deviations of the patches in which depth is lost."""
    grazing = 14.0 * np.maximum(angle - GRAZING_RAD, 0.0)
    dark = 1.5 * np.log(np.maximum(DIM / light, 1.0))
    dazzled = 6.0 * gloss * np.exp(-((mirror / MIRROR_RAD) ** 2))
    return -3.3 + 2.6 * edge + grazing + dark + dazzled


def measure_colour(exact: NDArray[np.uint8], config: SensorConfig, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Colour (h, w, 3) with noise."""
    if config.colour_sigma == 0.0:
        return exact
    noise = np.float32(config.colour_sigma) * rng.standard_normal(exact.shape, dtype=np.float32)
    return np.clip(np.rint(exact + noise), 0, 255).astype(np.uint8)
