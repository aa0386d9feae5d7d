"""The numba z-buffer: kernels that other kernels call, a pose at a time, so that scoring is fused with rendering.

Within a triangle 1/z is linear in the image, so it is interpolated with barycentric coordinates (Pineda, A parallel
algorithm for polygon rasterization, SIGGRAPH 1988). Pixels are sampled at their centres, which lie at whole numbers.
Triangles that reach behind the near plane are left out: a hypothesis so close to the camera is not one.

What makes it fast: one pass without branches finds the triangles that can cover a sample (most of a fine mesh's can't,
nor those on a solid's far side); those of at most 2 x 2 samples are drawn without branches; of wide ones only the
samples inside are visited. Vertices are (3, V), one coordinate after the other, so that projection is vectorised;
indices are unsigned, since numba tests signed ones for being negative.
"""

from __future__ import annotations

import numba
import numpy as np

NEAR_M = 0.05
"""the near plane"""

_MIN_AREA = 1e-8  # square pixels; below it barycentric coordinates are rounding errors
_ON_EDGE = 1e-9  # a sample on an edge belongs to both triangles, whatever way the rounding goes
_FAR = 1e30


_index = np.uintp
# no kernel makes an infinity or NaN, and without them minimum, maximum and choice are one instruction each
_KERNEL = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz", "nnan", "ninf"},
}


@numba.njit(cache=True, nogil=True)
def _is_pose(T):
    """Whether a pose has only numbers: an iteration that ran away may hand in what isn't one."""
    return np.abs(T).sum() < _FAR


@numba.njit(**_KERNEL)
def project(vertices, T, intrinsics, projected):
    """Project points.

    Args:
        vertices: (3, V) in the object frame, metres.
        T: (4, 4) T_camera_object.
        intrinsics: (4,) fx, fy, cx, cy.
        projected: (3, V), overwritten with u, v and 1/z; 1/z is 0 before the near plane, and where T isn't finite.
    """
    if not _is_pose(T):
        projected[:] = 0.0
        return
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    # the rows of K T; scalars, or they would be read again for each point
    z0, z1, z2, z3 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    u0, u1, u2, u3 = fx * T[0, 0] + cx * z0, fx * T[0, 1] + cx * z1, fx * T[0, 2] + cx * z2, fx * T[0, 3] + cx * z3
    v0, v1, v2, v3 = fy * T[1, 0] + cy * z0, fy * T[1, 1] + cy * z1, fy * T[1, 2] + cy * z2, fy * T[1, 3] + cy * z3
    xs, ys, zs = vertices[0], vertices[1], vertices[2]
    us, vs, ws = projected[0], projected[1], projected[2]
    for i in range(vertices.shape[1]):
        x, y, z = xs[i], ys[i], zs[i]
        depth = z0 * x + z1 * y + z2 * z + z3
        before = depth <= NEAR_M
        w = 1.0 / (1.0 if before else depth)
        us[i] = (u0 * x + u1 * y + u2 * z + u3) * w
        vs[i] = (v0 * x + v1 * y + v2 * z + v3) * w
        ws[i] = 0.0 if before else w


@numba.njit(**_KERNEL)
def rasterise(projected, faces, solid, chosen, inverse_depth, face_ids):
    """Draw triangles into a buffer of inverse depth, the nearest surface winning, of equal ones either.

    Args:
        projected: (3, V) from `project`.
        faces: (F, 3).
        solid: leave out faces that are seen from behind; see `catalogue.Mesh.is_solid`.
        chosen: (2, F + 1) int32 to work in: allocating for each pose takes as long as drawing it.
        inverse_depth: (h, w), updated in place; 0 = nothing.
        face_ids: (h, w), updated in place with the face that won; None where nobody wants them.
    """
    height, width = inverse_depth.shape
    n_small, n_large = _select(projected, faces, solid, height, width, chosen[0], chosen[1])
    _draw_small(projected, faces, chosen[0, :n_small], inverse_depth, face_ids)
    _draw_large(projected, faces, chosen[1, :n_large], inverse_depth, face_ids)


@numba.njit(**_KERNEL)
def _select(projected, faces, solid, height, width, small, large):
    """Write faces whose enclosing box holds 1 or 2 samples a side to `small`, larger ones to `large`; their counts."""
    us, vs, ws = projected[0], projected[1], projected[2]
    u_last, v_last = width - 1.0, height - 1.0
    # 2 x 2 samples are drawn at once, which an image of one row or column doesn't have
    limit = 2.0 if min(width, height) >= 2 else 0.0
    back = 0.0 if solid else 1.0
    n_small, n_large = _index(0), _index(0)
    for f in range(_index(faces.shape[0])):
        a, b, c = _index(faces[f, 0]), _index(faces[f, 1]), _index(faces[f, 2])
        ua, va, ub, vb, uc, vc = us[a], vs[a], us[b], vs[b], us[c], vs[c]
        # v points down: a face that turns counter-clockwise seen from outside has a negative area here
        area = (uc - ua) * (vb - va) - (ub - ua) * (vc - va)
        u0, u1 = np.ceil(min(ua, ub, uc)), max(ua, ub, uc)
        v0, v1 = np.ceil(min(va, vb, vc)), max(va, vb, vc)
        seen = (max(area, -area * back) > _MIN_AREA) & (ws[a] * ws[b] * ws[c] > 0.0)
        seen &= (u0 <= min(u1, u_last)) & (v0 <= min(v1, v_last)) & (u1 >= 0.0) & (v1 >= 0.0)
        fits = (u1 - u0 < limit) & (v1 - v0 < limit)
        small[n_small] = f
        n_small += _index(seen & fits)
        large[n_large] = f
        n_large += _index(seen & (not fits))
    return n_small, n_large


@numba.njit(**_KERNEL, inline="always")
def _gradients(ua, va, wa, ub, vb, wb, uc, vc, wc):
    """Steps along u and v of the barycentric coordinates of b and c, and of 1/z."""
    bu, bv, cu, cv = vc - va, ua - uc, va - vb, ub - ua
    scale = 1.0 / (bu * cv - bv * cu)
    bu, bv, cu, cv = bu * scale, bv * scale, cu * scale, cv * scale
    return bu, bv, cu, cv, bu * (wb - wa) + cu * (wc - wa), bv * (wb - wa) + cv * (wc - wa)


@numba.njit(**_KERNEL, inline="always")
def _put(inverse_depth, face_ids, v, u, inside, w, f):
    """Draw one sample where `inside` >= 0."""
    old = inverse_depth[v, u]
    drawn = w if inside >= 0.0 else 0.0
    inverse_depth[v, u] = max(old, drawn)
    if face_ids is not None:
        face_ids[v, u] = f if drawn > old else face_ids[v, u]


@numba.njit(**_KERNEL)
def _draw_small(projected, faces, chosen, inverse_depth, face_ids):
    us, vs, ws = projected[0], projected[1], projected[2]
    u_last, v_last = inverse_depth.shape[1] - 2.0, inverse_depth.shape[0] - 2.0
    for i in range(_index(chosen.shape[0])):
        f = _index(chosen[i])
        a, b, c = _index(faces[f, 0]), _index(faces[f, 1]), _index(faces[f, 2])
        ua, va, wa, ub, vb, wb, uc, vc, wc = us[a], vs[a], ws[a], us[b], vs[b], ws[b], us[c], vs[c], ws[c]
        bu, bv, cu, cv, wu, wv = _gradients(ua, va, wa, ub, vb, wb, uc, vc, wc)
        au, av = -bu - cu, -bv - cv
        # at the image's edge the 2 x 2 samples move inwards: the triangle's box is among them still
        left = min(max(0.0, np.ceil(min(ua, ub, uc))), u_last)
        top = min(max(0.0, np.ceil(min(va, vb, vc))), v_last)
        u, v = _index(np.int64(left)), _index(np.int64(top))
        right, below = u + _index(1), v + _index(1)
        du, dv = left - ua, top - va
        lb, lc, w = bu * du + bv * dv + _ON_EDGE, cu * du + cv * dv + _ON_EDGE, wa + wu * du + wv * dv
        la = 1.0 + 3.0 * _ON_EDGE - lb - lc
        _put(inverse_depth, face_ids, v, u, min(la, lb, lc), w, f)
        _put(inverse_depth, face_ids, v, right, min(la + au, lb + bu, lc + cu), w + wu, f)
        la, lb, lc, w = la + av, lb + bv, lc + cv, w + wv
        _put(inverse_depth, face_ids, below, u, min(la, lb, lc), w, f)
        _put(inverse_depth, face_ids, below, right, min(la + au, lb + bu, lc + cu), w + wu, f)


@numba.njit(**_KERNEL, inline="always")
def _crossing(l0, lu, lv):
    """Where l0 + lu i + lv j >= 0 in row j: from `low + low_step j` to `high + high_step j`."""
    inverse = 1.0 / (lu if lu != 0.0 else 1.0)
    x, step = -l0 * inverse, -lv * inverse
    left, right = lu > 0.0, lu < 0.0
    return x if left else -_FAR, step if left else 0.0, x if right else _FAR, step if right else 0.0


@numba.njit(**_KERNEL)
def _draw_large(projected, faces, chosen, inverse_depth, face_ids):
    us, vs, ws = projected[0], projected[1], projected[2]
    u_last, v_last = inverse_depth.shape[1] - 1.0, inverse_depth.shape[0] - 1.0
    for k in range(_index(chosen.shape[0])):
        f = _index(chosen[k])
        a, b, c = _index(faces[f, 0]), _index(faces[f, 1]), _index(faces[f, 2])
        ua, va, wa, ub, vb, wb, uc, vc, wc = us[a], vs[a], ws[a], us[b], vs[b], ws[b], us[c], vs[c], ws[c]
        bu, bv, cu, cv, wu, wv = _gradients(ua, va, wa, ub, vb, wb, uc, vc, wc)
        left, right = max(0.0, np.ceil(min(ua, ub, uc))), min(u_last, np.floor(max(ua, ub, uc)))
        top, bottom = max(0.0, np.ceil(min(va, vb, vc))), min(v_last, np.floor(max(va, vb, vc)))
        u, v = _index(np.int64(left)), _index(np.int64(top))
        du, dv = left - ua, top - va
        lb, lc, w = bu * du + bv * dv + _ON_EDGE, cu * du + cv * dv + _ON_EDGE, wa + wu * du + wv * dv
        a_low, a_low_step, a_high, a_high_step = _crossing(1.0 + 3.0 * _ON_EDGE - lb - lc, -bu - cu, -bv - cv)
        b_low, b_low_step, b_high, b_high_step = _crossing(lb, bu, bv)
        c_low, c_low_step, c_high, c_high_step = _crossing(lc, cu, cv)
        last = right - left
        for j in range(_index(np.int64(bottom - top) + 1)):
            y = np.float64(j)
            low = max(0.0, a_low + a_low_step * y, b_low + b_low_step * y, c_low + c_low_step * y)
            high = min(last, a_high + a_high_step * y, b_high + b_high_step * y, c_high + c_high_step * y)
            row, start = v + j, w + wv * y
            # most rows of a sliver hold at most two samples: these without branches, as the number is hard to foresee
            first = min(np.ceil(low), last)
            second = min(first + 1.0, last)
            i = _index(np.int64(first))
            _put(inverse_depth, face_ids, row, u + i, min(high - first, first - low), start + wu * first, f)
            i = _index(np.int64(second))
            _put(inverse_depth, face_ids, row, u + i, min(high - second, second - low), start + wu * second, f)
            for column in range(np.int64(first) + 2, np.int64(np.floor(max(high, -1.0))) + 1):
                _put(inverse_depth, face_ids, row, u + _index(column), 0.0, start + wu * column, f)
