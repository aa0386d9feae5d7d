"""CT-Map as a fixed-lag smoother: keyframe t is estimated from all keyframes up to t + L, and from nothing later.

It walks the keyframes in order, behind a filter that names objects, classes and poses (see `seeding`) and that knows
the past alone. Each image is read once. What an object needs of it is a look, a tile of depth, and looks are kept while
the window holds them; of what is older each object keeps some that are spread over its life, and those that are left
out lend them their evidence. So the trellis of an object has a bounded number of stages, and a pose that comes up late
is tried on all views that are kept, as if it had been known. The graph is that of a window of keyframes, see `window`.
With a lag of 0 it is a filter on the smoother's factors.

Whatever an object is at a keyframe (class, box, joined to one that vanished) is what was believed L keyframes later.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.building import Tables, build_estimate
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.company import Company
from ctmap_gtsam.frontend.observation import Observation, observations
from ctmap_gtsam.frontend.place import Place, describe
from ctmap_gtsam.frontend.proposer import PoseModes, Proposer
from ctmap_gtsam.frontend.standing import with_supports
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import one_place_m
from ctmap_gtsam.smoothing.alternatives import exchanges
from ctmap_gtsam.smoothing.association import Expected, assign
from ctmap_gtsam.smoothing.belief import Thing, judge
from ctmap_gtsam.smoothing.graph import Camera
from ctmap_gtsam.smoothing.identity import duplicates, join_moved
from ctmap_gtsam.smoothing.modes import Look, Recording, Sighting, Wanted, box_depths, in_world, look, sight
from ctmap_gtsam.smoothing.rounds import camera_of, company_of, expected_of, neighbours_of, objects_of, wanted_of
from ctmap_gtsam.smoothing.seeding import Believed, believed, careful, news, remembered
from ctmap_gtsam.smoothing.solver import Solution
from ctmap_gtsam.smoothing.window import Window
from ctmap_gtsam.smoothing.writing import Told, note_class, note_graph, write_at
from sequences.geometry import Plane
from sequences.progress import SILENT, Progress
from sequences.types import Detection, Run

Array = NDArray[np.float64]


def lagged_run(
    run: Run,
    forward: Estimate,
    config: Config | None = None,
    *,
    lag: int | None = None,
    progress: Progress | None = None,
) -> Estimate:
    """The fixed-lag smoother over a run, from the hypotheses of a forward pass.

    Args:
        run: from `sequences.bop.load_run`.
        forward: what a filter says of the run, which for each keyframe hangs on those up to it. With a T-Map's the
            smoother knows nothing of relations between objects either.
        config: settings; None = the defaults.
        lag: keyframes; None = `smoother.lag`.
        progress: who is told how far it is.

    Returns:
        The estimate p(o_t | z_1:t+lag) at the forward pass's keyframes; of the last ones, p(o_t | z_1:T).

    Raises:
        ValueError: `forward` is of another run.
    """
    if forward.meta.get("fingerprint") != run.fingerprint:
        raise ValueError(f"the forward pass is of another run than {run.name}")
    config = config or Config()
    lag = config.smoother.lag if lag is None else lag
    context = not str(forward.meta["method"]).endswith("-t")
    walk = _Walk(run, forward, Proposer(Model(run.catalogue, config, context=context)), lag)
    keyframes = forward.keyframe_frame
    name = f"lag{'' if lag else '0'}-{'ct' if context else 't'}"
    with (progress or SILENT).stage(name, total=len(keyframes)) as stage:
        for observation in observations(run, keyframes, config.seed):
            walk.step(observation)
            stage.advance()
    return walk.estimate(name)


@dataclass
class _Object:
    """What is kept of one object between keyframes."""

    poses: dict[int, Array] = field(default_factory=dict)
    """class index -> (n, 4, 4) T_world_centre that the filter ever believed in, the latest first"""
    boxes: dict[int, Detection] = field(default_factory=dict)
    """by keyframe"""
    looks: dict[int, Look] = field(default_factory=dict)
    """by keyframe"""
    sightings: dict[int, Sighting] = field(default_factory=dict)
    """the modes of each look"""
    thing: Thing | None = None
    """what the trellis says of the sightings; None before the first"""

    def forget(self, keyframe: int, *, lend: bool) -> None:
        """Leave out a look; where it is to lend its evidence, the one before it counts for both."""
        if not lend:
            del self.looks[keyframe], self.sightings[keyframe]
            return
        before = max(k for k in self.looks if k < keyframe)
        a, b = self.looks[before].view, self.looks.pop(keyframe).view
        share = a.share + b.share
        self.looks[before] = replace(self.looks[before], view=replace(a, share=share))
        self.sightings[before] = _counting(self.sightings[before], share / max(a.share, 1e-9))
        del self.sightings[keyframe]

    def absorb(self, other: _Object) -> None:
        """Take over what was seen of the same object, at keyframes where only the other has a box."""
        for k, at in other.looks.items():
            if k in other.boxes and k not in self.boxes:
                self.looks[k], self.sightings[k] = at, other.sightings[k]
        self.boxes = other.boxes | self.boxes


def _counting(sighting: Sighting, times: float) -> Sighting:
    """A sighting as of a view that counts so many times as much."""

    def more(modes: PoseModes | None) -> PoseModes | None:
        return modes and PoseModes.of(
            modes.T_camera_centre,
            times * modes.log_likelihood,
            times * modes.depth_log_ratio,
            modes.covariance / times,
            times * modes.witness,
        )

    modes = tuple(more(m) for m in sighting.modes)
    return replace(sighting, modes=modes, log_clutter=times * sighting.log_clutter)


class _Walk:
    """The state after a keyframe, and what has been said so far."""

    def __init__(self, run: Run, forward: Estimate, proposer: Proposer, lag: int) -> None:
        self.model, self.proposer, self.forward, self.lag = proposer.model, proposer, forward, lag
        self.settings = self.model.config.smoother
        n = len(forward.keyframe_frame)
        # what other keyframes' images show is nobody's business here
        self.recording = Recording(run, forward.keyframe_frame, (), (), Place(run))
        self.recent: deque[Observation] = deque(maxlen=lag + self.model.config.frontend.start_after)
        """images in which an object that the filter has just begun with may have been before"""
        self.objects: dict[int, _Object] = {}
        self.twins: set[int] = set()
        """objects of the filter that have been found to be others"""
        self.cameras: list[Camera] = []
        self.up_before: Array | None = None
        """(3,) which way was up by the visits before"""
        self.company: dict[int, Company] = {}
        """visit -> who was moved together, by the keyframe before"""
        self.window = Window(lag + self.settings.window)
        self.surfaces: list[tuple[Plane, ...]] = []
        """at each keyframe"""
        self.tables = Tables(0, n, len(self.model.catalogue))
        self.rows: dict[int, int] = {}
        """object -> row of the tables"""
        self.T_world_camera = np.zeros((n, 4, 4))
        self.camera_covariance = np.zeros((n, 6, 6))
        self.ends: Counter[str] = Counter()
        self.solution: Solution | None = None
        """of the last window that didn't converge; of the last one where all did"""

    @property
    def things(self) -> dict[int, Thing]:
        """All objects of which anything was seen."""
        return {i: o.thing for i, o in sorted(self.objects.items()) if o.thing is not None}

    def step(self, observation: Observation) -> None:
        """Take in a keyframe and say what is then believed of the one that lies the lag before."""
        k, before = observation.keyframe, self.things
        self.cameras.append(camera_of(self.recording, k))
        if k == 0 or self.cameras[-1].visit != self.cameras[-2].visit:
            self.up_before = self.recording.place.up_world
        self.recording.place.update(observation)
        self.surfaces.append(self.recording.place.surfaces)
        self.recent.append(observation)
        now = {i: b for i, b in believed(self.forward, self.model, k).items() if i not in self.twins}
        self._let_go(now)
        new = now.keys() - self.objects.keys()
        self.objects |= {i: _Object() for i in new}
        self._assign(observation, now)
        for i in sorted(new):
            self.objects[i].poses = remembered(self.model, {}, now[i].poses)
            self._see_recent(i, now[i], {})
        around = self._around(k, before)
        changed = {i for i in now if i not in new and self._see(i, observation, now[i], around.without(i))}
        self._judge(changed | new)
        self._merge()
        if len(self.things) > 1:
            for i in sorted(new & self.objects.keys()):
                self._see_recent(i, now[i], self.things)
            self._judge(new & self.objects.keys())
        for o in self.objects.values():
            self._thin(o, k)
        self._say(k)

    def _let_go(self, now: Mapping[int, Believed]) -> None:
        """What the filter doesn't know any more it has taken for another object, where that is believed now."""
        for i in sorted(self.objects.keys() - now.keys()):
            gone = self.objects.pop(i)
            pose = None if gone.thing is None else gone.thing.pose_near(gone.thing.best_class, len(self.cameras))
            if gone.thing is None or pose is None:
                continue
            c = gone.thing.best_class
            reach = one_place_m(self.model.shapes[c], self.model.shapes[c])
            for j, b in now.items():
                there = j in self.objects and b.best_class == c
                if there and np.linalg.norm(b.poses[c][0, :3, 3] - pose[0, :3, 3]) < reach:
                    self.objects[j].absorb(gone)
                    self._judge({j})
                    break

    def _assign(self, observation: Observation, now: Mapping[int, Believed]) -> None:
        """Which box is whose: in this keyframe, and of new objects those of the last ones that are nobody's."""
        k = observation.keyframe
        there = {i: self._expected(i, k, b) for i, b in now.items()}
        for i, detection in assign(observation.frame, box_depths(observation), self.model, there).items():
            self.objects[i].boxes[k] = detection
        fresh = {i: there[i] for i in there if not self.objects[i].sightings}
        for earlier in list(self.recent)[:-1] if fresh else ():
            j = earlier.keyframe
            taken = {id(o.boxes[j]) for o in self.objects.values() if j in o.boxes}
            free = [n for n, d in enumerate(earlier.frame.detections) if id(d) not in taken]
            frame = replace(earlier.frame, detections=tuple(earlier.frame.detections[n] for n in free))
            for i, detection in assign(frame, box_depths(earlier)[free], self.model, fresh).items():
                self.objects[i].boxes[j] = detection

    def _expected(self, i: int, keyframe: int, b: Believed) -> Expected:
        thing = self.objects[i].thing
        known = None if thing is None or self._elsewhere(i, keyframe, b) else expected_of(thing, keyframe)
        return known or Expected(b.best_class, b.poses[b.best_class][0], b.class_probability, 1.0)

    def _elsewhere(self, i: int, keyframe: int, b: Believed) -> bool:
        """Whether the filter has an object in another place than the smoother: that is where to look."""
        o, c = self.objects[i], b.best_class
        pose = None if o.thing is None else o.thing.pose_near(o.thing.best_class, keyframe)
        if pose is None:
            return False
        apart = np.linalg.norm(b.poses[c][0, :3, 3] - pose[0, :3, 3])
        return bool(apart > self.model.shapes[c].reach_m)

    def _see(self, i: int, observation: Observation, b: Believed, around: Surroundings) -> bool:
        """Look at an object, among what was there a keyframe ago; whether it is in view."""
        o, k = self.objects[i], observation.keyframe
        wish = self._wish(i, k, b)
        fresh = news(self.model, o.poses, b.poses)
        o.poses = remembered(self.model, o.poses, fresh)
        last = o.looks[max(o.looks)] if o.looks else None
        at = look(observation, self.recording.time_s(k), self.proposer, wish, o.boxes.get(k), around, last)
        if fresh:
            self._look_again(o, fresh, wish.careful)
        if at is not None:
            o.looks[k], o.sightings[k] = at, sight(at, self.proposer, wish)
        return at is not None or bool(fresh)

    def _around(self, keyframe: int, there: Mapping[int, Thing]) -> Surroundings:
        neighbours = neighbours_of(there, keyframe, self.model)
        company = self.company.get(self.cameras[keyframe].visit, {})
        return Surroundings(neighbours, self.recording.place.surfaces, company)

    def _wish(self, i: int, keyframe: int, b: Believed) -> Wanted:
        """What the filter believes in at a keyframe, and what the smoother does."""
        thing = self.objects[i].thing
        own = None
        if thing is not None:
            latest = self.objects[i].sightings[max(self.objects[i].sightings)]
            own = wanted_of(thing, keyframe, self.model, self._modes_of(latest))
        if own is None:
            best = b.best_class
            return Wanted(self.objects[i].poses, (best, b.poses[best][0]), careful(b.poses, b.class_probability))
        starts = {c: np.concatenate([T, b.poses[c]]) if c in b.poses else T for c, T in own.starts.items()}
        where = (b.best_class, b.poses[b.best_class][0]) if self._elsewhere(i, keyframe, b) else own.expected
        return replace(own, starts={**b.poses, **starts}, expected=where)

    def _modes_of(self, sighting: Sighting | None) -> Callable[[int], Array]:
        """Class index -> (n, 4, 4) T_world_centre of a sighting's modes."""
        if sighting is None:
            return lambda c: np.zeros((0, 4, 4))
        T_world_camera = self.recording.T_world_camera(sighting.keyframe)
        return lambda c: in_world(sighting, c, T_world_camera)

    def _look_again(self, o: _Object, fresh: Mapping[int, Array], probed: frozenset[int]) -> None:
        """Try poses on all looks that are kept."""
        for k, at in o.looks.items():
            known = o.sightings[k]
            starts = {c: np.concatenate([in_world(known, c, at.T_world_camera), T]) for c, T in fresh.items()}
            o.sightings[k] = sight(at, self.proposer, Wanted(starts, None, probed), known)

    def _see_recent(self, i: int, b: Believed, there: Mapping[int, Thing]) -> None:
        """Look at a new object in the last images; at first it knows no neighbours, as it may be one of them."""
        o = self.objects[i]
        known, o.looks, o.sightings = o.sightings, {}, {}
        last: Look | None = None
        for observation in self.recent:
            k = observation.keyframe
            wish = self._wish_at_first(o, k, b, known)
            around = self._around(k, there).without(i)
            at = look(observation, self.recording.time_s(k), self.proposer, wish, o.boxes.get(k), around, last)
            if at is not None:
                o.looks[k], o.sightings[k] = at, sight(at, self.proposer, wish)
                last = at

    def _wish_at_first(self, o: _Object, keyframe: int, b: Believed, known: Mapping[int, Sighting]) -> Wanted:
        own = None
        if o.thing is not None:
            own = wanted_of(o.thing, keyframe, self.model, self._modes_of(known.get(keyframe)))
        best = b.best_class
        return own or Wanted(o.poses, (best, b.poses[best][0]), careful(b.poses, b.class_probability))

    def _judge(self, changed: set[int]) -> None:
        """Solve the trellises of objects with new sightings; smoothed poses hold as long as the class does."""
        for i in sorted(changed):
            o = self.objects[i]
            if not o.sightings:
                continue
            thing = judge(i, o.boxes.copy(), o.sightings.copy(), self.recording, self.model)
            if o.thing is not None and o.thing.best_class == thing.best_class:
                thing = thing.with_poses({k: p for k, p in o.thing.poses.items() if k in o.sightings})
            o.thing = thing

    def _merge(self) -> None:
        """Two objects in one place are one for good: the surer one."""
        for i in duplicates(self.things, self.model):
            del self.objects[i]
            self.twins.add(i)

    def _thin(self, o: _Object, keyframe: int) -> None:
        """Forget looks from before the window beyond those that are remembered: those that were least news."""
        first = keyframe + 1 - self.window.length
        while True:
            old = sorted(k for k in o.looks if k < first)
            if len(old) <= self.settings.remembered:
                return
            # the first stands for itself: it says where the object came from
            like = [k for a, k in pairwise(old[1:]) if self._alike(o, a, k)]
            o.forget(min(like or old[1:], key=lambda k: (o.looks[k].view.share, k)), lend=bool(like))

    def _alike(self, o: _Object, a: int, b: int) -> bool:
        """Whether two looks are of one visit, and both with a box or both without."""
        return (a in o.boxes) == (b in o.boxes) and self.cameras[a].visit == self.cameras[b].visit

    def _say(self, k: int) -> None:
        """Join what vanished to what appeared, solve the window, and write down the keyframe that is due."""
        things = join_moved(self.things, self.recording, self.model)
        things = {i: thing.with_poses(self._history(thing)) for i, thing in things.items()}
        first = self.window.first
        chosen = objects_of(things, self.recording, self.model)
        noise, place = self.recording.run.localisation, self.recording.place
        smoothed, self.window = self.window.solve(self.model, self.cameras, noise, chosen, self.company, place)
        self.ends[smoothed.solution.end] += 1
        if self.solution is None or self.solution.end == "converged" or smoothed.solution.end != "converged":
            self.solution = smoothed.solution
        for i, thing in things.items():
            # what more likely doesn't exist isn't smoothed, and where it was smoothed before is no guess for it
            poses = {**thing.poses, **smoothed.objects.get(i, {})} if thing.exists else {}
            things[i] = thing.with_poses({j: p for j, p in poses.items() if j in thing.sightings})
        visits = [camera.visit for camera in self.cameras]
        self.company = company_of(things, visits, self.up_before, self.model)
        for o in self.objects.values():
            _learn(o, things)
        last = k == len(self.recording.keyframes) - 1
        for due in range(max(k - self.lag, 0), k + 1 if last else k + 1 - self.lag):
            self.T_world_camera[due] = smoothed.T_world_camera[due - first]
            self.camera_covariance[due] = smoothed.camera_covariance[due - first]
            self._write(due, things)
            note_graph(self.tables, self.rows, smoothed.contributions, (due,))

    def _history(self, thing: Thing) -> dict[int, tuple[Array, Array]]:
        """Smoothed poses of an object that may be joined of several: of those sightings that are its own."""
        out: dict[int, tuple[Array, Array]] = {}
        for part in self.things.values():
            if part.best_class == thing.best_class:
                out |= {k: p for k, p in part.poses.items() if thing.sightings.get(k) is part.sightings[k]}
        return out

    def _write(self, keyframe: int, things: Mapping[int, Thing]) -> None:
        told = Told(self.recording, self.model, things, exchanges(things, self.recording, self.model))
        for i, thing in sorted(things.items()):
            if thing.reported_class not in thing.posteriors:
                continue
            if i not in self.rows:
                self.rows[i] = self.tables.grow()
                note_class(self.tables, self.rows[i], thing)
            T = self.T_world_camera[keyframe]
            write_at(self.tables, self.rows[i], keyframe, thing, told, T)

    def estimate(self, method: str) -> Estimate:
        """All that has been said."""
        diagnostics = {
            "hypotheses_scored": self.proposer.hypotheses_scored,
            "lag": self.lag,
            "windows": dict(sorted(self.ends.items())),
        }
        if self.solution is not None:
            diagnostics["solver"] = {"end": self.solution.end, "trace": list(self.solution.trace)}
        estimate = build_estimate(
            self.recording.run,
            self.model.config,
            method,
            self.recording.keyframes,
            list(self.rows),
            self.tables,
            self.T_world_camera,
            self.camera_covariance,
            {"diagnostics": diagnostics, **describe(self.recording.place)},
        )
        last = len(self.surfaces) - 1
        said = [self.surfaces[min(k + self.lag, last)] for k in range(len(self.surfaces))]
        return with_supports(estimate, self.model, said)


def _learn(o: _Object, things: Mapping[int, Thing]) -> None:
    """Take the smoothed poses of the object that it is, or is a part of."""
    own = o.thing
    if own is None:
        return
    mine: dict[int, tuple[Array, Array]] = {}
    for whole in things.values():
        if whole.best_class == own.best_class:
            mine |= {k: p for k, p in whole.poses.items() if own.sightings.get(k) is whole.sightings[k]}
    o.thing = own.with_poses(mine)
