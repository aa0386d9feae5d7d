"""What happens between two visits: most things stay, some are taken somewhere else, the restless ones rather.

How likely a thing is to have been moved after a time follows the persistence model of CT-Map (Zeng et al., IROS 2018,
Equation 2, after Toris and Chernova, 2017): it stays with probability 1/2 + 1/2 exp(-dt / mu).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sequences.seeds import generator
from sequences.simulation.config import MotionConfig, PlaceConfig
from sequences.simulation.place import Place, Placed, put, stock_place

FIRST_VISIT_NS = 1_538_384_400_000_000_000  # 2018-10-01 09:00 UTC


@dataclass(frozen=True)
class Arrangement:
    """One visit's truth."""

    start_ns: int
    """UTC"""
    things: tuple[Placed, ...]
    moved: tuple[int, ...]
    """inst_ids of what was moved since the visit before"""


def arrange(place: Place, place_config: PlaceConfig, config: MotionConfig, seed: int) -> tuple[Arrangement, ...]:
    """Where everything is at each visit. Raises InputError where the place is too full."""
    gap_ns = round(config.gap_h * 3600e9)
    visits = [Arrangement(FIRST_VISIT_NS, stock_place(place, place_config, seed), ())]
    for k in range(1, config.visits):
        rng = generator(seed, "simulation.motion", keyframe=k)
        before = {t.inst_id: t for t in visits[-1].things}
        things = dict(before)
        for inst_id in _restless_first(visits[-1].things, config, rng):
            if sum(things[i] is not before[i] for i in before) == config.moves:
                break
            old = before[inst_id]
            others = tuple(t for t in things.values() if t is not old)
            area = place.spots[old.spot].T_world_area
            # what fits on no other surface stays
            things[inst_id] = put(place, inst_id, old.shape, others, place_config, rng, avoid_area=area) or old
        moved = tuple(i for i in before if things[i] is not before[i])
        visits.append(Arrangement(FIRST_VISIT_NS + k * gap_ns, tuple(things.values()), moved))
    return tuple(visits)


def _restless_first(things: tuple[Placed, ...], config: MotionConfig, rng: np.random.Generator) -> list[int]:
    """inst_ids in random order, drawn without replacement by their probability of not having stayed."""
    persistence = np.array([t.shape.object_class.persistence_s for t in things])
    leave = 0.5 * (1.0 - np.exp(-config.gap_h * 3600.0 / persistence))
    order = rng.choice(len(things), size=len(things), replace=False, p=leave / leave.sum())
    return [things[int(k)].inst_id for k in order]
