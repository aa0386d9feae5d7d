"""Simulated runs: a room's corner, things in it that move between visits, a robot's camera, a sensor and a detector.

Where a result comes from such a run it is called synthetic.
"""

from sequences.simulation.detections import DetectorConfig
from sequences.simulation.localisation import LocalisationConfig
from sequences.simulation.motion import MotionConfig
from sequences.simulation.place import PlaceConfig
from sequences.simulation.sensor import SensorConfig
from sequences.simulation.simulator import SimulationConfig, simulate_place
from sequences.simulation.trajectory import TrajectoryConfig

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
