"""Lens distortion undone, point by point."""

from numba import f8

from slamcli.jit.kernel import kernel

ROUNDS = 20  # at most; freiburg1's lens, the strongest known here, takes four in its corners
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
