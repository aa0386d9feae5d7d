"""A whole run, from a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from sequences.simulation.detections import Detector
from sequences.simulation.lighting import LitScene, light, photograph
from sequences.simulation.localisation import recorded_poses
from sequences.simulation.motion import Arrangement, Visit, arrange
from sequences.simulation.place import Place, Placed, furnish
from sequences.simulation.sensor import DepthSensor, measure_colour
from sequences.simulation.shapes import Shape, catalogue
from sequences.simulation.surfaces import EXACT, Surfaces, surface_error
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
    ):
        for k, visit in enumerate(visits):
            _simulate_visit(writer.add_visit(k + 1), place, visit, config, seed, k, stage)


def _simulate_visit(
    writer: VisitWriter, place: Place, visit: Visit, config: SimulationConfig, seed: int, v: int, stage: Stage
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
            images, visible = scene.look(camera, T)
            depth = sensor.measure(scene.surfaces.view(images, camera, T), rng)
            colour = photograph(scene.lit, camera, T, config.sensor.antialias)
            writer.add_frame(
                im_id=k + 1,
                time_ns=visit.start_ns + int(visit.times_ns[k]),
                camera=camera,
                T_world_camera=recorded[k],
                depth=depth,
                colour=measure_colour(colour, config.sensor, rng),
                detections=detector.detect(k, [one for one in visible if one.inst_id not in scene.disguised]),
                truth=FrameTruth(T, scene.sightings(visible)),
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
class _Scene:
    """What stands still from one nudge to the next, ready to be drawn and measured from anywhere."""

    known: tuple[Placed, ...]
    """what the truth knows"""
    obj_ids: Mapping[int, int]
    supports: Mapping[int, int | None]
    disguised: frozenset[int]
    """inst_ids of what doesn't look as in the catalogue"""
    lit: LitScene
    surfaces: Surfaces

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
        items = [*((p.body.mesh, p.T_world_object) for p in bodies), (place.room.mesh, np.eye(4))]
        gloss = [*(p.body.gloss for p in bodies), 0.0]
        lamp = np.append(place.layout.size / 2.0, LAMP_HEIGHT_M)
        errors = [surface_error(p.inst_id, _extent_m(p.body.mesh), config, seed, v) for p in bodies]
        supports = {p.inst_id: place.support(p) for p in known}
        return cls(
            known=known,
            obj_ids=obj_ids,
            supports={i: s if s in obj_ids else None for i, s in supports.items()},
            disguised=frozenset(
                p.inst_id for p in known if p.body.mesh is not place.known[p.inst_id].object_class.mesh
            ),
            lit=light(items, lamp, place.room.window, gloss),
            surfaces=Surfaces(items, gloss, [*errors, EXACT]),
        )

    def look(self, camera: Camera, T_world_camera: Array) -> tuple[SceneImages, list[Visible]]:
        """What a camera really sees, and what shows of each thing that the truth knows."""
        T_camera_world = se3.inverse(T_world_camera)
        images = render_scene([(mesh, T_camera_world @ T) for mesh, T in self.lit.items], camera)
        things = [
            Thing(p.inst_id, self.obj_ids[p.inst_id], p.body.mesh, T_camera_world @ p.T_world_object)
            for p in self.known
        ]
        return images, look(things, images.item, camera)

    def sightings(self, visible: Sequence[Visible]) -> tuple[Sighting, ...]:
        """The truth of one image."""
        return tuple(
            Sighting(p.inst_id, v.obj_id, p.T_world_object, v.fraction, self.supports[p.inst_id], v.box)
            for p, v in zip(self.known, visible, strict=True)
        )


def _extent_m(mesh: Mesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
