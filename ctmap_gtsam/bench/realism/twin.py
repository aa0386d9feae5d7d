"""The synthetic twin of a real recording: what was before the real camera, measured by the simulator's sensor.

Real and simulated depth then differ by the sensor alone, not by distance, angle or shape.

What has no mesh is taken from the recorded depth itself: what stands before an object as it is, what is behind it from
around its silhouette. Albedo is the recorded image's. How an object shines nobody recorded: `GLOSS` says what is plain
to see.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, median_filter

from ctmap_gtsam.bench.realism.residuals import ELSE_M, Items
from sequences.camera import Camera
from sequences.rendering.scene import SceneImages
from sequences.seeds import generator
from sequences.simulation.config import SensorConfig
from sequences.simulation.sensor import DepthSensor, View
from sequences.simulation.surfaces import Surfaces, albedo, surface_error
from sequences.types import Depth, Frame, Run, Truth

Array = NDArray[np.float64]

GLOSS = {"mug": 0.6}
"""name of a class -> share of light that it mirrors; 0 for the others"""
RIM_PX = 6  # recorded depth so near to a silhouette may be the object's own
SMOOTH_PX = 3.0


class Twin:
    """Measures frames of a recording anew.

    Args:
        run: the recording.
        truth: about it.
        config: of the sensor.
        seed: every draw comes from it.
    """

    def __init__(self, run: Run, truth: Truth, config: SensorConfig, seed: int) -> None:
        self._run, self._truth, self._config, self._seed = run, truth, config, seed
        self._sensor = DepthSensor(run.frames[0].camera, config, seed)

    def measure(self, frame: Frame, items: Items, images: SceneImages) -> Depth:
        """Depth (h, w) that the simulated sensor gives, metres, 0 = no measurement."""
        rng = generator(self._seed, "bench.realism.twin", keyframe=frame.index)
        return self._sensor.measure(self.view(frame, items, images), rng)

    def view(self, frame: Frame, items: Items, images: SceneImages) -> View:
        """What lies before the sensor: the objects where they show, the recorded depth elsewhere."""
        objects = [o for o in self._truth.objects if frame.index in o.frames]
        classes = [self._run.catalogue[o.obj_id] for o in objects]
        errors = [
            surface_error(o.inst_id, c.diameter_m, self._config, self._seed, frame.visit)
            for o, c in zip(objects, classes, strict=True)
        ]
        surfaces = Surfaces(items, [GLOSS.get(c.name, 0.0) for c in classes], errors)
        drawn = surfaces.view(images, frame.camera, np.eye(4))
        recorded = frame.read_depth()
        before = (recorded > 0) & (images.item >= 0) & (recorded < images.depth - ELSE_M)
        ours = (images.item >= 0) & ~before
        around = _filled(recorded, binary_dilation(ours, iterations=RIM_PX) & ~before)
        depth = np.where(ours, images.depth, around).astype(np.float32)
        return replace(
            drawn,
            depth=depth,
            normal=np.where(ours[..., None], drawn.normal, _normals(around, frame.camera)),
            albedo=albedo(frame.read_colour()).astype(np.float32),
            gloss=np.where(ours, drawn.gloss, np.float32(0.0)),
            error_m=np.where(ours, drawn.error_m, np.float32(0.0)),
        )


def _filled(depth: Depth, unusable: NDArray[np.bool_]) -> Depth:
    """(h, w) without holes: each takes the depth of the nearest pixel that has one; noise smoothed away."""
    missing = (depth <= 0) | unusable
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(median_filter(depth[tuple(nearest)], 7))


def _normals(depth: Depth, camera: Camera) -> NDArray[np.float32]:
    """(h, w, 3) of the surface through a depth image, towards the camera."""
    points = camera.points(gaussian_filter(depth, SMOOTH_PX))
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    return normals.astype(np.float32)
