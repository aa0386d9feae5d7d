"""The settings of the model and of the estimators, by section; `ctmap_gtsam.config` holds them in one tree."""

from __future__ import annotations

from dataclasses import dataclass, field

from factors.context import CategoryRelations
from factors.instance import InstancePrior
from sequences.options import option


@dataclass(frozen=True)
class Keyframes:
    """Which frames the estimators use: the first of a visit, and each n-th at which the camera has moved or turned."""

    every: int = option(1, "use every n-th frame", low=1)
    min_translation_m: float = option(0.0, "and only after the camera moved so far, metres ...", low=0.0)
    min_rotation_rad: float = option(0.0, "... or turned so far, rad", low=0.0)


@dataclass(frozen=True)
class Sensor:
    """The depth camera."""

    sigma_m: float = option(0.002, "noise floor of sensor, mesh and calibration together, metres", low=1e-5)
    sigma_quadratic_per_m: float = option(0.0015, "growth of the noise with squared depth, 1/m", low=0.0)
    outlier_weight: float = option(0.02, "share of pixels that say nothing", low=1e-6, high=0.5)
    range_m: float = option(8.0, "the largest depth the sensor gives, metres", low=0.1)
    occluder_weight: float = option(0.15, "chance that something stands before a known background", low=0.0, high=0.9)
    background_sigma_m: float = option(0.005, "how well a background plane's depth is known, metres", low=0.0)
    clutter_gain: float = option(2.5, "nats a sample that a surface of no known mesh would explain", low=0.0)
    kappa: float = option(0.05, "one over the number of samples whose noise is correlated", low=0.0, high=1.0)
    fresh_view_rad: float = option(0.1, "change of viewing direction after which depth errs anew, rad", low=1e-3)
    fresh_view_s: float = option(2.0, "time after which depth errs anew even in the same view, s", low=1e-3)
    bias_rotation_rad: float = option(
        0.01, "error shared by the depth measurements of one object and visit, rad", low=1e-6
    )
    bias_translation_m: float = option(0.001, "the same, metres", low=1e-7)
    bias_size: float = option(0.004, "what large things are off besides: this share of their radius", low=0.0)
    bias_surface_m: float = option(
        0.002, "how far off a thing's surface may be as a whole: turns it by this over its radius, metres", low=0.0
    )
    mesh_share: float = option(
        0.03, "what a thing's mesh is off by costs it this share of what it explains, alike in all views", low=1e-6
    )
    occlusion_margin_m: float = option(0.02, "a measurement so far in front of an object is an occluder", low=0.0)


@dataclass(frozen=True)
class Detector:
    """What is believed of the detector."""

    detection_probability: float = option(0.9, "of an object in full view", low=0.01, high=0.999)
    box_sigma: float = option(0.05, "scale of a box edge's error, as a share of the box's size", low=0.005)
    box_outlier: float = option(0.02, "share of boxes that have nothing to do with the object", low=1e-6, high=0.5)
    clutter_rate: float = option(0.3, "chance that clutter is detected again where it was", low=0.01, high=0.99)
    unfound: float = option(
        0.4,
        "chance that a track of which no pose explains more than clutter is a known thing all the same",
        low=0.0,
        high=0.9,
    )
    lookalike: float = option(
        0.1, "chance that what a known mesh explains is something else of its shape", low=1e-9, high=0.5
    )
    deceived: float = option(
        0.2,
        "share of things of unknown mesh that are taken for known ones as often as those are found",
        low=1e-9,
        high=0.9,
    )
    overlooked: float = option(
        0.02,
        "share of visits in which a known thing is found as rarely as one of unknown mesh",
        low=1e-9,
        high=0.9,
    )
    confusion: float = option(0.1, "chance that a class is persistently taken for another", low=1e-6, high=0.9)
    score_floor: float = option(0.05, "weight of a uniform belief mixed into score vectors", low=1e-6, high=0.9)


@dataclass(frozen=True)
class Prediction:
    """How objects move from keyframe to keyframe."""

    rotation_rate: float = option(0.01, "random walk in view, rad per sqrt(s)", low=1e-6)
    translation_rate: float = option(0.002, "random walk in view, metres per sqrt(s)", low=1e-6)
    jump_probability: float = option(
        1e-4, "chance a keyframe that a seen thing is pushed elsewhere nearby, or taken away", low=1e-15, high=0.5
    )
    region_radius_m: float = option(
        0.3, "radius of that neighbourhood, and of where a first pose may be, metres", low=0.01
    )
    stay_limit: float = option(0.5, "r1 of Equation 2: P(stay) after an endless absence", low=0.0, high=1.0)
    significant_period_s: float = option(10.0, "absences shorter than this can't hold a move, s", low=0.0)
    landing_tilt_rad: float = option(0.1, "how far from flat on its face a thing put down may seem, rad", low=1e-3)


@dataclass(frozen=True)
class Context:
    """Relations between objects."""

    relations: CategoryRelations = field(default_factory=CategoryRelations)
    instance: InstancePrior = field(default_factory=InstancePrior)
    moved_m: float = option(
        0.1, "what stands so near to where it stood in another visit isn't taken to have been moved, metres", low=0.0
    )
    support_tolerance_m: float = option(0.008, "gaps and dents up to this are errors of the surface, metres", low=0.0)
    support_sigma_m: float = option(0.01, "how far beyond that a thing may seem to float, metres", low=1e-4)
    standing_tilt_rad: float = option(
        0.1, "how far from flat on its face a thing on a level surface may seem to stand, rad", low=1e-5
    )
    other_support: float = option(0.3, "chance that a thing rests on what was not seen", low=1e-9, high=1.0)
    penetration_sigma_m: float = option(0.003, "how deep a thing may seem to sink into another, metres", low=1e-4)
    doubt: float = option(
        1e-6, "chance that a neighbour or a surface isn't where it is believed to be", low=1e-300, high=0.5
    )

    @property
    def bearing_m(self) -> float:
        """How far from a surface a thing may seem to end that stands on it, metres."""
        return self.support_tolerance_m + 2.0 * self.support_sigma_m


@dataclass(frozen=True)
class Frontend:
    """Tracks and proposals, shared by filter and smoother."""

    association_iou: float = option(0.4, "least overlap of a box with its track's predicted box", low=0.0, high=1.0)
    start_after: int = option(2, "frames with a box before a track is estimated", low=1)
    lost_after_s: float = option(2.0, "a track not yet started is given up after so long without a box, s", low=0.0)
    angular_step_rad: float = option(0.0075, "depth is sampled at this step", low=1e-4)
    tile_samples: int = option(6400, "at most so many in a region: what is larger is sampled more coarsely", low=64)
    region_margin: float = option(0.5, "depth is scored in the box enlarged by this share on each side", low=0.0)
    mesh_faces: int = option(500, "triangles of the meshes that score", low=20)
    fresh_poses: int = option(1000, "random poses a class in a full search", low=1)
    refined_poses: int = option(48, "of these, so many are refined on depth", low=1)
    perturbed_poses: int = option(4, "second starts around each of the best", low=0)
    max_modes: int = option(4, "poses kept a class, track and keyframe", low=1)
    refinement_steps: int = option(20, "steps of the registration on depth", low=1)
    refinement_widths_m: tuple[float, float] = option((0.03, 0.004), "its robust width at first and at last, metres")


@dataclass(frozen=True)
class Filter:
    """The particle filter, the paper's Algorithm 1."""

    particles: int = option(
        300,
        "particles an object (the paper's M); a third in one place, four times as many where views leave it open",
        low=10,
    )
    min_particles: int = option(24, "of a class that is still possible", low=1)
    proposal_share: float = option(
        0.5, "particles drawn around refined modes rather than from the prediction", low=0.01, high=0.95
    )
    search_every: int = option(5, "keyframes between fresh searches at least; they grow with an object's age", low=1)
    search_share: float = option(0.25, "effort of such a search, as a share of the first one's", low=0.0, high=1.0)
    trajectories: int = option(300, "a class and object drawn back through the particles, for ffbsi-ct", low=10)


@dataclass(frozen=True)
class Paper:
    """The paper's filter to the letter, `--paper`: constants that it names but doesn't give."""

    particles: int = option(2000, "M, particles an object", low=10)
    rotation_sigma_rad: float = option(
        0.05, "root of Sigma in Equation 2, about each axis and a keyframe, rad", low=1e-6
    )
    translation_sigma_m: float = option(0.01, "the same in each direction, metres", low=1e-6)
    lambda_per_m2: float = option(50.0, "lambda of Equation 6, by the sum over samples of squared metres", low=0.0)
    delta: float = option(1e-3, "phi_m of what is out of view", low=1e-300)


@dataclass(frozen=True)
class Smoother:
    """The factor graph and its rounds."""

    unmeasured: float = option(
        0.02, "chance that none of a view's modes is the pose of the thing that is there", low=0.0, high=0.5
    )
    surface_nats: float = option(
        0.3, "a thing's own surface may favour a near-symmetric way round by this in every view, nats", low=1e-3
    )
    exchange: float = option(
        0.1, "chance that two alike things change places in a gap between visits, however short", low=0.0, high=0.5
    )
    rounds: int = option(2, "re-weighting rounds after the first, at most", low=2)
    max_iterations: int = option(30, "of the Levenberg-Marquardt loop a round", low=1)
    tolerance: float = option(1e-6, "relative fall of the energy at which the loop has converged", low=0.0)
    lag: int = option(5, "fixed lag: keyframe t is estimated from those up to t + lag (method lag-ct)", low=0)
    window: int = option(10, "fixed lag: keyframes before the lag that are still solved anew", low=1)
    remembered: int = option(10, "fixed lag: views of an object from before those that are kept, at most", low=2)


@dataclass(frozen=True)
class Baselines:
    """What the estimators are held to: registration of single frames by ICP and FPFH, and static fusion."""

    iterations: int = option(50000, "of ICP, and of FPFH's RANSAC, at most (the paper's)", low=1)
    crop_diameters: float = option(
        0.5, "a box's points further from its middle's depth than so many diameters are left out; 0 = none", low=0.0
    )
    voxel: float = option(0.05, "clouds keep a point a voxel of this share of the class's diameter ...", low=1e-3)
    min_voxel_m: float = option(0.003, "... but of this size at least, metres", low=1e-4)
    min_points: int = option(20, "a crop of fewer points is not registered", low=4)
    mesh_points: int = option(20000, "points drawn on a class's mesh, before they are thinned", low=100)
    icp_starts: int = option(4, "random orientations that ICP starts from; the best fit counts", low=1)
    icp_distance: float = option(0.3, "ICP pairs points up to this share of the diameter apart", low=1e-3)
    fpfh_refine: bool = option(False, "ICP after FPFH's global registration, of which the paper says nothing")
    fusion_search_share: float = option(
        0.25, "effort of static fusion's search in each keyframe, as a share of the configured one", low=0.01
    )
