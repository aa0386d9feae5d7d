"""What the benchmark does: its places, its rows, and the changes of the model. protocol.toml says it all."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ctmap_gtsam.config import Config
from ctmap_gtsam.evaluation import ceiling
from ctmap_gtsam.runtime.settings import merge, parse_assignments, to_dict
from sequences.errors import InputError
from sequences.seeds import generator
from sequences.simulation import SimulationConfig

PROTOCOL = Path(__file__).with_name("protocol.toml")
SETTINGS = Path(__file__).with_name("settings.toml")

MAIN = "main"
"""Name of the pass in which nothing is changed"""

CEILING = ceiling.NAME
"""Name of the row in which the truth's own map is scored"""

SETS = ("tuning", "reported")


@dataclass(frozen=True)
class Variant:
    """The main pass, or one in which the model is changed and the data are not."""

    name: str
    kind: Literal["main", "pass", "ablation"]
    summary: str = ""
    methods: tuple[str, ...] | None = None
    """None for all there are"""
    main: tuple[str, ...] = ()
    """rows of the main pass that these rows are held to, beside their own"""
    persistence: float = 1.0
    """factor on the catalogue's mu"""
    shuffled: bool = False
    """whether the catalogue's categories are permuted"""
    scale: tuple[tuple[str, float], ...] = ()
    """setting and factor"""
    set: tuple[str, ...] = ()
    """such as "keyframes.every=2" """

    def settings(self, config: Config) -> Config:
        """The settings that the estimators get."""
        scaled = [f"{path}={factor * _value(config, path)!r}" for path, factor in self.scale]
        return merge(config, parse_assignments((*scaled, *self.set)), f"{PROTOCOL.name}: {self.name}")


@dataclass(frozen=True)
class Place:
    """One simulated place."""

    seed: int
    simulation: SimulationConfig


@dataclass(frozen=True)
class Protocol:
    """What protocol.toml says."""

    sets: Mapping[str, tuple[int, ...]]
    """of SETS -> the seeds of its places"""
    quick: tuple[int, ...]
    """seeds of the few places of a quick look"""
    keyframes: tuple[int, int]
    """of a place, over all visits: least and most"""
    draws: Mapping[str, tuple[float, float]]
    """setting of [simulation] -> least and most"""
    paper: Mapping[str, float]
    """row -> mAP of the paper's Table I"""
    pairs: tuple[tuple[str, str], ...]
    """rows whose difference is shown, and the row that each is held to"""
    variants: Mapping[str, Variant]
    """by name, the main pass first"""

    def place(self, seed: int, config: Config) -> Place:
        """A place with its share of what is drawn, the rest as `config` has it."""
        rng = generator(seed, "bench.paper.place")
        drawn = {path: _draw(rng, low, high) for path, (low, high) in self.draws.items()}
        keyframes = _draw(rng, *self.keyframes)
        assignments = [f"{path}={value!r}" for path, value in drawn.items()]
        simulation = merge(config.simulation, parse_assignments(assignments), PROTOCOL)
        # rounded down, which stays within bounds that all numbers of visits divide
        trajectory = replace(simulation.trajectory, frames=int(keyframes // simulation.motion.visits))
        return Place(seed, replace(simulation, trajectory=trajectory))

    def choose(self, names: str) -> tuple[Variant, ...]:
        """The variants of a list "main,wrong-x4"; "ablations" and "passes" stand for all of them.

        Raises:
            InputError: there is none of the name.
        """
        groups = {
            f"{plural}": [v.name for v in self.variants.values() if v.kind == kind]
            for plural, kind in (("passes", "pass"), ("ablations", "ablation"))
        }
        wanted = {one for name in _listed(names) for one in groups.get(name, [name])}
        if unknown := sorted(wanted - self.variants.keys()):
            raise InputError(
                f"there is no pass {', '.join(unknown)}",
                field="--pass",
                remedy=f"choose of {', '.join([*self.variants, *groups])}",
            )
        return tuple(v for name, v in self.variants.items() if name in wanted)

    def seeds(self, text: str) -> tuple[int, ...]:
        """The seeds of "tuning", "reported", "quick", or of a list such as "0-4,7".

        Raises:
            InputError: it is none of these.
        """
        named = {**self.sets, "quick": self.quick}
        if text in named:
            return named[text]
        try:
            spans = [[int(end) for end in part.split("-")] for part in _listed(text)]
            found = [seed for span in spans for seed in range(span[0], span[-1] + 1)]
        except ValueError:
            found = []
        if not found or len(set(found)) < len(found):
            raise InputError(
                f"{text!r} names no seeds", field="--seeds", remedy=f"give one of {', '.join(named)}, or 0-4,7"
            )
        return tuple(found)

    def set_of(self, seeds: tuple[int, ...]) -> str | None:
        """The name of the set that holds all the seeds."""
        return next((name for name, members in self.sets.items() if set(seeds) <= set(members)), None)


@cache
def load_protocol(path: Path = PROTOCOL) -> Protocol:
    """Read protocol.toml."""
    said = tomllib.loads(path.read_text(encoding="utf-8"))
    places = said["places"]
    sets = {name: tuple(range(places[name][0], places[name][1] + 1)) for name in SETS}
    variants = [Variant(MAIN, "main")]
    variants += [_variant(name, "pass", about) for name, about in said["passes"].items()]
    variants += [_variant(name, "ablation", about) for name, about in said["ablations"].items()]
    return Protocol(
        sets=sets,
        quick=sets["tuning"][: places["quick"]],
        keyframes=tuple(places["keyframes"]),
        draws={name: tuple(span) for name, span in places["draws"].items()},
        paper=said["paper"],
        pairs=tuple((row, to) for row, to in said["differences"]["pairs"]),
        variants={v.name: v for v in variants},
    )


def _variant(name: str, kind: Literal["pass", "ablation"], about: Mapping[str, Any]) -> Variant:
    lists = {key: tuple(about[key]) for key in ("methods", "main", "set") if key in about}
    scale = tuple(about.get("scale", {}).items())
    return Variant(name=name, kind=kind, **{**about, **lists, "scale": scale})


def _draw(rng: np.random.Generator, low: float, high: float) -> float:
    """A whole number evenly, any other evenly in its logarithm (to three digits, as people write it)."""
    if isinstance(low, int) and isinstance(high, int):
        return int(rng.integers(low, high + 1))
    return float(f"{np.exp(rng.uniform(np.log(low), np.log(high))):.3g}")


def _value(config: Config, path: str) -> float:
    value: Any = to_dict(config)
    for name in path.split("."):
        value = value[name]
    return float(value)


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]
