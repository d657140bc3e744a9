"""Kernels of bundle_problem.py: cost, normal equations, elimination of the landmarks, back-substitution.

K key frames of which n are free, L landmarks, O observations.
`measured` (O, 5) holds per observation u, v [px], depth [m], 1 / sigma_px, 1 / sigma_z. Where 1 / sigma_px is 0 the observation is
switched off; where 1 / sigma_z is 0 the pixel alone counts. `limits` are the chi2 from which Huber's cost grows like the root, without
and with depth.
"""

from typing import NamedTuple

import numpy as np
from numba import f8, i4, i8, u8, uint64

from slamcli.geometry.se3 import left_update
from slamcli.jit.kernel import kernel

Z_MIN = 1e-2  # [m] a landmark nearer to the image plane than this, or behind it, has no projection
CHI2_BEHIND = 1e6  # what such an observation costs: more than any that can be seen, yet finite, and no slope


class Variables(NamedTuple):
    """What is adjusted."""

    T_cw: f8[:, :, ::1]  # (K, 4, 4)
    x_w: f8[:, ::1]  # (L, 3) m


class Sightings(NamedTuple):
    """Which key frame each observation is of."""

    kf: u8[::1]  # (O,)
    offset: i8[::1]  # (L+1,) observations of a landmark; within it they stand in the order of `place`
    place: i8[::1]  # (K,) a key frame's block in the reduced camera system, -1 where it is fixed


class NormalEquations(NamedTuple):
    """The blocks of the normal equations; of U and V the upper triangles alone, b is minus the gradient."""

    U: f8[:, :, ::1]  # (n, 6, 6) of the free key frames, by their left twists (rho, phi)
    b_c: f8[:, ::1]  # (n, 6)
    V: f8[:, :, ::1]  # (L, 3, 3) of the landmarks
    b_l: f8[:, ::1]  # (L, 3)
    W: f8[:, :, ::1]  # (O, 3, 6) landmark by key frame, of each observation

    @classmethod
    def empty(cls, n: int, n_landmarks: int, n_observations: int) -> "NormalEquations":
        """Make blocks for n free key frames, to be filled."""
        shapes = (n, 6, 6), (n, 6), (n_landmarks, 3, 3), (n_landmarks, 3), (n_observations, 3, 6)
        return cls(*(np.empty(shape) for shape in shapes))

    def clear(self) -> None:
        """Set to 0 what is summed over observations."""
        for block in (self.U, self.b_c, self.V, self.b_l):
            block.fill(0.0)


class ReducedBlocks(NamedTuple):
    """The reduced camera system S dx_c = rhs, and what eliminating the landmarks leaves."""

    block_of: i4[:, ::1]  # (n, n) number of each block of S
    S: f8[:, :, ::1]  # (B, 6, 6) blocks on and above the diagonal; of those on it only the upper triangle holds
    rhs: f8[:, ::1]  # (n, 6)
    V_inv: f8[:, ::1]  # (L, 6) upper triangles of the inverses of the damped V, 0 where a landmark is not observed
    scratch: f8[:, :, ::1]  # (most observations of a landmark, 6, 3)


class SharedGradient(NamedTuple):
    """J_map^T w J of one number that all observations share."""

    reduced: f8[:, ::1]  # (n, 6) of the free key frames, less what goes with the landmarks
    lifted: f8[:, ::1]  # (L, 3) of the landmarks


@kernel(error_model="numpy")
def evaluate(at: Variables, seen: Sightings, measured: f8[:, ::1], camera: f8[::1], limits: f8[::1], chi2: f8[::1]):
    """Write chi2 (O,), 0 where switched off, and return the sum of Huber's costs."""
    T, x_w = at
    obs_kf, offset = seen.kf, seen.offset
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    cost = 0.0
    for lm in range(len(x_w)):
        px, py, pz = x_w[lm, 0], x_w[lm, 1], x_w[lm, 2]
        for o in range(offset[lm], offset[lm + 1]):
            k = obs_kf[o]
            inv_px, inv_z = measured[o, 3], measured[o, 4]
            z = T[k, 2, 0] * px + T[k, 2, 1] * py + T[k, 2, 2] * pz + T[k, 2, 3]
            s = CHI2_BEHIND if inv_px > 0.0 else 0.0
            if z > Z_MIN:
                ru = (fx * (T[k, 0, 0] * px + T[k, 0, 1] * py + T[k, 0, 2] * pz + T[k, 0, 3]) / z + cx - measured[o, 0]) * inv_px
                rv = (fy * (T[k, 1, 0] * px + T[k, 1, 1] * py + T[k, 1, 2] * pz + T[k, 1, 3]) / z + cy - measured[o, 1]) * inv_px
                rz = (z - measured[o, 2]) * inv_z
                s = ru * ru + rv * rv + rz * rz
            limit = limits[1] if inv_z > 0.0 else limits[0]
            chi2[o] = s
            cost += s if s <= limit else 2.0 * np.sqrt(limit * s) - limit
    return cost


@kernel(error_model="numpy")
def linearize(at: Variables, seen: Sightings, measured: f8[:, ::1], camera: f8[::1], limits: f8[::1], normal: NormalEquations):
    """Add up the blocks of the normal equations with Huber's weights, in arrays that hold 0 before.

    W = J_landmark^T w J_pose is written for free key frames alone.

    With r = prediction - measurement, each residual's derivative by the point in the camera, scaled by 1 / sigma,
        u: g = (fx/Z, 0, -fx X/Z^2)    v: g = (0, fy/Z, -fy Y/Z^2)    z: g = (0, 0, 1)
    makes the row (g, x_c x g) of J_pose, minus (8), and the row g R of J_landmark, minus (9). So all blocks follow from
    M = sum w g^T g and q = sum w g^T r of the observation:
        U = [I; x_c^] M [I, -x_c^]    V = R^T M R    W^T = [I; x_c^] M R    b_c = -[q; x_c x q]    b_l = -R^T q
    """
    T, x_w = at
    obs_kf, offset, place = seen
    U, b_c, V, b_l, W = normal
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for lm in range(len(x_w)):
        px, py, pz = x_w[lm, 0], x_w[lm, 1], x_w[lm, 2]
        for o in range(offset[lm], offset[lm + 1]):
            f, R, m = place[obs_kf[o]], T[obs_kf[o]], measured[o]
            inv_px, inv_z = m[3], m[4]
            x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + R[0, 3]
            y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + R[1, 3]
            z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + R[2, 3]
            if not (inv_px > 0.0 and z > Z_MIN):
                for i in range(3 if f >= 0 else 0):
                    for j in range(6):
                        W[o, i, j] = 0.0
                continue
            a, b = fx / z * inv_px, fy / z * inv_px
            c, d = -a * x / z, -b * y / z
            ru, rv, rz = a * x + (cx - m[0]) * inv_px, b * y + (cy - m[1]) * inv_px, (z - m[2]) * inv_z
            s = ru * ru + rv * rv + rz * rz
            limit = limits[1] if inv_z > 0.0 else limits[0]
            w = 1.0 if s <= limit else np.sqrt(limit / s)
            m00, m02, m11, m12, m22 = w * a * a, w * a * c, w * b * b, w * b * d, w * (c * c + d * d + inv_z * inv_z)
            q0, q1, q2 = w * a * ru, w * b * rv, w * (c * ru + d * rv + inv_z * rz)
            for j in range(3):
                r0, r1, r2 = R[0, j], R[1, j], R[2, j]
                p0, p1, p2 = m00 * r0 + m02 * r2, m11 * r1 + m12 * r2, m02 * r0 + m12 * r1 + m22 * r2
                b_l[lm, j] -= r0 * q0 + r1 * q1 + r2 * q2
                for i in range(j + 1):
                    V[lm, i, j] += R[0, i] * p0 + R[1, i] * p1 + R[2, i] * p2
                if f >= 0:
                    row = W[o, j]
                    row[0], row[1], row[2], row[3], row[4], row[5] = p0, p1, p2, y * p2 - z * p1, z * p0 - x * p2, x * p1 - y * p0
            if f < 0:
                continue
            _add_to_key_frame(U[f], b_c[f], (x, y, z), (m00, m02, m11, m12, m22), (q0, q1, q2))


@kernel(error_model="numpy")
def _add_to_key_frame(u, g, x_c, M, q):
    """Add [I; x_c^] M [I, -x_c^] to the upper triangle of u (6, 6), and -[q; x_c x q] to g (6,)."""
    x, y, z = x_c
    m00, m02, m11, m12, m22 = M
    q0, q1, q2 = q
    c03, c04, c05 = y * m02, z * m00 - x * m02, -y * m00
    c13, c14, c15 = y * m12 - z * m11, -x * m12, x * m11
    c23, c24, c25 = y * m22 - z * m12, z * m02 - x * m22, x * m12 - y * m02
    u[0, 0] += m00
    u[0, 2] += m02
    u[0, 3] += c03
    u[0, 4] += c04
    u[0, 5] += c05
    u[1, 1] += m11
    u[1, 2] += m12
    u[1, 3] += c13
    u[1, 4] += c14
    u[1, 5] += c15
    u[2, 2] += m22
    u[2, 3] += c23
    u[2, 4] += c24
    u[2, 5] += c25
    u[3, 3] += y * c23 - z * c13
    u[3, 4] += y * c24 - z * c14
    u[3, 5] += y * c25 - z * c15
    u[4, 4] += z * c04 - x * c24
    u[4, 5] += z * c05 - x * c25
    u[5, 5] += x * c15 - y * c05
    g[0] -= q0
    g[1] -= q1
    g[2] -= q2
    g[3] -= y * q2 - z * q1
    g[4] -= z * q0 - x * q2
    g[5] -= x * q1 - y * q0


@kernel(error_model="numpy")
def eliminate(normal: NormalEquations, seen: Sightings, damping: f8, hold: f8[::1], reduced: ReducedBlocks):
    """Assemble the reduced camera system S dx_c = rhs, the Schur complement of the landmarks.

    damping multiplies the diagonals (Marquardt); hold (n,) is added to the key frames' diagonals. S is to hold 0 before.
    """
    U, b_c, V, b_l, W = normal
    obs_kf, offset, place = seen
    block_of, S, rhs, V_inv, Y = reduced
    for f in range(len(U)):
        s = block_of[f, f]
        for i in range(6):
            for j in range(i, 6):
                S[s, i, j] = U[f, i, j]
            S[s, i, i] += damping * U[f, i, i] + hold[f]
            rhs[f, i] = b_c[f, i]
    d = 1.0 + damping
    for lm in range(len(V)):
        v00, v01, v02, v11, v12, v22 = d * V[lm, 0, 0], V[lm, 0, 1], V[lm, 0, 2], d * V[lm, 1, 1], V[lm, 1, 2], d * V[lm, 2, 2]
        c00, c01, c02 = v11 * v22 - v12 * v12, v02 * v12 - v01 * v22, v01 * v12 - v02 * v11
        det = v00 * c00 + v01 * c01 + v02 * c02
        q = 1.0 / det if det > 0.0 else 0.0
        q00, q01, q02 = q * c00, q * c01, q * c02
        q11, q12, q22 = q * (v00 * v22 - v02 * v02), q * (v01 * v02 - v00 * v12), q * (v00 * v11 - v01 * v01)
        V_inv[lm, 0], V_inv[lm, 1], V_inv[lm, 2], V_inv[lm, 3], V_inv[lm, 4], V_inv[lm, 5] = q00, q01, q02, q11, q12, q22
        b0, b1, b2 = b_l[lm, 0], b_l[lm, 1], b_l[lm, 2]
        first, last = offset[lm], offset[lm + 1]
        for b in range(first, last):
            g = place[obs_kf[b]]
            if g < 0:
                first = b + 1
                continue
            for i in range(6):
                a0, a1, a2 = W[b, 0, i], W[b, 1, i], W[b, 2, i]
                y0, y1, y2 = a0 * q00 + a1 * q01 + a2 * q02, a0 * q01 + a1 * q11 + a2 * q12, a0 * q02 + a1 * q12 + a2 * q22
                rhs[g, i] -= y0 * b0 + y1 * b1 + y2 * b2
                Y[b - first, i, 0], Y[b - first, i, 1], Y[b - first, i, 2] = y0, y1, y2
            # Most of the time goes here. W in named variables stays in registers, as an array it would be read again after each store;
            # unsigned rows spare the test for a negative index. Together 60 ns a block became 25.
            w00, w01, w02, w03, w04, w05 = W[b, 0, 0], W[b, 0, 1], W[b, 0, 2], W[b, 0, 3], W[b, 0, 4], W[b, 0, 5]
            w10, w11, w12, w13, w14, w15 = W[b, 1, 0], W[b, 1, 1], W[b, 1, 2], W[b, 1, 3], W[b, 1, 4], W[b, 1, 5]
            w20, w21, w22, w23, w24, w25 = W[b, 2, 0], W[b, 2, 1], W[b, 2, 2], W[b, 2, 3], W[b, 2, 4], W[b, 2, 5]
            for a in range(first, b + 1):
                s, p = uint64(block_of[place[obs_kf[a]], g]), uint64(a - first)
                for i in range(6):
                    y0, y1, y2 = Y[p, i, 0], Y[p, i, 1], Y[p, i, 2]
                    S[s, i, 0] -= y0 * w00 + y1 * w10 + y2 * w20
                    S[s, i, 1] -= y0 * w01 + y1 * w11 + y2 * w21
                    S[s, i, 2] -= y0 * w02 + y1 * w12 + y2 * w22
                    S[s, i, 3] -= y0 * w03 + y1 * w13 + y2 * w23
                    S[s, i, 4] -= y0 * w04 + y1 * w14 + y2 * w24
                    S[s, i, 5] -= y0 * w05 + y1 * w15 + y2 * w25


@kernel(error_model="numpy")
def step(
    at: Variables,
    normal: NormalEquations,
    V_inv: f8[:, ::1],
    seen: Sightings,
    damping: f8,
    hold: f8[::1],
    dx: f8[:, ::1],
    to: Variables,
):
    """Back-substitute the landmarks, write the moved poses and landmarks; return the decrease of the cost to be expected."""
    T, x_w = at
    U, b_c, V, b_l, W = normal
    obs_kf, offset, place = seen
    T_new, x_new = to
    expected = 0.0
    for k in range(len(T)):
        for i in range(4):
            for j in range(4):
                T_new[k, i, j] = T[k, i, j]
        f = place[k]
        if f >= 0:
            left_update(T_new[k], dx[f])
            for i in range(6):
                expected += dx[f, i] * (b_c[f, i] + (damping * U[f, i, i] + hold[f]) * dx[f, i])
    for lm in range(len(x_w)):
        g0, g1, g2 = b_l[lm, 0], b_l[lm, 1], b_l[lm, 2]
        for o in range(offset[lm], offset[lm + 1]):
            f = place[obs_kf[o]]
            if f < 0:
                continue
            for j in range(6):
                d = dx[f, j]
                g0 -= W[o, 0, j] * d
                g1 -= W[o, 1, j] * d
                g2 -= W[o, 2, j] * d
        d0 = V_inv[lm, 0] * g0 + V_inv[lm, 1] * g1 + V_inv[lm, 2] * g2
        d1 = V_inv[lm, 1] * g0 + V_inv[lm, 3] * g1 + V_inv[lm, 4] * g2
        d2 = V_inv[lm, 2] * g0 + V_inv[lm, 4] * g1 + V_inv[lm, 5] * g2
        expected += d0 * (b_l[lm, 0] + damping * V[lm, 0, 0] * d0)
        expected += d1 * (b_l[lm, 1] + damping * V[lm, 1, 1] * d1)
        expected += d2 * (b_l[lm, 2] + damping * V[lm, 2, 2] * d2)
        x_new[lm, 0], x_new[lm, 1], x_new[lm, 2] = x_w[lm, 0] + d0, x_w[lm, 1] + d1, x_w[lm, 2] + d2
    return expected


@kernel(error_model="numpy")
def shared_gradient(
    at: Variables,
    seen: Sightings,
    measured: f8[:, ::1],
    camera: f8[::1],
    column: f8[:, ::1],
    W: f8[:, :, ::1],
    V_inv: f8[:, ::1],
    to: SharedGradient,
):
    """Add up J_landmark^T w J and J_pose^T w J in arrays that hold 0 before.

    W, V_inv : of a problem that is linearized and its landmarks eliminated
    column (O, 3) : of J, the growth of u, v [px] and depth [m]. The rows of J_pose and J_landmark are those of `linearize`.
    """
    T, x_w = at
    obs_kf, offset, place = seen
    fx, fy = camera[0], camera[1]
    reduced, lifted = to
    for lm in range(len(x_w)):
        px, py, pz = x_w[lm, 0], x_w[lm, 1], x_w[lm, 2]
        for o in range(offset[lm], offset[lm + 1]):
            R, f = T[obs_kf[o]], place[obs_kf[o]]
            inv_px, inv_z = measured[o, 3], measured[o, 4]
            x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + R[0, 3]
            y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + R[1, 3]
            z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + R[2, 3]
            if not (inv_px > 0.0 and z > Z_MIN):
                continue
            u, v = column[o, 0] * inv_px * inv_px, column[o, 1] * inv_px * inv_px
            q0, q1 = fx / z * u, fy / z * v
            q2 = column[o, 2] * inv_z * inv_z - (q0 * x + q1 * y) / z
            for j in range(3):
                lifted[lm, j] += R[0, j] * q0 + R[1, j] * q1 + R[2, j] * q2
            if f >= 0:
                row = reduced[f]
                row[0] += q0
                row[1] += q1
                row[2] += q2
                row[3] += y * q2 - z * q1
                row[4] += z * q0 - x * q2
                row[5] += x * q1 - y * q0
        l0, l1, l2 = lifted[lm, 0], lifted[lm, 1], lifted[lm, 2]
        y0 = V_inv[lm, 0] * l0 + V_inv[lm, 1] * l1 + V_inv[lm, 2] * l2
        y1 = V_inv[lm, 1] * l0 + V_inv[lm, 3] * l1 + V_inv[lm, 4] * l2
        y2 = V_inv[lm, 2] * l0 + V_inv[lm, 4] * l1 + V_inv[lm, 5] * l2
        for o in range(offset[lm], offset[lm + 1]):
            f = place[obs_kf[o]]
            for i in range(6 if f >= 0 else 0):
                reduced[f, i] -= W[o, 0, i] * y0 + W[o, 1, i] * y1 + W[o, 2, i] * y2
