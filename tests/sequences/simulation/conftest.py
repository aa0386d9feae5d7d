from collections.abc import Callable
from pathlib import Path

import pytest

from sequences.simulation import (
    MotionConfig,
    PlaceConfig,
    SensorConfig,
    SimulationConfig,
    TrajectoryConfig,
    simulate_place,
)

TINY = SimulationConfig(
    place=PlaceConfig(objects=4, twins=1, distractors=1, clutter=2, cloth=0.0),
    motion=MotionConfig(visits=2, moves=1, gap_h=4.0, nudges=1),
    trajectory=TrajectoryConfig(frames=6),
    sensor=SensorConfig(width=320, antialias=1),
)


@pytest.fixture(scope="session")
def tiny() -> SimulationConfig:
    """Two visits of six frames of 320 x 240 pixels, four things, one nudged in each visit."""
    return TINY


@pytest.fixture(scope="session")
def simulated(tmp_path_factory) -> Callable[[SimulationConfig, int], Path]:
    """The run of a configuration and a seed, simulated once a session."""
    made: dict[tuple[SimulationConfig, int], Path] = {}

    def simulate(config: SimulationConfig, seed: int) -> Path:
        if (config, seed) not in made:
            made[config, seed] = tmp_path_factory.mktemp("simulated") / "run"
            simulate_place(made[config, seed], config, seed)
        return made[config, seed]

    return simulate
