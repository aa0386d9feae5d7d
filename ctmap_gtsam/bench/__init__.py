"""Measurements, by name: each is a module with `run(config, progress, ...) -> {"<method>.<figure>": value}`."""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

from ctmap_gtsam.config import Config
from ctmap_gtsam.runtime.versions import versions
from sequences.errors import InputError
from sequences.progress import SILENT, Progress

BENCHES = {
    name: f"ctmap_gtsam.bench.{name}" for name in ("detector", "highlight", "realism", "render", "solver", "spread")
}
BENCHES |= {name: f"ctmap_gtsam.bench.scaling.{name}" for name in ("filter", "smooth")}
"""Name -> module"""


def run_bench(name: str, config: Config, progress: Progress = SILENT, **options: Any) -> dict[str, Any]:
    """Measure once.

    Args:
        name: of the measurement.
        config: settings.
        progress: is told how far it is.
        options: of that measurement.

    Returns:
        {"schema": 1, "name", "figures": {"<method>.<figure>": value}, "seconds", "versions"}

    Raises:
        InputError: where there is no such measurement.
    """
    if name not in BENCHES:
        raise InputError(f"no measurement is called {name!r}", remedy=f"choose one of {', '.join(sorted(BENCHES))}")
    began = time.perf_counter()
    figures = import_module(BENCHES[name]).run(config, progress, **options)
    seconds = time.perf_counter() - began
    return {"schema": 1, "name": name, "figures": figures, "seconds": seconds, "versions": versions()}
