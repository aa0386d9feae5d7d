"""The residual between two poses modulo symmetry, compiled for one pair at a time.

A graph is linearised factor by factor. There the batched NumPy functions of `sequences.se3` cost 1 ms a pair in call
overhead, these kernels 30 microseconds; the tests hold both to each other. Formulas: Barfoot, State Estimation for
Robotics (2017), ch. 7.
"""

import math

import numba
import numpy as np

_KERNEL = {"cache": True, "nogil": True, "error_model": "numpy"}


@numba.njit(**_KERNEL)
def _hat(a):
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@numba.njit(**_KERNEL)
def _quaternion(R):
    """[x, y, z, w] up to sign, by the best conditioned of Shepperd's four formulas."""
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    i = 3
    largest = trace
    for a in range(3):
        if R[a, a] > largest:
            largest, i = R[a, a], a
    if i == 3:
        q[3] = 1.0 + trace
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + 2.0 * R[i, i] - trace
        q[j], q[k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    return q / math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)


@numba.njit(**_KERNEL)
def _so3_log(R):
    q = _quaternion(R)
    if q[3] < 0.0:
        q = -q
    norm = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    return q[:3] * (2.0 / q[3] if norm < 1e-9 else 2.0 * math.atan2(norm, q[3]) / norm)


@numba.njit(**_KERNEL)
def _curvature(angle):
    """The coefficient k of W^2 in the inverse left Jacobian I - W/2 + k W^2 of SO(3)."""
    if angle < 1e-2:
        return 1.0 / 12.0 + angle**2 / 720.0 + angle**4 / 30240.0
    return (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2


@numba.njit(**_KERNEL)
def _log(T):
    """The tangent [rotation, translation] of one motion (4, 4)."""
    w = _so3_log(T[:3, :3])
    W = _hat(w)
    t = T[:3, 3].copy()
    Wt = W @ t
    r = np.empty(6)
    r[:3] = w
    r[3:] = t - 0.5 * Wt + _curvature(math.sqrt((w**2).sum())) * (W @ Wt)
    return r


@numba.njit(**_KERNEL)
def _right_jacobian_inverse(r):
    """(6,) -> (6, 6): log(exp(r) exp(d)) ~ r + J_r^-1 d."""
    angle = math.sqrt((r[:3] ** 2).sum())
    W, V = _hat(-r[:3]), _hat(-r[3:])
    inverse = np.eye(3) - 0.5 * W + _curvature(angle) * (W @ W)
    a, a2 = angle, angle * angle
    if angle < 1e-2:
        c1 = 1.0 / 6.0 - a2 / 120.0 + a2 * a2 / 5040.0
        c2 = 1.0 / 24.0 - a2 / 720.0 + a2 * a2 / 40320.0
        c3 = 1.0 / 120.0 - a2 / 2520.0 + a2 * a2 / 120960.0
    else:
        sin, cos = math.sin(a), math.cos(a)
        c1 = (a - sin) / a**3
        c2 = (a2 + 2.0 * cos - 2.0) / (2.0 * a**4)
        c3 = (2.0 * a - 3.0 * sin + a * cos) / (2.0 * a**5)
    WV, VW = W @ V, V @ W
    WVW = WV @ W
    Q = 0.5 * V + c1 * (WV + VW + WVW) + c2 * (W @ WV + VW @ W - 3.0 * WVW) + c3 * (WVW @ W + W @ WVW)
    out = np.zeros((6, 6))
    out[:3, :3] = inverse
    out[3:, 3:] = inverse
    out[3:, :3] = -inverse @ Q @ inverse
    return out


@numba.njit(**_KERNEL)
def _inverse(T):
    out = np.eye(4)
    R = T[:3, :3].T.copy()
    out[:3, :3] = R
    out[:3, 3] = -(R @ T[:3, 3].copy())
    return out


@numba.njit(**_KERNEL)
def _adjoint_inverse(T):
    """Ad(T^-1) (6, 6)."""
    R = T[:3, :3].T.copy()
    out = np.zeros((6, 6))
    out[:3, :3] = R
    out[3:, 3:] = R
    out[3:, :3] = -R @ _hat(T[:3, 3])
    return out


@numba.njit(**_KERNEL)
def _untwisting(R, free, centre):
    """The motion (4, 4) about the centre after which R has no part along the free axes (3, f): f = 1 or 3."""
    out = np.eye(4)
    if free.shape[1] == 3:
        U = R.T.copy()
    else:
        axis = free[:, 0].copy()
        q = _quaternion(R)
        angle = -2.0 * math.atan2((q[:3] * axis).sum(), q[3])
        W = _hat(axis)
        U = np.eye(3) + math.sin(angle) * W + (1.0 - math.cos(angle)) * (W @ W)
    out[:3, :3] = U
    out[:3, 3] = centre - U @ centre
    return out


@numba.njit(**_KERNEL)
def shortest(T_a, T_b, discrete, free, centre, information, residuals, images, chosen):
    """The shortest log(T_a^-1 T_b g) of each of n pairs over the symmetries g.

    Args:
        T_a: (n, 4, 4).
        T_b: (n, 4, 4).
        discrete: (S, 4, 4).
        free: (3, f) free axes through the centre.
        centre: (3,).
        information: (n, 6, 6) or (1, 6, 6) to measure length by; (0, 6, 6) = the rotation's angle.
        residuals: (n, 6) out.
        images: (n, 4, 4) out, the g.
        chosen: (n,) out, which discrete symmetry.
    """
    for n in range(T_a.shape[0]):
        relative = _inverse(T_a[n]) @ T_b[n]
        best = np.inf
        for s in range(discrete.shape[0]):
            g = discrete[s].copy()
            if free.shape[1] > 0:
                g = g @ _untwisting((relative @ g)[:3, :3].copy(), free, centre)
            r = _log(relative @ g)
            if information.shape[0] == 0:
                length = (r[:3] ** 2).sum()
            else:
                L = information[n if information.shape[0] > 1 else 0]
                length = (r * (L @ r)).sum()
            if s == 0 or length < best:
                best = length
                residuals[n], images[n], chosen[n] = r, g, s


@numba.njit(**_KERNEL)
def shortest_jacobians(T_a, T_b, residuals, images, generators, reader, by_a, by_b):
    """Derivatives of what `shortest` found, by right perturbations of both poses.

    With M = T_a^-1 T_b g and r = log M, d r = J_r^-1(r) [Ad(g^-1) d_b - Ad(M^-1) d_a]. Where a direction is free, g
    moves along its generator so that r keeps no part there: an oblique projection along J_r^-1(r) generator.

    Args:
        T_a: (n, 4, 4).
        T_b: (n, 4, 4).
        residuals: (n, 6) of `shortest`.
        images: (n, 4, 4) of `shortest`.
        generators: (6, f) the free directions.
        reader: (f, 6) what they take out of a residual.
        by_a: (n, 6, 6) out.
        by_b: (n, 6, 6) out.
    """
    for n in range(T_a.shape[0]):
        right = _right_jacobian_inverse(residuals[n])
        if generators.shape[1] > 0:
            along = right @ generators
            right = right - along @ (np.linalg.pinv(reader @ along) @ (reader @ right))
        g = images[n].copy()
        by_b[n] = right @ _adjoint_inverse(g)
        by_a[n] = -right @ _adjoint_inverse(_inverse(T_a[n]) @ T_b[n] @ g)
