"""CT-Map on GTSAM: what was where and when, from recorded RGB-D runs.

The public names, each loaded when it is first used::

    from ctmap_gtsam import compare, filter_run, load_run, smooth_run

    run = load_run("recordings/kitchen")
    filtered = filter_run(run)
    print(compare(run, {"filter-ct": filtered, "smooth-ct": smooth_run(run, filtered)}).table())
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ctmap_gtsam.config import Config, load_config
    from ctmap_gtsam.estimate import Estimate
    from ctmap_gtsam.evaluation.comparison import compare
    from ctmap_gtsam.filtering.filter import filter_run
    from ctmap_gtsam.smoothing.lagged import lagged_run
    from ctmap_gtsam.smoothing.smoother import smooth_run
    from sequences.bop import load_run
    from sequences.errors import InputError
    from sequences.truth import load_truth

__all__ = [
    "Config",
    "Estimate",
    "InputError",
    "compare",
    "filter_run",
    "lagged_run",
    "load_config",
    "load_run",
    "load_truth",
    "smooth_run",
]

_HOMES = {
    "Config": "ctmap_gtsam.config",
    "Estimate": "ctmap_gtsam.estimate",
    "InputError": "sequences.errors",
    "compare": "ctmap_gtsam.evaluation.comparison",
    "filter_run": "ctmap_gtsam.filtering.filter",
    "lagged_run": "ctmap_gtsam.smoothing.lagged",
    "load_config": "ctmap_gtsam.config",
    "load_run": "sequences.bop",
    "load_truth": "sequences.truth",
    "smooth_run": "ctmap_gtsam.smoothing.smoother",
}


def __getattr__(name: str) -> Any:
    """Import a public name's module when the name is first used (PEP 562), so that `ctmap --help` imports none."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
