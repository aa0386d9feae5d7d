"""Simulated runs: rooms, things in them that move between visits, a robot's camera, a sensor and a detector.

Where a result comes from such a run it is called synthetic.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sequences.simulation.config import (
    DetectorConfig,
    LocalisationConfig,
    MotionConfig,
    PlaceConfig,
    SensorConfig,
    SimulationConfig,
    TrajectoryConfig,
)

if TYPE_CHECKING:
    from sequences.simulation.simulator import simulate_place

__all__ = [
    "DetectorConfig",
    "LocalisationConfig",
    "MotionConfig",
    "PlaceConfig",
    "SensorConfig",
    "SimulationConfig",
    "TrajectoryConfig",
    "simulate_place",
]


def __getattr__(name: str) -> Any:
    """Import the simulator when it is first used (PEP 562): its settings are wanted by all commands, it by few."""
    if name != "simulate_place":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sequences.simulation.simulator import simulate_place

    return simulate_place
