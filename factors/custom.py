"""Potentials as GTSAM factors: the only module of this package that imports gtsam.

`gtsam.CustomFactor` crashes the interpreter where a Jacobian has a wrong shape or isn't written. `custom_factor` checks
every number that a Python function hands to GTSAM and raises an error with the factor's name instead; an exception
inside a callback passes through GTSAM's optimisers unchanged. NumPy arrays of any memory order and real type are handed
over as they mean.

Inside GTSAM's own optimisers a callback's cost grows with the size of Values; with `graph.linearize(values)` on Values
that Python owns it doesn't. A factor can't be copied or serialised: keep the numbers it was built from.

The residuals themselves are those of `factors.terms`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.terms import Terms

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


def terms_factor(name: str, keys: Sequence[int], terms: Terms) -> Any:
    """One factor of `factors.terms` (batch shape ()) as a GTSAM factor.

    Args:
        name: for errors.
        keys: as the form says.
        terms: its numbers.
    """
    noise = gtsam.noiseModel.Unit.Create(terms.rows)
    return custom_factor(name, keys, noise, lambda values, _need: terms.linearised(values))


def stay_factor(key_a: int, key_b: int, sigma: ArrayLike) -> Any:
    """phi_p of an object without symmetry in GTSAM's own compiled code: `terms.Predictions` says the same.

    Args:
        key_a: Pose3 T_world_object before.
        key_b: Pose3 T_world_object after.
        sigma: (6, 6) from `prediction.covariance`.
    """
    noise = gtsam.noiseModel.Gaussian.Covariance(np.asarray(sigma, dtype=np.float64))
    return gtsam.BetweenFactorPose3(key_a, key_b, gtsam.Pose3(), noise)
