"""Poses and symmetries that laws are tried on, and the derivative they are held to."""

import numpy as np
from hypothesis import strategies as st

from factors.symmetry import Symmetry
from sequences import se3

SEEDS = st.integers(0, 2**31)
SCALES = st.sampled_from([1e-7, 1e-3, 0.3, 1.0])
"""sizes of relative motions, from near identity to far; their angles stay below pi"""

_CENTRE = se3.make(np.eye(3), np.array([0.03, -0.02, 0.05]))


def _about_centre(R):
    return _CENTRE @ se3.make(R, np.zeros(3)) @ se3.inverse(_CENTRE)


_HALF_TURNS = np.stack([_about_centre(np.diag(d)) for d in ([1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])])
_AXIS = np.array([1.0, 2.0, 2.0]) / 3.0
_FLIP = _about_centre(se3.so3_exp(np.pi * np.array([2.0, 1.0, -2.0]) / 3.0))
_POINT = _CENTRE[:3, 3]

SYMMETRIES = {
    "none": Symmetry(),
    "half turn": Symmetry(discrete=_HALF_TURNS[[0, 3]]),
    "box": Symmetry(discrete=_HALF_TURNS),
    "axis": Symmetry(axes=_AXIS[None], offsets=_POINT[None] + 0.3 * _AXIS),
    "cylinder": Symmetry(discrete=np.stack([np.eye(4), _FLIP]), axes=_AXIS[None], offsets=_POINT[None]),
    "ball": Symmetry(axes=np.eye(3)[:2], offsets=np.stack([_POINT, _POINT])),
}


def random_pose(rng):
    return se3.exp(np.concatenate([rng.uniform(-1.5, 1.5, 3), rng.uniform(-2, 2, 3)]))


def random_tangent(rng, scale, max_angle=3.0):
    direction = rng.standard_normal(6)
    rotation = direction[:3] / np.linalg.norm(direction[:3]) * rng.uniform(0.1, 1.0) * max_angle
    return scale * np.concatenate([rotation, direction[3:]])


def random_spd(rng, size=6):
    A = rng.standard_normal((size, size))
    return A @ A.T + size * np.eye(size)


def random_image(rng, symmetry):
    """Some motion of a symmetry's group."""
    g = symmetry.discrete[rng.integers(symmetry.order)]
    if symmetry.free:
        turn = symmetry.free_rotations @ rng.uniform(-1.5, 1.5, symmetry.free)
        return g @ symmetry.T_object_centre @ se3.exp(np.r_[turn, 0, 0, 0]) @ se3.inverse(symmetry.T_object_centre)
    return g


def numerical_jacobian(function, T, step=1e-6):
    """d function(T exp(xi)) / d xi by central differences, of a batched function with values (n,) or (n, m): (m, 6)."""
    around = se3.retract(T, step * np.concatenate([np.eye(6), -np.eye(6)]))
    values = np.asarray(function(around)).reshape(12, -1)
    return (values[:6] - values[6:]).T / (2 * step)
