"""A whole run, from a seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue, Mesh
from sequences.progress import SILENT, Progress, Stage
from sequences.rendering.scene import SceneImages, render_scene
from sequences.seeds import generator
from sequences.simulation.config import SensorConfig, SimulationConfig
from sequences.simulation.detections import Detector, Surroundings
from sequences.simulation.lighting import LitScene, light, photograph
from sequences.simulation.localisation import recorded_poses
from sequences.simulation.motion import Arrangement, Visit, arrange
from sequences.simulation.place import Place, Placed, furnish
from sequences.simulation.sensor import DepthSensor, measure_colour
from sequences.simulation.shapes import Shape, catalogue
from sequences.simulation.surfaces import EXACT, SurfaceError, Surfaces, surface_error
from sequences.simulation.visibility import Thing, Visible, look
from sequences.writing import FrameTruth, RunWriter, Sighting, VisitWriter

Array = NDArray[np.float64]

SOURCE = "simulation"
UP = np.array([0.0, 0.0, 1.0])
LAMP_HEIGHT_M = 2.45


def simulate_place(
    out: Path,
    config: SimulationConfig,
    seed: int,
    progress: Progress = SILENT,
    shapes: Sequence[Shape] | None = None,
) -> None:
    """Write a simulated run with all its truth (docs/run-layout.md); the same seed gives the same bytes.

    Args:
        out: the run's folder; replaced only if it holds a simulated run.
        config: settings.
        seed: every draw comes from it.
        progress: is told of each frame.
        shapes: what there is to choose from (`models.load_shapes`); the household where not given.

    Raises:
        InputError: the folder is taken, or more things than fit.
    """
    place = furnish(config.place, seed, shapes)
    visits = arrange(place, config, seed)
    classes = _known_classes(place, config)
    with (
        RunWriter(out, classes, source=SOURCE, up_world=UP, localisation=config.localisation.noise) as writer,
        progress.stage("simulate", total=len(visits) * config.trajectory.frames) as stage,
        ThreadPoolExecutor(1) as painter,
    ):
        for k, visit in enumerate(visits):
            _simulate_visit(writer.add_visit(k + 1), place, visit, config, seed, k, stage, painter)


def _simulate_visit(
    writer: VisitWriter,
    place: Place,
    visit: Visit,
    config: SimulationConfig,
    seed: int,
    v: int,
    stage: Stage,
    painter: Executor,
) -> None:
    camera, classes = config.sensor.camera, _known_classes(place, config)
    noise = config.localisation.noise
    rng = generator(seed, "simulation.localisation", keyframe=v)
    recorded = recorded_poses(visit.T_world_camera, visit.times_ns, noise, rng)
    sensor = DepthSensor(camera, config.sensor, seed)
    known = {i: shape.object_class.obj_id for i, shape in _in_catalogue(place, config).items()}
    detector = Detector(classes, (camera.width, camera.height), config.detector, seed, v, known, len(visit.times_ns))
    for arrangement, frames in visit.episodes():
        scene = _Scene.of(place, visit, arrangement, known, config.sensor, seed, v)
        for k in frames:
            T = visit.T_world_camera[k]
            rng = generator(seed, f"simulation.sensor.{v}", keyframe=k)
            colour = painter.submit(photograph, scene.lit, camera, T, config.sensor.antialias)  # half of all the work
            glimpse = scene.look(camera, T)
            depth = sensor.measure(scene.surfaces.view(glimpse.images, camera, T), rng)
            writer.add_frame(
                im_id=k + 1,
                time_ns=visit.start_ns + int(visit.times_ns[k]),
                camera=camera,
                T_world_camera=recorded[k],
                depth=depth,
                colour=measure_colour(colour.result(), config.sensor, rng),
                detections=detector.detect(k, glimpse.recognisable, glimpse.around),
                truth=FrameTruth(T, scene.sightings(glimpse.visible)),
            )
            stage.advance()
    for move in visit.moves:
        supports = (s if s in known else None for s in (move.from_support, move.to_support))
        writer.add_move(move.inst_id, move.time_ns, move.kind, *supports)


def _in_catalogue(place: Place, config: SimulationConfig) -> dict[int, Shape]:
    """inst_id -> shape of what the truth knows: furniture may be something that nobody modelled."""
    return {i: s for i, s in place.known.items() if config.place.known_furniture or not s.areas}


def _known_classes(place: Place, config: SimulationConfig) -> Catalogue:
    return catalogue(tuple(s for s in place.shapes if config.place.known_furniture or not s.areas))


@dataclass(frozen=True)
class Glimpse:
    """What an image shows, before any sensor or detector."""

    images: SceneImages
    visible: tuple[Visible, ...]
    """what the truth knows, shown or not"""
    recognisable: tuple[Visible, ...]
    """those that look as in the catalogue"""
    around: Surroundings


@dataclass(frozen=True)
class Watched:
    """All that detectors get to see of a place."""

    classes: Catalogue
    obj_ids: Mapping[int, int]
    """inst_id -> obj_id of all that the truth knows"""
    visits: tuple[tuple[int, Iterator[Glimpse]], ...]
    """the number of images of each visit, and what they show, drawn when asked for and not kept"""


def watch_place(config: SimulationConfig, seed: int, shapes: Sequence[Shape] | None = None) -> Watched:
    """What shows in each image of the place that `simulate_place` writes: no depth is measured, no colour drawn."""
    place = furnish(config.place, seed, shapes)
    known = {i: shape.object_class.obj_id for i, shape in _in_catalogue(place, config).items()}
    visits = tuple(
        (len(visit.times_ns), _watch_visit(place, visit, known, config, seed, v))
        for v, visit in enumerate(arrange(place, config, seed))
    )
    return Watched(_known_classes(place, config), known, visits)


def _watch_visit(
    place: Place, visit: Visit, known: Mapping[int, int], config: SimulationConfig, seed: int, v: int
) -> Iterator[Glimpse]:
    for arrangement, frames in visit.episodes():
        scene = _Scene.of(place, visit, arrangement, known, config.sensor, seed, v)
        for k in frames:
            yield scene.look(config.sensor.camera, visit.T_world_camera[k])


@dataclass(frozen=True)
class _Scene:
    """What stands still from one nudge to the next, ready to be drawn and measured from anywhere."""

    place: Place
    bodies: tuple[Placed, ...]
    """all that stands there, what the truth knows first"""
    known: tuple[Placed, ...]
    """what the truth knows"""
    clutter: frozenset[int]
    """inst_ids of what nobody modelled"""
    obj_ids: Mapping[int, int]
    supports: Mapping[int, int | None]
    disguised: frozenset[int]
    """inst_ids of what doesn't look as in the catalogue"""
    errors: tuple[SurfaceError, ...]
    """of the bodies' depth"""

    @classmethod
    def of(
        cls,
        place: Place,
        visit: Visit,
        arrangement: Arrangement,
        obj_ids: Mapping[int, int],
        config: SensorConfig,
        seed: int,
        v: int,
    ) -> _Scene:
        """The scene of a visit from one of its arrangements on; obj_ids are those of all that the truth knows."""
        bodies = (*arrangement.things, *visit.furniture, *arrangement.clutter)
        bodies = tuple(sorted(bodies, key=lambda p: p.inst_id not in obj_ids))  # known ones are drawn first
        known = tuple(p for p in bodies if p.inst_id in obj_ids)
        supports = {p.inst_id: place.support(p) for p in known}
        return cls(
            place=place,
            bodies=bodies,
            known=known,
            clutter=frozenset(p.inst_id for p in arrangement.clutter),
            obj_ids=obj_ids,
            supports={i: s if s in obj_ids else None for i, s in supports.items()},
            disguised=frozenset(
                p.inst_id for p in known if p.body.mesh is not place.known[p.inst_id].object_class.mesh
            ),
            errors=tuple(surface_error(p.inst_id, _extent_m(p.body.mesh), config, seed, v) for p in bodies),
        )

    @cached_property
    def items(self) -> tuple[tuple[Mesh, Array], ...]:
        """All that is drawn, with T_world_object (4, 4): the bodies, then the room."""
        return (*((p.body.mesh, p.T_world_object) for p in self.bodies), (self.place.room.mesh, np.eye(4)))

    @cached_property
    def gloss(self) -> tuple[float, ...]:
        """Of the items."""
        return (*(p.body.gloss for p in self.bodies), 0.0)

    @cached_property
    def lit(self) -> LitScene:
        """Ready for the colour camera."""
        lamp = np.append(self.place.layout.size / 2.0, LAMP_HEIGHT_M)
        return light(self.items, lamp, self.place.room.window, self.gloss)

    @cached_property
    def surfaces(self) -> Surfaces:
        """Ready for the depth sensor."""
        return Surfaces(self.items, self.gloss, [*self.errors, EXACT])

    def look(self, camera: Camera, T_world_camera: Array) -> Glimpse:
        """What a camera really sees."""
        T_camera_world = se3.inverse(T_world_camera)
        images = render_scene([(mesh, T_camera_world @ T) for mesh, T in self.items], camera)
        things = [
            Thing(p.inst_id, self.obj_ids.get(p.inst_id, 0), p.body.mesh, T_camera_world @ p.T_world_object)
            for p in self.bodies
        ]
        seen = look(things, images.item, camera)
        visible = tuple(seen[: len(self.known)])
        around = Surroundings(
            camera,
            T_world_camera,
            images.depth,
            images.item >= len(self.known),
            [v for v in seen if v.inst_id in self.clutter],
        )
        return Glimpse(images, visible, tuple(v for v in visible if v.inst_id not in self.disguised), around)

    def sightings(self, visible: Sequence[Visible]) -> tuple[Sighting, ...]:
        """The truth of one image."""
        return tuple(
            Sighting(p.inst_id, v.obj_id, p.T_world_object, v.fraction, self.supports[p.inst_id], v.box)
            for p, v in zip(self.known, visible, strict=True)
        )


def _extent_m(mesh: Mesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
