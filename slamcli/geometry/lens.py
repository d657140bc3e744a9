"""Lens distortion undone, point by point."""

import math

from numba import f8

from slamcli.geometry import elementary
from slamcli.jit.kernel import kernel

ROUNDS = 20  # at most; freiburg1's lens, the strongest known here, takes four in its corners
WIDEST = 1.55  # [rad] from the axis, 88.8 degrees: the plane z = 1 has no farther points
SMALL = 1e-20  # squared step at which a point is found: 1e-10 of the focal length


@kernel
def undistort(raw: f8[:, ::1], k1: f8, k2: f8, k3: f8, p1: f8, p2: f8, out: f8[:, ::1]):
    """Fill `out` (N, 2) with the points that the lens maps to `raw` (N, 2), x/z and y/z both, by Newton's method."""
    for i in range(len(raw)):
        x, y = raw[i, 0], raw[i, 1]
        for _ in range(ROUNDS):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
            ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - raw[i, 0]
            ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - raw[i, 1]
            xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            determinant = xx * yy - xy * xy
            if determinant <= 0.0:  # beyond the radius up to which the polynomial describes a lens
                break
            dx, dy = (yy * ex - xy * ey) / determinant, (xx * ey - xy * ex) / determinant
            x, y = x - dx, y - dy
            if not dx * dx + dy * dy > SMALL:
                break
        out[i, 0], out[i, 1] = x, y


@kernel
def undistort_rational(raw: f8[:, ::1], k: f8[::1], out: f8[:, ::1]):
    """Fill `out` (N, 2) as `undistort` does; k (8,) are k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV's rational model."""
    p1, p2 = k[2], k[3]
    for i in range(len(raw)):
        x, y = raw[i, 0], raw[i, 1]
        for _ in range(ROUNDS):
            r2 = x * x + y * y
            above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
            below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
            if below <= 0.0:
                break
            radial = above / below
            growth = k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[4]) - radial * (k[5] + r2 * (2.0 * k[6] + 3.0 * r2 * k[7]))
            slope = 2.0 * growth / below
            ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - raw[i, 0]
            ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - raw[i, 1]
            xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            determinant = xx * yy - xy * xy
            if determinant <= 0.0:
                break
            dx, dy = (yy * ex - xy * ey) / determinant, (xx * ey - xy * ex) / determinant
            x, y = x - dx, y - dy
            if not dx * dx + dy * dy > SMALL:
                break
        out[i, 0], out[i, 1] = x, y


@kernel
def undistort_equidistant(raw: f8[:, ::1], k: f8[::1], out: f8[:, ::1]):
    """Fill `out` (N, 2) as `undistort` does; k (4,) are k1 .. k4 of OpenCV's fisheye model.

    Rays at 90 degrees and more from the axis meet no plane z = 1: they become points far out on it.
    """
    for i in range(len(raw)):
        bent = math.sqrt(raw[i, 0] * raw[i, 0] + raw[i, 1] * raw[i, 1])
        theta = min(bent, WIDEST)
        for _ in range(ROUNDS):
            t2 = theta * theta
            error = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) - bent
            slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
            if slope <= 0.0:
                break
            step = error / slope
            theta = min(max(theta - step, 0.0), WIDEST)
            if not step * step > SMALL:
                break
        factor = elementary.sine(theta) / elementary.cosine(theta) / bent if bent > 1e-12 else 1.0
        out[i, 0], out[i, 1] = raw[i, 0] * factor, raw[i, 1] * factor
