"""A whole run, from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue, Mesh
from sequences.progress import SILENT, Progress, Stage
from sequences.rendering.scene import SceneImages, render_scene
from sequences.seeds import generator
from sequences.simulation.config import SensorConfig, SimulationConfig
from sequences.simulation.detections import Detector, Visible
from sequences.simulation.lighting import LitScene, light, photograph
from sequences.simulation.localisation import recorded_poses
from sequences.simulation.motion import Arrangement, arrange
from sequences.simulation.place import Place, Placed, furnish
from sequences.simulation.sensor import measure_colour, measure_depth
from sequences.simulation.shapes import catalogue
from sequences.simulation.trajectory import camera_path
from sequences.writing import FrameTruth, RunWriter, Sighting, VisitWriter

Array = NDArray[np.float64]

SOURCE = "simulation"
UP = np.array([0.0, 0.0, 1.0])
LAMP_M = (1.5, -1.3, 2.45)
SILHOUETTE_PX = 160  # a silhouette is counted on a grid of at most so many samples each way
NEAREST_M = 0.05  # vertices nearer than this say nothing of where a silhouette lies


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
    items = [(p.shape.object_class.mesh, p.T_world_object) for p in (*arrangement.things, *place.furniture)]
    scene = light([*items, (place.room, np.eye(4))], np.array(LAMP_M) * (place.side, 1.0, 1.0))
    times, T_world_camera = camera_path(place, config.trajectory, seed, visit)
    rng = generator(seed, "simulation.localisation", keyframe=visit)
    recorded = recorded_poses(T_world_camera, times, config.localisation.noise, rng)
    bias = _object_bias(placed, len(scene.items), config.sensor, seed, visit)
    things = {p.inst_id: p.shape.object_class.obj_id for p in placed}
    detector = Detector(classes, (camera.width, camera.height), config.detector, seed, visit, things, len(times))
    for k, T in enumerate(T_world_camera):
        rng = generator(seed, f"simulation.sensor.{visit}", keyframe=k)
        images, visible = _look(scene, placed, camera, T)
        cosine = _incidence(scene, images, camera, T)
        depth = measure_depth(images.depth, cosine, bias[images.item], config.sensor, rng)
        colour = photograph(scene, camera, T, config.sensor.antialias)
        sightings = [
            Sighting(p.inst_id, p.shape.object_class.obj_id, p.T_world_object, v.fraction)
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


def _object_bias(placed: Sequence[Placed], items: int, config: SensorConfig, seed: int, visit: int) -> Array:
    """(items + 1,) depth error of each thing, metres; 0 for what has no mesh and, at -1, for where nothing is."""
    bias = np.zeros(items + 1)
    for i, p in enumerate(placed):
        bias[i] = config.object_bias_m * generator(seed, "simulation.bias", p.inst_id, visit).standard_normal()
    return bias


def _look(
    scene: LitScene, placed: Sequence[Placed], camera: Camera, T_world_camera: Array
) -> tuple[SceneImages, list[Visible]]:
    """What a camera really sees, and for each thing its box (zeros where nothing of it shows) and visible share."""
    T_camera_world = se3.inverse(T_world_camera)
    items = [(mesh, T_camera_world @ T) for mesh, T in scene.items]
    images = render_scene(items, camera)
    boxes = find_objects(images.item + 1, max_label=len(placed))
    counts = np.bincount(images.item.ravel() + 1, minlength=len(placed) + 1)[1:]
    visible = [
        Visible(p.inst_id, p.shape.object_class.obj_id, _box(box), *_visible_shares(int(count), *item, camera))
        for p, item, box, count in zip(placed, items, boxes, counts, strict=False)
    ]
    return images, visible


def _box(slices: tuple[slice, slice] | None) -> tuple[float, float, float, float]:
    if slices is None:
        return (0.0, 0.0, 0.0, 0.0)
    rows, columns = slices
    return (float(columns.start), float(rows.start), float(columns.stop - columns.start), float(rows.stop - rows.start))


def _visible_shares(seen_px: int, mesh: Mesh, T_camera_object: Array, camera: Camera) -> tuple[float, float]:
    """What share of a thing's silhouette is visible: of all of it, and of the part in the image.

    As in BOP, "all" reaches out of the image by the image's own size each way. Large ones are counted on a coarse grid.
    """
    if seen_px == 0:
        return 0.0, 0.0
    points = se3.transform(T_camera_object, mesh.vertices)
    pixels = camera.project(points[points[:, 2] > NEAREST_M])
    size = np.array([camera.width, camera.height])
    low = np.floor(np.clip(pixels.min(axis=0), -size, size)).astype(int)
    high = np.ceil(np.clip(pixels.max(axis=0), 0, 2 * size)).astype(int)
    step = int(np.ceil((high - low + 1).max() / SILHOUETTE_PX))
    columns, rows = -(-(high - low + 1) // step)
    window = camera.window(int(low[0]), int(low[1]), int(columns), int(rows), step)
    silhouette = render_scene([(mesh, T_camera_object)], window).item >= 0
    u, v = low[0] + step * np.arange(columns), low[1] + step * np.arange(rows)
    inside = ((v >= 0) & (v < camera.height))[:, None] & (u >= 0) & (u < camera.width)
    seen = seen_px / step**2
    return min(1.0, seen / max(int(silhouette.sum()), 1)), min(1.0, seen / max(int((silhouette & inside).sum()), 1))


def _incidence(scene: LitScene, images: SceneImages, camera: Camera, T_world_camera: Array) -> Array:
    """(h, w) cosine of the angle between line of sight and surface normal."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = camera.backproject(u, v, np.ones(u.shape)) @ T_world_camera[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.abs(np.einsum("hwk,hwk->hw", rays, scene.face_normals(images)))
