"""Rigid motions as batched 4x4 matrices, by GTSAM's rules: tangent [rotation rad, translation m], right perturbation.

``T_a_b`` maps points of frame b to frame a. ``retract(T, xi) = T @ exp(xi)`` and ``local(A, B) = log(A^-1 B)``.
Formulas: Barfoot, State Estimation for Robotics (2017), ch. 7; Sola et al., A micro Lie theory (arXiv:1812.01537).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL = 1e-4  # below this angle (rad) series are exact to the last bit and divisions are not


def hat(w: Array) -> Array:
    """Vectors (..., 3) -> skew matrices (..., 3, 3), hat(a) b = a x b."""
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return out


def _coefficients(angle: Array) -> tuple[Array, Array, Array]:
    """sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3 with their series near zero; shapes of `angle`."""
    small = angle < _SMALL
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    first = np.where(small, 1.0 - a2 / 6.0, np.sin(a) / a)
    # 2 sin^2(a/2) keeps the digits that 1 - cos(a) loses
    second = np.where(small, 0.5 - a2 / 24.0, 2.0 * np.sin(a / 2.0) ** 2 / (a * a))
    third = np.where(small, 1.0 / 6.0 - a2 / 120.0, (a - np.sin(a)) / (a * a * a))
    return first, second, third


def so3_exp(w: Array) -> Array:
    """Rotation vectors (..., 3), rad -> rotation matrices (..., 3, 3)."""
    w = np.asarray(w, dtype=np.float64)
    first, second, _ = _coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + first[..., None, None] * W + second[..., None, None] * (W @ W)


def so3_log(R: Array) -> Array:
    """Rotation matrices (..., 3, 3) -> rotation vectors (..., 3) with angle in [0, pi]."""
    R = np.asarray(R, dtype=np.float64)
    q = quaternion(R)
    vector, scalar = q[..., :3], q[..., 3]
    norm = np.linalg.norm(vector, axis=-1)
    small = norm < 1e-9
    safe = np.where(small, 1.0, norm)
    scale = np.where(small, 2.0 / np.where(scalar == 0, 1.0, scalar), 2.0 * np.arctan2(safe, scalar) / safe)
    return vector * scale[..., None]


def quaternion(R: Array) -> Array:
    """Rotation matrices (..., 3, 3) -> unit quaternions (..., 4) as [x, y, z, w], w >= 0 (Shepperd's method)."""
    m = np.asarray(R, dtype=np.float64)
    d = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1)
    trace = d.sum(-1)
    candidates = np.empty((*m.shape[:-2], 4, 4))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        candidates[..., i, i] = 1.0 + 2.0 * d[..., i] - trace
        candidates[..., i, j] = m[..., j, i] + m[..., i, j]
        candidates[..., i, k] = m[..., k, i] + m[..., i, k]
        candidates[..., i, 3] = m[..., k, j] - m[..., j, k]
        candidates[..., 3, i] = candidates[..., i, 3]
    candidates[..., 3, 3] = 1.0 + trace
    # the candidate with the largest diagonal is the best conditioned
    best = np.argmax(np.einsum("...ii->...i", candidates), axis=-1)
    q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def rotation_from_quaternion(q: Array) -> Array:
    """Quaternions (..., 4) as [x, y, z, w], any length > 0 -> rotation matrices (..., 3, 3)."""
    q = np.asarray(q, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    W = hat(q[..., :3])
    return np.eye(3) + 2.0 * q[..., 3, None, None] * W + 2.0 * (W @ W)


def make(R: Array, t: Array) -> Array:
    """Rotations (..., 3, 3) and translations (..., 3), metres -> (..., 4, 4)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    shape = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: Array) -> Array:
    """(..., 4, 4) -> the inverse motions (..., 4, 4)."""
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return make(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def transform(T: Array, points: Array) -> Array:
    """T_a_b (..., 4, 4) on points of b (..., n, 3) -> points of a (..., n, 3)."""
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def exp(xi: Array) -> Array:
    """Tangents (..., 6) [rotation, translation] -> (..., 4, 4)."""
    xi = np.asarray(xi, dtype=np.float64)
    w, v = xi[..., :3], xi[..., 3:]
    V = so3_left_jacobian(w)
    return make(so3_exp(w), (V @ v[..., None])[..., 0])


def log(T: Array) -> Array:
    """(..., 4, 4) -> tangents (..., 6) [rotation, translation]."""
    w = so3_log(T[..., :3, :3])
    v = np.linalg.solve(so3_left_jacobian(w), T[..., :3, 3:])[..., 0]
    return np.concatenate([w, v], axis=-1)


def retract(T: Array, xi: Array) -> Array:
    """T exp(xi): (..., 4, 4), (..., 6) -> (..., 4, 4)."""
    return T @ exp(xi)


def local(A: Array, B: Array) -> Array:
    """log(A^-1 B): the tangent (..., 6) at A that leads to B."""
    return log(inverse(A) @ B)


def so3_left_jacobian(w: Array) -> Array:
    """(..., 3) -> (..., 3, 3): exp(w + d) ~ exp(J_l(w) d) exp(w)."""
    w = np.asarray(w, dtype=np.float64)
    _, second, third = _coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + second[..., None, None] * W + third[..., None, None] * (W @ W)


def adjoint(T: Array) -> Array:
    """(..., 4, 4) -> Ad (..., 6, 6): T exp(xi) T^-1 = exp(Ad xi)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(t) @ R
    return out


def right_jacobian(xi: Array) -> Array:
    """(..., 6) -> (..., 6, 6): exp(xi + d) ~ exp(xi) exp(J_r(xi) d)."""
    return _left_jacobian(-np.asarray(xi, dtype=np.float64))


def right_jacobian_inverse(xi: Array) -> Array:
    """(..., 6) -> (..., 6, 6): log(exp(xi) exp(d)) ~ xi + J_r^-1(xi) d."""
    return np.linalg.inv(right_jacobian(xi)).astype(np.float64, copy=False)


def _left_jacobian(xi: Array) -> Array:
    """Barfoot (7.85), in the order [rotation, translation]."""
    w, v = xi[..., :3], xi[..., 3:]
    angle = np.linalg.norm(w, axis=-1)
    J, W, V = so3_left_jacobian(w), hat(w), hat(v)
    small = angle < 1e-2  # the fourth coefficient divides by angle^5
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    c1 = np.where(small, 1 / 6 - a2 / 120 + a2 * a2 / 5040, (a - np.sin(a)) / a**3)
    c2 = np.where(small, 1 / 24 - a2 / 720 + a2 * a2 / 40320, (a * a + 2 * np.cos(a) - 2) / (2 * a**4))
    c3 = np.where(small, 1 / 120 - a2 / 2520 + a2 * a2 / 120960, (2 * a - 3 * np.sin(a) + a * np.cos(a)) / (2 * a**5))
    c1, c2, c3 = (c[..., None, None] for c in (c1, c2, c3))
    WV, VW, WVW = W @ V, V @ W, W @ V @ W
    Q = 0.5 * V + c1 * (WV + VW + WVW) + c2 * (W @ WV + VW @ W - 3 * WVW) + c3 * (WVW @ W + W @ WVW)
    out = np.zeros((*xi.shape[:-1], 6, 6))
    out[..., :3, :3], out[..., 3:, 3:], out[..., 3:, :3] = J, J, Q
    return out


def uniform_rotations(uniforms: Array) -> Array:
    """Numbers (..., 3) in [0, 1) -> rotations (..., 3, 3) uniform on SO(3) (Shoemake, Graphics Gems III, 1992)."""
    u = np.asarray(uniforms, dtype=np.float64)
    a, b = np.sqrt(1.0 - u[..., 0]), np.sqrt(u[..., 0])
    p, r = 2.0 * np.pi * u[..., 1], 2.0 * np.pi * u[..., 2]
    return rotation_from_quaternion(np.stack([a * np.sin(p), a * np.cos(p), b * np.sin(r), b * np.cos(r)], axis=-1))
