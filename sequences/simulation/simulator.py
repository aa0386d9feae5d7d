"""A whole run, from a seed."""

from __future__ import annotations

from collections.abc import Sequence
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
from sequences.simulation.motion import Arrangement, arrange
from sequences.simulation.place import Place, Placed, furnish
from sequences.simulation.sensor import DepthSensor, measure_colour
from sequences.simulation.shapes import catalogue
from sequences.simulation.surfaces import EXACT, Surfaces, surface_error
from sequences.simulation.trajectory import camera_path
from sequences.simulation.visibility import Thing, Visible, look
from sequences.writing import FrameTruth, RunWriter, Sighting, VisitWriter

Array = NDArray[np.float64]

SOURCE = "simulation"
UP = np.array([0.0, 0.0, 1.0])
LAMP_M = (1.5, -1.3, 2.45)


def simulate_place(out: Path, config: SimulationConfig, seed: int, progress: Progress = SILENT) -> None:
    """Write a simulated run with all its truth (docs/run-layout.md); the same seed gives the same bytes.

    Args:
        out: the run's folder; replaced only if it holds a simulated run.
        config: settings.
        seed: every draw comes from it.
        progress: is told of each frame.

    Raises:
        InputError: the folder is taken, or more things than fit.
    """
    place = furnish(config.place, seed)
    arrangements = arrange(place, config.place, config.motion, seed)
    classes = _known_classes(place, config)
    with (
        RunWriter(out, classes, source=SOURCE, up_world=UP, localisation=config.localisation.noise) as writer,
        progress.stage("simulate", total=len(arrangements) * config.trajectory.frames) as stage,
    ):
        for k, arrangement in enumerate(arrangements):
            _simulate_visit(writer.add_visit(k + 1), place, arrangement, config, seed, k, stage)


def _simulate_visit(
    writer: VisitWriter,
    place: Place,
    arrangement: Arrangement,
    config: SimulationConfig,
    seed: int,
    visit: int,
    stage: Stage,
) -> None:
    camera, classes = config.sensor.camera, _known_classes(place, config)
    placed = (*arrangement.things, *place.furniture) if config.place.known_furniture else arrangement.things
    items = [(p.shape.mesh, p.T_world_object) for p in (*arrangement.things, *place.furniture)]
    scene = light([*items, (place.room, np.eye(4))], np.array(LAMP_M) * (place.side, 1.0, 1.0))
    times, T_world_camera = camera_path(place, config.trajectory, seed, visit)
    rng = generator(seed, "simulation.localisation", keyframe=visit)
    recorded = recorded_poses(T_world_camera, times, config.localisation.noise, rng)
    surfaces = _surfaces((*arrangement.things, *place.furniture), place.room, config.sensor, seed, visit)
    sensor = DepthSensor(camera, config.sensor, seed)
    things = {p.inst_id: p.shape.object_class.obj_id for p in placed}
    detector = Detector(classes, (camera.width, camera.height), config.detector, seed, visit, things, len(times))
    for k, T in enumerate(T_world_camera):
        rng = generator(seed, f"simulation.sensor.{visit}", keyframe=k)
        images, visible = _look(scene, placed, camera, T)
        depth = sensor.measure(surfaces.view(images, camera, T), rng)
        colour = photograph(scene, camera, T, config.sensor.antialias)
        sightings = [
            Sighting(p.inst_id, p.shape.object_class.obj_id, p.T_world_object, v.fraction, visible_box=v.box)
            for p, v in zip(placed, visible, strict=True)
        ]
        writer.add_frame(
            im_id=k + 1,
            time_ns=arrangement.start_ns + int(times[k]),
            camera=camera,
            T_world_camera=recorded[k],
            depth=depth,
            colour=measure_colour(colour, config.sensor, rng),
            detections=detector.detect(k, visible),
            truth=FrameTruth(T, tuple(sightings)),
        )
        stage.advance()


def _known_classes(place: Place, config: SimulationConfig) -> Catalogue:
    """The catalogue of the run: furniture may be something that nobody modelled."""
    return catalogue(tuple(s for s in place.shapes if config.place.known_furniture or s.object_class.movable))


def _surfaces(bodies: Sequence[Placed], room: Mesh, config: SensorConfig, seed: int, visit: int) -> Surfaces:
    """What the sensor must know of everything that is drawn: things and furniture, then the room."""
    items = [(p.shape.mesh, p.T_world_object) for p in bodies]
    gloss = [p.shape.gloss for p in bodies]
    errors = [surface_error(p.inst_id, p.shape.object_class.diameter_m, config, seed, visit) for p in bodies]
    return Surfaces([*items, (room, np.eye(4))], [*gloss, 0.0], [*errors, EXACT])


def _look(
    scene: LitScene, placed: Sequence[Placed], camera: Camera, T_world_camera: Array
) -> tuple[SceneImages, list[Visible]]:
    """What a camera really sees, and what shows of each thing."""
    T_camera_world = se3.inverse(T_world_camera)
    images = render_scene([(mesh, T_camera_world @ T) for mesh, T in scene.items], camera)
    things = [
        Thing(p.inst_id, p.shape.object_class.obj_id, p.shape.mesh, T_camera_world @ p.T_world_object) for p in placed
    ]
    return images, look(things, images.item, camera)
