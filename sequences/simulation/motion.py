"""What happens from visit to visit, and in one: most things stay, some are taken elsewhere, the restless ones rather.

How likely a thing is to have been moved after a time follows the persistence model of CT-Map (Zeng et al., IROS 2018,
Equation 3, after Toris and Chernova, 2017): it stays with probability 1/2 + 1/2 exp(-dt / mu). A share of what is moved
leaves the place, and what is away comes back at the rate that keeps that share of everything away.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera
from sequences.errors import InputError
from sequences.rendering.scene import render_scene
from sequences.seeds import generator
from sequences.simulation.config import MotionConfig, SimulationConfig
from sequences.simulation.place import SEATS, Place, Placed
from sequences.simulation.shapes import Shape, clothed
from sequences.simulation.standing import put, shift
from sequences.simulation.trajectory import camera_path
from sequences.types import MoveKind, TrueMove

Array = NDArray[np.float64]
Where = dict[int, Placed]
"""inst_id -> where it is, for what is in the place"""

FIRST_VISIT_NS = 1_538_384_400_000_000_000  # 2018-10-01 09:00 UTC
ATTEMPTS = 20  # at putting all things somewhere
CLUTTER_PERSISTENCE_S = 24 * 3600.0
NUDGE_M, NUDGE_RAD = (0.02, 0.06), (0.05, 0.4)  # how far things are pushed and turned
NUDGES_TRIED, FRAMES_TRIED = 20, 4
VIEW_WIDTH, LEAST_PX = 80, 8  # a nudge is seen if so many pixels of a small image show the thing before and after


@dataclass(frozen=True)
class Arrangement:
    """What stands where from one frame of a visit on."""

    frame: int
    """position in the visit, 0-based"""
    things: tuple[Placed, ...]
    """of the truth, by inst_id"""
    clutter: tuple[Placed, ...]


@dataclass(frozen=True)
class Visit:
    """All of one visit's truth."""

    start_ns: int
    """UTC"""
    times_ns: NDArray[np.int64]
    """(n,) of its frames, since the start"""
    T_world_camera: Array
    """(n, 4, 4)"""
    furniture: tuple[Placed, ...]
    """as it looks in this visit: some may wear a cloth"""
    arrangements: tuple[Arrangement, ...]
    """the first from frame 0 on, one more after each nudge"""
    moves: tuple[TrueMove, ...]
    """since the visit before, and in this one; by time"""

    def episodes(self) -> Iterator[tuple[Arrangement, range]]:
        """Each arrangement with the frames through which it stands."""
        ends = [*(a.frame for a in self.arrangements[1:]), len(self.times_ns)]
        for arrangement, end in zip(self.arrangements, ends, strict=True):
            yield arrangement, range(arrangement.frame, end)


def arrange(place: Place, config: SimulationConfig, seed: int) -> tuple[Visit, ...]:
    """Where everything is, and what happens to it. Raises InputError where the place is too full."""
    visits: list[Visit] = []
    where, start, moves = _stock(place, config, seed), FIRST_VISIT_NS, list[TrueMove]()
    for k in range(config.motion.visits):
        if visits:
            end = start + int(visits[-1].times_ns[-1])
            start = end + _gap_ns(config.motion, seed, k)
            where, moves = _between(place, where, (end, start), config, seed, k)
        visit, where = _visit(place, where, start, moves, config, seed, k)
        visits.append(visit)
    return tuple(visits)


def _stock(place: Place, config: SimulationConfig, seed: int) -> Where:
    """Put every thing somewhere, but for what is away: the large ones first, as people do, and clutter at last."""
    without = ""
    for attempt in range(ATTEMPTS):
        where, without = _stocked(place, config, seed, attempt)
        if not without:
            return where
    raise InputError(
        f"found no free spot for {without}, one of {len(place.stock)} objects",
        field="place.objects",
        remedy="simulate fewer objects, or set a smaller place.clearance_m",
    )


def _stocked(place: Place, config: SimulationConfig, seed: int, attempt: int) -> tuple[Where, str]:
    """Where things are, and the name of the first that found no place, if any; clutter that finds none is left out."""
    bodies = place.loose
    away = 0.0 if config.motion.moves is not None else config.motion.away
    where: Where = {}
    for inst_id in sorted(bodies, key=lambda i: (i not in place.known, -_size(bodies[i].mesh.vertices))):
        if generator(seed, "simulation.away", inst_id).random() < away:
            continue
        rng = generator(seed, "simulation.stock", inst_id, attempt)
        placed = put(place, inst_id, tuple(where.values()), config.place, rng)
        if placed is not None:
            where[inst_id] = placed
        elif inst_id in place.known:
            return where, place.known[inst_id].object_class.name
    return where, ""


def _size(vertices: Array) -> float:
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def _gap_ns(config: MotionConfig, seed: int, visit: int) -> int:
    """How long nobody was there before a visit."""
    low, high = np.log([config.shortest_gap_h, config.longest_gap_h])
    drawn = float(np.exp(generator(seed, "simulation.gap", keyframe=visit).uniform(low, high)))
    return round((drawn if config.gap_h is None else config.gap_h) * 3600e9)


# --- between two visits ---


def _between(
    place: Place, before: Where, gap: tuple[int, int], config: SimulationConfig, seed: int, visit: int
) -> tuple[Where, list[TrueMove]]:
    """What is moved in a gap (start and end, ns): one thing after another, each where there is room by then."""
    where = dict(before)
    rng = generator(seed, "simulation.between", keyframe=visit)
    twins = _swapping(place, where, config.motion, rng)
    tried = [i for i in _restless(place, where, (gap[1] - gap[0]) * 1e-9, config.motion, seed, visit) if i not in twins]
    most = len(tried) if config.motion.moves is None else min(config.motion.moves, len(tried))
    times = iter(np.sort(rng.integers(gap[0] + 1, gap[1], most + 1)).tolist())
    moves: list[TrueMove] = []
    if twins:
        a, b = (where[i] for i in twins)
        where |= {a.inst_id: replace(b, inst_id=a.inst_id), b.inst_id: replace(a, inst_id=b.inst_id)}
        time = next(times)
        moves += [_move(place, i, visit, time, before[i], where[i]) for i in twins]
    done = 0
    for inst_id in tried:
        if done == most:
            break
        old = where.get(inst_id)
        new = _taken(place, inst_id, where, config, generator(seed, "simulation.motion", inst_id, visit))
        if new is old:
            continue  # it fits nowhere else
        done += 1
        time = next(times)
        where = {i: p for i, p in where.items() if i != inst_id} | ({} if new is None else {inst_id: new})
        if inst_id in place.known:
            moves.append(_move(place, inst_id, visit, time, old, new))
    return where, moves


def _swapping(place: Place, where: Where, config: MotionConfig, rng: np.random.Generator) -> tuple[int, ...]:
    """Two things of one class that take each other's place, or none."""
    there = [i for i in sorted(where) if i in place.known]
    pairs = [(i, j) for i, j in combinations(there, 2) if place.known[i] is place.known[j]]
    swap, which = rng.random() < config.swap_twins, rng.random()
    return pairs[int(which * len(pairs))] if swap and pairs else ()


def _restless(place: Place, where: Where, dt_s: float, config: MotionConfig, seed: int, visit: int) -> list[int]:
    """inst_ids of what is moved, each by its own chance; or of all that could be where the number of moves is given.

    In random order: with a given number drawn without replacement by the same chances.
    """
    leaves = {i: 0.5 * (1.0 - np.exp(-dt_s / _persistence_s(place, i))) for i in place.loose}
    rng = generator(seed, "simulation.restless", keyframe=visit)
    if config.moves is not None:
        known = [i for i in leaves if i in where and i in place.known]
        p = np.array([leaves[i] for i in known])
        return [known[int(k)] for k in rng.choice(len(known), len(known), replace=False, p=p / p.sum())]
    chances = {i: p if i in where else p * (1.0 - config.away) for i, p in leaves.items()}
    moved = [i for i, p in chances.items() if generator(seed, "simulation.leave", i, visit).random() < p]
    return [moved[int(k)] for k in rng.permutation(len(moved))]


def _persistence_s(place: Place, inst_id: int) -> float:
    known = place.known.get(inst_id)
    return CLUTTER_PERSISTENCE_S if known is None else known.object_class.persistence_s


def _taken(
    place: Place, inst_id: int, where: Where, config: SimulationConfig, rng: np.random.Generator
) -> Placed | None:
    """Where a thing goes that is moved; None out of the place. It stays away, or where it is, if there is no room."""
    old = where.get(inst_id)
    leaves = rng.random() < config.motion.away
    if old is not None and leaves and config.motion.moves is None:
        return None
    others = tuple(p for i, p in where.items() if i != inst_id)
    support = None if old is None else place.support(old)
    return put(place, inst_id, others, config.place, rng, leave=support) or old


def _move(place: Place, inst_id: int, visit: int, time_ns: int, old: Placed | None, new: Placed | None) -> TrueMove:
    kind: MoveKind = "appeared" if old is None else "vanished" if new is None else "moved"
    before, after = (None if p is None else place.support(p) for p in (old, new))
    return TrueMove(inst_id, visit, time_ns, kind, before, after)


# --- in a visit ---


def _visit(
    place: Place, where: Where, start_ns: int, moves: Sequence[TrueMove], config: SimulationConfig, seed: int, k: int
) -> tuple[Visit, Where]:
    """One visit, and where everything is at its end."""
    times, T_world_camera = camera_path(place, config.trajectory, seed, k)
    furniture = _dressed(place, config.place.cloth, seed, k)
    arrangements = [_arrangement(place, where, furniture, 0)]
    nudges: list[TrueMove] = []
    parts = np.array_split(np.arange(1, len(times)), max(config.motion.nudges, 1))[: config.motion.nudges]
    for j, part in enumerate(parts):
        rng = generator(seed, f"simulation.nudge.{k}", keyframe=j)
        for frame in rng.permutation(part)[:FRAMES_TRIED].tolist():
            views = T_world_camera[frame - 1 : frame + 1]
            pushed = _nudged(place, where, furniture, views, config, rng)
            if pushed is not None:
                where = {**where, pushed.inst_id: pushed}
                arrangements.append(_arrangement(place, where, furniture, frame))
                support, time = place.support(pushed), start_ns + int(times[frame - 1] + times[frame]) // 2
                nudges.append(TrueMove(pushed.inst_id, k, time, "nudged", support, support))
                break
    visit = Visit(start_ns, times, T_world_camera, furniture, tuple(arrangements), (*moves, *nudges))
    return visit, where


def _dressed(place: Place, cloth: float, seed: int, visit: int) -> tuple[Placed, ...]:
    """The furniture, that with a single top perhaps under a cloth."""
    dressed = []
    for piece in place.furniture:
        rng = generator(seed, "simulation.cloth", piece.inst_id, visit)
        shape = place.known[piece.inst_id]
        covered = len(shape.areas) == 1 and shape.object_class.name not in SEATS and rng.random() < cloth
        dressed.append(replace(piece, body=clothed(shape, rng)) if covered else piece)
    return tuple(dressed)


def _arrangement(place: Place, where: Where, furniture: Sequence[Placed], frame: int) -> Arrangement:
    lifted = {i: _lifted(place, where[i], furniture) for i in sorted(where)}
    things = tuple(p for i, p in lifted.items() if i in place.known)
    return Arrangement(frame, things, tuple(p for i, p in lifted.items() if i not in place.known))


def _lifted(place: Place, placed: Placed, furniture: Sequence[Placed]) -> Placed:
    """On the cloth, where what it stands on wears one."""
    k = place.surfaces[placed.surface].furniture
    body, bare = furniture[k].body, place.furniture[k].body
    if body is bare or not isinstance(body, Shape) or not isinstance(bare, Shape):
        return placed
    T = placed.T_world_object.copy()
    T[2, 3] += body.areas[0].centre[2] - bare.areas[0].centre[2]
    return replace(placed, T_world_object=T)


def _nudged(
    place: Place,
    where: Where,
    furniture: Sequence[Placed],
    views: Array,
    config: SimulationConfig,
    rng: np.random.Generator,
) -> Placed | None:
    """A thing of the truth pushed a little, and seen so from both views (2, 4, 4); None where nothing can be pushed."""
    scene = [*where.values(), *furniture]
    before = _pixels(scene, views[0], config)
    seen = [i for i in sorted(where) if i in place.known and before.get(i, 0) >= LEAST_PX]
    for _ in range(NUDGES_TRIED if seen else 0):
        inst_id = seen[int(rng.integers(len(seen)))]
        away, turn = rng.uniform(*NUDGE_M), rng.uniform(*NUDGE_RAD) * rng.choice([-1.0, 1.0])
        direction = rng.uniform(-np.pi, np.pi)
        metres = away * np.array([np.cos(direction), np.sin(direction)])
        others = tuple(p for i, p in where.items() if i != inst_id)
        pushed = shift(place, where[inst_id], others, config.place, metres, turn)
        if pushed is not None and _pixels([*others, pushed, *furniture], views[1], config).get(inst_id, 0) >= LEAST_PX:
            return pushed
    return None


def _pixels(scene: Sequence[Placed], T_world_camera: Array, config: SimulationConfig) -> Mapping[int, int]:
    """inst_id -> pixels of a small image that show it."""
    camera = config.sensor.camera
    step = camera.width // VIEW_WIDTH
    window: Camera = camera.window(0, 0, VIEW_WIDTH, camera.height // step, step)
    T_camera_world = se3.inverse(T_world_camera)
    item = render_scene([(p.body.mesh, T_camera_world @ p.T_world_object) for p in scene], window).item
    counts = np.bincount(item.ravel() + 1, minlength=len(scene) + 1)[1:]
    return {p.inst_id: int(n) for p, n in zip(scene, counts, strict=True)}
