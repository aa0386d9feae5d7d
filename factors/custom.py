"""Potentials as GTSAM factors: the only module of this package that imports gtsam.

`gtsam.CustomFactor` crashes the interpreter where a Jacobian has a wrong shape or isn't written. `custom_factor` checks
every number that a Python function hands to GTSAM and raises an error with the factor's name instead; an exception
inside a callback passes through GTSAM's optimisers unchanged. NumPy arrays of any memory order and real type are handed
over as they mean.

Inside GTSAM's own optimisers a callback's cost grows with the size of Values; with `graph.linearize(values)` on Values
that Python owns it doesn't. A factor can't be copied or serialised: keep the numbers it was built from.

The factors' errors are the potentials' energies but for constants: error = c - log potential, with c the potential's
`mixture.log_constant`, or for context its peak.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors import context, measurement, mixture
from factors.symmetry import NONE, Symmetry, gauge_residual, reduced_residual_jacobians

Array = NDArray[np.float64]
Residual = Callable[[list[Array], bool], tuple[Array, Sequence[Array]]]
"""(values, need_jacobians) -> residual (m,) and a Jacobian (m, d_i) for each value, anything where not needed.

A value is the (4, 4) matrix of a Pose3, with d_i = 6 for its right perturbation [rotation, translation], or a vector
(d_i,).
"""


class FactorError(Exception):
    """A custom factor's function returned what GTSAM can't take."""


class FactorShapeError(FactorError):
    """A residual or Jacobian of the wrong shape or number.

    Args:
        factor: its name.
        what: which of its arrays.
        expected: shape.
        got: shape.
    """

    def __init__(self, factor: str, what: str, expected: object, got: object) -> None:
        super().__init__(f"factor {factor!r}: {what} has shape {got}, expected {expected}")
        self.factor, self.what, self.expected, self.got = factor, what, expected, got


class FactorValueError(FactorError):
    """A residual or Jacobian that isn't made of finite real numbers."""

    def __init__(self, factor: str, what: str, problem: str) -> None:
        super().__init__(f"factor {factor!r}: {what} {problem}")
        self.factor, self.what = factor, what


def custom_factor(name: str, keys: Sequence[int], noise: Any, function: Residual) -> Any:
    """A GTSAM factor of a Python residual, with every array checked.

    Args:
        name: what errors call it.
        keys: of Pose3 or vector values.
        noise: a gtsam noise model of the residual's dimension m.
        function: see `Residual`.

    Returns:
        gtsam.CustomFactor. Evaluating it raises FactorShapeError or FactorValueError where the function misbehaves, and
        passes its exceptions on.
    """
    rows, keys = noise.dim(), list(keys)
    readers: list[Callable[[Any, int], Array]] = []

    def evaluate(_factor: Any, values: Any, H: Any) -> Array:
        if not readers:  # what a key holds doesn't change
            readers.extend(_reader(values, key) for key in keys)
        arrays = [read(values, key) for read, key in zip(readers, keys, strict=True)]
        residual, jacobians = function(arrays, H is not None)
        if H is not None:
            if len(jacobians) != len(keys):
                raise FactorShapeError(name, "the list of Jacobians", (len(keys),), (len(jacobians),))
            for i, (key, array, J) in enumerate(zip(keys, arrays, jacobians, strict=True)):
                width = 6 if array.ndim == 2 else len(array)
                H[i] = _checked(name, J, (rows, width), key)
        return _checked(name, residual, (rows,), None)

    return gtsam.CustomFactor(noise, keys, evaluate)


def _pose(values: Any, key: int) -> Array:
    return values.atPose3(key).matrix()


def _vector(values: Any, key: int) -> Array:
    return values.atVector(key)


def _reader(values: Any, key: int) -> Callable[[Any, int], Array]:
    """How to read a key's value as an array; GTSAM has no way to ask for a value's type but to try."""
    try:
        values.atPose3(key)
    except RuntimeError:
        return _vector
    return _pose


def _checked(name: str, array: Any, shape: tuple[int, ...], key: int | None) -> Array:
    """The array as GTSAM takes it. `key` is None for the residual."""
    what = "residual" if key is None else f"Jacobian of {gtsam.DefaultKeyFormatter(key)}"
    try:
        raw = np.asarray(array)
    except ValueError as error:
        raise FactorValueError(name, what, f"isn't an array: {error}") from error
    if raw.dtype.kind not in "fiu":
        raise FactorValueError(name, what, f"isn't made of real numbers but of {raw.dtype}")
    out = raw.astype(np.float64, copy=False)
    if out.shape != shape:
        raise FactorShapeError(name, what, shape, out.shape)
    if not np.isfinite(out).all():
        raise FactorValueError(name, what, "has a value that isn't finite")
    return out


def prediction_factor(name: str, key_a: int, key_b: int, sigma: ArrayLike, symmetry: Symmetry = NONE) -> Any:
    """phi_p between an object's poses at two times; see `factors.prediction`.

    Args:
        name: for errors.
        key_a: Pose3 T_world_object before.
        key_b: Pose3 T_world_object after.
        sigma: (6, 6) from `prediction.covariance`.
        symmetry: of the object.
    """
    sigma = np.asarray(sigma, dtype=np.float64)
    information = np.linalg.inv(sigma)
    noise = gtsam.noiseModel.Gaussian.Covariance(symmetry.reduced_covariance(sigma))

    def function(values: list[Array], _need: bool) -> tuple[Array, Sequence[Array]]:
        r, J_a, J_b = reduced_residual_jacobians(values[0], values[1], symmetry, information)
        return r, (J_a, J_b)

    return custom_factor(name, (key_a, key_b), noise, function)


def mode_factor(
    name: str,
    key_camera: int,
    key_object: int,
    T_camera_mode: ArrayLike,
    information: ArrayLike,
    symmetry: Symmetry = NONE,
    key_bias: int | None = None,
) -> Any:
    """A measurement mode between camera, object and the bias of the visit; see `factors.measurement`.

    Args:
        name: for errors.
        key_camera: Pose3 T_world_camera.
        key_object: Pose3 T_world_object.
        T_camera_mode: (4, 4).
        information: (6, 6) in the object's tangent; its flat directions stay free.
        symmetry: of the object.
        key_bias: vector (6,) in the object's tangent; None = no bias.
    """
    information, mode = np.asarray(information, dtype=np.float64), np.asarray(T_camera_mode, dtype=np.float64)
    whiten = mixture.square_root(symmetry.reduced_information(information)) @ symmetry.projection
    keys = (key_camera, key_object) if key_bias is None else (key_camera, key_object, key_bias)

    def function(values: list[Array], _need: bool) -> tuple[Array, Sequence[Array]]:
        bias = values[2] if len(values) == 3 else None
        r, J_camera, J_object = measurement.mode_residual_jacobians(
            values[0], values[1], mode, bias, symmetry, information
        )
        jacobians = [whiten @ J_camera, whiten @ J_object] + ([] if bias is None else [-whiten])
        return whiten @ r, jacobians

    return custom_factor(name, keys, gtsam.noiseModel.Unit.Create(len(whiten)), function)


def context_factor(
    name: str,
    key_a: int,
    key_b: int,
    centres: tuple[ArrayLike, ArrayLike],
    pair: context.PairMixture,
    instance: float = 0.0,
    keyframes: int = 1,
) -> Any:
    """phi_c between two objects at one time; see `factors.context`.

    Args:
        name: for errors.
        key_a: Pose3 T_world_object of one.
        key_b: Pose3 T_world_object of the other.
        centres: (3,) of each, object frames, between which the distance is taken.
        pair: of their classes, shape ().
        instance: log(phi_ins / phi_background), nats.
        keyframes: n, over how many keyframes this one fact is spread.
    """
    a, b = (np.asarray(centre, dtype=np.float64) for centre in centres)
    share = 1.0 / np.sqrt(keyframes)

    def function(values: list[Array], _need: bool) -> tuple[Array, Sequence[Array]]:
        distance, J_a, J_b = context.pair_distance_jacobians(values[0], values[1], a, b)
        e, slope, _ = context.context_residual(distance, pair, instance)
        return share * e[None], (share * slope * J_a[None], share * slope * J_b[None])

    return custom_factor(name, (key_a, key_b), gtsam.noiseModel.Unit.Create(1), function)


def gauge_factor(name: str, key: int, T_reference: ArrayLike, symmetry: Symmetry, sigma_rad: float = np.pi) -> Any:
    """What holds a symmetric object's free directions near a reference pose (4, 4); see `symmetry.gauge_residual`."""
    reference = np.asarray(T_reference, dtype=np.float64)
    noise = gtsam.noiseModel.Isotropic.Sigma(symmetry.free, sigma_rad)

    def function(values: list[Array], _need: bool) -> tuple[Array, Sequence[Array]]:
        r, J = gauge_residual(reference, values[0], symmetry)
        return r, (J,)

    return custom_factor(name, (key,), noise, function)
