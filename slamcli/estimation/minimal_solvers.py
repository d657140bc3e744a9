"""Minimal solvers: as many poses at once as there are samples, in plain NumPy, since compiling them would cost more than they do."""

import numpy as np

from slamcli.geometry import elementary
from slamcli.geometry.algebra import eigh, inverse, product

LEAST_SINE = 1e-4  # between two edges of a triangle: below, its points lie on a line as far as single precision tells
NEWTON_STEPS = 3  # each doubles the digits, and rounding leaves no more than a few wrong


def p3p(x: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Find the poses that see three points along three rays.

    x : (M, 3, 3) [m], a point per row; ray : (M, 3, 3) directions, of any length
    Returns T (M, 4, 3, 4), up to four solutions [R | t] per sample so that R x_i + t lies on ray i; NaN for those that do not exist.

    The cosine laws |l_i y_i - l_j y_j|^2 = |x_i - x_j|^2 are quadratic forms in the distances l. A root of a cubic makes a combination of
    two of them singular, that is a pair of planes through the origin; on each plane the rest is a quadratic equation in tau = l_2 / l_1.

    M. Persson, K. Nordberg, Lambda Twist: An Accurate Fast Robust Perspective Three Point (P3P) Solver, ECCV 2018,
    doi:10.1007/978-3-030-01225-0_20
    """
    y = ray / np.linalg.norm(ray, axis=2, keepdims=True)
    with np.errstate(all="ignore"):  # what does not exist becomes NaN
        b12, b13, b23 = (-2.0 * (y[:, i] * y[:, j]).sum(axis=1) for i, j in ((0, 1), (0, 2), (1, 2)))
        a12, a13, a23 = (((x[:, i] - x[:, j]) ** 2).sum(axis=1) for i, j in ((0, 1), (0, 2), (1, 2)))
        laws = np.stack([b12, b13, b23, a12, a13, a23])
        distances = _polish(_distances(laws), laws[:, :, None])
        is_real = np.isfinite(distances).all(axis=0) & (distances > 0.0).all(axis=0)
        distances = np.where(is_real, distances, np.nan)
        return _align(x, np.moveaxis(distances, 0, -1)[..., None] * y[:, None])


def _distances(laws: np.ndarray) -> np.ndarray:
    """Solve the cosine laws (6, M) for the distances (3, M, 4)."""
    b12, b13, b23, a12, a13, a23 = laws
    c12, c13, c23 = -0.5 * b12, -0.5 * b13, -0.5 * b23
    s12, s13, s23 = 1.0 - c12 * c12, 1.0 - c13 * c13, 1.0 - c23 * c23
    blob = c12 * c23 * c13 - 1.0
    p3 = a13 * (a23 * s13 - a13 * s23)
    p2 = 2.0 * blob * a23 * a13 + a13 * (2.0 * a12 + a13) * s23 + a23 * (a23 - a12) * s13
    p1 = a23 * (a13 - a23) * s12 - a12 * a12 * s23 - 2.0 * a12 * (blob * a23 + a13 * s23)
    p0 = a12 * (a12 * s23 - a23 * s12)
    g = _real_root(p2 / p3, p1 / p3, p0 / p3)
    rows = [
        [a23 * (1.0 - g), 0.5 * a23 * b12, -0.5 * a23 * b13 * g],
        [0.5 * a23 * b12, a23 - a12 + a13 * g, 0.5 * b23 * (a13 * g - a12)],
        [-0.5 * a23 * b13 * g, 0.5 * b23 * (a13 * g - a12), g * (a13 - a23) - a12],
    ]
    form = np.moveaxis(np.array(rows), -1, 0)
    is_finite = np.all(np.isfinite(form), axis=(1, 2))
    value, vector = eigh(np.where(is_finite[:, None, None], form, np.eye(3)))
    # One eigenvalue is 0 up to rounding, the middle one, as those of a pair of real planes have opposite signs.
    slope = np.sqrt(-value[:, 0] / value[:, 2])
    e, f = vector[:, :, 2], vector[:, :, 0]
    solutions = []
    for s in (slope, -slope):
        w2 = 1.0 / (s * f[:, 0] - e[:, 0])
        w0, w1 = (e[:, 1] - s * f[:, 1]) * w2, (e[:, 2] - s * f[:, 2]) * w2  # the plane l_0 = w0 l_1 + w1 l_2
        a = (a13 - a12) * w1 * w1 - a12 * b13 * w1 - a12
        b = (a13 * b12 * w1 - a12 * b13 * w0 - 2.0 * w0 * w1 * (a12 - a13)) / a
        c = ((a13 - a12) * w0 * w0 + a13 * b12 * w0 + a13) / a
        larger = -0.5 * (b + np.copysign(np.sqrt(b * b - 4.0 * c), b))
        for tau in (larger, c / larger):
            l1 = np.sqrt(a23 / (tau * (b23 + tau) + 1.0))
            l2 = tau * l1
            solutions.append(np.stack([w0 * l1 + w1 * l2, l1, l2]))
    return np.where(is_finite[:, None], np.stack(solutions, axis=2), np.nan)


def _real_root(b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return a real root of x^3 + b x^2 + c x + d: Cardano's where there is one, the largest where there are three; then Newton's method."""
    p, q = c - b * b / 3.0, b * (2.0 * b * b / 27.0 - c / 3.0) + d
    discriminant = 0.25 * q * q + p * p * p / 27.0
    u = elementary.cbrt(-0.5 * q - np.copysign(np.sqrt(np.maximum(discriminant, 0.0)), q))
    one = u - np.where(u == 0.0, 0.0, p / (3.0 * u))
    radius = np.sqrt(np.maximum(-p / 3.0, 0.0))
    largest = 2.0 * radius * elementary.cos(elementary.arccos(np.clip(-0.5 * q / (radius * radius * radius), -1.0, 1.0)) / 3.0)
    root = np.where(discriminant > 0.0, one, largest) - b / 3.0
    for _ in range(NEWTON_STEPS):
        step = (((root + b) * root + c) * root + d) / ((3.0 * root + 2.0 * b) * root + c)
        root = np.where(np.isfinite(step), root - step, root)
    return root


def _polish(distances: np.ndarray, laws: np.ndarray) -> np.ndarray:
    """Take the rounding of all steps out of the distances (3, M, 4): Newton's method on the cosine laws."""
    b12, b13, b23, a12, a13, a23 = laws
    l0, l1, l2 = distances
    for _ in range(NEWTON_STEPS):
        r0 = l0 * l0 + l1 * l1 + b12 * l0 * l1 - a12
        r1 = l0 * l0 + l2 * l2 + b13 * l0 * l2 - a13
        r2 = l1 * l1 + l2 * l2 + b23 * l1 * l2 - a23
        j00, j01 = 2.0 * l0 + b12 * l1, 2.0 * l1 + b12 * l0
        j10, j12 = 2.0 * l0 + b13 * l2, 2.0 * l2 + b13 * l0
        j21, j22 = 2.0 * l1 + b23 * l2, 2.0 * l2 + b23 * l1
        det = -j00 * j12 * j21 - j01 * j10 * j22
        l0 = l0 - (-j12 * j21 * r0 - j01 * j22 * r1 + j01 * j12 * r2) / det
        l1 = l1 - (-j10 * j22 * r0 + j00 * j22 * r1 - j00 * j12 * r2) / det
        l2 = l2 - (j10 * j21 * r0 - j00 * j21 * r1 - j01 * j10 * r2) / det
    return np.stack([l0, l1, l2])


def _align(x: np.ndarray, x_c: np.ndarray) -> np.ndarray:
    """Return [R | t] (M, 4, 3, 4) that takes congruent triangles x (M, 3, 3) to x_c (M, 4, 3, 3): edges to edges, normal to normal."""
    frame = _edges_and_normal(x)
    R = product(_edges_and_normal(x_c), inverse(frame)[:, None])  # NaN where the points lie on a line
    t = x_c[:, :, 0] - np.einsum("msij,mj->msi", R, x[:, 0])
    return np.concatenate([R, t[..., None]], axis=-1)


def _edges_and_normal(x: np.ndarray) -> np.ndarray:
    a, b = x[..., 1, :] - x[..., 0, :], x[..., 2, :] - x[..., 0, :]
    return np.stack([a, b, np.cross(a, b)], axis=-1)


def rigid3(x_a: np.ndarray, x_b: np.ndarray) -> np.ndarray:
    """Find the least-squares rigid motion T_ba (M, 3, 4) of three points onto three; NaN where they lie on a line.

    x_a, x_b : (M, 3, 3) [m], a point per row
    The planes of both triangles are laid on each other; what remains is a turn within the plane, whose angle is an arc tangent.

    B. Horn, Closed-form solution of absolute orientation using unit quaternions, JOSA A 1987, section 5 (coplanar points),
    doi:10.1364/JOSAA.4.000629
    """
    mean_a, mean_b = x_a.mean(axis=1), x_b.mean(axis=1)
    E_a, E_b = _plane_frame(x_a), _plane_frame(x_b)
    uv_a, uv_b = product(x_a - mean_a[:, None], E_a), product(x_b - mean_b[:, None], E_b)
    sine = (uv_a[..., 0] * uv_b[..., 1] - uv_a[..., 1] * uv_b[..., 0]).sum(axis=1)
    cosine = (uv_a[..., 0] * uv_b[..., 0] + uv_a[..., 1] * uv_b[..., 1]).sum(axis=1)
    with np.errstate(invalid="ignore"):
        norm = np.sqrt(sine * sine + cosine * cosine)
        s, c = sine / norm, cosine / norm
    zero, one = np.zeros_like(c), np.ones_like(c)
    turn = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    R = product(E_b, turn, np.swapaxes(E_a, 1, 2))
    t = mean_b - np.einsum("mij,mj->mi", R, mean_a)
    return np.concatenate([R, t[..., None]], axis=-1)


def _plane_frame(x: np.ndarray) -> np.ndarray:
    """Return orthonormal columns (M, 3, 3): along the first edge, across it within the plane, and the normal; NaN for points on a line."""
    a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    normal = np.cross(a, b)
    length, area = np.linalg.norm(a, axis=1), np.linalg.norm(normal, axis=1)
    is_flat = area <= LEAST_SINE * length * np.linalg.norm(b, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        first, third = a / length[:, None], np.where(is_flat[:, None], np.nan, normal / area[:, None])
    return np.stack([first, np.cross(third, first), third], axis=-1)
