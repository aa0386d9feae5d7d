"""The residual between two poses modulo symmetry, compiled for one pair at a time.

A graph is linearised factor by factor. There the batched NumPy functions of `sequences.se3` cost 1 ms a pair in call
overhead, these kernels 30 microseconds; the tests hold both to each other. Formulas: Barfoot, State Estimation for
Robotics (2017), ch. 7.
"""

import math

import numba
import numpy as np

from factors.motions import compiled_retract

_KERNEL = {"cache": True, "nogil": True, "error_model": "numpy"}
# an array that is handed on, and a part of one, is counted by an atomic instruction, which takes as long as a sine:
# what is called for each pair is inlined, and copies entries
_INLINED = {**_KERNEL, "inline": "always"}


@numba.njit(**_INLINED)
def _quaternion(R, q):
    """[x, y, z, w] up to sign into q (4,), by the best conditioned of Shepperd's four formulas."""
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
    norm = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for a in range(4):
        q[a] /= norm


@numba.njit(**_INLINED)
def _curvature(angle):
    """The coefficient k of W^2 in the inverse left Jacobian I - W/2 + k W^2 of SO(3)."""
    if angle < 1e-2:
        return 1.0 / 12.0 + angle**2 / 720.0 + angle**4 / 30240.0
    return (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2


@numba.njit(**_INLINED)
def _log(T, q, r):
    """The tangent [rotation, translation] of one motion (4, 4) into r (6,). q is (4,) to write into."""
    _quaternion(T, q)
    norm = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    sign = -1.0 if q[3] < 0.0 else 1.0
    scale = 2.0 / q[3] if norm < 1e-9 else sign * 2.0 * math.atan2(norm, sign * q[3]) / norm
    x, y, z = scale * q[0], scale * q[1], scale * q[2]
    k = _curvature(math.sqrt(x * x + y * y + z * z))
    # w x t, and w x (w x t)
    a, b, c = y * T[2, 3] - z * T[1, 3], z * T[0, 3] - x * T[2, 3], x * T[1, 3] - y * T[0, 3]
    r[0], r[1], r[2] = x, y, z
    r[3] = T[0, 3] - 0.5 * a + k * (y * c - z * b)
    r[4] = T[1, 3] - 0.5 * b + k * (z * a - x * c)
    r[5] = T[2, 3] - 0.5 * c + k * (x * b - y * a)


@numba.njit(**_INLINED)
def _product(A, B, out):
    """A @ B of 3 x 3 matrices, without a call to BLAS, which costs more than the product."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@numba.njit(**_KERNEL)
def _fill_hat(x, y, z, out):
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2], out[1, 2] = -z, y, -x
    out[1, 0], out[2, 0], out[2, 1] = z, -y, x


@numba.njit(**_KERNEL)
def _right_jacobian_inverse(r, work, A, B):
    """log(exp(r) exp(d)) ~ r + J_r^-1 d, with J_r^-1 = [[A, 0], [B, A]]. `work` is (7, 3, 3) to write into."""
    W, V, WV, VW, WVW, Q, product = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    a2 = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    a = math.sqrt(a2)
    if a < 1e-2:
        c1 = 1.0 / 6.0 - a2 / 120.0 + a2 * a2 / 5040.0
        c2 = 1.0 / 24.0 - a2 / 720.0 + a2 * a2 / 40320.0
        c3 = 1.0 / 120.0 - a2 / 2520.0 + a2 * a2 / 120960.0
    else:
        sin, cos = math.sin(a), math.cos(a)
        c1 = (a - sin) / a**3
        c2 = (a2 + 2.0 * cos - 2.0) / (2.0 * a**4)
        c3 = (2.0 * a - 3.0 * sin + a * cos) / (2.0 * a**5)
    _fill_hat(-r[0], -r[1], -r[2], W)
    _fill_hat(-r[3], -r[4], -r[5], V)
    _product(W, W, A)
    k = _curvature(a)
    for i in range(3):
        for j in range(3):
            A[i, j] = k * A[i, j] - 0.5 * W[i, j]
        A[i, i] += 1.0
    _product(W, V, WV)
    _product(V, W, VW)
    _product(WV, W, WVW)
    for i in range(3):
        for j in range(3):
            Q[i, j] = 0.5 * V[i, j] + c1 * (WV[i, j] + VW[i, j] + WVW[i, j]) - 3.0 * c2 * WVW[i, j]
            for m in range(3):
                Q[i, j] += c2 * (W[i, m] * WV[m, j] + VW[i, m] * W[m, j])
                Q[i, j] += c3 * (WVW[i, m] * W[m, j] + W[i, m] * WVW[m, j])
    _product(A, Q, product)
    _product(product, A, B)
    for i in range(3):
        for j in range(3):
            B[i, j] = -B[i, j]


@numba.njit(**_KERNEL)
def _times_adjoint_inverse(A, B, T, sign, work, out):
    """out (6, 6) = sign [[A, 0], [B, A]] Ad(T^-1), Ad(T^-1) = [[R', 0], [-R' hat(t), R']]. `work` is (3, 3)."""
    for i in range(3):
        for j in range(3):
            work[i, j] = sign * (A[i, 0] * T[j, 0] + A[i, 1] * T[j, 1] + A[i, 2] * T[j, 2])
            out[3 + i, j] = sign * (B[i, 0] * T[j, 0] + B[i, 1] * T[j, 1] + B[i, 2] * T[j, 2])
            out[i, j] = out[3 + i, 3 + j] = work[i, j]
            out[i, 3 + j] = 0.0
        x, y, z = T[0, 3], T[1, 3], T[2, 3]
        out[3 + i, 0] -= work[i, 1] * z - work[i, 2] * y
        out[3 + i, 1] -= work[i, 2] * x - work[i, 0] * z
        out[3 + i, 2] -= work[i, 0] * y - work[i, 1] * x


@numba.njit(**_INLINED)
def _copy(motions, n, out):
    """Motion n of (N, 4, 4) into `out` (4, 4)."""
    for i in range(4):
        for j in range(4):
            out[i, j] = motions[n, i, j]


@numba.njit(**_INLINED)
def _relative(T_a, T_b, g, work, out):
    """T_a^-1 T_b g into `out` (4, 4), whose last row is that of a motion already. `work` is (3, 3)."""
    for i in range(3):
        for j in range(3):
            work[i, j] = T_a[0, i] * T_b[0, j] + T_a[1, i] * T_b[1, j] + T_a[2, i] * T_b[2, j]
    _product(work, g, out)
    x, y, z = T_b[0, 3] - T_a[0, 3], T_b[1, 3] - T_a[1, 3], T_b[2, 3] - T_a[2, 3]
    for i in range(3):
        out[i, 3] = T_a[0, i] * x + T_a[1, i] * y + T_a[2, i] * z
        out[i, 3] += work[i, 0] * g[0, 3] + work[i, 1] * g[1, 3] + work[i, 2] * g[2, 3]


@numba.njit(**_INLINED)
def _untwisting(R, free, centre, q, out):
    """The motion about the centre after which R has no part along the free axes (3, f), f = 1 or 3, into `out` (4, 4).

    `q` is (4,) to write into.
    """
    if free.shape[1] == 3:
        for i in range(3):
            for j in range(3):
                out[i, j] = R[j, i]
    else:
        x, y, z = free[0, 0], free[1, 0], free[2, 0]
        _quaternion(R, q)
        angle = -2.0 * math.atan2(q[0] * x + q[1] * y + q[2] * z, q[3])
        s, k = math.sin(angle), 1.0 - math.cos(angle)
        out[0, 0], out[0, 1], out[0, 2] = 1.0 - k * (y * y + z * z), k * x * y - s * z, k * x * z + s * y
        out[1, 0], out[1, 1], out[1, 2] = k * x * y + s * z, 1.0 - k * (x * x + z * z), k * y * z - s * x
        out[2, 0], out[2, 1], out[2, 2] = k * x * z - s * y, k * y * z + s * x, 1.0 - k * (x * x + y * y)
    for i in range(3):
        out[i, 3] = centre[i] - out[i, 0] * centre[0] - out[i, 1] * centre[1] - out[i, 2] * centre[2]


@numba.njit(**_INLINED)
def _untwist(R, free, centre, q, U, g, work):
    """g times the motion that `_untwisting` gives, in place. `U` is (4, 4) and `work` (3, 3) to write into."""
    _untwisting(R, free, centre, q, U)
    for i in range(3):
        g[i, 3] += g[i, 0] * U[0, 3] + g[i, 1] * U[1, 3] + g[i, 2] * U[2, 3]
    _product(g, U, work)
    for i in range(3):
        for j in range(3):
            g[i, j] = work[i, j]


@numba.njit(**_INLINED)
def _least_turned(T_a, T_b, discrete, free, work, q, g, M):
    """Which discrete symmetry leaves the smallest angle of log(T_a^-1 T_b g), free rotations taken out.

    The angle a of a rotation has cos(a / 2) = |w| of its quaternion, and that of its swing sqrt((q . u)^2 + w^2).
    `work` is (3, 3), `q` (4,), `g` and `M` (4, 4) to write into.
    """
    best, chosen = -1.0, 0
    for s in range(0 if len(discrete) == 1 or free.shape[1] == 3 else len(discrete)):
        _copy(discrete, s, g)
        _relative(T_a, T_b, g, work, M)
        if free.shape[1] == 0:
            score = 2.0 + M[0, 0] + M[1, 1] + M[2, 2]  # 4 w^2, and one
        else:
            _quaternion(M, q)
            score = (q[0] * free[0, 0] + q[1] * free[1, 0] + q[2] * free[2, 0]) ** 2 + q[3] ** 2
        if score > best:
            best, chosen = score, s
    return chosen


@numba.njit(**_KERNEL)
def shortest(T_a, T_b, discrete, free, centre, information, residuals, images, chosen):
    """The shortest log(T_a^-1 T_b g) of each of n pairs over the symmetries g.

    Args:
        T_a: (n, 4, 4) or one (1, 4, 4).
        T_b: (n, 4, 4).
        discrete: (S, 4, 4).
        free: (3, f) free axes through the centre.
        centre: (3,).
        information: (n, 6, 6) or (1, 6, 6) to measure length by; (0, 6, 6) = the rotation's angle.
        residuals: (n, 6) out.
        images: (n, 4, 4) out, the g.
        chosen: (n,) out, which discrete symmetry.
    """
    work, q, r = np.empty((3, 3)), np.empty(4), np.empty(6)
    A, B, g, M, U = np.eye(4), np.eye(4), np.eye(4), np.eye(4), np.eye(4)
    for n in range(T_b.shape[0]):
        if n < T_a.shape[0]:
            _copy(T_a, n, A)
        _copy(T_b, n, B)
        first, last, best = 0, discrete.shape[0], np.inf
        if information.shape[0] == 0:
            first = _least_turned(A, B, discrete, free, work, q, g, M)
            last = first + 1
        for s in range(first, last):
            _copy(discrete, s, g)
            _relative(A, B, g, work, M)
            if free.shape[1] > 0:
                _untwist(M, free, centre, q, U, g, work)
                _relative(A, B, g, work, M)
            _log(M, q, r)
            length = 0.0
            if information.shape[0] > 0:
                metric = n if information.shape[0] > 1 else 0
                for i in range(6):
                    for j in range(6):
                        length += r[i] * information[metric, i, j] * r[j]
            if s == first or length < best:
                best = length
                chosen[n] = s
                for i in range(6):
                    residuals[n, i] = r[i]
                for i in range(4):
                    for j in range(4):
                        images[n, i, j] = g[i, j]


@numba.njit(**_KERNEL)
def near(T, others, discrete, free, centre, rotation, translation, out):
    """Whether the shortest log(T^-1 T_b g) of each of n poses turns and moves by less than a limit, into `out` (n,).

    A shift t of a motion is never longer than that of its log, so most pairs need no more than the distance where the
    symmetries are turns about the origin.

    Args:
        T: (4, 4).
        others: (n, 4, 4).
        discrete: (S, 4, 4).
        free: (3, f) free axes through the centre.
        centre: (3,).
        rotation: rad.
        translation: metres.
        out: (n,) bool.
    """
    work, q, r = np.empty((3, 3)), np.empty(4), np.empty(6)
    B, g, M, U = np.eye(4), np.eye(4), np.eye(4), np.eye(4)
    turns = not (np.any(discrete[:, :3, 3]) or (free.shape[1] > 0 and np.any(centre)))
    farthest = translation * (1.0 + 1e-9)
    for n in range(len(others)):
        x, y, z = others[n, 0, 3] - T[0, 3], others[n, 1, 3] - T[1, 3], others[n, 2, 3] - T[2, 3]
        if turns and x * x + y * y + z * z > farthest * farthest:
            out[n] = False
            continue
        _copy(others, n, B)
        s = _least_turned(T, B, discrete, free, work, q, g, M)
        _copy(discrete, s, g)
        _relative(T, B, g, work, M)
        if free.shape[1] > 0:
            _untwist(M, free, centre, q, U, g, work)
            _relative(T, B, g, work, M)
        _log(M, q, r)
        turned, moved = r[0] ** 2 + r[1] ** 2 + r[2] ** 2, r[3] ** 2 + r[4] ** 2 + r[5] ** 2
        out[n] = math.sqrt(turned) < rotation and math.sqrt(moved) < translation


@numba.njit(**_KERNEL)
def distinct(poses, order, most, discrete, free, centre, rotation, translation, kept):
    """Rows of poses (n, 4, 4), in an order (n,), that are `near` none taken before, into `kept` (n,); their number."""
    left, number = order.copy(), 0
    rest = len(left)
    around, there = np.empty(poses.shape), np.empty(len(left), np.bool_)
    while rest > 0 and number < most:
        row = left[0]
        kept[number] = row
        number += 1
        for i in range(1, rest):
            around[i] = poses[left[i]]
        near(poses[row], around[1:rest], discrete, free, centre, rotation, translation, there[1:rest])
        remaining = 0
        for i in range(1, rest):
            if not there[i]:
                left[remaining] = left[i]
                remaining += 1
        rest = remaining
    return number


@numba.njit(**_KERNEL)
def moments(T, poses, weights, discrete, free, centre, steps, still, residuals, covariance):
    """Mean and covariance of weighted poses, each in its image nearest to the mean, by fixed-point steps.

    Args:
        T: (1, 4, 4) where the mean is looked for; out, the mean.
        poses: (n, 4, 4).
        weights: (n,) of sum 1.
        discrete: (S, 4, 4).
        free: (3, f) free axes through the centre.
        centre: (3,).
        steps: at most.
        still: rad or metres, a step that none need follow.
        residuals: (n, 6) the shortest from T to the poses; out, from the mean.
        covariance: (6, 6) out, of the mean's right tangent.
    """
    step, moved, angle = np.empty((1, 6)), np.empty((1, 4, 4)), np.empty((0, 6, 6))
    images, chosen = np.empty(poses.shape), np.empty(len(poses), np.int64)
    for _ in range(steps):
        step[:] = 0.0
        for n in range(len(poses)):
            for i in range(6):
                step[0, i] += weights[n] * residuals[n, i]
        compiled_retract(T, step, moved)
        T[:] = moved
        shortest(T, poses, discrete, free, centre, angle, residuals, images, chosen)
        if np.abs(step).max() < still:
            break
    covariance[:] = 0.0
    for n in range(len(poses)):
        for i in range(6):
            for j in range(6):
                covariance[i, j] += weights[n] * residuals[n, i] * residuals[n, j]


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
    work, A, B, M, right = np.empty((7, 3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.eye(4), np.zeros((6, 6))
    free = generators.shape[1] > 0
    for n in range(T_a.shape[0]):
        _right_jacobian_inverse(residuals[n], work, A, B)
        _relative(T_a[n], T_b[n], images[n], work[0], M)
        _times_adjoint_inverse(A, B, images[n], 1.0, work[0], by_b[n])
        _times_adjoint_inverse(A, B, M, -1.0, work[0], by_a[n])
        if free:
            right[:3, :3], right[3:, 3:], right[3:, :3] = A, A, B
            along = right @ generators
            off = along @ np.linalg.pinv(reader @ along) @ reader
            by_b[n] -= off @ by_b[n]
            by_a[n] -= off @ by_a[n]
