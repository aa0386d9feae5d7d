"""A class registered to the depth in a box, by ICP or by FPFH: the paper's baselines for poses, by Open3D.

The paper crops the point cloud by the box and registers the mesh to it, 50,000 iterations at most, and says no more.
Here the crop is registered to points of the mesh, which is inverted: each point that was seen has its like on the mesh,
while most of the mesh has none in the crop.

- ICP (Besl and McKay, A method for registration of 3-D shapes, PAMI 1992), point to point: it finds the next minimum
  from where it starts. It starts with the crop's centroid at the mesh's, from a few random orientations, and the best
  fit counts. (Point to plane is no better here and mostly ends in a cycle, never converging.)
- FPFH (Rusu et al., Fast point feature histograms (FPFH) for 3D registration, ICRA 2009): points of like features are
  paired and RANSAC takes the pose on which most of the crop lies on the mesh. Radii as in Open3D's tutorial.

All draws follow from the generator that is handed in. Open3D works with one thread meanwhile: its RANSAC draws, and
its sums add up, in the order in which threads happen to come.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.frontend.observation import centre_depth
from sequences import se3
from sequences.catalogue import Catalogue, Mesh
from sequences.rendering.raycast import Raycaster
from sequences.seeds import generator
from sequences.types import Frame

Array = NDArray[np.float64]
Kind = Literal["icp", "fpfh"]

_NORMAL_RADIUS, _FEATURE_RADIUS, _REACH = 2.0, 5.0, 1.5  # voxels
_NORMAL_NEIGHBOURS, _FEATURE_NEIGHBOURS = 30, 100  # at most
_EDGE_SIMILARITY = 0.9  # RANSAC's triangles of paired points have sides so alike
_CONFIDENCE = 0.999  # with which RANSAC may stop early
_CONVERGED = 1e-6  # relative change of fit and residual at which ICP stops


@dataclass(frozen=True)
class Registration:
    """Where a class fits a crop."""

    T_camera_object: Array
    """(4, 4)"""
    covariance: Array
    """(6, 6) of its right tangent, by the normal equations of point to plane, as if the points' errors were independent
    and the pairs right: sure of itself even where it is wrong"""


@dataclass(frozen=True)
class _Target:
    """Points of a class's mesh."""

    cloud: Any
    """open3d.geometry.PointCloud with normals, object frame"""
    features: Any
    """FPFH of each point; None for ICP"""
    voxel_m: float
    diameter_m: float


def obstacle() -> str | None:
    """None where Open3D can be loaded, else why not, with the remedy."""
    return Raycaster().available()


class Registrar:
    """Registers the classes of a catalogue. Holds the points of the meshes that it has met."""

    def __init__(self, kind: Kind, catalogue: Catalogue, config: Config) -> None:
        self._kind = kind
        self._catalogue = catalogue
        self._seed = config.seed
        self._sigma_m = config.sensor.sigma_m
        self._settings = config.baselines
        self._targets: dict[int, _Target] = {}

    def register(
        self, obj_id: int, frame: Frame, depth: NDArray[np.float32], box: Array, object_id: int
    ) -> Registration | None:
        """Register a class to a box of a depth image.

        Args:
            obj_id: the class.
            frame: of the image.
            depth: (h, w) metres.
            box: (4,) x, y, width, height, pixels.
            object_id: names the object whose draws these are.

        Returns:
            None where the box holds too little depth, or nothing fits.
        """
        points = crop(frame, depth, box, self._settings.crop_diameters * self._catalogue[obj_id].diameter_m)
        return self.register_points(obj_id, points, self._rng(object_id, frame.index))

    def register_points(self, obj_id: int, points: Array, rng: np.random.Generator) -> Registration | None:
        """Register a class to points (n, 3) in the camera frame; see `register`."""
        if len(points) < self._settings.min_points:
            return None
        with _repeatable(rng):
            target = self._target(obj_id)
            source = _thinned(points, target.voxel_m)
            if len(source.points) < self._settings.min_points:
                return None
            found = self._icp(source, target, rng) if self._kind == "icp" else self._fpfh(source, target)
        pairs = np.asarray(found.correspondence_set)
        if len(pairs) == 0:
            return None
        T_object_camera = np.array(found.transformation)
        return Registration(se3.inverse(T_object_camera), self._covariance(source, target, pairs, T_object_camera))

    def _icp(self, source: Any, target: _Target, rng: np.random.Generator) -> Any:
        reach = self._settings.icp_distance * target.diameter_m
        middle, centre = (np.asarray(c.points).mean(axis=0) for c in (target.cloud, source))
        rotations = se3.uniform_rotations(rng.random((self._settings.icp_starts, 3)))
        starts = se3.make(rotations, middle - rotations @ centre)
        found = [self._closest(source, target, reach, T) for T in starts]
        return max(found, key=lambda r: (r.fitness, -r.inlier_rmse))

    def _fpfh(self, source: Any, target: _Target) -> Any:
        from open3d.pipelines import registration as o3d

        _estimate_normals(source, target.voxel_m)
        reach = _REACH * target.voxel_m
        found = o3d.registration_ransac_based_on_feature_matching(
            source,
            target.cloud,
            _features(source, target.voxel_m),
            target.features,
            False,
            reach,
            o3d.TransformationEstimationPointToPoint(False),
            3,
            [
                o3d.CorrespondenceCheckerBasedOnEdgeLength(_EDGE_SIMILARITY),
                o3d.CorrespondenceCheckerBasedOnDistance(reach),
            ],
            o3d.RANSACConvergenceCriteria(self._settings.iterations, _CONFIDENCE),
        )
        if self._settings.fpfh_refine:
            return self._closest(source, target, reach, np.array(found.transformation))
        return found

    def _closest(self, source: Any, target: _Target, reach_m: float, T_object_camera: Array) -> Any:
        """ICP from a start (4, 4)."""
        from open3d.pipelines import registration as o3d

        return o3d.registration_icp(
            source,
            target.cloud,
            reach_m,
            T_object_camera,
            o3d.TransformationEstimationPointToPoint(False),
            o3d.ICPConvergenceCriteria(_CONVERGED, _CONVERGED, self._settings.iterations),
        )

    def _target(self, obj_id: int) -> _Target:
        if obj_id not in self._targets:
            self._targets[obj_id] = self._make_target(obj_id)
        return self._targets[obj_id]

    def _make_target(self, obj_id: int) -> _Target:
        settings, known = self._settings, self._catalogue[obj_id]
        voxel = max(settings.voxel * known.diameter_m, settings.min_voxel_m)
        rng = generator(self._seed, "baselines.mesh", obj_id)
        points, normals = surface_points(known.mesh, settings.mesh_points, rng)
        cloud = _thinned(points, voxel, normals)
        cloud.normalize_normals()
        return _Target(cloud, _features(cloud, voxel) if self._kind == "fpfh" else None, voxel, known.diameter_m)

    def _covariance(self, source: Any, target: _Target, pairs: NDArray[np.int32], T_object_camera: Array) -> Array:
        """(6, 6); what the pairs leave free is known to a turn and a diameter."""
        p = se3.transform(T_object_camera, np.asarray(source.points)[pairs[:, 0]])
        q, n = (np.asarray(a)[pairs[:, 1]] for a in (target.cloud.points, target.cloud.normals))
        J = np.concatenate([np.cross(p, n), n], axis=-1)
        variance = max(float(np.mean(((p - q) * n).sum(axis=-1) ** 2)), self._sigma_m**2)
        known = np.diag(np.repeat([np.pi, target.diameter_m], 3) ** -2.0)
        return np.linalg.inv(J.T @ J / variance + known)

    def _rng(self, object_id: int, frame: int) -> np.random.Generator:
        return generator(self._seed, f"baselines.{self._kind}", object_id, frame)


def crop(frame: Frame, depth: NDArray[np.float32], box: Array, reach_m: float) -> Array:
    """Points (n, 3) in the camera frame of the pixels in a box (x, y, width, height).

    With a reach, those that are further than it from the depth of the box's middle are left out, before and behind.
    """
    x, y, w, h = box
    low, high = np.clip([[x, y], [x + w, y + h]], 0.0, [frame.camera.width, frame.camera.height])
    columns, rows = (np.arange(int(np.ceil(a)), int(np.ceil(b))) for a, b in zip(low, high, strict=True))
    z = depth[np.ix_(rows, columns)].astype(np.float64)
    kept = z > 0
    middle = centre_depth(depth, box)
    if reach_m > 0.0 and middle > 0.0:
        kept &= np.abs(z - middle) < reach_m
    v, u = np.nonzero(kept)
    return frame.camera.backproject(columns[u].astype(np.float64), rows[v].astype(np.float64), z[kept])


def surface_points(mesh: Mesh, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (n, 3) uniform over a mesh's surface and the normals (n, 3) of their faces, object frame.

    Osada et al., Shape distributions, ACM Trans. Graphics 2002, Section 4.1.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=-1)
    face = np.searchsorted(np.cumsum(area), rng.random(n) * area.sum(), side="right").clip(max=len(area) - 1)
    r, s = np.sqrt(rng.random((n, 1))), rng.random((n, 1))
    points = (1.0 - r) * a[face] + r * (1.0 - s) * b[face] + r * s * c[face]
    return points, normals[face] / np.where(area > 0.0, area, 1.0)[face, None]


def _thinned(points: Array, voxel_m: float, normals: Array | None = None) -> Any:
    """A cloud with the mean of the points in each voxel."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(normals)
    return cloud.voxel_down_sample(voxel_m)


def _estimate_normals(cloud: Any, voxel_m: float) -> None:
    """Towards the camera, as a mesh's are to its outside."""
    import open3d

    radius = _NORMAL_RADIUS * voxel_m
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius, _NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(np.zeros(3))


def _features(cloud: Any, voxel_m: float) -> Any:
    import open3d

    around = open3d.geometry.KDTreeSearchParamHybrid(_FEATURE_RADIUS * voxel_m, _FEATURE_NEIGHBOURS)
    compute: Any = open3d.pipelines.registration.compute_fpfh_feature  # whose stub wants an argument more
    return compute(cloud, around)


@contextmanager
def _repeatable(rng: np.random.Generator) -> Iterator[None]:
    """One thread, Open3D's own draws from ours, and no word on a registration that fails."""
    from open3d import utility

    threads = utility.get_max_threads()
    utility.set_max_threads(1)
    try:
        with utility.VerbosityContextManager(utility.VerbosityLevel.Error):
            utility.random.seed(int(rng.integers(2**31)))
            yield
    finally:
        utility.set_max_threads(threads)
