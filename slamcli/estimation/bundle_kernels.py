"""Kernels of bundle_problem.py: cost, normal equations, elimination of the landmarks, back-substitution.

K key frames of which n are free, L landmarks, O observations.
`measured` (O, 5) holds per observation u, v [px], depth [m], 1 / sigma_px, 1 / sigma_z. Where 1 / sigma_px is 0 the observation is
switched off; where 1 / sigma_z is 0 the pixel alone counts. `limits` are the chi2 from which Huber's cost grows like the root, without
and with depth.
"""

from typing import NamedTuple

import numpy as np
from numba import f8, i4, i8, u8

from slamcli.geometry.se3 import left_update
from slamcli.geometry.six import load, screw, six, store
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
    """The blocks of the normal equations; b is minus the gradient."""

    U: f8[:, :, ::1]  # (n, 6, 6) of the free key frames, by their left twists (rho, phi)
    b_c: f8[:, ::1]  # (n, 6)
    V: f8[:, ::1]  # (L, 6) upper triangles, of the landmarks
    b_l: f8[:, ::1]  # (L, 3)
    W: f8[:, :, ::1]  # (O, 3, 6) landmark by key frame, of each observation

    @classmethod
    def empty(cls, n: int, n_landmarks: int, n_observations: int) -> "NormalEquations":
        """Make blocks for n free key frames, to be filled."""
        shapes = (n, 6, 6), (n, 6), (n_landmarks, 6), (n_landmarks, 3), (n_observations, 3, 6)
        return cls(*(np.empty(shape) for shape in shapes))

    def clear(self) -> None:
        """Set to 0 what is summed over the landmarks."""
        for block in (self.U, self.b_c):
            block.fill(0.0)


class ReducedBlocks(NamedTuple):
    """The reduced camera system S dx_c = rhs, and what eliminating the landmarks leaves."""

    block_of: i4[:, ::1]  # (n, n) number of each block of S
    S: f8[:, :, ::1]  # (B, 6, 6) blocks on and above the diagonal; of those on it only the upper triangle holds
    rhs: f8[:, ::1]  # (n, 6)
    V_inv: f8[:, ::1]  # (L, 6) upper triangles of the inverses of the damped V, 0 where a landmark is not observed
    scratch: f8[:, :, ::1]  # (most observations of a landmark, 3, 6)


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
    """Add up the blocks of the normal equations with Huber's weights; U and b_c are to hold 0 before.

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
        v00 = v01 = v02 = v11 = v12 = v22 = b0 = b1 = b2 = 0.0  # in registers; as arrays they would be written for each observation
        for o in range(offset[lm], offset[lm + 1]):
            k, m = obs_kf[o], measured[o]
            f, t, inv_px, inv_z = place[k], T[k], m[3], m[4]
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = t[0, 0], t[0, 1], t[0, 2], t[1, 0], t[1, 1], t[1, 2], t[2, 0], t[2, 1], t[2, 2]
            x = r00 * px + r01 * py + r02 * pz + t[0, 3]
            y = r10 * px + r11 * py + r12 * pz + t[1, 3]
            z = r20 * px + r21 * py + r22 * pz + t[2, 3]
            if not (inv_px > 0.0 and z > Z_MIN):
                for j in range(3 if f >= 0 else 0):
                    store(W[o], j, six(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
                continue
            a, b = fx / z * inv_px, fy / z * inv_px
            c, d = -a * x / z, -b * y / z
            ru, rv, rz = a * x + (cx - m[0]) * inv_px, b * y + (cy - m[1]) * inv_px, (z - m[2]) * inv_z
            s = ru * ru + rv * rv + rz * rz
            limit = limits[1] if inv_z > 0.0 else limits[0]
            w = 1.0 if s <= limit else np.sqrt(limit / s)
            m00, m02, m11, m12, m22 = w * a * a, w * a * c, w * b * b, w * b * d, w * (c * c + d * d + inv_z * inv_z)
            q0, q1, q2 = w * a * ru, w * b * rv, w * (c * ru + d * rv + inv_z * rz)
            b0 -= r00 * q0 + r10 * q1 + r20 * q2
            b1 -= r01 * q0 + r11 * q1 + r21 * q2
            b2 -= r02 * q0 + r12 * q1 + r22 * q2
            # Columns of M R.
            g0, g1, g2 = m00 * r00 + m02 * r20, m11 * r10 + m12 * r20, m02 * r00 + m12 * r10 + m22 * r20
            h0, h1, h2 = m00 * r01 + m02 * r21, m11 * r11 + m12 * r21, m02 * r01 + m12 * r11 + m22 * r21
            i0, i1, i2 = m00 * r02 + m02 * r22, m11 * r12 + m12 * r22, m02 * r02 + m12 * r12 + m22 * r22
            v00 += r00 * g0 + r10 * g1 + r20 * g2
            v01 += r00 * h0 + r10 * h1 + r20 * h2
            v11 += r01 * h0 + r11 * h1 + r21 * h2
            v02 += r00 * i0 + r10 * i1 + r20 * i2
            v12 += r01 * i0 + r11 * i1 + r21 * i2
            v22 += r02 * i0 + r12 * i1 + r22 * i2
            if f < 0:
                continue
            store(W[o], 0, screw(x, y, z, g0, g1, g2))
            store(W[o], 1, screw(x, y, z, h0, h1, h2))
            store(W[o], 2, screw(x, y, z, i0, i1, i2))
            u0, u1, u2 = screw(x, y, z, m00, 0.0, m02), screw(x, y, z, 0.0, m11, m12), screw(x, y, z, m02, m12, m22)
            u = U[f]  # [I; x_c^] M [I, -x_c^]: its lower rows follow from the upper ones
            store(u, 0, load(u, 0) + u0)
            store(u, 1, load(u, 1) + u1)
            store(u, 2, load(u, 2) + u2)
            store(u, 3, load(u, 3) + (y * u2 - z * u1))
            store(u, 4, load(u, 4) + (z * u0 - x * u2))
            store(u, 5, load(u, 5) + (x * u1 - y * u0))
            store(b_c, f, load(b_c, f) - screw(x, y, z, q0, q1, q2))
        V[lm, 0], V[lm, 1], V[lm, 2], V[lm, 3], V[lm, 4], V[lm, 5] = v00, v01, v02, v11, v12, v22
        b_l[lm, 0], b_l[lm, 1], b_l[lm, 2] = b0, b1, b2


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
        v00, v01, v02, v11, v12, v22 = d * V[lm, 0], V[lm, 1], V[lm, 2], d * V[lm, 3], V[lm, 4], d * V[lm, 5]
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
            w0, w1, w2 = load(W[b], 0), load(W[b], 1), load(W[b], 2)
            y0, y1, y2 = q00 * w0 + q01 * w1 + q02 * w2, q01 * w0 + q11 * w1 + q12 * w2, q02 * w0 + q12 * w1 + q22 * w2
            store(rhs, g, load(rhs, g) - (b0 * y0 + b1 * y1 + b2 * y2))
            y = Y[b - first]
            store(y, 0, y0)
            store(y, 1, y1)
            store(y, 2, y2)
            for a in range(first, b + 1):  # most of the time goes here
                s, y = S[block_of[place[obs_kf[a]], g]], Y[a - first]
                for i in range(6):
                    store(s, i, load(s, i) - (y[0, i] * w0 + y[1, i] * w1 + y[2, i] * w2))


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
        expected += d0 * (b_l[lm, 0] + damping * V[lm, 0] * d0)
        expected += d1 * (b_l[lm, 1] + damping * V[lm, 3] * d1)
        expected += d2 * (b_l[lm, 2] + damping * V[lm, 5] * d2)
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
