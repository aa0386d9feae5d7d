"""What a depth renderer is. Three stand behind it and are held to each other by a conformance test."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.errors import InputError


class DepthRenderer(Protocol):
    """Depth images of one mesh at many poses, each pose alone in its image."""

    name: str

    def available(self) -> str | None:
        """None where it can render here, else the reason why not, with the remedy."""

    def render(self, mesh: Mesh, camera: Camera, T_camera_object: NDArray[np.float64]) -> NDArray[np.float32]:
        """Depth images (K, height, width), metres along z, 0 where nothing is.

        Args:
            mesh: faces are seen from both sides. What is nearer than `kernels.NEAR_M` is undefined.
            camera: pixel centres at whole numbers; part of an image, with a stride, is `Camera.window`.
            T_camera_object: (K, 4, 4), metres.

        Raises:
            Unavailable: where `available` gives a reason.
        """


class Unavailable(InputError):
    """A renderer's library, or a system library under it, is missing here."""
