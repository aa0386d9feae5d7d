"""Every object pose and robot pose of the run in one GTSAM graph.

Variables: x_k, the camera at keyframe k; o_ik, object i at keyframe k where a mode measures it; b_iv, the error that
all depth measurements of object i in visit v share, so that a thousand frames don't make a millimetre of bias certain.
Factors: measurement modes, prediction, context and gauge (of free rotations) from `factors`; localisation and the
prior on b_iv from here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.solver import Solution, optimise
from factors import symmetry
from factors.custom import context_factor, custom_factor, gauge_factor, mode_factor, prediction_factor
from sequences import se3
from sequences.types import LocalisationNoise

Array = NDArray[np.float64]

_EXACT = np.repeat([1e-5, 1e-5], 3)
"""rad, metres: how well a camera pose is known that is recorded without error"""
_STRIDE = 1_000_000


@dataclass(frozen=True)
class Measured:
    """The mode that the trellis chose for an object at a keyframe."""

    keyframe: int
    time_s: float
    visit: int
    T_camera_centre: Array
    """(4, 4)"""
    covariance: Array
    """(6, 6) of its right tangent"""
    stays: bool
    """whether it is the same place as at the object's measurement before"""


@dataclass(frozen=True)
class Camera:
    """A recorded camera pose."""

    T_world_camera: Array
    """(4, 4)"""
    time_s: float
    visit: int


@dataclass
class SmootherGraph:
    """The graph, its initial values, and what each factor is."""

    graph: Any
    """gtsam.NonlinearFactorGraph"""
    initial: Any
    """gtsam.Values"""
    kinds: list[str] = field(default_factory=list)
    """one a factor: localisation, bias, measurement, prediction, context, gauge"""

    def add(self, kind: str, factor: Any) -> None:
        """Add a factor of a kind."""
        self.graph.add(factor)
        self.kinds.append(kind)

    def count(self) -> dict[str, int]:
        """Number of factors by kind."""
        return dict(Counter(self.kinds))

    def energy(self, values: Any) -> dict[str, float]:
        """Error by kind at given values, nats."""
        out: dict[str, float] = dict.fromkeys(self.kinds, 0.0)
        for i, kind in enumerate(self.kinds):
            out[kind] += self.graph.at(i).error(values)
        return out


@dataclass(frozen=True)
class Smoothed:
    """The solution in arrays."""

    solution: Solution
    T_world_camera: Array
    """(K, 4, 4)"""
    camera_covariance: Array
    """(K, 6, 6)"""
    objects: Mapping[int, Mapping[int, tuple[Array, Array]]]
    """object -> keyframe -> T_world_centre (4, 4) and covariance (6, 6)"""


def camera_key(keyframe: int) -> int:
    """x_k."""
    return int(gtsam.symbol("x", keyframe))


def object_key(row: int, keyframe: int) -> int:
    """o_ik."""
    return int(gtsam.symbol("o", row * _STRIDE + keyframe))


def bias_key(row: int, visit: int) -> int:
    """b_iv."""
    return int(gtsam.symbol("b", row * _STRIDE + visit))


def build(
    model: Model,
    cameras: Sequence[Camera],
    noise: LocalisationNoise,
    objects: Mapping[int, tuple[Shape, Sequence[Measured]]],
) -> SmootherGraph:
    """The graph of a run.

    Args:
        model: potentials.
        cameras: one a keyframe.
        noise: of the recorded poses.
        objects: object -> its class and chosen modes in order of time.
    """
    built = SmootherGraph(gtsam.NonlinearFactorGraph(), gtsam.Values())
    _add_cameras(built, cameras, noise)
    for row, (shape, measured) in objects.items():
        _add_object(built, model, row, shape, measured, cameras)
    if model.context:
        _add_context(built, model, objects)
    return built


def smooth(
    built: SmootherGraph, model: Model, objects: Mapping[int, tuple[Shape, Sequence[Measured]]], n: int
) -> Smoothed:
    """Solve and take the marginals; n is the number of keyframes."""
    settings = model.config.smoother
    solution = optimise(
        built.graph, built.initial, max_iterations=settings.max_iterations, tolerance=settings.tolerance
    )
    marginals = gtsam.Marginals(built.graph, solution.values)

    def read(key: int) -> tuple[Array, Array]:
        return solution.values.atPose3(key).matrix(), marginals.marginalCovariance(key)

    cameras = [read(camera_key(k)) for k in range(n)]
    poses = {
        row: {m.keyframe: read(object_key(row, m.keyframe)) for m in measured} for row, (_, measured) in objects.items()
    }
    return Smoothed(solution, np.stack([c[0] for c in cameras]), np.stack([c[1] for c in cameras]), poses)


def _add_cameras(built: SmootherGraph, cameras: Sequence[Camera], noise: LocalisationNoise) -> None:
    """Recorded poses with a stationary Gauss-Markov error a visit, e_k+1 = rho e_k + noise."""
    sigmas = np.repeat([noise.rotation_rad, noise.translation_m], 3)
    exact = not (sigmas > 0).all()
    sigmas = np.maximum(sigmas, _EXACT)
    for k, camera in enumerate(cameras):
        pose = gtsam.Pose3(camera.T_world_camera)
        built.initial.insert(camera_key(k), pose)
        before = cameras[k - 1] if k else None
        if exact or before is None or before.visit != camera.visit:
            model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            built.add("localisation", gtsam.PriorFactorPose3(camera_key(k), pose, model))
        else:
            rho = float(np.exp(-(camera.time_s - before.time_s) / max(noise.correlation_time_s, 1e-9)))
            built.add("localisation", _drift_factor(k, before, camera, rho, sigmas))


def _drift_factor(k: int, before: Camera, camera: Camera, rho: float, sigmas: Array) -> Any:
    """e_k - rho e_k-1 with e = log(recorded^-1 x): a between factor knows no error that decays."""
    inverse = [se3.inverse(c.T_world_camera) for c in (before, camera)]

    def function(values: list[Array], _need: bool) -> tuple[Array, Sequence[Array]]:
        e = [se3.log(T @ value) for T, value in zip(inverse, values, strict=True)]
        J = [se3.right_jacobian_inverse(x) for x in e]
        return e[1] - rho * e[0], (-rho * J[0], J[1])

    fresh = sigmas * np.sqrt(max(1.0 - rho**2, 1e-6))
    model = gtsam.noiseModel.Diagonal.Sigmas(fresh)
    return custom_factor(f"drift {k}", (camera_key(k - 1), camera_key(k)), model, function)


def _add_object(
    built: SmootherGraph, model: Model, row: int, shape: Shape, measured: Sequence[Measured], cameras: Sequence[Camera]
) -> None:
    S = shape.symmetry
    reference: Array | None = None
    before: Measured | None = None
    for m in measured:
        T = cameras[m.keyframe].T_world_camera @ m.T_camera_centre
        # one of the equivalent poses throughout: the bias lives in the object's tangent
        reference = T if reference is None else symmetry.nearest_image(reference, T, S)
        key = object_key(row, m.keyframe)
        built.initial.insert(key, gtsam.Pose3(reference))
        _add_bias(built, model, row, m.visit)
        mode = se3.inverse(cameras[m.keyframe].T_world_camera) @ reference
        name = f"object {row} keyframe {m.keyframe}"
        information = np.linalg.inv(m.covariance)
        bias = bias_key(row, m.visit)
        built.add(
            "measurement",
            mode_factor(f"mode of {name}", camera_key(m.keyframe), key, mode, information, S, key_bias=bias),
        )
        if S.free:
            built.add("gauge", gauge_factor(f"gauge of {name}", key, reference, S))
        if before is not None and m.stays:
            sigma = model.prediction_covariance(max(m.time_s - before.time_s, 1e-3))
            previous = object_key(row, before.keyframe)
            built.add("prediction", prediction_factor(f"prediction of {name}", previous, key, sigma, S))
        before = m


def _add_bias(built: SmootherGraph, model: Model, row: int, visit: int) -> None:
    key = bias_key(row, visit)
    if built.initial.exists(key):
        return
    settings = model.config.sensor
    sigmas = np.repeat([settings.bias_rotation_rad, settings.bias_translation_m], 3)
    built.initial.insert(key, np.zeros(6))
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    built.add("bias", gtsam.PriorFactorVector(key, np.zeros(6), noise))


def _add_context(built: SmootherGraph, model: Model, objects: Mapping[int, tuple[Shape, Sequence[Measured]]]) -> None:
    """Category context of related pairs, one fact spread over the keyframes that they share."""
    rows = sorted(objects)
    origin = np.zeros(3)
    for position, a in enumerate(rows):
        for b in rows[position + 1 :]:
            pair = model.relations[objects[a][0].index, objects[b][0].index]
            if pair.together <= 0.0:
                continue
            shared = sorted({m.keyframe for m in objects[a][1]} & {m.keyframe for m in objects[b][1]})
            for k in shared:
                name = f"context of objects {a} and {b} keyframe {k}"
                keys = object_key(a, k), object_key(b, k)
                factor = context_factor(name, *keys, (origin, origin), pair, keyframes=len(shared))
                built.add("context", factor)
