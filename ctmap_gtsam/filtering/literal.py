"""Algorithm 1 with the paper's own potentials, to the letter: what the departures of `docs/model.md` are held to.

A particle is a class and a pose. Each keyframe resamples, draws from the prediction (Equation 2 in view; out of view
stay or move by Equation 3, a move to another object's top), and weighs by phi_m = delta out of view, f alone where the
detector misses the object, else g = sum_k h l f with f = exp(-lambda SSD) (Equation 6), times phi_c to the neighbours
at t-1 at their most likely particles (Equation 5). What stands in no line of the paper is not here: nothing is refined,
no class has particles of its own, Equation 3 is drawn from anew at every keyframe of an absence, the context is
multiplied in at every keyframe, and what has once been seen exists.

Where the paper leaves a choice: SSD is summed over the pixels that the rendered object covers and the sensor measured,
sampled at a fixed angular step; phi_cat is that of `factors.context`, phi_ins says nothing (no instance is known), and
the neighbourhood Gamma(i) is all other objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import Tables, build_estimate, localisation_covariance
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.particles import Particles, modes_of, systematic
from ctmap_gtsam.filtering.reporting import Reported
from ctmap_gtsam.frontend.association import Associator, Track
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.observation import CENTRE_REGION, Observation, centre_depth, observations
from ctmap_gtsam.frontend.place import Place, describe
from ctmap_gtsam.frontend.scoring import cut_tile, squared_differences
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors import prediction
from factors.measurement import box_overlap_min, paper_log_potential, paper_log_similarity
from factors.mixture import normalised
from sequences import se3
from sequences.progress import SILENT, Progress
from sequences.seeds import generator
from sequences.types import Detection, Frame, Run

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_LEVEL = 0.9  # least cosine between up and the normal of a face that things are put on
_SAMPLES = 4.0  # of a tile, in those of a tile for one object: particles are spread


@dataclass(frozen=True)
class Cloud:
    """Q_t^i: M weighted particles of one object."""

    class_index: Ints
    """(M,)"""
    T_world_centre: Array
    """(M, 4, 4)"""
    log_weight: Array
    """(M,) normalised"""
    seen_ns: int
    """when the object was last observed"""

    def best(self) -> tuple[int, Array]:
        """Class index and T_world_centre (4, 4) of the most likely particle."""
        k = int(np.argmax(self.log_weight))
        return int(self.class_index[k]), self.T_world_centre[k]


def literal_filter_run(
    run: Run, config: Config | None = None, *, context: bool = True, progress: Progress | None = None
) -> Estimate:
    """The paper's particle filter over a run, to the letter.

    Args:
        run: from `sequences.bop.load_run`.
        config: settings, `paper` above all; None = the defaults.
        context: False for the paper's T-Map.
        progress: who is told how far it is.

    Returns:
        The estimate at every keyframe.
    """
    config = config or Config()
    name = "paper-ct" if context else "paper-t"
    filter_ = _Filter(run, Model(run.catalogue, config, context=context))
    keyframes = select_keyframes(run, config.keyframes)
    with (progress or SILENT).stage(name, total=len(keyframes)) as stage:
        reports = []
        for observation in observations(run, keyframes, config.seed):
            reports.append(filter_.step(observation))
            stage.advance()
    objects = sorted({i for reported in reports for i in reported})
    rows = {i: row for row, i in enumerate(objects)}
    tables = Tables(len(objects), len(keyframes), len(run.catalogue))
    for k, reported in enumerate(reports):
        for i, said in reported.items():
            said.write(tables, rows, i, k, filter_.model)
    cameras = np.stack([run.frames[int(f)].T_world_camera for f in keyframes])
    sure = np.tile(localisation_covariance(run.localisation), (len(keyframes), 1, 1))
    return build_estimate(run, config, name, keyframes, objects, tables, cameras, sure, describe(filter_.place))


class _Filter:
    """All objects' particles after a keyframe."""

    def __init__(self, run: Run, model: Model) -> None:
        self.model = model
        self.settings = model.config.paper
        self.associator = Associator(model.config.frontend, model.catalogue)
        self.place = Place(run)
        self.clouds: dict[int, Cloud] = {}

    def step(self, observation: Observation) -> dict[int, Reported]:
        """Algorithm 1 for every object, then the first particles of new ones."""
        self.associator.step(observation)
        self.place.update(observation)
        tracks = {track.track_id: track for track in self.associator.tracks()}
        before = {i: cloud.best() for i, cloud in self.clouds.items()}
        for i, cloud in sorted(self.clouds.items()):
            others = {j: best for j, best in before.items() if j != i}
            rng = generator(self.model.config.seed, "paper.step", i, observation.frame.index)
            detection = tracks[i].at(observation.keyframe)
            drawn = self._predict(cloud, observation.frame, others, rng)
            self.clouds[i] = self._weigh(drawn, detection, observation, self._around(others))
        for i in sorted(tracks.keys() - self.clouds.keys()):
            started = self._start(tracks[i], observation)
            self.clouds[i] = self._weigh(started, tracks[i].at(observation.keyframe), observation, self._around(before))
        return {i: self._report(cloud, observation.frame) for i, cloud in sorted(self.clouds.items())}

    def _around(self, others: Mapping[int, tuple[int, Array]]) -> Surroundings:
        shapes = self.model.shapes
        neighbours = tuple(Neighbour(j, shapes[c], T, 0.0) for j, (c, T) in sorted(others.items()))
        return Surroundings(neighbours, self.place.surfaces)

    def _start(self, track: Track, observation: Observation) -> Cloud:
        """The first particles: classes by the scores, centres in the box's centre region, orientations uniform."""
        detection = track.at(observation.keyframe)
        assert detection is not None
        rng = generator(self.model.config.seed, "paper.start", track.track_id, observation.frame.index)
        n, camera = self.settings.particles, observation.frame.camera
        scores = detection.class_scores[1:] + 1e-12
        classes = rng.choice(len(scores), size=n, p=scores / scores.sum())
        x, y, w, h = detection.box
        offsets = CENTRE_REGION * (rng.random((n, 2)) - 0.5)
        pixels = np.array([x + w / 2, y + h / 2]) + offsets * [w, h]
        z = centre_depth(observation.depth, np.array(detection.box))
        # what is measured is the surface; the centre lies behind it by about the object's radius
        radius = np.array([shape.radius_m for shape in self.model.shapes])[classes]
        centres = camera.backproject(pixels[:, 0], pixels[:, 1], z + radius * rng.random(n))
        poses = se3.make(se3.uniform_rotations(rng.random((n, 3))), centres)
        uniform = np.full(n, -np.log(n))
        return Cloud(classes, observation.frame.T_world_camera @ poses, uniform, observation.frame.time_ns)

    def _predict(
        self, cloud: Cloud, frame: Frame, others: Mapping[int, tuple[int, Array]], rng: np.random.Generator
    ) -> Cloud:
        """Resample, then draw from phi_p: Equation 2 where the particle is in view or stays, else a move."""
        n = len(cloud.log_weight)
        picks = systematic(cloud.log_weight, n, float(rng.random()))
        classes, T = cloud.class_index[picks], cloud.T_world_centre[picks]
        away_s = (frame.time_ns - cloud.seen_ns) * 1e-9
        moves = np.zeros(n, dtype=np.bool_)
        if away_s >= self.model.config.prediction.significant_period_s and others:
            stay = np.array([self.model.stay_probability(s.source, away_s) for s in self.model.shapes])
            moves = ~_in_view(T, frame) & (rng.random(n) >= stay[classes])
        sigma = np.repeat([self.settings.rotation_sigma_rad, self.settings.translation_sigma_m], 3) ** 2
        # the paper's exponent has no 1/2: its Sigma is twice a covariance
        T = prediction.sample(T, np.diag(sigma) / 2.0, rng.normal(size=(n, 6)))
        if moves.any():
            T[moves] = self._moved(classes[moves], T[moves], others, rng)
        return replace(cloud, class_index=classes, T_world_centre=T)

    def _moved(
        self, classes: Ints, T: Array, others: Mapping[int, tuple[int, Array]], rng: np.random.Generator
    ) -> Array:
        """Onto another object each, drawn uniformly: anywhere on its upper faces, turned by any yaw.

        Where up is unknown, or the other has no upper face, the object stays.
        """
        out, up = T.copy(), self.place.up_world
        names = sorted(others)
        chosen = rng.integers(len(names), size=len(T))
        for index in np.unique(chosen):
            c, T_other = others[names[index]]
            rows = np.flatnonzero(chosen == index)
            spots = None if up is None else _spots_on(self.model.shapes[c], T_other, up, len(rows), rng)
            if up is None or spots is None:
                continue
            turned = se3.so3_exp(rng.uniform(-np.pi, np.pi, size=(len(rows), 1)) * up) @ T[rows, :3, :3]
            hulls = [self.model.shapes[k].hull_points for k in classes[rows]]
            low = np.array([(hull @ R.T @ up).min() for hull, R in zip(hulls, turned, strict=True)])
            out[rows] = se3.make(turned, spots - low[:, None] * up)
        return out

    def _weigh(
        self, cloud: Cloud, detection: Detection | None, observation: Observation, around: Surroundings
    ) -> Cloud:
        """phi_m times phi_c, class by class."""
        log_weight = np.zeros(len(cloud.class_index))
        for c in np.unique(cloud.class_index):
            rows, shape = cloud.class_index == c, self.model.shapes[int(c)]
            T = cloud.T_world_centre[rows]
            log_weight[rows] = self._measured(shape, T, detection is not None, observation)
            log_weight[rows] += around.log_potential(self.model, shape, T)
        # an object whose every particle is impossible keeps them all: the paper says nothing of it
        seen_ns = cloud.seen_ns if detection is None else observation.frame.time_ns
        return replace(cloud, log_weight=normalised(log_weight), seen_ns=seen_ns)

    def _measured(self, shape: Shape, T_world_centre: Array, detected: bool, observation: Observation) -> Array:
        """log phi_m (K,) of poses (K, 4, 4)."""
        frame, front = observation.frame, self.model.config.frontend
        T = frame.T_camera_world @ T_world_centre
        in_view = _in_view(T_world_centre, frame)
        boxes = _projected_boxes(shape, T, frame)
        step = max(1, round(frame.camera.fx * front.angular_step_rad))
        union = np.array([*boxes[:, :2].min(axis=0), *(boxes[:, :2] + boxes[:, 2:]).max(axis=0)])
        area = float(np.prod(np.maximum(union[2:] - union[:2], 1.0)))
        by = max(1, int(np.ceil(np.sqrt(area / (step**2 * front.tile_samples * _SAMPLES)))))
        tile = cut_tile(frame.camera, observation.depth, (), union, step * by)
        ssd = by**2 * squared_differences(shape.mesh, tile, T)
        h, overlaps = np.zeros((len(T), 0)), np.zeros((len(T), 0))
        if detected:
            h = np.tile([d.class_scores[1 + shape.index] for d in frame.detections], (len(T), 1))
            overlaps = box_overlap_min(boxes[:, None], np.array([d.box for d in frame.detections])[None])
        log_f = paper_log_similarity(ssd, self.settings.lambda_per_m2)
        return paper_log_potential(h, overlaps, log_f, in_view, self.settings.delta)

    def _report(self, cloud: Cloud, frame: Frame) -> Reported:
        weight = np.exp(cloud.log_weight)
        share = np.bincount(cloud.class_index, weights=weight, minlength=len(self.model.shapes))
        modes = []
        for c in np.flatnonzero(share > 0.0):
            rows = cloud.class_index == c
            own = Particles(cloud.T_world_centre[rows], normalised(cloud.log_weight[rows]))
            modes += modes_of(int(c), own, self.model.shapes[int(c)])
        best = cloud.T_world_centre[[int(np.argmax(cloud.log_weight))]]
        visible = bool(_in_view(best, frame)[0])
        return Reported(share / share.sum(), 0.0, 1.0, 0.0, visible, tuple(modes))


def _in_view(T_world_centre: Array, frame: Frame) -> Bools:
    """(K,) whether centres are in the camera's field of view."""
    centres = se3.transform(frame.T_camera_world, T_world_centre[:, :3, 3])
    ahead = centres[:, 2] > 0.0
    pixels = frame.camera.project(np.where(ahead[:, None], centres, [0.0, 0.0, 1.0]))
    size = [frame.camera.width, frame.camera.height]
    return np.asarray(ahead & ((pixels >= 0) & (pixels < size)).all(axis=-1))


def _projected_boxes(shape: Shape, T_camera_centre: Array, frame: Frame) -> Array:
    """b(o, x): boxes (K, 4), x, y, w, h, that enclose the projections in the image; empty out of view."""
    points = se3.transform(T_camera_centre, shape.hull_points)  # (K, H, 3)
    ahead = points[..., 2] > 0.0
    pixels = frame.camera.project(np.where(ahead[..., None], points, [0.0, 0.0, 1.0]))
    size = np.array([frame.camera.width, frame.camera.height], dtype=np.float64)
    low = np.clip(np.where(ahead[..., None], pixels, np.inf).min(axis=1), 0.0, size)
    high = np.clip(np.where(ahead[..., None], pixels, -np.inf).max(axis=1), 0.0, size)
    return np.concatenate([low, np.maximum(high - low, 0.0)], axis=-1)


def _spots_on(shape: Shape, T_world_centre: Array, up: Array, n: int, rng: np.random.Generator) -> Array | None:
    """Points (n, 3) drawn evenly from a shape's upper faces, world frame; None where it has none."""
    corners = se3.transform(T_world_centre, shape.mesh.vertices)[shape.mesh.faces]  # (F, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=-1)
    area = np.where(cross @ up > _LEVEL * area, area, 0.0)
    if area.sum() == 0.0:
        return None
    faces = corners[rng.choice(len(area), size=n, p=area / area.sum())]
    # uniform in a triangle (Osada et al., ACM Trans. Graph. 2002)
    a, b = np.sqrt(rng.random(n))[:, None], rng.random(n)[:, None]
    return np.asarray((1 - a) * faces[:, 0] + a * (1 - b) * faces[:, 1] + a * b * faces[:, 2])
