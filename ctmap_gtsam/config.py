"""All settings, as one tree of frozen dataclasses; `ctmap config` prints it as commented TOML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from ctmap_gtsam.parameters import (
    Baselines,
    Context,
    Detector,
    Filter,
    Frontend,
    Keyframes,
    Paper,
    Prediction,
    Sensor,
    Smoother,
)
from ctmap_gtsam.runtime import settings
from sequences.options import option
from sequences.simulation import SimulationConfig


@dataclass(frozen=True)
class Config:
    """The whole tree. One that is built is a valid one: InputError otherwise."""

    seed: int = option(0, "every random draw depends on this and on what it is for, nothing else", low=0)
    keyframes: Keyframes = field(default_factory=Keyframes)
    sensor: Sensor = field(default_factory=Sensor)
    detector: Detector = field(default_factory=Detector)
    prediction: Prediction = field(default_factory=Prediction)
    context: Context = field(default_factory=Context)
    frontend: Frontend = field(default_factory=Frontend)
    filter: Filter = field(default_factory=Filter)
    paper: Paper = field(default_factory=Paper)
    smoother: Smoother = field(default_factory=Smoother)
    baselines: Baselines = field(default_factory=Baselines)
    simulation: SimulationConfig = field(default_factory=SimulationConfig)

    def __post_init__(self) -> None:
        settings.check(self)


def load_config(path: Path | str | None = None, assignments: Iterable[str] = ()) -> Config:
    """Read settings: the defaults, changed by a TOML file, changed by assignments.

    Args:
        path: a TOML file as `ctmap config` prints it; it may hold only some of the settings.
        assignments: such as "filter.particles=500", as `--set` takes them; the later wins.

    Raises:
        InputError: for a file that can't be read, an unknown setting, a wrong type or a value out of bounds.
    """
    config = Config()
    if path is not None:
        config = settings.merge(config, settings.read_toml(Path(path)), Path(path))
    return settings.merge(config, settings.parse_assignments(assignments), "--set")
