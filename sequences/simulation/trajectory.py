"""How the robot looks around: it drives past the furniture while its head pans from one piece to the next and back.

A tour is a list of stops. At each the head looks at one piece of furniture, along it from one side to the other, while
the robot drives past; between two it drives on and the head turns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from sequences import se3
from sequences.seeds import generator
from sequences.simulation.config import TrajectoryConfig
from sequences.simulation.place import Place, Placed

Array = NDArray[np.float64]

SPEED_M_S, TURN_RAD_S = 0.25, 0.5  # of the robot and of its head, on average between two stops
STOP_S = 2.0  # where there is time for it
ASIDE_RAD = 1.0  # how far to the side of a piece of furniture the robot may stand when it looks at it
DRIVE_M = 0.3  # about how far it drives from one look to the next, if it needn't drive further
SPREAD = 0.2  # of the distance to what it looks at
OFF_DISTANCE = 20.0  # rather a long way to drive than so many times the error of the distance
SWEEP = 0.2  # share of the furniture's width that the head sweeps, to either side of the middle
SWAY_M = 0.006  # of the head, up and down
TRIES = 300


@dataclass(frozen=True)
class _Look:
    """A moment of the tour."""

    eye: Array
    """(2,) where the camera is, world x and y"""
    target: Array
    """(3,) what it looks at, metres, world frame"""


def camera_path(place: Place, config: TrajectoryConfig, seed: int, visit: int) -> tuple[NDArray[np.int64], Array]:
    """The true path of one visit. The whole tour is made, at a quicker pace where there is little time for it.

    Args:
        place: where.
        config: settings.
        seed: the run's.
        visit: position of the visit, 0-based; each goes its own way.

    Returns:
        Times (n,) since the visit's start, nanoseconds, and T_world_camera (n, 4, 4), level.
    """
    rng = generator(seed, "simulation.trajectory", keyframe=visit)
    times = np.rint(np.arange(config.frames) * config.period_s * 1e9).astype(np.int64)
    duration = (config.frames - 1) * config.period_s
    looks, moments = _tour(place, config, duration, rng)
    at = np.arange(config.frames) / max(config.frames - 1, 1)
    eyes = np.stack([look.eye for look in looks])
    gaze = np.stack([_angles(look, config.height_m) for look in looks])
    xy, angles = PchipInterpolator(moments, eyes)(at), PchipInterpolator(moments, gaze)(at)
    sway = SWAY_M * np.sin(2 * np.pi * (rng.uniform(0.5, 1.0) * times * 1e-9 + rng.random()))
    return times, _looking(np.column_stack([xy, config.height_m + sway]), angles)


def _tour(
    place: Place, config: TrajectoryConfig, duration: float, rng: np.random.Generator
) -> tuple[list[_Look], Array]:
    """What is looked at from where, and when (m,) as a share of the visit: every piece, then any while time lasts."""
    looks: list[_Look] = []
    waits: list[float] = []
    eye = rng.uniform(place.layout.free_low, place.layout.free_high)
    for k, piece in enumerate(_order(place, rng)):
        stop = _stop(place, piece, eye, config, rng)
        transit = [_transit(looks[-1], stop[0], config)] if looks else []
        if k > len(place.furniture) and sum(waits) + sum(transit) + STOP_S > duration:
            break
        waits += [*transit, STOP_S]
        looks += stop
        eye = stop[-1].eye
    moments = np.concatenate([[0.0], np.cumsum(waits)])
    return looks, moments / moments[-1]


def _order(place: Place, rng: np.random.Generator) -> Iterator[Placed]:
    """Pieces of furniture to look at: all from one side to the other, then those that carry much rather than others."""
    pieces = sorted(place.furniture, key=lambda piece: _bearing(place, piece))
    order = pieces if rng.random() < 0.5 else pieces[::-1]
    yield from order
    worth = {p.inst_id: place.odds[k] * len(place.spots_on[k]) for k, p in enumerate(place.furniture)}
    now = order[-1]
    while True:
        rest = [p for p in place.furniture if p is not now] or [now]
        weights = np.array([worth[p.inst_id] for p in rest])
        now = rest[int(rng.choice(len(rest), p=weights / weights.sum()))]
        yield now


def _bearing(place: Place, piece: Placed) -> float:
    """Direction of a piece from the middle of the free floor, rad, 0 towards the back wall, clockwise."""
    x, y = piece.T_world_object[:2, 3] - (place.layout.free_low + place.layout.free_high) / 2.0
    return float(np.arctan2(x, y))


def _transit(a: _Look, b: _Look, config: TrajectoryConfig) -> float:
    """Seconds from one look to another."""
    turn = np.abs(_angles(a, config.height_m) - _angles(b, config.height_m)).max()
    return float(max(np.linalg.norm(a.eye - b.eye) / SPEED_M_S, turn / TURN_RAD_S, 0.5))


def _stop(place: Place, piece: Placed, eye: Array, config: TrajectoryConfig, rng: np.random.Generator) -> list[_Look]:
    """Two looks at a piece of furniture, at its one side and its other, from not far from where the robot is (2,)."""
    surfaces = [s for s in place.surfaces if place.furniture[s.furniture] is piece]
    middles = np.stack([s.T_world_area[:3, 3] for s in surfaces])
    T, width = surfaces[0].T_world_area, max(float(s.size[0]) for s in surfaces)
    centre = np.append(middles[:, :2].mean(axis=0), 0.0)
    low, high = middles[:, 2].min() + 0.05, middles[:, 2].max() + 0.05
    side, upside = rng.choice([-1.0, 1.0], 2)
    looks = []
    for end in (-side, side):
        height = (low + high) / 2.0 + end * upside * rng.uniform(0.1, 0.35) * (high - low)
        target = centre + end * SWEEP * width * T[:3, 0] + [0.0, 0.0, height]
        turn = rng.uniform(0.0, 2.0 * np.pi)
        eye = _stand(place, T, target, eye + DRIVE_M * np.array([np.cos(turn), np.sin(turn)]), config, rng)
        looks.append(_Look(eye, target))
    return looks


def _stand(
    place: Place, T_world_area: Array, target: Array, near: Array, config: TrajectoryConfig, rng: np.random.Generator
) -> Array:
    """(2,) where to look at a target from: on the free floor, near the wanted distance, and near a point (2,)."""
    down = config.height_m - target[2]
    angle = rng.uniform(-ASIDE_RAD, ASIDE_RAD, TRIES)[:, None]
    distance = config.distance_m * rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, TRIES)
    away = np.sqrt(np.maximum(distance**2 - down**2, 0.3))[:, None]
    out = np.sin(angle) * T_world_area[:2, 0] - np.cos(angle) * T_world_area[:2, 1]
    wanted = target[:2] + away * out
    eyes = np.clip(wanted, place.layout.free_low, place.layout.free_high)
    off = np.abs(np.hypot(np.linalg.norm(eyes - target[:2], axis=-1), down) - config.distance_m)
    cost = np.linalg.norm(eyes - near, axis=-1) + OFF_DISTANCE * np.maximum(off - SPREAD * config.distance_m, 0.0)
    return np.asarray(eyes[int(np.argmin(cost))])


def _angles(look: _Look, height: float) -> Array:
    """(2,) yaw and pitch of a look, rad: 0 is level towards the back wall, clockwise and up."""
    x, y, z = look.target - np.append(look.eye, height)
    return np.array([np.arctan2(x, y), np.arctan2(z, np.hypot(x, y))])


def _looking(eyes: Array, angles: Array) -> Array:
    """Level cameras (n, 4, 4) at `eyes` (n, 3), metres, that look along yaw and pitch (n, 2)."""
    yaw, pitch = angles[:, 0], angles[:, 1]
    forward = np.stack([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1)
    right = np.stack([np.cos(yaw), -np.sin(yaw), np.zeros_like(yaw)], axis=-1)
    return se3.make(np.stack([right, np.cross(forward, right), forward], axis=-1), eyes)
