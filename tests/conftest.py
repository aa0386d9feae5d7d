"""What the tests share: where the real recordings are, and how hypothesis runs."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from ctmap_gtsam.runtime.threads import limit_library_threads

limit_library_threads()  # as the command does, and before NumPy is imported

ROOT = Path(__file__).parents[1]
RECORDINGS = ("ycb_desk", "visp_rbt", "tum_cabinet")

# compiled kernels and slow machines make the first example long; the same examples every time make a failure repeatable
settings.register_profile(
    "ctmap", deadline=None, derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("ctmap")


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings: the environment variable CTMAP_DATA, else ../shared/data beside the checkout."""
    folder = Path(os.environ.get("CTMAP_DATA", ROOT.parent / "shared" / "data")).resolve()
    missing = [name for name in RECORDINGS if not (folder / name).is_dir()]
    if missing:
        pytest.skip(f"the real recordings {', '.join(missing)} are not in {folder}; set CTMAP_DATA to their folder")
    return folder
