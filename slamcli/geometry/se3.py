"""Rigid motions.

`T_ab` maps points from frame b to frame a: ``x_a = T_ab @ x_b``. A twist is ``xi = (rho, phi)``, translation first, and updates act
on the left: ``T <- exp(xi) @ T``. Every function takes stacks: (..., 4, 4) matrices, (..., 6) twists.
"""

import numpy as np
from numba import float64 as f8

from slamcli.errors import SlamError
from slamcli.geometry import elementary
from slamcli.geometry.algebra import eigh, for_kernel, nearest_rotation, product
from slamcli.jit.kernel import kernel

LINE = 1e-14  # squared ratio of the second extent of points to the first, below which rounding hides which line they leave
SMALL_ANGLE = 1e-4  # [rad] below this the series in phi^2 are exact to double precision after two terms


def hat(phi: np.ndarray) -> np.ndarray:
    """Return the skew matrices (..., 3, 3) with ``hat(a) @ b == cross(a, b)``."""
    phi = np.asarray(phi, dtype=np.float64)
    out = np.zeros(phi.shape[:-1] + (3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -phi[..., 2], phi[..., 1], -phi[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = phi[..., 2], -phi[..., 1], phi[..., 0]
    return out


def inverse(T_ab: np.ndarray) -> np.ndarray:
    """Invert rigid motions (..., 4, 4) by transposing the rotation."""
    T_ab = np.asarray(T_ab, dtype=np.float64)
    T_ba = np.empty(T_ab.shape)
    _invert(for_kernel(T_ab).reshape(-1, 4, 4), T_ba.reshape(-1, 4, 4))
    return T_ba


@kernel
def _invert(T: f8[:, :, ::1], out: f8[:, :, ::1]):
    for s in range(len(T)):
        for i in range(3):
            for j in range(3):
                out[s, i, j] = T[s, j, i]
            out[s, i, 3] = -(T[s, 0, i] * T[s, 0, 3] + T[s, 1, i] * T[s, 1, 3] + T[s, 2, i] * T[s, 2, 3])
        out[s, 3, 0] = out[s, 3, 1] = out[s, 3, 2] = 0.0
        out[s, 3, 3] = 1.0


def transform(T_ab: np.ndarray, x_b: np.ndarray) -> np.ndarray:
    """Map points (..., 3) from frame b to frame a, as float64."""
    return _transformed(T_ab[:3, :3], T_ab[:3, 3], x_b)


def rotate(R_ab: np.ndarray, v_b: np.ndarray) -> np.ndarray:
    """Turn vectors (..., 3) from the axes of b to those of a, as float64."""
    return _transformed(R_ab, np.zeros(3), v_b)


def _transformed(R: np.ndarray, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    x = for_kernel(x)
    out = np.empty(x.shape)
    _transform(for_kernel(R), for_kernel(t), x.reshape(-1, 3), out.reshape(-1, 3))
    return out


@kernel
def _transform(R: f8[:, ::1], t: f8[::1], x: f8[:, ::1], out: f8[:, ::1]):
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    for n in range(len(x)):
        a, b, c = x[n, 0], x[n, 1], x[n, 2]
        out[n, 0] = r00 * a + r01 * b + r02 * c + t0
        out[n, 1] = r10 * a + r11 * b + r12 * c + t1
        out[n, 2] = r20 * a + r21 * b + r22 * c + t2


def exp(xi: np.ndarray) -> np.ndarray:
    """Map twists (..., 6) [m, rad] to rigid motions (..., 4, 4).

    T. Barfoot, State Estimation for Robotics, 2017, section 7.1.
    """
    xi = for_kernel(xi)
    T = np.empty((*xi.shape[:-1], 4, 4))
    _exp(xi.reshape(-1, 6), T.reshape(-1, 4, 4))
    return T


@kernel(error_model="numpy")
def _exp(xi: f8[:, ::1], T: f8[:, :, ::1]):
    for s in range(len(xi)):
        for i in range(4):
            for j in range(4):
                T[s, i, j] = 1.0 if i == j else 0.0
        left_update(T[s], xi[s])


def log(T: np.ndarray) -> np.ndarray:
    """Map rigid motions (..., 4, 4) to twists (..., 6) with rotation angle in [0, pi]."""
    T = for_kernel(T)
    xi = np.empty((*T.shape[:-2], 6))
    quaternion = for_kernel(quaternion_xyzw(T)).reshape(-1, 4)
    _log(T.reshape(-1, 4, 4), quaternion, xi.reshape(-1, 6))
    return xi


@kernel(error_model="numpy")
def _log(T: f8[:, :, ::1], quaternion: f8[:, ::1], xi: f8[:, ::1]):
    for s in range(len(T)):
        sign = -1.0 if quaternion[s, 3] < 0.0 else 1.0
        x, y, z, w = sign * quaternion[s, 0], sign * quaternion[s, 1], sign * quaternion[s, 2], sign * quaternion[s, 3]
        sine = np.sqrt(x * x + y * y + z * z)
        angle = 2.0 * elementary.arctangent2(sine, w)
        # angle / sin(angle / 2) -> 2 as the angle vanishes; the quaternion keeps full precision both there and at pi.
        scale = 2.0 if sine < SMALL_ANGLE else angle / sine
        p0, p1, p2 = scale * x, scale * y, scale * z
        sinc, cosc, _ = series(angle)
        quadratic = 1.0 / 12.0 if angle < SMALL_ANGLE else (1.0 - 0.5 * sinc / cosc) / (angle * angle)
        t0, t1, t2 = T[s, 0, 3], T[s, 1, 3], T[s, 2, 3]
        c0, c1, c2 = p1 * t2 - p2 * t1, p2 * t0 - p0 * t2, p0 * t1 - p1 * t0  # phi x t
        xi[s, 0] = t0 - 0.5 * c0 + quadratic * (p1 * c2 - p2 * c1)
        xi[s, 1] = t1 - 0.5 * c1 + quadratic * (p2 * c0 - p0 * c2)
        xi[s, 2] = t2 - 0.5 * c2 + quadratic * (p0 * c1 - p1 * c0)
        xi[s, 3], xi[s, 4], xi[s, 5] = p0, p1, p2


def adjoint(T_ab: np.ndarray) -> np.ndarray:
    """Return Ad (..., 6, 6) with ``T @ exp(xi) @ inverse(T) == exp(Ad @ xi)``."""
    T_ab = np.asarray(T_ab, dtype=np.float64)
    R = T_ab[..., :3, :3]
    out = np.zeros(T_ab.shape[:-2] + (6, 6))
    out[..., :3, :3] = R
    out[..., :3, 3:] = product(hat(T_ab[..., :3, 3]), R)
    out[..., 3:, 3:] = R
    return out


def quaternion_xyzw(T: np.ndarray) -> np.ndarray:
    """Return unit quaternions (..., 4), order x y z w, of the rotations in (..., 4, 4) or (..., 3, 3).

    From the largest of its four components, which loses no digits: S. Shepperd, Quaternion from rotation matrix, JGC 1978,
    doi:10.2514/3.55767b
    """
    R = np.asarray(T, dtype=np.float64)[..., :3, :3]
    x, y, z = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    xy, xz, yz = R[..., 1, 0] + R[..., 0, 1], R[..., 0, 2] + R[..., 2, 0], R[..., 2, 1] + R[..., 1, 2]
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    # Rows of 4 q q^T: each is the quaternion times one of its components.
    rows = [[1.0 + x - y - z, xy, xz, wx], [xy, 1.0 - x + y - z, yz, wy], [xz, yz, 1.0 - x - y + z, wz], [wx, wy, wz, 1.0 + x + y + z]]
    outer = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def from_quaternion(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Build rigid motions (..., 4, 4) from positions (..., 3) and quaternions (..., 4) x y z w, which need not be unit."""
    quaternion = np.asarray(quaternion, dtype=np.float64)
    x, y, z, w = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    T = np.zeros(quaternion.shape[:-1] + (4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    T[..., :3, 3] = position
    T[..., 3, 3] = 1.0
    return T


def orthonormalize(T: np.ndarray) -> np.ndarray:
    """Return T (..., 4, 4) with the rotation nearest to its upper left block.

    Every law here, `inverse` first, rests on orthonormal rotations; solvers of polynomials and long products do not keep them so.
    """
    T = np.array(T, dtype=np.float64)
    T[..., :3, :3] = nearest_rotation(T[..., :3, :3])
    T[..., 3, :] = [0.0, 0.0, 0.0, 1.0]
    return T


def interpolate(T_wa: np.ndarray, T_wb: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
    """Go the share `alpha` of the screw motion from a to b; 0 gives `T_wa`, 1 gives `T_wb`, values outside extrapolate."""
    alpha = np.asarray(alpha, dtype=np.float64)
    return product(T_wa, exp(alpha[..., None] * log(product(inverse(T_wa), T_wb))))


def umeyama(x_a: np.ndarray, x_b: np.ndarray, *, with_scale: bool = False) -> tuple[np.ndarray, float]:
    """Find the rigid motion (or similarity) that best maps points a onto points b.

    x_a, x_b : (N, 3) [m], corresponding rows, N >= 3
    Returns T_ba (4, 4) and scale s, so that ``x_b ~ s R_ba x_a + t_ba``; raises SlamError when fewer than three points are given or
    all lie on one line, as the rotation about that line is then unknown.

    S. Umeyama, PAMI 1991, doi:10.1109/34.88573
    """
    x_a, x_b = np.asarray(x_a, dtype=np.float64), np.asarray(x_b, dtype=np.float64)
    if len(x_a) < 3:
        raise SlamError(f"alignment needs at least 3 point pairs, got {len(x_a)}")
    mean_a, mean_b = x_a.mean(axis=0), x_b.mean(axis=0)
    d_a, d_b = x_a - mean_a, x_b - mean_b
    for d in (d_a, d_b):
        spread = eigh(product(d.T, d))[0]  # squared extents along the principal axes
        if not spread[1] > LINE * spread[2]:
            raise SlamError("alignment is undetermined: the points lie on one line")
    covariance = product(d_b.T, d_a) / len(x_a)
    R_ba = nearest_rotation(covariance)
    scale = float((R_ba * covariance).sum() / (d_a * d_a).sum(axis=1).mean()) if with_scale else 1.0
    T_ba = np.eye(4)
    T_ba[:3, :3] = R_ba
    T_ba[:3, 3] = mean_b - scale * product(R_ba, mean_a)
    return T_ba, scale


@kernel(error_model="numpy")
def series(angle):
    """Return sin(a) / a, (1 - cos a) / a^2 and (a - sin a) / a^3 of an angle, safe at a = 0."""
    a2 = angle * angle
    if angle < SMALL_ANGLE:
        return 1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    sine, half = elementary.sine(angle), elementary.sine(0.5 * angle) / (0.5 * angle)
    # 1 - cos a loses all digits at small a; 2 sin^2(a/2) does not
    return sine / angle, 0.5 * half * half, (angle - sine) / (a2 * angle)


@kernel(error_model="numpy")
def left_update(T, xi):
    """Replace T (4, 4) in place by exp(xi) @ T, written out for use inside kernels."""
    p0, p1, p2 = xi[3], xi[4], xi[5]
    sinc, cosc, cubic = series(np.sqrt(p0 * p0 + p1 * p1 + p2 * p2))
    r00, r01, r02 = 1.0 - cosc * (p1 * p1 + p2 * p2), -sinc * p2 + cosc * p0 * p1, sinc * p1 + cosc * p0 * p2
    r10, r11, r12 = sinc * p2 + cosc * p0 * p1, 1.0 - cosc * (p0 * p0 + p2 * p2), -sinc * p0 + cosc * p1 * p2
    r20, r21, r22 = -sinc * p1 + cosc * p0 * p2, sinc * p0 + cosc * p1 * p2, 1.0 - cosc * (p0 * p0 + p1 * p1)
    x, y, z = xi[0], xi[1], xi[2]
    c0, c1, c2 = p1 * z - p2 * y, p2 * x - p0 * z, p0 * y - p1 * x  # phi x rho
    d0, d1, d2 = p1 * c2 - p2 * c1, p2 * c0 - p0 * c2, p0 * c1 - p1 * c0  # phi x (phi x rho)
    t0, t1, t2 = x + cosc * c0 + cubic * d0, y + cosc * c1 + cubic * d1, z + cosc * c2 + cubic * d2
    for j in range(4):
        a0, a1, a2j = T[0, j], T[1, j], T[2, j]
        T[0, j] = r00 * a0 + r01 * a1 + r02 * a2j
        T[1, j] = r10 * a0 + r11 * a1 + r12 * a2j
        T[2, j] = r20 * a0 + r21 * a1 + r22 * a2j
    T[0, 3] += t0
    T[1, 3] += t1
    T[2, 3] += t2
