"""Rigid motions.

`T_ab` maps points from frame b to frame a: ``x_a = T_ab @ x_b``. A twist is ``xi = (rho, phi)``, translation first, and updates act
on the left: ``T <- exp(xi) @ T``. Every function takes stacks: (..., 4, 4) matrices, (..., 6) twists.
"""

import numpy as np

from slamcli.errors import SlamError
from slamcli.jit.kernel import kernel

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
    T_ba = np.zeros_like(T_ab)
    R_ba = np.swapaxes(T_ab[..., :3, :3], -1, -2)
    T_ba[..., :3, :3] = R_ba
    T_ba[..., :3, 3] = -np.einsum("...ij,...j->...i", R_ba, T_ab[..., :3, 3])
    T_ba[..., 3, 3] = 1.0
    return T_ba


def transform(T_ab: np.ndarray, x_b: np.ndarray) -> np.ndarray:
    """Map points (N, 3) from frame b to frame a."""
    return x_b @ T_ab[:3, :3].T + T_ab[:3, 3]


def _series(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3, safe at a = 0."""
    small = angle < SMALL_ANGLE
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    sinc = np.where(small, 1.0 - a2 / 6.0, np.sin(a) / a)
    half_sinc = np.sin(0.5 * a) / (0.5 * a)  # 1 - cos a loses all digits at small a; 2 sin^2(a/2) does not
    cosc = np.where(small, 0.5 - a2 / 24.0, 0.5 * half_sinc * half_sinc)
    cubic = np.where(small, 1.0 / 6.0 - a2 / 120.0, (a - np.sin(a)) / (a * a * a))
    return sinc, cosc, cubic


def exp(xi: np.ndarray) -> np.ndarray:
    """Map twists (..., 6) [m, rad] to rigid motions (..., 4, 4).

    T. Barfoot, State Estimation for Robotics, 2017, section 7.1.
    """
    xi = np.asarray(xi, dtype=np.float64)
    Phi = hat(xi[..., 3:])
    Phi2 = Phi @ Phi
    sinc, cosc, cubic = (s[..., None, None] for s in _series(np.linalg.norm(xi[..., 3:], axis=-1)))
    T = np.zeros(xi.shape[:-1] + (4, 4))
    T[..., :3, :3] = np.eye(3) + sinc * Phi + cosc * Phi2
    V = np.eye(3) + cosc * Phi + cubic * Phi2
    T[..., :3, 3] = np.einsum("...ij,...j->...i", V, xi[..., :3])
    T[..., 3, 3] = 1.0
    return T


def log(T: np.ndarray) -> np.ndarray:
    """Map rigid motions (..., 4, 4) to twists (..., 6) with rotation angle in [0, pi]."""
    T = np.asarray(T, dtype=np.float64)
    quaternion = quaternion_xyzw(T)
    quaternion = np.where(quaternion[..., 3:] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[..., :3], axis=-1)
    angle = 2.0 * np.arctan2(sine, quaternion[..., 3])
    # angle / sin(angle / 2) -> 2 as the angle vanishes; the quaternion keeps full precision both there and at pi.
    phi = quaternion[..., :3] * np.where(sine < SMALL_ANGLE, 2.0, angle / np.where(sine == 0.0, 1.0, sine))[..., None]
    Phi = hat(phi)
    sinc, cosc, _ = _series(angle)
    safe = np.where(angle < SMALL_ANGLE, 1.0, angle)
    quadratic = np.where(angle < SMALL_ANGLE, 1.0 / 12.0, (1.0 - 0.5 * sinc / cosc) / (safe * safe))
    V_inverse = np.eye(3) - 0.5 * Phi + quadratic[..., None, None] * (Phi @ Phi)
    rho = np.einsum("...ij,...j->...i", V_inverse, T[..., :3, 3])
    return np.concatenate([rho, phi], axis=-1)


def adjoint(T_ab: np.ndarray) -> np.ndarray:
    """Return Ad (..., 6, 6) with ``T @ exp(xi) @ inverse(T) == exp(Ad @ xi)``."""
    T_ab = np.asarray(T_ab, dtype=np.float64)
    R = T_ab[..., :3, :3]
    out = np.zeros(T_ab.shape[:-2] + (6, 6))
    out[..., :3, :3] = R
    out[..., :3, 3:] = hat(T_ab[..., :3, 3]) @ R
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
    from scipy.spatial.transform import Rotation

    quaternion = np.asarray(quaternion, dtype=np.float64)
    T = np.zeros(quaternion.shape[:-1] + (4, 4))
    T[..., :3, :3] = Rotation.from_quat(quaternion.reshape(-1, 4)).as_matrix().reshape(quaternion.shape[:-1] + (3, 3))
    T[..., :3, 3] = position
    T[..., 3, 3] = 1.0
    return T


def orthonormalize(T: np.ndarray) -> np.ndarray:
    """Return T (..., 4, 4) with the rotation nearest to its upper left block.

    Every law here, `inverse` first, rests on orthonormal rotations; solvers of polynomials and long products do not keep them so.
    """
    T = np.array(T, dtype=np.float64)
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]  # a rotation, where the nearest orthonormal matrix were a reflection
    T[..., :3, :3] = U @ Vt
    T[..., 3, :] = [0.0, 0.0, 0.0, 1.0]
    return T


def interpolate(T_wa: np.ndarray, T_wb: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
    """Go the share `alpha` of the screw motion from a to b; 0 gives `T_wa`, 1 gives `T_wb`, values outside extrapolate."""
    alpha = np.asarray(alpha, dtype=np.float64)
    return T_wa @ exp(alpha[..., None] * log(inverse(T_wa) @ T_wb))


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
    U, singular, Vt = np.linalg.svd(d_b.T @ d_a / len(x_a))
    if singular[1] <= 1e-12 * max(singular[0], 1e-300):
        raise SlamError("alignment is undetermined: the points lie on one line")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R_ba = (U * sign) @ Vt
    scale = float((singular * sign).sum() / (d_a * d_a).sum(axis=1).mean()) if with_scale else 1.0
    T_ba = np.eye(4)
    T_ba[:3, :3] = R_ba
    T_ba[:3, 3] = mean_b - scale * R_ba @ mean_a
    return T_ba, scale


@kernel
def left_update(T, xi):
    """Replace T (4, 4) in place by exp(xi) @ T, written out for use inside kernels."""
    p0, p1, p2 = xi[3], xi[4], xi[5]
    a2 = p0 * p0 + p1 * p1 + p2 * p2
    a = np.sqrt(a2)
    if a < 1e-4:
        sinc, cosc, cubic = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    else:
        half = np.sin(0.5 * a) / (0.5 * a)
        sinc, cosc, cubic = np.sin(a) / a, 0.5 * half * half, (a - np.sin(a)) / (a2 * a)
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
