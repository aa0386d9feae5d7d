"""Open3D's RaycastingScene (Embree): a reference for the rasteriser.

The rays of all poses are moved into the object's frame and cast at once, so that a mesh's acceleration structure is
built once. Ray directions have z = 1 in the camera frame, which makes Open3D's hit distance the depth along z.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.protocol import Unavailable

SYSTEM_PACKAGES = ("libegl1", "libgl1", "libx11-6", "libusb-1.0-0", "libudev1", "libidn2-0")
"""Debian and Ubuntu packages that `import open3d` needs"""

_RAYS_AT_ONCE = 1 << 22  # 24 bytes each


class Raycaster:
    """Open3D behind the `DepthRenderer` protocol. Holds the acceleration structure of the last mesh."""

    name = "raycast"

    def __init__(self) -> None:
        self._mesh: Mesh | None = None
        self._scene: Any = None

    def available(self) -> str | None:
        """None where Open3D can be imported, else why not."""
        try:
            import open3d  # noqa: F401
        except (ImportError, OSError) as error:
            return f"Open3D can't be loaded ({error}): apt-get install {' '.join(SYSTEM_PACKAGES)}"
        return None

    def render(self, mesh: Mesh, camera: Camera, T_camera_object: NDArray[np.float64]) -> NDArray[np.float32]:
        """See `DepthRenderer.render`."""
        if reason := self.available():
            raise Unavailable(reason)
        if mesh is not self._mesh:
            self._mesh, self._scene = mesh, _scene(mesh)
        T_object_camera = se3.inverse(np.asarray(T_camera_object, dtype=np.float64).reshape(-1, 4, 4))
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        directions = camera.backproject(u.ravel(), v.ravel(), np.ones(u.size))
        depth = np.empty((len(T_object_camera), u.size), dtype=np.float32)
        chunk = max(1, _RAYS_AT_ONCE // u.size)
        for start in range(0, len(depth), chunk):
            depth[start : start + chunk] = _cast(self._scene, directions, T_object_camera[start : start + chunk])
        return depth.reshape(-1, camera.height, camera.width)


def _scene(mesh: Mesh) -> Any:
    import open3d

    tensor = open3d.core.Tensor.from_numpy
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    return scene


def _cast(scene: Any, directions: NDArray[np.float64], T_object_camera: NDArray[np.float64]) -> NDArray[np.float32]:
    """Directions (n, 3) with z = 1 in the camera frame, poses (K, 4, 4) -> depth (K, n)."""
    import open3d

    rays = np.empty((len(T_object_camera), len(directions), 6), dtype=np.float32)
    rays[..., :3] = T_object_camera[:, None, :3, 3]
    rays[..., 3:] = directions @ np.swapaxes(T_object_camera[:, :3, :3], -1, -2)
    hit: NDArray[np.float32] = scene.cast_rays(open3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
    return np.where(np.isfinite(hit), hit, np.float32(0.0))
