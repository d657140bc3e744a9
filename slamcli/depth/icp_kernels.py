"""Kernels of icp.py: depth images made coarse, and point-to-plane alignment by Gauss-Newton."""

from typing import NamedTuple

import numpy as np
from numba import boolean, f4, f8, i4, i8

from slamcli.geometry.cholesky import solve_damped
from slamcli.geometry.se3 import left_update
from slamcli.geometry.six import six, store
from slamcli.jit.kernel import kernel

Z_MIN = 0.05  # [m] a point nearer to the image plane than this, or behind it, falls on nothing
LEAST_VARIANCE_FACTOR = 0.01  # mean of w chi2: of less, images that are equal give no evidence
BAND = 0.05  # of the nearest reading: readings farther behind it belong to another surface


class Points(NamedTuple):
    """The surface of one depth image, as points with normals."""

    xyz: f4[:, ::1]  # (N, 3) [m], camera frame
    normal: f4[:, ::1]  # (N, 3) unit, towards the camera
    variance: f4[::1]  # (N,) [m^2], of a reading along the ray


class PointImage(NamedTuple):
    """Which point each pixel shows."""

    row: i4[:, ::1]  # (h, w), -1 = none
    pinhole: f8[::1]  # fx, fy, cx, cy [px]


class AgreementRule(NamedTuple):
    """When points that meet agree, and what they count."""

    min_cosine: float  # of their normals
    limit: float  # chi2 from which Huber's cost grows like the root
    readings_as_one: float  # what H and b are divided by, beside the variance factor


class PoseEquations(NamedTuple):
    """H xi = b of the left twist of T_ij."""

    H: f8[:, ::1]  # (6, 6)
    b: f8[::1]  # (6,)


class _Round(NamedTuple):
    """One round of Gauss-Newton."""

    every: i8  # n-th point of j takes part
    reach: f8  # [m] that points which meet may be apart
    is_final: boolean  # whether no step follows


@kernel(error_model="numpy")
def window_means(depth: f4[:, ::1], side: i8, first: i8, width: i8, out: f4[:, ::1]):
    """Average the middle of each block of `side` px of a depth image [m]: `width` px from `first` on, both ways.

    NaN where less than three quarters of them show one surface.
    """
    enough = 3 * width * width
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            y0, x0 = v * side + first, u * side + first
            nearest = np.float32(np.inf)
            for y in range(y0, y0 + width):
                for x in range(x0, x0 + width):
                    nearest = min(nearest, depth[y, x]) if depth[y, x] > 0.0 else nearest
            limit, total, n = np.float32((1.0 + BAND) * nearest), np.float32(0.0), 0
            for y in range(y0, y0 + width):
                for x in range(x0, x0 + width):
                    if depth[y, x] > 0.0 and depth[y, x] <= limit:
                        total += depth[y, x]
                        n += 1
            out[v, u] = total / np.float32(n) if 4 * n >= enough else np.nan


@kernel(error_model="numpy")
def _shown_at(x, y, z, view):
    """Return the point that a view shows where a place of its camera's frame projects to, -1 = none."""
    if not z > Z_MIN:
        return -1
    u, v = view.pinhole[0] * x / z + view.pinhole[2] + 0.5, view.pinhole[1] * y / z + view.pinhole[3] + 0.5
    if not (u >= 0.0 and v >= 0.0 and u < view.row.shape[1] and v < view.row.shape[0]):
        return -1
    return view.row[int(v), int(u)]


@kernel(error_model="numpy")
def _normal_equations(T, source, target, view, now, rule, out):
    """Write H = sum w J^T J and b = -sum w J^T r over every `now.every`-th point of j; return points met, points that agree, sum of w chi2.

    r = n_i (q - x_i) is the distance from the plane of i, J = (n_i, q x n_i) its derivative by the left twist of T_ij, w its inverse
    variance times Huber's weight from chi2 = `rule.limit` on.

    Normals err, and so add to H in directions in which nothing is known: over a plane, as if it were rough. In the end, therefore,
    H = sum w (J^T M + M^T J) / 2, with M the same of the normal of j: their errors are independent, and their products vanish on average.

    Written out entry by entry for speed; tests/depth/test_icp.py has its slow twin.
    """
    xyz_j, normal_j, variance_j = source
    xyz_i, normal_i, variance_i = target
    min_cosine, limit, _ = rule
    every, reach, is_final = now
    H, b = out
    h0 = h1 = h2 = h3 = h4 = h5 = g = six(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    cost = 0.0
    T00, T01, T02, T03, T10, T11, T12, T13 = T[0, 0], T[0, 1], T[0, 2], T[0, 3], T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    T20, T21, T22, T23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    met, agree = 0, 0
    for j in range(0, len(xyz_j), every):
        x, y, z = xyz_j[j, 0], xyz_j[j, 1], xyz_j[j, 2]
        qx, qy, qz = T00 * x + T01 * y + T02 * z + T03, T10 * x + T11 * y + T12 * z + T13, T20 * x + T21 * y + T22 * z + T23
        i = _shown_at(qx, qy, qz, view)
        if i < 0:
            continue
        met += 1
        dx, dy, dz = qx - xyz_i[i, 0], qy - xyz_i[i, 1], qz - xyz_i[i, 2]
        n0, n1, n2 = normal_i[i, 0], normal_i[i, 1], normal_i[i, 2]
        x, y, z = normal_j[j, 0], normal_j[j, 1], normal_j[j, 2]
        m0, m1, m2 = T00 * x + T01 * y + T02 * z, T10 * x + T11 * y + T12 * z, T20 * x + T21 * y + T22 * z
        if not (dx * dx + dy * dy + dz * dz <= reach * reach and n0 * m0 + n1 * m1 + n2 * m2 >= min_cosine):
            continue
        agree += 1
        r = n0 * dx + n1 * dy + n2 * dz
        variance = variance_i[i] + variance_j[j]
        chi2 = r * r / variance
        w = 1.0 if chi2 <= limit else np.sqrt(limit / chi2)
        cost += w * chi2
        w /= variance
        n3, n4, n5 = qy * n2 - qz * n1, qz * n0 - qx * n2, qx * n1 - qy * n0
        n = six(n0, n1, n2, n3, n4, n5)
        g = g - (w * r) * n
        if is_final:
            m3, m4, m5 = qy * m2 - qz * m1, qz * m0 - qx * m2, qx * m1 - qy * m0
        else:
            m0, m1, m2, m3, m4, m5 = n0, n1, n2, n3, n4, n5
        m = six(m0, m1, m2, m3, m4, m5)
        w *= 0.5
        h0 = h0 + w * (n0 * m + m0 * n)
        h1 = h1 + w * (n1 * m + m1 * n)
        h2 = h2 + w * (n2 * m + m2 * n)
        h3 = h3 + w * (n3 * m + m3 * n)
        h4 = h4 + w * (n4 * m + m4 * n)
        h5 = h5 + w * (n5 * m + m5 * n)
    store(b.reshape(1, 6), 0, g)
    for i, h in enumerate((h0, h1, h2, h3, h4, h5)):
        store(H, i, h)
    return met, agree, cost


@kernel(error_model="numpy")
def align(
    T_ij: f8[:, ::1],
    source: Points,
    target: Points,
    view: PointImage,
    schedule: f8[:, ::1],
    rule: AgreementRule,
    known: PoseEquations,
    out: PoseEquations,
):
    """Move T_ij (4, 4), in place, to where the points of j, the source, agree best with those of i; write H (upper triangle) and b there.

    A point of j meets the one of i that `view` shows where it projects to. They agree when they are within reach and their normals are
    alike. Returns points met, points that agree, sum of w chi2, iterations, whether the last pass ended by a step that was short enough.

    schedule : (S, 4) rows of every (so many-th point), reach [m], iterations at most, length of a step of the motion that ends them
    known : what is known at the start besides
    """
    A, g, total, xi, L = np.empty((6, 6)), np.empty(6), np.zeros(6), np.empty(6), np.empty((6, 6))
    s, done, iterations, is_short = 0, 0, 0, False
    while True:  # one call, so that what it calls is compiled into this kernel once
        now = _Round(1, schedule[s - 1, 1], True) if s == len(schedule) else _Round(int(schedule[s, 0]), schedule[s, 1], False)
        met, agree, cost = _normal_equations(T_ij, source, target, view, now, rule, out)
        if now.is_final:
            return met, agree, cost, iterations, is_short
        done += 1
        iterations += 1
        # One reading weighs 1 / (readings_as_one s^2), and `every` times that, as it stands for those that this pass leaves out.
        # s^2 = max(cost / n, LEAST_VARIANCE_FACTOR) is how much noisier the depth is than the model says.
        weight = now.every / (rule.readings_as_one * max(cost / max(agree, 1), LEAST_VARIANCE_FACTOR))
        # (weight H + H_prior) xi = weight b + b_prior - H_prior total: the prior is of the start, and so pulls back what was moved since.
        for i in range(6):
            g[i] = weight * out.b[i] + known.b[i]
            for j in range(6):
                A[i, j] = weight * out.H[min(i, j), max(i, j)] + known.H[i, j]
                g[i] -= known.H[i, j] * total[j]
        length = 0.0
        is_solved = solve_damped(A, g, 0.0, L, xi)
        if is_solved:
            left_update(T_ij, xi)  # T <- exp(xi) T
            for i in range(6):
                total[i] += xi[i]
                length += xi[i] * xi[i]
        is_short = is_solved and length < schedule[s, 3] ** 2
        if is_short or not is_solved or done == schedule[s, 2]:
            s, done = s + 1, 0
