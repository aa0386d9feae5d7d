"""What ran: stored with every result, so that a difference can be traced to a library."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = (
    "ctmap-gtsam",
    "gtsam",
    "numpy",
    "scipy",
    "numba",
    "trimesh",
    "opencv-python-headless",
    "open3d-cpu",
    "open3d",
    "pyrender",
)


def versions() -> dict[str, str]:
    """Name -> version of Python and of the packages that numbers may depend on, as far as they are installed."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
