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
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from sequences.camera import Camera
from sequences.seeds import generator
from sequences.simulation.config import FOCAL_PX, SENSOR_WIDTH, SensorConfig

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Depth = NDArray[np.float32]

BASELINE_M = 0.075
STRENGTH = np.float32(FOCAL_PX * BASELINE_M)  # disparity at 1 m, pixels of the sensor
RANGE_M = (0.35, 4.5)
GRAZING_RAD = 1.2  # from this angle of incidence on, less and less light comes back
EDGE_STEP = 0.02  # neighbours whose depths differ by this share are an edge
ONE_SURFACE_PX = 1.0  # what differs by more in disparity is hardly of one surface
DIM = 0.04  # light that comes back, as a share of a white surface's at 1 m, below which measuring gets hard
UNSURE = 4.5  # how much noisier, as a power of e, depth is that is a standard deviation nearer to being lost
SELDOM = -2.7  # how far well-lit surfaces are from being lost, standard deviations of the patches that are
AT_EDGES = 2.4  # how much nearer to it depth edges are
HOLE_PX = 2.5  # over how many pixels of the sensor depth is lost together
UNEVEN_OVER = 3.0  # the noise's size changes over so many times the length over which the noise does
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
        c, scale, amount = self._config, self._scale, np.float32(self._config.depth_noise)
        if amount == 0.0:
            return view.depth
        at = _frayed(view.depth.shape, float(amount) * c.lateral_sigma_px * scale, scale, rng)
        z, error = view.depth[at], view.error_m[at]
        disparity = np.where(z > 0.0, STRENGTH / np.where(z > 0.0, z + amount * error, 1.0), 0.0)
        disparity = _rounded(disparity, c.window_px * scale)
        angle, mirror, light = _light(view, at)
        poor = amount * _patches(z.shape, HOLE_PX * scale, rng) + _tendency_to_be_lost(
            angle, mirror, light, view.gloss[at]
        )
        torn = AT_EDGES * _edges(view.depth, max(1, round(scale * c.edge_px)))
        noise = _uneven(z.shape, c.correlation_px * scale, c.unevenness, rng)
        noise *= c.disparity_sigma_px * _noise_factor(angle, light, poor)
        disparity += amount * (noise + self._distortion)
        step = min(1.0, c.depth_noise) * c.quantisation_px
        if step > 0.0:
            disparity = np.rint(disparity / np.float32(step)) * np.float32(step)
        seen = (z > 0.0) & (disparity > 0.0) & (poor + torn < 0.0) & lit_by_projector(view.depth, scale)
        measured = np.where(seen, STRENGTH / np.where(seen, disparity, 1.0), 0.0)
        in_range = (measured > RANGE_M[0]) & (measured < RANGE_M[1])
        return np.where(in_range, measured, 0.0).astype(np.float32)


@lru_cache(maxsize=4)
def rays(camera: Camera) -> Field:
    """(h, w, 3) points at 1 m of depth that the pixels see, camera frame."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    return camera.backproject(u, v, np.ones(u.shape)).astype(np.float32)


def _smooth_field(camera: Camera, length_px: float, rng: np.random.Generator) -> Field:
    """(h, w) standard normal numbers that change over so many pixels of the sensor, the same however it is read."""
    knot = length_px / 2.0
    reach = int(np.ceil(SENSOR_WIDTH / knot)) + 4
    knots = _patches((reach, reach), np.sqrt(2.0), rng)
    at = np.moveaxis(rays(camera)[..., 1::-1], -1, 0) * FOCAL_PX / knot + reach / 2.0
    return np.asarray(map_coordinates(knots, at, order=3, mode="nearest"))


def _frayed(
    shape: tuple[int, ...], sigma: float, length: float, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each pixel the row and column that it is measured at: neighbours go astray together."""
    rows, columns = np.indices(shape)
    dv, du = (np.rint(np.float32(sigma) * _patches(shape, length, rng)).astype(np.intp) for _ in range(2))
    return np.clip(rows + dv, 0, shape[0] - 1), np.clip(columns + du, 0, shape[1] - 1)


def _patches(shape: tuple[int, ...], length: float, rng: np.random.Generator) -> Field:
    """Standard normal numbers (h, w), alike within some pixels: white noise, smoothed and scaled back."""
    white = rng.standard_normal(shape, dtype=np.float32)
    if length <= 0.0:
        return white
    size = 2 * int(np.ceil(4.0 * length)) + 1
    smooth = cv2.GaussianBlur(white, (size, size), length)
    return np.asarray(smooth / np.float32((cv2.getGaussianKernel(size, length) ** 2).sum()))


def _uneven(shape: tuple[int, ...], length: float, unevenness: float, rng: np.random.Generator) -> Field:
    """Numbers (h, w) of variance 1, alike within some pixels, whose size differs from place to place (log-normal)."""
    size = np.float32(0.5 * unevenness) * _patches(shape, UNEVEN_OVER * length, rng) - np.float32(0.25 * unevenness**2)
    return _patches(shape, length, rng) * np.exp(size)


def _rounded(disparity: Field, window_px: float) -> Field:
    """The mean over the window of what is one surface: edges and hollows lose their sharpness, steps don't.

    A bilateral filter (Tomasi and Manduchi, ICCV 1998).
    """
    if window_px <= 0.0:
        return disparity
    size = 2 * int(np.ceil(2.0 * window_px)) + 1
    return np.asarray(cv2.bilateralFilter(disparity, size, ONE_SURFACE_PX, window_px))


def _light(view: View, at: tuple[NDArray[np.intp], NDArray[np.intp]]) -> tuple[Field, Field, Field]:
    """How the projector's light meets the surfaces and what of it comes back.

    Returns:
        (h, w) each: angle of incidence of the line of sight, rad; angle between the normal and that of a mirror which
        would throw the projector's light into the camera, rad; the light that comes back, 1 from white paper that
        faces the projector at 1 m. A glossy surface sends light away that meets it at an angle.
    """
    z = view.depth[at]
    point = rays(view.camera) * np.where(z > 0.0, z, np.float32(1.0))[..., None]
    to_camera = -_unit(point)
    to_projector = _unit(np.array([BASELINE_M, 0.0, 0.0], dtype=np.float32) - point)
    normal = view.normal[at]
    cosine, lit, facing = (
        np.clip(np.einsum("hwk,hwk->hw", normal, direction), 1e-3, 1.0)
        for direction in (to_camera, to_projector, _unit(to_camera + to_projector))
    )
    scattered = view.albedo[at] * (1.0 - view.gloss[at] * (1.0 - lit))
    return np.arccos(cosine), np.arccos(facing), np.maximum(scattered * lit / np.maximum(z, 0.1) ** 2, 1e-4)


def _unit(vectors: Field) -> Field:
    return np.asarray(vectors / np.sqrt(np.einsum("hwk,hwk->hw", vectors, vectors))[..., None])


def _noise_factor(angle: Field, light: Field, poor: Field) -> Field:
    """(h, w) growth of the noise, 1 on white paper that faces the camera.

    With the angle of incidence after Nguyen et al., where little light comes back, and where depth is nearly lost.
    """
    grazing = 1.0 + 0.07 * angle**2 / np.maximum(np.pi / 2.0 - angle, 0.05) ** 2
    return np.asarray(grazing * np.sqrt(1.0 + DIM / light) * np.exp(UNSURE * np.clip(poor + 1.0, 0.0, 1.0)))


def lit_by_projector(depth: Depth, scale: float = 1.0) -> NDArray[np.bool_]:
    """Which pixels (h, w) the projector reaches, one baseline to the right of the camera.

    A point at column u meets the projector's column u - d. Whatever lies further right and meets the same column, or
    one to its left, has the larger disparity, so stands nearer and takes the light.

    Args:
        depth: (h, w) metres, 0 where nothing is.
        scale: pixels of the image a pixel of the sensor.
    """
    with np.errstate(divide="ignore"):
        disparity = np.where(depth > 0.0, STRENGTH * scale / depth, 0.0)
    column = np.arange(depth.shape[1]) - disparity
    nearest_right = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(column <= nearest_right + 0.5)


def _edges(depth: Depth, reach: int) -> NDArray[np.bool_]:
    """Pixels (h, w) with a step of depth within so many pixels."""
    low, high = minimum_filter(depth, 2 * reach + 1), maximum_filter(depth, 2 * reach + 1)
    return np.asarray(high - low > EDGE_STEP * reach * np.maximum(high, 0.1))


def _tendency_to_be_lost(angle: Field, mirror: Field, light: Field, gloss: Field) -> Field:
    """(h, w) in standard deviations of the patches in which depth is lost, 0 where half of it is."""
    grazing = 14.0 * np.maximum(angle - GRAZING_RAD, 0.0)
    dark = 1.5 * np.log(np.maximum(DIM / light, 1.0))
    dazzled = 6.0 * gloss * np.exp(-((mirror / MIRROR_RAD) ** 2))
    return np.asarray(SELDOM + grazing + dark + dazzled)


def measure_colour(exact: NDArray[np.uint8], config: SensorConfig, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Colour (h, w, 3) with noise."""
    if config.colour_sigma == 0.0:
        return exact
    noise = np.float32(config.colour_sigma) * rng.standard_normal(exact.shape, dtype=np.float32)
    return np.clip(np.rint(exact + noise), 0, 255).astype(np.uint8)
