"""Frames of things on a table, rendered: what the estimators are tried on where the answer is known."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.observation import Observation, observe
from ctmap_gtsam.model import Model
from ctmap_gtsam.runtime import settings
from ctmap_gtsam.shapes import Shape
from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Catalogue, Mesh
from sequences.geometry import Plane
from sequences.rendering.scene import render_scene
from sequences.simulation.shapes import catalogue, household
from sequences.types import Detection, Frame, LocalisationNoise, Run, Visit

CAMERA = Camera(285.0, 285.0, 159.5, 119.5, 320, 240)
UP = np.array([0.0, 0.0, 1.0])
CHEAP = ("frontend.fresh_poses=100", "frontend.refined_poses=8", "filter.particles=60")
"""settings with which estimators are quick and still themselves"""


def config_of(*assignments: str) -> Config:
    """The defaults, changed as `--set` changes them."""
    return settings.merge(Config(), settings.parse_assignments(assignments))


def classes(*names: str) -> Catalogue:
    """Some of the simulator's household, by ascending obj_id."""
    return catalogue(tuple(s for s in household() if s.object_class.name in names))


def model_of(*names: str, config: Config | None = None, context: bool = True) -> Model:
    """A model of some of the household."""
    return Model(classes(*names), config or Config(), context=context)


def shape_named(model: Model, name: str) -> Shape:
    return next(s for s in model.shapes if s.source.name == name)


def looking(yaw: float = 0.0, away: float = 0.7, pitch: float = 0.7, roll: float = 0.0) -> np.ndarray:
    """T_world_camera (4, 4) of a camera that looks at the origin from a distance, down by a pitch; world z is up."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    R = se3.so3_exp(np.array([0, 0, yaw])) @ level @ se3.so3_exp(np.array([-pitch, 0, 0]))
    R = R @ se3.so3_exp(np.array([0, 0, roll]))
    return se3.make(R, -away * R[:, 2])


def standing(shape: Shape, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """T_world_centre (4, 4) of a shape upright on the table z = 0."""
    low = shape.mesh.vertices[:, 2].min()
    return se3.make(se3.so3_exp(np.array([0, 0, yaw])), np.array([x, y, -low]))


def level(height: float, half: float = 0.6) -> Plane:
    """A level surface about the z axis, world frame."""
    hull = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return Plane(UP, height, se3.make(np.eye(3), height * UP), hull, 0.5)


def table(half: float = 0.6) -> Mesh:
    """The table's top, z = 0."""
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), np.full((4, 3), 90, dtype=np.uint8))


Items = Sequence[tuple[Shape, np.ndarray]]


def depth_of(items: Items, T_world_camera: np.ndarray, *, ground: bool = True, camera: Camera = CAMERA) -> np.ndarray:
    """Exact depth (h, w) of shapes at T_world_centre on the table."""
    T = se3.inverse(T_world_camera)
    things = [(shape.mesh, T @ pose) for shape, pose in items]
    return render_scene(things + ([(table(), T)] if ground else []), camera).depth


def box_of(shape: Shape, T_camera_centre: np.ndarray, camera: Camera = CAMERA) -> tuple[float, float, float, float]:
    """Box (x, y, w, h) of all that a shape covers, clipped to the image; no occlusion."""
    drawn = render_scene([(shape.mesh, T_camera_centre)], camera).depth > 0
    rows, columns = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    x, y = float(columns[0]), float(rows[0])
    return (x - 0.5, y - 0.5, columns[-1] - x + 1.0, rows[-1] - y + 1.0)


def detection_of(
    shape: Shape, T_camera_centre: np.ndarray, n_classes: int, score: float = 0.8, camera: Camera = CAMERA
) -> Detection:
    """A perfect box, and scores for the shape's own class."""
    scores = np.full(n_classes + 1, (1.0 - score) / n_classes)
    scores[1 + shape.index] = score
    return Detection(box_of(shape, T_camera_centre, camera), scores)


def frame_of(
    index: int,
    T_world_camera: np.ndarray,
    depth: np.ndarray,
    detections: Sequence[Detection] = (),
    *,
    visit: int = 0,
    time_s: float | None = None,
    camera: Camera = CAMERA,
) -> Frame:
    """A frame that lives in memory; half a second after the one before where no time is given."""
    return Frame(
        index=index,
        visit=visit,
        scene_id=visit + 1,
        im_id=index + 1,
        time_ns=round((0.5 * index if time_s is None else time_s) * 1e9),
        T_world_camera=T_world_camera,
        camera=camera,
        detections=tuple(detections),
        depth_path=Path("depth.png"),
        colour_path=None,
        read_depth=lambda: depth,
        read_colour=lambda: np.full((camera.height, camera.width, 3), 127, dtype=np.uint8),
    )


def view_of(model: Model, items: Items, T_world_camera: np.ndarray, index: int = 0, **options) -> Observation:
    """A keyframe of things on the table, each detected perfectly."""
    T = se3.inverse(T_world_camera)
    found = [detection_of(shape, T @ pose, len(model.shapes)) for shape, pose in items]
    depth = depth_of(items, T_world_camera)
    return observe(frame_of(index, T_world_camera, depth, found, **options), index, seed=0)


def run_of(catalogue: Catalogue, frames: Sequence[Frame], noise: LocalisationNoise | None = None) -> Run:
    """A run of frames that live in memory."""
    n = 1 + max(f.visit for f in frames)
    visits = tuple(Visit(v + 1, tuple(f for f in frames if f.visit == v), np.eye(4)) for v in range(n))
    return Run(Path("run"), "run", catalogue, visits, UP, noise or LocalisationNoise(), "fingerprint")


def small_run(
    names: Sequence[str] = ("mug", "soup_can"),
    others: Sequence[str] = ("banana",),
    *,
    frames: int = 6,
    visits: int = 1,
    seed: int = 0,
    seen: Callable[[int, str], bool] = lambda k, name: True,
    there: Callable[[int, str], bool] = lambda k, name: True,
    moved: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[Run, dict[str, np.ndarray]]:
    """A camera goes round a table with some things on it: the run, and T_world_object of each thing.

    Args:
        names: what stands on the table, at fixed spots.
        others: further classes of the catalogue.
        frames: images a visit, half a second apart.
        visits: an hour apart.
        seed: of the noise of depth, 1 mm, and boxes.
        seen: (frame, name) -> whether the detector finds it.
        there: (frame, name) -> whether it stands there.
        moved: where some things stand from the second visit on; the truth is that of the first.
    """
    model = model_of(*names, *others)
    rng = np.random.default_rng(seed)
    placed = {
        name: standing(shape_named(model, name), *spot, yaw)
        for name, spot, yaw in zip(names, ((-0.08, 0.0), (0.1, 0.03), (0.0, 0.16)), (0.4, 1.0, 2.0), strict=False)
    }
    made = []
    for k in range(frames * visits):
        T_world_camera = looking(0.12 * (k % frames) - 0.3, 0.75, 0.75)
        T = se3.inverse(T_world_camera)
        where = placed | {
            name: standing(shape_named(model, name), *spot) for name, spot in (moved or {}).items() if k >= frames
        }
        present = [(shape_named(model, name), where[name]) for name in names if there(k, name)]
        depth = depth_of(present, T_world_camera)
        depth = (depth + (depth > 0) * 0.001 * rng.normal(size=depth.shape)).astype(np.float32)
        found = [detection_of(s, T @ pose, len(model.shapes)) for s, pose in present if seen(k, s.source.name)]
        shaken = [Detection(tuple(np.array(d.box) + rng.normal(size=4)), d.class_scores) for d in found]
        time_s = 3600.0 * (k // frames) + 0.5 * (k % frames)
        made.append(frame_of(k, T_world_camera, depth, shaken, visit=k // frames, time_s=time_s))
    truth = {name: shape_named(model, name).to_object(T) for name, T in placed.items()}
    return run_of(model.catalogue, made), truth


def cut(run: Run, n: int) -> Run:
    """The first n frames of a run."""
    visits = tuple(replace(v, frames=tuple(f for f in v.frames if f.index < n)) for v in run.visits)
    return replace(run, visits=tuple(v for v in visits if v.frames))


def rows_of(estimate: Estimate, k: int) -> dict[int, tuple]:
    """What is said at keyframe k, by object id."""
    out = {}
    for row, i in enumerate(estimate.object_id):
        own = (estimate.modes.object == row) & (estimate.modes.keyframe == k)
        modes = {name: value[own] for name, value in vars(estimate.modes).items() if name not in ("object", "keyframe")}
        ledger = (estimate.ledger.object == row) & (estimate.ledger.keyframe == k)
        if own.any():
            out[int(i)] = (
                estimate.class_probability[row, k],
                estimate.existence[row, k],
                estimate.in_view[row, k],
                modes,
                estimate.ledger.nats[ledger],
            )
    return out


def assert_begins_with(whole: Estimate, part: Estimate) -> None:
    """Law 2 of the model: what is said of a keyframe hangs on the past alone."""
    n = len(part.keyframe_frame)
    assert list(part.keyframe_frame) == list(whole.keyframe_frame[:n])
    for k in range(n):
        all_, cut_ = rows_of(whole, k), rows_of(part, k)
        assert all_.keys() == cut_.keys()
        for i in all_:
            for a, b in zip(all_[i][:3] + all_[i][4:], cut_[i][:3] + cut_[i][4:], strict=True):
                np.testing.assert_array_equal(a, b)
            for name, value in all_[i][3].items():
                np.testing.assert_array_equal(value, cut_[i][3][name])


def assert_the_seed_decides(estimate: Callable[[int], Estimate], folder: Path) -> None:
    """The same seed gives the same bytes, another seed others."""
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        estimate(seed).save(folder / f"{name}.npz")
    a, b, c = ((folder / f"{name}.npz").read_bytes() for name in "abc")
    assert a == b
    assert a != c
