"""Depth held to the true surface: residuals of every object in every frame, and what they say of the sensor.

The true surface is each object's mesh at its true pose, seen from the true camera. On real recordings neither pose nor
mesh is quite true, and what they are wrong by is in the residual. So every figure of shape (spread, tails, correlation)
is taken after a small rigid refit of each object in each frame to its own depth, alike for real and simulated
recordings. The figures of bias are taken before it: the real ones hold the truth's error too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from sequences import se3
from sequences.catalogue import Mesh
from sequences.rendering.scene import SceneImages, render_scene
from sequences.simulation.config import FOCAL_PX
from sequences.simulation.sensor import BASELINE_M
from sequences.types import Depth, Frame, Run, Truth

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Items = Sequence[tuple[Mesh, Array]]
Measurement = Callable[[Frame, Items, SceneImages], Depth]
"""What gives the depth (h, w) of a frame of which the truth has drawn the items, metres, 0 = no measurement"""

LAGS = (1, 2, 4, 8, 16)  # pixels of the image
BAND_PX = 3.0  # pixels of the sensor: nearer to the silhouette's rim is its edge band
ELSE_M = 0.03  # residuals beyond are of something else: what stands before it, what is behind
FLYING_M = 0.01
LEAST_PX = 150
LEAST_COSINE = 0.3  # below, a pose's error moves depth by more than a linear refit can tell
REFIT_RAD, REFIT_M = 0.05, 0.01  # sigma of the refit's prior
REFIT_ROUNDS = 9
CUTOFF = 4.0  # Tukey's biweight, robust sigmas
LEAST_SIGMA_M = 1e-6
LEAST_SPOTS = 30
FAR = 10.0  # robust sigmas: what is further off would decide a kurtosis alone
SPOT_M = 0.003  # edge of the cells in which spots of a surface are compared between frames


@dataclass(frozen=True)
class Glance:
    """One object in one frame: images (h, w) cut out around it."""

    thing: tuple[int, int]
    """visit and inst_id"""
    frame: int
    scale: float
    """pixels of the image a pixel of the sensor"""
    z: float
    """median true depth, metres"""
    raw: Array
    """measured minus true depth, metres; NaN where there is none, or of something else"""
    refitted: Array
    """the same after the refit; NaN outside the interior"""
    interior: Bools
    """its visible pixels away from the rim"""
    band: Bools
    """its visible pixels near the rim"""
    hole: Bools
    """no measurement"""
    flying: Bools
    """a measurement that is off by FLYING_M or more"""
    cosine: Array
    """of the angle of incidence"""
    points: Array
    """(h, w, 3) true surface, object frame, metres"""
    normal: NDArray[np.float32]
    """(h, w, 3) its unit normal, object frame"""
    T_camera_object: Array
    """(4, 4)"""

    @property
    def depth(self) -> Array:
        """(h, w) of the true surface, metres."""
        return self.points @ self.T_camera_object[2, :3] + self.T_camera_object[2, 3]

    def jacobian(self, centre: Array) -> Array:
        """By how much depth grows with the object's pose: (h, w, 6), metres per rad and per metre; 0 at grazing angles.

        A surface point p with normal n that moves by d meets its line of sight n.d / n.ray further away. The pose is
        perturbed from the right, about a centre (3,) of the object frame.
        """
        normal = self.normal.astype(np.float64)
        ray = (self.points - se3.inverse(self.T_camera_object)[:3, 3]) / np.maximum(self.depth, 1e-9)[..., None]
        towards = np.einsum("hwk,hwk->hw", normal, ray)[..., None]
        along = np.concatenate([np.cross(self.points - centre, normal), normal], axis=-1)
        flat = self.cosine[..., None] > LEAST_COSINE
        return np.divide(along, towards, out=np.zeros_like(along), where=flat & (towards != 0.0))

    @property
    def pixels_per_metre(self) -> float:
        """Disparity of the sensor for a small change of depth at z."""
        return FOCAL_PX * BASELINE_M / self.z**2


@dataclass(frozen=True)
class Picture:
    """One frame to look at: images (h, w)."""

    colour: NDArray[np.uint8]
    depth: Depth
    residual: Array
    """measured minus true depth, metres; NaN where no object shows, or nothing was measured"""
    ours: Bools
    """where an object shows"""


def picture(run: Run, truth: Truth, measured: Measurement) -> Picture:
    """The frame in which the movable objects cover most."""
    best = max(run.frames, key=lambda frame: _covered(run, truth, frame).sum())
    items, _ = true_items(run, truth, best)
    images, ours = render_scene(items, best.camera), _covered(run, truth, best)
    depth = measured(best, items, images)
    residual = np.where(ours & (depth > 0), depth.astype(np.float64) - images.depth, np.nan)
    return Picture(best.read_colour(), depth, residual, ours)


def _covered(run: Run, truth: Truth, frame: Frame) -> Bools:
    """(h, w) where a movable object would show."""
    items, which = true_items(run, truth, frame)
    movable = np.array([run.catalogue[truth.objects[k].obj_id].movable for k in which] + [False])
    return np.asarray(movable[render_scene(items, frame.camera).item])


def true_items(run: Run, truth: Truth, frame: Frame) -> tuple[Items, list[int]]:
    """What the truth has in a frame, as mesh and T_camera_object, and the position of each in `truth.objects`."""
    T_camera_world = se3.inverse(truth.T_world_camera[frame.index])
    items, which = [], []
    for k, o in enumerate(truth.objects):
        at = np.flatnonzero(o.frames == frame.index)
        if at.size:
            items.append((run.catalogue[o.obj_id].mesh, T_camera_world @ o.T_world_object[at[0]]))
            which.append(k)
    return items, which


def glances(run: Run, truth: Truth, every: int, measured: Measurement) -> Iterator[Glance]:
    """All movable objects that show well, in every so-many-th frame."""
    for frame in run.frames[::every]:
        items, which = true_items(run, truth, frame)
        images = render_scene(items, frame.camera)
        depth = measured(frame, items, images).astype(np.float64)
        for k, (item, o) in enumerate(zip(items, (truth.objects[w] for w in which), strict=True)):
            if run.catalogue[o.obj_id].movable:
                glance = _glance(frame, o.inst_id, item, images, k, depth)
                if glance is not None:
                    yield glance


def _glance(
    frame: Frame, inst_id: int, item: tuple[Mesh, Array], images: SceneImages, k: int, depth: Array
) -> Glance | None:
    whole = images.item == k
    if whole.sum() < LEAST_PX:
        return None
    camera, scale = frame.camera, frame.camera.fx / FOCAL_PX
    rows, columns = np.nonzero(whole)
    cut = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    mask, true, seen = whole[cut], images.depth[cut].astype(np.float64), depth[cut]
    v, u = np.mgrid[cut]
    ray = camera.backproject(u, v, np.ones(mask.shape))
    normal = _face_normals(*item)[np.where(mask, images.face[cut], 0)]
    residual = seen - true
    ours = mask & (seen > 0.0) & (np.abs(residual) < ELSE_M)
    interior = mask & (distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] > BAND_PX * scale)
    cosine = np.abs(np.einsum("hwk,hwk->hw", normal, ray)) / np.linalg.norm(ray, axis=-1)
    usable = ours & interior & (cosine > LEAST_COSINE)
    if usable.sum() < LEAST_PX:
        return None
    refitted = np.full(mask.shape, np.nan)
    refitted[usable] = _refit(residual[usable], true[usable], ray[usable], normal[usable])
    return Glance(
        thing=(frame.visit, inst_id),
        frame=frame.index,
        scale=scale,
        z=float(np.median(true[mask])),
        raw=np.where(ours, residual, np.nan),
        refitted=refitted,
        interior=interior,
        band=mask & ~interior,
        hole=mask & (seen <= 0.0),
        flying=mask & (seen > 0.0) & (np.abs(residual) > FLYING_M),
        cosine=cosine,
        points=se3.transform(se3.inverse(item[1]), ray * true[..., None]),
        normal=(normal @ item[1][:3, :3]).astype(np.float32),
        T_camera_object=item[1],
    )


def _face_normals(mesh: Mesh, T_camera_object: Array) -> Array:
    """(F, 3) unit normals, camera frame."""
    a, b, c = np.swapaxes(mesh.vertices[mesh.faces], 0, 1)
    normals = np.cross(b - a, c - a) @ T_camera_object[:3, :3].T
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30))


def _refit(residual: Array, depth: Array, ray: Array, normal: Array) -> Array:
    """Residuals (n,) of depth after the rigid motion of the surface that explains most of them.

    A surface point p with normal n that moves by w x p + v meets its line of sight n.(w x p + v) / n.ray further away.
    Robust (Tukey's biweight, reweighted, from wide to narrow); a wide Gaussian prior settles what depth can't tell.
    """
    points = ray * depth[:, None]
    towards = np.einsum("nk,nk->n", normal, ray)
    J = np.concatenate([np.cross(points - points.mean(axis=0), normal), normal], axis=1) / towards[:, None]
    # in the units of the prior all six parameters are alike
    J *= np.repeat([REFIT_RAD, REFIT_M], 3)
    motion = np.zeros(6)
    for k in range(REFIT_ROUNDS):
        left = residual - J @ motion
        sigma = max(robust_sigma(left), ELSE_M * 0.5**k)
        weight = np.maximum(1.0 - (left / (CUTOFF * sigma)) ** 2, 0.0) ** 2 / sigma**2
        motion = np.linalg.solve(J.T @ (weight[:, None] * J) + np.eye(6), J.T @ (weight * residual))
    return residual - J @ motion


def robust_sigma(values: Array) -> float:
    """Standard deviation by the median absolute deviation; NaN without values."""
    if values.size == 0:
        return float("nan")
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def standardised(values: Array) -> Array:
    """(n,) distances from the median in robust sigmas."""
    return (values - np.median(values)) / max(robust_sigma(values), LEAST_SIGMA_M)


def finite(values: Array) -> Array:
    """Those that aren't NaN, (n,)."""
    return values[np.isfinite(values)]


def figures(some: Sequence[Glance]) -> dict[str, float]:
    """All figures of one recording; lengths in millimetres, shares of pixels. See the module and docs/benchmarks.md."""
    refitted = [finite(g.refitted) for g in some]
    whole = np.concatenate(refitted)
    standard = np.concatenate([standardised(r) for r in refitted])
    near = standard[np.abs(standard) < FAR]
    out = {
        "z_m": float(np.mean([g.z for g in some])),
        "spread_mm": 1e3 * robust_sigma(whole),
        "spread_before_refit_mm": 1e3 * robust_sigma(np.concatenate([finite(g.raw[g.interior]) for g in some])),
        "spread_px": robust_sigma(np.concatenate([finite(g.refitted) * g.pixels_per_metre for g in some])),
        "beyond_5_mm": float((np.abs(whole - np.median(whole)) > 0.005).mean()),
        "beyond_3_sigma": float((np.abs(standard) > 3.0).mean()),
        "kurtosis": float((near**4).mean() / max((near**2).mean() ** 2, 1e-30)),
        "holes_interior": _share([g.hole for g in some], [g.interior for g in some]),
        "holes_edge": _share([g.hole for g in some], [g.band for g in some]),
        "flying_edge": _share([g.flying for g in some], [g.band & ~g.hole for g in some]),
    }
    out |= {f"correlation_{lag}": value for lag, value in zip(LAGS, autocorrelation(some, LAGS), strict=True)}
    return out | _bias(some) | {"lasting_mm": 1e3 * lasting(some)}


def _share(of: Sequence[Bools], among: Sequence[Bools]) -> float:
    total = sum(int(m.sum()) for m in among)
    return sum(int((m & n).sum()) for m, n in zip(of, among, strict=True)) / max(total, 1)


def _bias(some: Sequence[Glance]) -> dict[str, float]:
    """Mean residuals of object-frames before the refit: root mean square over things, and scatter within a thing."""
    by_thing: dict[tuple[int, int], list[float]] = {}
    for g in some:
        by_thing.setdefault(g.thing, []).append(float(np.nanmean(g.raw[g.interior])))
    means = np.array([np.mean(values) for values in by_thing.values()])
    within = [np.var(values) for values in by_thing.values()]
    return {"bias_mm": 1e3 * float(np.sqrt((means**2).mean())), "bias_within_mm": 1e3 * float(np.sqrt(np.mean(within)))}


def autocorrelation(some: Sequence[Glance], lags: Sequence[int]) -> list[float]:
    """Of refitted residuals, so many pixels apart along rows and columns; NaN where no object is as large."""
    maps = [g.refitted - np.nanmedian(g.refitted) for g in some]
    # a single far point must not decide
    limits = [CUTOFF * max(robust_sigma(finite(m)), LEAST_SIGMA_M) for m in maps]
    clipped = [np.clip(m, -limit, limit) for m, limit in zip(maps, limits, strict=True)]
    return [_correlation([p for m in clipped for p in _pairs(m, lag)]) for lag in lags]


def _pairs(m: Array, lag: int) -> list[tuple[Array, Array]]:
    return [(m[:, lag:], m[:, :-lag]), (m[lag:], m[:-lag])]


def _correlation(pairs: Sequence[tuple[Array, Array]]) -> float:
    product = left = right = 0.0
    for a, b in pairs:
        both = np.isfinite(a) & np.isfinite(b)
        product += float((a[both] * b[both]).sum())
        left += float((a[both] ** 2).sum())
        right += float((b[both] ** 2).sum())
    return product / np.sqrt(left * right) if left * right > 0.0 else float("nan")


def lasting(some: Sequence[Glance]) -> float:
    """Standard deviation, metres, of the part of the refitted residual that a spot of a surface keeps.

    Root of the mean product of a spot's residuals in two frames, at least a third of the recording apart.
    """
    by_thing: dict[tuple[int, int], list[tuple[int, dict[int, float]]]] = {}
    for g in some:
        by_thing.setdefault(g.thing, []).append((g.frame, _spots(g)))
    frames = np.array([g.frame for g in some])
    apart = float(np.ptp(frames)) / 3.0
    products = []
    for views in by_thing.values():
        for i, (frame, spots) in enumerate(views):
            for later, others in views[i + 1 :]:
                shared = spots.keys() & others.keys()
                if later - frame >= apart and len(shared) >= LEAST_SPOTS:
                    pairs = np.array([(spots[s], others[s]) for s in shared])
                    products.append(float((pairs - pairs.mean(axis=0)).prod(axis=1).mean()))
    return max(float(np.mean(products)), 0.0) ** 0.5 if products else float("nan")


def _spots(g: Glance) -> dict[int, float]:
    """Mean residual of each cell of the surface, cut at CUTOFF sigmas."""
    known = np.isfinite(g.refitted)
    limit = CUTOFF * max(robust_sigma(g.refitted[known]), LEAST_SIGMA_M)
    cell = np.floor(g.points[known] / SPOT_M).astype(np.int64) @ np.array([1, 2048, 2048**2])
    names, member = np.unique(cell, return_inverse=True)
    mean = np.bincount(member, np.clip(g.refitted[known], -limit, limit)) / np.bincount(member)
    return dict(zip(names.tolist(), mean.tolist(), strict=True))
