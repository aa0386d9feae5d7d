"""pyrender (OpenGL by EGL or OSMesa): a reference for the rasteriser.

What had to be known about it:

- PyOpenGL chooses its platform once, when it is first imported: here EGL where libEGL loads, else OSMesa, unless
  `PYOPENGL_PLATFORM` says. pyrender 0.1.45 pins PyOpenGL 3.1.0, which can't import OSMesa: that path needs
  ``pip install --no-deps "PyOpenGL>=3.1.5"``.
- pyrender draws into a buffer of four samples and copies its depth into a single-sampled one. OpenGL leaves the outcome
  open, and Mesa under EGL gives depths of no surface at silhouettes. Here the first buffer has one sample too.
- When it renders depth alone it culls back faces whatever its flags and materials say. Here it doesn't.
- A second OffscreenRenderer in a process breaks the first, so there is one, resized as needed, used by one thread.
- `Scene.bounds` and all that needs it fails under NumPy 2 (`np.infty`); depth alone doesn't need it.
- OpenGL has pixel centres at halves, so the principal point moves by half a pixel.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.rendering.kernels import NEAR_M
from sequences.rendering.protocol import Unavailable

SYSTEM_PACKAGES = ("libegl1", "libgl1", "libxrender1")
"""Debian and Ubuntu packages that it needs (libxrender1 for its pyglet; software rendering comes with libegl1)"""

_LIBRARIES = {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6")}


class Pyrender:
    """pyrender behind the `DepthRenderer` protocol."""

    name = "pyrender"

    def available(self) -> str | None:
        """None where an OpenGL context can be made here, else why not."""
        return _open()[1]

    def render(self, mesh: Mesh, camera: Camera, T_camera_object: NDArray[np.float64]) -> NDArray[np.float32]:
        """See `DepthRenderer.render`."""
        offscreen, reason = _open()
        if reason:
            raise Unavailable(reason)
        import pyrender

        poses = np.asarray(T_camera_object, dtype=np.float64).reshape(-1, 4, 4)
        depth = np.zeros((len(poses), camera.height, camera.width), dtype=np.float32)
        radius = 1.01 * np.linalg.norm(mesh.vertices, axis=1).max(initial=0.0)
        scene, node, intrinsics = _scene(mesh, camera)
        offscreen.viewport_width, offscreen.viewport_height = camera.width, camera.height
        with _plain_depth():
            for k, pose in enumerate(poses):
                near, far = max(NEAR_M, pose[2, 3] - radius), pose[2, 3] + radius
                if far > near:  # a depth buffer has 24 bits: spend them on the object
                    intrinsics.znear, intrinsics.zfar = near, far
                    scene.set_pose(node, pose)
                    depth[k] = offscreen.render(scene, pyrender.RenderFlags.DEPTH_ONLY)
        return depth


def _scene(mesh: Mesh, camera: Camera) -> tuple[Any, Any, Any]:
    """A scene with one mesh, the mesh's node and the camera."""
    import pyrender

    primitive = pyrender.Primitive(
        positions=mesh.vertices.astype(np.float32),
        indices=mesh.faces.astype(np.uint32),
        mode=pyrender.GLTF.TRIANGLES,
    )
    scene = pyrender.Scene()
    node = scene.add(pyrender.Mesh([primitive]))
    intrinsics = pyrender.IntrinsicsCamera(camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    scene.add(intrinsics, pose=np.diag([1.0, -1.0, -1.0, 1.0]))  # OpenGL looks along -z, y up
    return scene, node, intrinsics


@contextmanager
def _plain_depth() -> Iterator[None]:
    """What pyrender draws inside has one sample a pixel and both sides of faces."""
    import pyrender.renderer as module

    storage, enable = module.glRenderbufferStorageMultisample, module.glEnable
    module.glRenderbufferStorageMultisample = lambda target, _, *rest: storage(target, 0, *rest)
    module.glEnable = lambda capability: None if capability == module.GL_CULL_FACE else enable(capability)
    try:
        yield
    finally:
        module.glRenderbufferStorageMultisample, module.glEnable = storage, enable


@cache
def _open() -> tuple[Any, str | None]:
    """The process's one offscreen renderer, or the reason why there is none."""
    remedy = f"apt-get install {' '.join(SYSTEM_PACKAGES)}"
    platform = os.environ.get("PYOPENGL_PLATFORM") or next((name for name in _LIBRARIES if _loads(name)), None)
    if platform is None:
        return None, f"neither EGL nor OSMesa is installed: {remedy}"
    os.environ["PYOPENGL_PLATFORM"] = platform
    try:
        import pyrender

        return pyrender.OffscreenRenderer(64, 64), None
    except Exception as error:  # PyOpenGL fails with whatever its platform's loader stumbles over
        return None, f"pyrender can't open an OpenGL context by {platform} ({error!r}): {remedy}"


def _loads(platform: str) -> bool:
    for library in _LIBRARIES[platform]:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False
