"""The simulator's settings. This module imports nothing that takes long, so that all commands can show them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sequences.camera import Camera
from sequences.options import option
from sequences.types import LocalisationNoise

SENSOR_WIDTH = 640
FOCAL_PX = 570.3422  # of the PrimeSense Carmine and Asus Xtion as OpenNI states it


@dataclass(frozen=True)
class PlaceConfig:
    """What is in the place."""

    kind: Literal["any", "kitchen", "living room", "bathroom", "study", "workroom", "mixed"] = option(
        "any", "of room, which says what furniture stands there and what is kept there"
    )
    objects: int = option(10, "small things that belong in the place", low=1, high=40)
    twins: int = option(1, "of these, how many are of the same class as another", low=0, high=20)
    distractors: int = option(3, "classes in the catalogue of which the place has none", low=0)
    clutter: int = option(
        3, "things about which nobody modelled: they are in no catalogue and no truth", low=0, high=20
    )
    known_furniture: bool = option(True, "whether furniture is in the catalogue, or surfaces that nobody modelled")
    together: float = option(0.75, "probability that a thing stands where its category has its spot", low=0.0, high=1.0)
    cloth: float = option(0.1, "probability that a piece of furniture wears a cloth in a visit", low=0.0, high=1.0)
    clearance_m: float = option(0.012, "least gap between the outlines of two things on one surface, metres", low=0.0)


@dataclass(frozen=True)
class MotionConfig:
    """The visits and what changes between them and in them."""

    visits: int = option(2, "recordings of the place", low=1, high=4)
    gap_h: float | None = option(
        None, "hours from the end of a visit to the next one's start; without it each gap is drawn", low=0.01
    )
    shortest_gap_h: float = option(0.1, "least gap that is drawn, hours; its logarithm is uniform", low=0.01)
    longest_gap_h: float = option(72.0, "greatest gap that is drawn, hours", low=0.01)
    moves: int | None = option(
        None,
        "things taken to another piece of furniture between two visits, as far as they fit; without it each thing "
        "stays or moves by its own persistence",
        low=0,
    )
    away: float = option(
        0.1, "share of the moves without such a number that take a thing out of the place", low=0.0, high=0.9
    )
    swap_twins: float = option(
        0.0, "probability that two things of one class take each other's place between two visits", low=0.0, high=1.0
    )
    nudges: int = option(0, "things pushed a little in view of the camera in each visit", low=0, high=10)

    def __post_init__(self) -> None:
        if self.shortest_gap_h > self.longest_gap_h:
            raise ValueError("shortest_gap_h is above longest_gap_h")


@dataclass(frozen=True)
class TrajectoryConfig:
    """The camera's path in each visit: a robot drives past the furniture and looks from one piece to the next."""

    frames: int = option(26, "images of each visit", low=1)
    period_s: float = option(0.5, "seconds between two images", low=0.001)
    height_m: float = option(1.2, "of the camera above the floor, a head's; metres", low=0.9, high=1.6)
    distance_m: float = option(1.0, "from the camera to what it looks at, more or less; metres", low=0.8, high=1.8)


@dataclass(frozen=True)
class SensorConfig:
    """The camera."""

    width: int = option(640, "of the images, pixels; the height is three quarters of it", low=80, high=1280)
    antialias: int = option(2, "each pixel's colour is the mean of so many samples each way", low=1, high=4)
    depth_noise: float = option(1.0, "scales all noise and holes of depth; 0 is exact depth", low=0.0, high=10.0)
    disparity_sigma_px: float = option(0.11, "noise of disparity, pixels: 2.6 mm at 1 m, 10 mm at 2 m", low=0.0)
    correlation_px: float = option(2.5, "over how many pixels noise is alike", low=0.0)
    unevenness: float = option(1.5, "how much the noise's size differs from place to place, heavy tails", low=0.0)
    window_px: float = option(3.0, "over how many pixels the sensor averages within a surface", low=0.0)
    distortion_px: float = option(0.07, "sigma of the camera's own distortion of disparity, pixels", low=0.0)
    distortion_length_px: float = option(80.0, "over how many pixels the distortion changes", low=8.0)
    lateral_sigma_px: float = option(0.7, "how far to the side depth is taken from, pixels", low=0.0)
    edge_px: float = option(3.0, "how far from a depth edge holes are likely, pixels", low=0.0)
    quantisation_px: float = option(0.125, "step of disparity, pixels", low=0.0)
    object_bias_m: float = option(0.001, "sigma of each thing's own depth error in a visit, metres", low=0.0)
    surface_sigma_m: float = option(0.0019, "sigma of what a thing's surface differs from its mesh, metres", low=0.0)
    surface_length: float = option(0.1, "over which share of the thing's diameter that changes", low=0.01)
    colour_sigma: float = option(2.0, "noise of colour, of 255", low=0.0)

    @property
    def camera(self) -> Camera:
        """Intrinsics: the sensor's, scaled to the images' width."""
        scale, height = self.width / SENSOR_WIDTH, self.width * 3 // 4
        focal = FOCAL_PX * scale
        return Camera(focal, focal, (self.width - 1) / 2.0, (height - 1) / 2.0, self.width, height)


@dataclass(frozen=True)
class LocalisationConfig:
    """Error of the recorded camera poses; the run states it."""

    rotation_rad: float = option(0.003, "standard deviation about each axis, rad", low=0.0)
    translation_m: float = option(0.005, "standard deviation along each axis, metres", low=0.0)
    correlation_time_s: float = option(10.0, "how long an error lasts, seconds", low=0.001)

    @property
    def noise(self) -> LocalisationNoise:
        """As a run states it."""
        return LocalisationNoise(self.rotation_rad, self.translation_m, self.correlation_time_s)


@dataclass(frozen=True)
class DetectorConfig:
    """The detector."""

    noise: float = option(1.03, "scales every imperfection; 0 is a perfect detector", low=0.0, high=4.0)
    furniture: bool = option(True, "whether tables and shelves are detected too")
    confusions: tuple[tuple[str, str], ...] = option(
        (("loofah", "bowl"), ("milk_carton", "shampoo_bottle")),
        "names of classes that are taken for each other; the others are for what looks like them",
    )


@dataclass(frozen=True)
class SimulationConfig:
    """A simulated run: a room with furniture and small things, visited a few times."""

    place: PlaceConfig = field(default_factory=PlaceConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    trajectory: TrajectoryConfig = field(default_factory=TrajectoryConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    localisation: LocalisationConfig = field(default_factory=LocalisationConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
