"""Where a system library is missing, a reference renderer says which and how to get it."""

import sys

import numpy as np
import pytest

from sequences.errors import InputError
from sequences.rendering import RENDERERS, pyrender_
from sequences.rendering.raycast import Raycaster
from tests.sequences.rendering.shapes import SHAPES, WINDOW, mesh_of


def test_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    renderer = Raycaster()
    reason = renderer.available()
    assert reason is not None
    assert "apt-get install" in reason
    assert "libusb-1.0-0" in reason
    with pytest.raises(InputError, match="libusb"):
        renderer.render(mesh_of(SHAPES["box"]()), WINDOW, np.eye(4)[None])


def test_pyrender_without_a_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(pyrender_, "_loads", lambda platform: False)
    renderer, reason = pyrender_._open.__wrapped__()
    assert renderer is None
    assert "libegl1" in reason


def test_pyrender_that_fails_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    monkeypatch.setitem(sys.modules, "pyrender", None)
    renderer, reason = pyrender_._open.__wrapped__()
    assert renderer is None
    assert "by egl" in reason
    assert "libegl1" in reason


def test_the_rasteriser_needs_nothing() -> None:
    assert RENDERERS["rasteriser"]().available() is None
