"""Poses that explain the depth: drawn as the paper draws its first particles, refined on the depth image, scored.

The paper puts an object's centre around the 3-D points in the box's centre region, with an orientation uniform on
SO(3). One such draw in some thousands lies within reach of the truth, so the best by score are refined by
point-to-plane registration, tried again from starts around them and from half-turns, and what remains are the score's
modes: the proposals of filter and smoother, which weigh them with the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.observation import CENTRE_REGION, Observation, centre_depth
from ctmap_gtsam.frontend.resting import UNIFORMS, resting_poses, shifted_poses, snapped_poses
from ctmap_gtsam.frontend.scoring import Scores, Tile, coarser, cut_tile, refine_on_depth, score_depth
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors import symmetry
from factors.motions import retract
from sequences import se3
from sequences.rendering.rasteriser import Rasteriser
from sequences.types import Detection

Array = NDArray[np.float64]

COARSE = 2
"""a first look takes every so many samples: a quarter of the work, and as good for telling what needs a closer one"""

ENOUGH_SAMPLES = 40
"""across a tile, for it to be looked at coarsely"""

_HALF_TURNS = np.stack([np.diag(d).astype(np.float64) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])])
_LADDER_M = np.array([0.001, 0.002, 0.005, 0.01, 0.02, 0.04])
"""steps at which the score's shape is probed, metres at the object's radius"""

PROBED_M = float(_LADDER_M[-1])
"""how far the score's shape is probed: the standard deviation of a mode along an axis that shows nothing"""

FLAT_M = 0.5 * PROBED_M
"""standard deviation from which on an axis is free: a score that is even as far as it is probed has a little more"""

_CLIMBS, _CLIMB_NATS = 6, 0.05  # at most so many moves on the score, each gaining at least this much
_SMALL_REACH_M = 0.3  # of things that are refined with the configured widths
_LARGE_SAMPLES = 0.25  # of the configured samples, as many as tell where furniture is as well as all of them
_UNLIKE = 0.4  # sizes of which one is less than this share of the other don't belong together
_LITTLE, _FURNITURE = 0.25, 6.0  # effort for a class of the wrong size, and for one that is large
_EDGE_PX = 3.0  # a box so near to the image's edge may be cut by it
_REST_REACH = 2.0  # a resting pose is that many times its reach from the depth that is seen, at most
_RIPPLE = 2.0  # a width so many times that of the score's first fall is the score's, the first fall a ripple
_BOX_SLACK = 0.15  # of a box's sides by which the thing may reach beyond it on each
_ONE_WAY_ROUND_RAD = 0.4  # how far a turn from one near-symmetry to the next may be off
_CLOSER, _CLOSER_SHARE = 3, 0.25  # times as many starts as modes are kept, and share of all, that are looked at closely
_MOSTLY_SEEN = 0.85  # of what is measured of a silhouette: less of it, and it may stand another way about what shows
_LEVEL = 3.0  # nats: ways round that a view hardly tells apart
_ONE_POSE = (0.12, 0.008)  # rad, metres: what lies nearer to each other in one view is one mode


@dataclass(frozen=True)
class View:
    """One track in one keyframe: where to look, and what the detector said there."""

    tile: Tile
    detection: Detection | None
    image_size: tuple[int, int]
    """width, height"""
    centre_depth_m: float
    """median in the middle of the box that was looked in; 0 where nothing was measured"""
    share: float = 1.0
    """of the view that is news: its evidence is raised to this power"""
    samples: int = 1
    """at the configured angular step that one of this tile stands for"""

    def coarse(self) -> View:
        """The same view with a sample in each block of `COARSE` by `COARSE`, where enough are left."""
        if min(self.tile.depth.shape) < ENOUGH_SAMPLES:
            return self
        return replace(self, tile=coarser(self.tile, COARSE), samples=self.samples * COARSE**2)


@dataclass(frozen=True, slots=True)  # a map holds one for each object, class and keyframe
class PoseModes:
    """Maxima of the measurement potential for one class in one view, best first: n of them."""

    numbers: Array
    """(55 n,) of all that is said below, one after the other: five small arrays are as large as what is in them"""

    @classmethod
    def of(
        cls,
        T_camera_centre: Array,
        log_likelihood: Array,
        depth_log_ratio: Array,
        covariance: Array,
        witness: Array,
    ) -> PoseModes:
        """Modes of what the properties say."""
        told = (T_camera_centre, covariance, log_likelihood, depth_log_ratio, witness)
        return cls(np.concatenate([numbers.ravel() for numbers in told]))

    @property
    def T_camera_centre(self) -> Array:
        """(n, 4, 4)."""
        return self._told(0, 16).reshape(-1, 4, 4)

    @property
    def covariance(self) -> Array:
        """(n, 6, 6) of the right tangent, from the score's own shape."""
        return self._told(16, 52).reshape(-1, 6, 6)

    @property
    def log_likelihood(self) -> Array:
        """(n,) tempered depth ratio plus the box's, nats."""
        return self._told(52, 53)

    @property
    def depth_log_ratio(self) -> Array:
        """(n,) the depth's part of it."""
        return self._told(53, 54)

    @property
    def witness(self) -> Array:
        """(n,) what the view's box or its absence says for a known thing there against a look-alike, nats."""
        return self._told(54, 55)

    def _told(self, begin: int, end: int) -> Array:
        n = len(self)
        return self.numbers[begin * n : end * n]

    def __len__(self) -> int:
        return len(self.numbers) // 55


class Proposer:
    """Finds poses in views. Counts the hypotheses it had scored."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.settings = model.config.frontend
        self.hypotheses_scored = 0
        self._fine = np.full(self.settings.refinement_steps - self._coarse_steps, self.settings.refinement_widths_m[1])

    @property
    def _coarse_steps(self) -> int:
        return max(1, self.settings.refinement_steps // 2)

    def _coarse(self, shape: Shape) -> Array:
        """Falling widths; furniture is drawn from further away than a mug, by its size."""
        first, last = self.settings.refinement_widths_m
        return np.geomspace(first * max(1.0, shape.reach_m / _SMALL_REACH_M), last, self._coarse_steps)

    def view(
        self,
        observation: Observation,
        box: Array,
        detection: Detection | None,
        surroundings: Surroundings | None = None,
        share: float = 1.0,
    ) -> View:
        """The region of a box (x, y, w, h) enlarged by the margin.

        Args:
            observation: the keyframe.
            box: where the object is looked for, pixels.
            detection: the track's detection here, if there is one.
            surroundings: whose surfaces and neighbours join the background.
            share: see `Model.view_share`.
        """
        camera = observation.frame.camera
        x, y, w, h = box
        margin = self.settings.region_margin
        region = np.array([x - margin * w, y - margin * h, x + (1 + margin) * w, y + (1 + margin) * h])
        step = max(1, round(camera.fx * self.settings.angular_step_rad))
        low, high = np.clip(region.reshape(2, 2), 0.0, [camera.width, camera.height])
        z = centre_depth(observation.depth, box)
        seen_m = float(np.hypot(w, h)) * z / camera.fx
        samples = self.settings.tile_samples * (_LARGE_SAMPLES if seen_m > 2.0 * _SMALL_REACH_M else 1.0)
        by = max(1, int(np.ceil(np.sqrt((high - low).prod() / (step**2 * samples)))))
        tile = cut_tile(camera, observation.depth, observation.planes_behind(box), region, by * step)
        if surroundings is not None:
            tile = surroundings.behind(surroundings.beneath(tile, observation.frame, box), observation.frame)
        if detection is not None:
            tile = bounded(tile, box)
        return View(tile, detection, (camera.width, camera.height), z, share, by**2)

    def score(self, shape: Shape, view: View, T_camera_centre: Array) -> tuple[Array, Scores]:
        """log-likelihood ratio (K,) of poses (K, 4, 4), and the fused kernel's answer."""
        self.hypotheses_scored += len(T_camera_centre)
        return self._scored(shape, view, T_camera_centre)

    def _scored(self, shape: Shape, view: View, T_camera_centre: Array) -> tuple[Array, Scores]:
        scores = score_depth(
            shape.mesh,
            view.tile,
            T_camera_centre,
            self.model.depth_parameters,
            self.model.config.sensor.occlusion_margin_m,
        )
        scores = replace(scores, log_ratio=view.samples * scores.log_ratio)
        return view.share * self.model.log_likelihood(scores, view.detection, view.image_size), scores

    def search(
        self,
        shape: Shape,
        view: View,
        observation: Observation,
        surroundings: Surroundings,
        rng: np.random.Generator,
        share: float = 1.0,
    ) -> Array:
        """A fresh search in a view with a detection: refined poses (K, 4, 4) T_camera_centre, not yet sorted out.

        Args:
            shape: the class.
            view: where to look.
            observation: the keyframe of the view.
            surroundings: on whose surfaces it may rest.
            rng: draws the poses.
            share: of the configured effort.
        """
        assert view.detection is not None
        box = np.array(view.detection.box)
        view = view.coarse()
        z = view.centre_depth_m
        if z == 0.0:
            return np.zeros((0, 4, 4))
        share *= _worth(shape, float(np.hypot(*box[2:])) * z / observation.frame.camera.fx)
        n = max(8, round(share * self.settings.fresh_poses))
        drawn = self._draw(shape, box, z, observation, surroundings, n, rng)
        keep = max(2, round(share * self.settings.refined_poses))
        coarse = self._refine(shape, view, self._best(shape, view, drawn, keep), self._coarse(shape))
        best = self._best(shape, view, coarse, max(1, keep // 6))
        starts = self._perturb(shape, view, best, rng)
        if _large(shape):
            shifted = shifted_poses(shape, best, observation.planes)
            starts = np.concatenate([starts, self._best(shape, view, shifted, keep)])
        around = self._refine(shape, view, starts, self._coarse(shape)[self._coarse_steps // 2 :])
        return np.concatenate([coarse, around])

    def modes(self, shape: Shape, view: View, starts: Array, probe: bool = True, ways_round: bool = False) -> PoseModes:
        """Refine starts (K, 4, 4) T_camera_centre, score, merge equal ones and keep the best few.

        Args:
            shape: the class.
            view: where to look.
            starts: (K, 4, 4) T_camera_centre.
            probe: whether to climb along the axes on the score, and to take covariances from its shape (else from the
                registration's normal equations).
            ways_round: whether the best is tried as turned by each of the class's near-symmetries and about what
                shows of it, too, and the best of each is kept, and ways that fit all but equally well have as many
                modes each: all views decide which way round it stands, not which ways were tried.
        """
        if len(starts) == 0:
            return _no_modes()
        starts = self._promising(shape, view, starts)
        ways = self._ways_round(shape, view, starts) if ways_round else np.zeros((0, 4, 4))
        starts = np.concatenate([starts, ways])
        candidates = np.concatenate([self._refine(shape, view, starts, self._fine), starts])
        score, scores = self.score(shape, view, candidates)
        keep = self._distinct(shape, candidates, score, ways, ways_round)
        known: dict[int, Array] = {}
        if probe and view.detection is not None:
            climbed, known = self._climb(shape, view, candidates[keep])
            candidates = np.concatenate([climbed, candidates[keep]])
            score, scores = self.score(shape, view, candidates)
            keep = self._distinct(shape, candidates, score, ways, ways_round)
        poses = candidates[keep]
        covariance = self._shape_of_score(shape, view, poses, probe, [known.get(row) for row in keep])
        depth = view.share * self.model.kappa * scores.log_ratio[keep]
        return PoseModes.of(poses, score[keep], depth, covariance, self._witness(view, scores)[keep])

    def told(self, shape: Shape, view: View, T_camera_centre: Array) -> tuple[float, float]:
        """What depth and the detector say of one pose (4, 4), nats: for the ledger, and no hypothesis."""
        score, scores = self._scored(shape, view, T_camera_centre[None])
        depth = float(view.share * self.model.kappa * scores.log_ratio[0])
        return depth, float(score[0]) - depth

    def _promising(self, shape: Shape, view: View, starts: Array) -> Array:
        """Those of starts (n, 4, 4) that are worth a closer look: the best by score that differ from each other.

        A step of the registration takes as long as a score, and most of what a search finds is found several times.
        """
        most = max(_CLOSER * self.settings.max_modes, round(_CLOSER_SHARE * len(starts)))
        if len(starts) <= most:
            return starts
        score, _ = self.score(shape, view, starts)
        return starts[distinct(shape, starts, score, _ONE_POSE, most)]

    def witness(self, shape: Shape, view: View, T_camera_centre: Array) -> float:
        """What a view's box, or its absence, says for a known thing at a pose (4, 4) against a look-alike, nats."""
        return float(self._witness(view, self.score(shape, view, T_camera_centre[None])[1])[0])

    def _witness(self, view: View, scores: Scores) -> Array:
        return view.share * self.model.witness(scores, view.detection is not None)

    def near(self, shape: Shape, view: View, T_camera_centre: Array, reach: Array) -> float:
        """The best log-likelihood of a view about one pose (4, 4): there, or where depth draws it, if that is in reach.

        Args:
            shape: the class.
            view: where to look.
            T_camera_centre: the pose.
            reach: (2,) rad and metres by which it may be moved.
        """
        drawn = self._refine(shape, view, T_camera_centre[None], self._fine)
        xi = symmetry.residual(T_camera_centre, drawn[0])
        within = np.linalg.norm(xi[:3]) <= reach[0] and np.linalg.norm(xi[3:]) <= reach[1]
        poses = np.concatenate([T_camera_centre[None], drawn]) if within else T_camera_centre[None]
        return float(self.score(shape, view, poses)[0].max())

    def log_clutter(self, shape: Shape, view: View, T_camera_centre: Array, first: bool) -> float:
        """What a view says for something that no mesh explains, of the silhouette of one pose (4, 4), nats.

        A surface of unknown form explains a share of what the right mesh would, where the background doesn't explain
        the depth already; its boxes come less often, and fit as well. It has gone where most of the silhouette is seen
        through.

        Args:
            shape: the class.
            view: where to look.
            T_camera_centre: the pose.
            first: whether this is the first view of it.
        """
        sensor = self.model.config.sensor
        rendered = Rasteriser().render(shape.mesh, view.tile.camera, T_camera_centre[None])[0]
        z, background = view.tile.depth, view.tile.background
        measured = (rendered > 0) & (z > 0)
        seen = measured & (z > rendered - sensor.occlusion_margin_m)
        sample = view.samples * self.model.kappa * sensor.clutter_gain
        visible = np.array([seen.sum() / max(int(measured.sum()), 1)])
        boxes = float(self.model.clutter_detection(visible, view.detection, view.image_size, first)[0])
        if view.detection is None:
            through = measured & (z > rendered + sensor.occlusion_margin_m)
            empty = float(max(2 * int(through.sum()) - int(measured.sum()), 0))
            return view.share * (boxes - sample * empty)
        # what stands before the pose within the box is explained, too: it is the surface of the thing itself
        surprising = (background == 0) | (z < background - sensor.occlusion_margin_m)
        return view.share * (boxes + sample * float((measured & surprising).sum()))

    def _draw(
        self,
        shape: Shape,
        box: Array,
        z: float,
        observation: Observation,
        surroundings: Surroundings,
        n: int,
        rng: np.random.Generator,
    ) -> Array:
        """First poses (n, 4, 4): the paper's, and where there are level surfaces, half of them at rest on one.

        Half of furniture's are drawn to the planes that are seen (see `resting`).

        Args:
            shape: the class.
            box: (4,) detected, x, y, w, h.
            z: depth in its middle, metres.
            observation: the keyframe.
            surroundings: with the level surfaces.
            n: how many.
            rng: draws them.
        """
        camera, uniforms = observation.frame.camera, rng.random((n, 6 + UNIFORMS))
        low, high = _centre_region(box, (camera.width, camera.height), shape.reach_m / z)
        pixels = low + uniforms[:, :2] * (high - low)
        rays = camera.backproject(pixels[:, 0], pixels[:, 1], np.ones(n))
        # the centre lies behind the surface that is seen, by anything up to its extent
        behind = z + uniforms[:, 2] * np.abs(shape.mesh.vertices).max()
        anyhow = se3.make(se3.uniform_rotations(uniforms[:, 3:6]), behind[:, None] * rays)
        surfaces = tuple(s.moved(observation.frame.T_camera_world) for s in surroundings.supports)
        if not surfaces:
            return anyhow
        up = surfaces[0].normal
        resting = resting_poses(shape, rays, surfaces, observation.planes, up, uniforms[:, 6:])
        near = np.abs(resting[:, 2, 3] - z) < _REST_REACH * shape.reach_m
        if not _large(shape) or not len(shape.flats):
            resting = resting[near][: n // 2]
            return np.concatenate([resting, anyhow[: n - len(resting)]])
        resting = resting[near][: n // 4]
        half = slice(n - n // 2, n)
        snapped = snapped_poses(shape, anyhow[half, :3, 3], observation.planes, up, uniforms[half, 6:], rng)
        return np.concatenate([resting, anyhow[: n - len(resting) - len(snapped)], snapped])

    def _best(self, shape: Shape, view: View, poses: Array, n: int) -> Array:
        score, _ = self.score(shape, view, poses)
        return poses[np.argsort(-score, kind="stable")[:n]]

    def _refine(self, shape: Shape, view: View, poses: Array, widths: Array) -> Array:
        return refine_on_depth(shape.mesh, shape.normals, view.tile, poses, widths)[0]

    def _perturb(self, shape: Shape, view: View, poses: Array, rng: np.random.Generator) -> Array:
        """Starts around poses: half-turns about the box's axes and about what shows, and random turns and shifts."""
        turned = poses[:, None] @ se3.make(_HALF_TURNS[1:], np.zeros(3))
        noise = rng.normal(size=(len(poses), self.settings.perturbed_poses, 6))
        noise *= np.repeat([0.35, 0.2 * shape.radius_m], 3)
        around = retract(poses[:, None], noise)
        out = np.concatenate([turned, around], axis=1).reshape(-1, 4, 4)
        return np.concatenate([out, self._about_what_shows(shape, view, poses)])

    def _ways_round(self, shape: Shape, view: View, poses: Array) -> Array:
        """The best of poses (n, 4, 4) as turned by near-symmetries, and about what shows: (t, 4, 4)."""
        best = self._best(shape, view.coarse(), poses, 1)
        turned = best @ se3.make(shape.near_symmetries, np.zeros((len(shape.near_symmetries), 3)))
        return np.concatenate([turned, self._about_what_shows(shape, view, best)])

    def _about_what_shows(self, shape: Shape, view: View, poses: Array) -> Array:
        """Half-turns about the middle of what is seen of poses (n, 4, 4) that are mostly hidden: (<= 3 n, 4, 4).

        What shows may be another side of a thing that reaches elsewhere, and no turn about its centre leads there.
        """
        tile = view.tile
        z = Rasteriser().render(shape.mesh, tile.camera, poses).astype(np.float64)
        measured = (z > 0) & (tile.depth > 0)
        seen = measured & (np.abs(tile.depth - z) < self.model.config.sensor.occlusion_margin_m)
        n = seen.sum(axis=(1, 2))
        hidden = (n > 0) & (n < _MOSTLY_SEEN * measured.sum(axis=(1, 2)))
        at = np.indices(z.shape[1:]).astype(np.float64)
        points = tile.camera.backproject(at[1], at[0], z[hidden])
        middle = np.einsum("nhw,nhwi->ni", seen[hidden], points) / n[hidden, None]
        T = poses[hidden]
        there = se3.inverse(T) @ se3.make(np.eye(3), middle)
        there[:, :3, :3] = np.eye(3)
        turned = T[:, None] @ there[:, None] @ se3.make(_HALF_TURNS[1:], np.zeros(3)) @ se3.inverse(there)[:, None]
        return turned.reshape(-1, 4, 4)

    def _distinct(self, shape: Shape, poses: Array, score: Array, ways: Array, turns: bool) -> list[int]:
        """Rows of the best few poses (n, 4, 4), in turn or not, and those of the best turned as each of (t, 4, 4)."""
        rows = distinct(shape, poses, score, _ONE_POSE, len(poses))
        kept = (in_turn(shape, poses, score, rows) if turns else rows)[: self.settings.max_modes]
        for way in ways:
            there = symmetry.near(way, poses[rows], shape.symmetry, _ONE_WAY_ROUND_RAD, np.inf)
            if there.any() and rows[int(np.argmax(there))] not in kept:
                kept.append(rows[int(np.argmax(there))])
        return sorted(kept, key=lambda row: (-score[row], row))

    def _shape_of_score(
        self, shape: Shape, view: View, poses: Array, probe: bool, known: Sequence[Array | None]
    ) -> Array:
        """Covariances (n, 6, 6): how far the score lets a pose go along the axes of its normal equations.

        The normal equations alone are falsely certain: where the score is flat, faces that happen to be hit still pull.

        Args:
            shape: the class.
            view: where to look.
            poses: (n, 4, 4).
            probe: whether to look, or go by the normal equations.
            known: n, (6, 6) where `_climb` has seen the score's shape.
        """
        if not probe:
            return self._laplace(view.share * view.samples * self._hessian(shape, view, poses), _unit(shape))
        missing = [n for n, covariance in enumerate(known) if covariance is None]
        probed = iter(self._probed(shape, view, poses[missing]) if missing else ())
        return np.stack([next(probed) if covariance is None else covariance for covariance in known])

    def _probed(self, shape: Shape, view: View, poses: Array) -> Array:
        view = view.coarse()
        unit, directions = self._axes(shape, view, poses)
        around = np.concatenate([poses, _ladder(poses, directions * unit).reshape(-1, 4, 4)])
        depth = self.score(shape, view, around)[1].log_ratio
        return self._covariance(view, depth[: len(poses)], depth[len(poses) :], directions * unit)

    def _covariance(self, view: View, here: Array, there: Array, axes: Array) -> Array:
        """Covariances (n, 6, 6) by the depth's log ratio at poses (n,) and on their ladders (n 12 steps,)."""
        fall = here[:, None, None, None] - there.reshape(len(here), 6, 2, len(_LADDER_M))
        sigma = _widths(view.share * self.model.kappa * fall)
        return np.asarray(np.einsum("nd,ndi,ndj->nij", sigma**2, axes, axes))

    def _climb(self, shape: Shape, view: View, poses: Array) -> tuple[Array, dict[int, Array]]:
        """Poses (n, 4, 4) moved along their axes to where the score is larger, as long as that gains anything.

        Registration doesn't move a flat face along itself: what tells where its edges are is the silhouette. Hiding
        behind or under something is no gain: at least half of what was to be seen stays so. Not for what the detector
        doesn't see: something that was taken away would climb into hiding.

        Returns:
            The poses, and the covariance (6, 6) of each row that was looked around from and stayed.
        """
        view = view.coarse()
        poses = poses.copy()
        score, scores = self.score(shape, view, poses)
        least, depth = 0.5 * scores.visible, scores.log_ratio.copy()
        climbing = np.arange(len(poses))
        known: dict[int, Array] = {}
        for _ in range(_CLIMBS):
            unit, directions = self._axes(shape, view, poses[climbing])
            around = _ladder(poses[climbing], directions * unit).reshape(len(climbing), -1, 4, 4)
            there, scores = self.score(shape, view, around.reshape(-1, 4, 4))
            there_depth = scores.log_ratio.reshape(len(climbing), -1)
            in_sight = scores.visible.reshape(len(climbing), -1) >= least[climbing, None]
            there = np.where(in_sight, there.reshape(len(climbing), -1), -np.inf)
            best = np.argmax(there, axis=1)
            gains = there[np.arange(len(climbing)), best] > score[climbing] + _CLIMB_NATS
            top = climbing[~gains]
            shapes = self._covariance(view, depth[top], there_depth[~gains], (directions * unit)[~gains])
            known |= dict(zip(top.tolist(), shapes, strict=True))
            poses[climbing[gains]] = around[gains, best[gains]]
            score[climbing[gains]] = there[gains, best[gains]]
            depth[climbing[gains]] = there_depth[gains, best[gains]]
            climbing = climbing[gains]
            if not len(climbing):
                break
        return poses, known

    def _axes(self, shape: Shape, view: View, poses: Array) -> tuple[Array, Array]:
        """What turns metres into rad (6,), and the normal equations' axes (n, 6 directions, 6) so scaled."""
        unit = _unit(shape)
        hessian = self._hessian(shape, view, poses)
        return unit, np.linalg.eigh(hessian * unit[:, None] * unit)[1].swapaxes(-1, -2)

    def _hessian(self, shape: Shape, view: View, poses: Array) -> Array:
        return refine_on_depth(shape.mesh, shape.normals, view.tile, poses, self._fine[:1])[1]

    def _laplace(self, hessian: Array, unit: Array) -> Array:
        sensor = self.model.config.sensor
        scaled = hessian * unit[:, None] * unit * self.model.kappa / sensor.sigma_m**2
        scaled = scaled + np.eye(6) / _LADDER_M[-1] ** 2
        return np.linalg.inv(scaled) * unit[:, None] * unit


def in_turn(shape: Shape, poses: Array, score: Array, rows: list[int]) -> list[int]:
    """Rows reordered so that ways round that fit all but equally well take turns.

    Of two that a view can't tell apart, the one with more modes would have the ridges that depth leaves flat covered
    better, view by view, which says nothing of which it is.

    Args:
        shape: the class.
        poses: (n, 4, 4).
        score: (n,) nats.
        rows: of poses, the best first.
    """
    ways: list[list[int]] = []
    left = rows
    while left:
        alike = symmetry.near(poses[left[0]], poses[left], shape.symmetry, _ONE_WAY_ROUND_RAD, np.inf)
        ways.append([row for row, same in zip(left, alike, strict=True) if same])
        left = [row for row, same in zip(left, alike, strict=True) if not same]
    level = [way for way in ways if score[way[0]] > score[rows[0]] - _LEVEL]
    first = [row for turn in zip_longest(*level) for row in turn if row is not None]
    return first + [row for row in rows if row not in first]


def distinct(shape: Shape, poses: Array, score: Array, apart: tuple[float, float], most: int) -> list[int]:
    """Rows of the best poses that differ from each other, symmetry allowed for, the best first.

    Args:
        shape: the class.
        poses: (n, 4, 4).
        score: (n,)
        apart: rad and metres within which two poses are one.
        most: so many rows at most.
    """
    return symmetry.distinct(poses, np.argsort(-score, kind="stable"), most, shape.symmetry, *apart)


def _large(shape: Shape) -> bool:
    """Whether a class is furniture by its size: it needs more to be found."""
    return shape.reach_m > _SMALL_REACH_M


def _worth(shape: Shape, seen_m: float) -> float:
    """Effort for a class by its size: more for furniture, little for what could hardly look so large or so small.

    Something much smaller than its class would be seen may be hidden but for a part, so it is searched for, too.

    Args:
        shape: the class.
        seen_m: the box's diagonal at the depth of its middle, metres.
    """
    sides = np.sort(np.ptp(shape.mesh.vertices, axis=0))
    if seen_m < _UNLIKE * np.hypot(sides[0], sides[1]) or seen_m * _UNLIKE > 2.0 * shape.reach_m:
        return _LITTLE
    return _FURNITURE if _large(shape) else 1.0


def _unit(shape: Shape) -> Array:
    """(6,) a tangent of as many metres at the surface."""
    return np.repeat([1.0 / shape.radius_m, 1.0], 3)


def _ladder(poses: Array, axes: Array) -> Array:
    """Poses (n, 6, steps, 4, 4) both ways along axes (n, 6 directions, 6), whose unit is a metre at the surface."""
    steps = np.concatenate([_LADDER_M, -_LADDER_M])
    return retract(poses[:, None, None], axes[:, :, None] * steps[:, None])


def _centre_region(box: Array, image_size: tuple[int, int], nearness: float) -> tuple[Array, Array]:
    """Corners (2,) of where in the image a thing's centre may be, for a box (x, y, w, h).

    The paper's centre region; wider where a thing is so large for its distance (`nearness`, its reach over its depth)
    that its centre isn't seen in the middle of its box, and open to the side where the image's edge cuts the box.
    """
    share = min(1.0, CENTRE_REGION * (1.0 + nearness))
    middle, size, image = box[:2] + box[2:] / 2, box[2:], np.array(image_size)
    low, high = middle - share * size / 2, middle + share * size / 2
    low = np.where(box[:2] <= _EDGE_PX, -size / 2, low)
    high = np.where(box[:2] + size >= image - _EDGE_PX, image + size / 2, high)
    return low, high


def bounded(tile: Tile, box: Array) -> Tile:
    """The tile of a thing with a detected box (x, y, w, h): what is seen outside of the box is other things' surface.

    It is background there, so that no pose gains by explaining it.
    """
    margin = _BOX_SLACK * box[2:]
    low, high = box[:2] - margin, box[:2] + box[2:] + margin
    height, width = tile.depth.shape
    u, v = tile.x + tile.step * np.arange(width), tile.y + tile.step * np.arange(height)
    inside = ((v >= low[1]) & (v <= high[1]))[:, None] & ((u >= low[0]) & (u <= high[0]))
    nearer = (tile.depth > 0) & ((tile.background == 0) | (tile.depth < tile.background))
    return replace(tile, background=np.where(~inside & nearer, tile.depth, tile.background))


def _widths(drop: Array) -> Array:
    """Standard deviations (n, 6), scaled metres, from the log-likelihood's fall (n, 6, 2, steps), both ways along axes.

    The first step at which it falls by half a nat on the mean of both ways, one standard deviation of a Gaussian, tells
    the width by its parabola. Where the score is flat but for ripples, such as facets make, that is a ripple's width:
    the root mean square step, weighed by the likelihood of where it leads, is then the larger, and is taken.
    """
    both = drop.mean(axis=2)
    reached = both >= 0.5
    flat = ~reached.any(axis=-1)
    first = np.where(flat, len(_LADDER_M) - 1, np.argmax(reached, axis=-1))
    fall = np.maximum(np.take_along_axis(both, first[..., None], axis=-1)[..., 0], 0.5)
    parabola = _LADDER_M[first] / np.sqrt(2.0 * fall)
    steps = np.concatenate([[0.0], _LADDER_M])
    likelihood = np.exp(-np.maximum(drop, 0.0)).sum(axis=2)
    likelihood = np.concatenate([np.full((*likelihood.shape[:2], 1), 2.0), likelihood], axis=-1)
    square = np.trapezoid(likelihood * steps**2, steps) / np.trapezoid(likelihood, steps)
    return np.where(np.sqrt(square) > _RIPPLE * parabola, np.sqrt(square), parabola)


def _no_modes() -> PoseModes:
    return PoseModes(np.zeros(0))
