"""Depth renderers behind one protocol, and images of whole scenes."""

from collections.abc import Callable, Mapping

from sequences.rendering.protocol import DepthRenderer, Unavailable
from sequences.rendering.pyrender_ import Pyrender
from sequences.rendering.rasteriser import Rasteriser
from sequences.rendering.raycast import Raycaster
from sequences.rendering.scene import SceneImages, render_scene, shade

RENDERERS: Mapping[str, Callable[[], DepthRenderer]] = {kind.name: kind for kind in (Rasteriser, Raycaster, Pyrender)}
"""every renderer by its name"""

__all__ = ["RENDERERS", "DepthRenderer", "SceneImages", "Unavailable", "render_scene", "shade"]
