"""Kernels of background_motion.py: which matches, and how much surface, agree with a motion."""

from typing import NamedTuple

import numpy as np
from numba import b1, f4, f8

from slamcli.depth.icp_kernels import PointImage, Points
from slamcli.geometry import depth_noise
from slamcli.geometry.depth_noise import DepthNoise
from slamcli.jit.kernel import kernel

Z_MIN = 0.05  # [m] nearer to the image plane than this a point falls on nothing
BEHIND = 1e9  # squared distance in sigma of such a point
LEAST_COSINE = 0.25  # of a surface seen more slantingly, that its area is divided by
SAME_NORMAL = 0.8  # cosine between the normals of points on one surface


class WeightedMatches(NamedTuple):
    """N points of the reference, and where the frame sees them."""

    x_r: f8[:, ::1]  # (N, 3) [m]
    xy: f8[:, ::1]  # (N, 2) [px]
    depth: f8[::1]  # (N,) [m], NaN = unknown
    inv_px: f8[::1]  # (N,) [1/px] 1 / sigma
    inv_z: f8[::1]  # (N,) [1/m]
    weight: f8[::1]  # (N,) what the votes of each count


@kernel
def vote(T: f8[:, :, ::1], matches: WeightedMatches, pinhole: f8[::1], chi2: f8, agrees: b1[::1]):
    """Find the motion T (M, 3 or 4, 4) with which matches of the greatest total weight agree; write these; return its number and the weight.

    The better a match agrees, the more of its weight counts (P. Torr, A. Zisserman, CVIU 2000, doi:10.1006/cviu.1999.0832).
    A motion that is not finite has no votes; -1 where none is.
    """
    weight = matches.weight
    best, most = -1, -1.0
    everything = weight.sum()
    for h in range(len(T)):
        if not np.isfinite(T[h, 0, 0]):
            continue
        total, left = 0.0, everything
        for i in range(len(weight)):
            if total + left <= most:
                break
            left -= weight[i]
            misfit = _misfit(T[h], matches, i, pinhole)
            if misfit < chi2:
                total += weight[i] * (1.0 - misfit / chi2)
        if total > most:
            best, most = h, total
    if best >= 0:
        for i in range(len(weight)):
            agrees[i] = _misfit(T[best], matches, i, pinhole) < chi2
    return best, most


@kernel
def _misfit(T, matches, i, pinhole):
    """Squared distance in sigma between where a point should be seen and where it is."""
    x_r, xy, depth, inv_px, inv_z, _ = matches
    x, y, z = x_r[i, 0], x_r[i, 1], x_r[i, 2]
    far = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if not far > Z_MIN:
        return BEHIND
    du = (pinhole[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / far + pinhole[2] - xy[i, 0]) * inv_px[i]
    dv = (pinhole[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / far + pinhole[3] - xy[i, 1]) * inv_px[i]
    dz = (far - depth[i]) * inv_z[i] if depth[i] == depth[i] else 0.0
    return du * du + dv * dv + dz * dz


@kernel
def surface(xyz: f4[:, ::1], normal: f4[:, ::1], pinhole: f8[::1]):
    """Sum the surface [m^2] that points (N, 3), one a pixel, stand for."""
    total = 0.0
    for j in range(len(xyz)):
        total += _area(xyz, normal, pinhole, j)
    return total


@kernel
def _area(xyz, normal, pinhole, j):
    x, y, z = xyz[j, 0], xyz[j, 1], xyz[j, 2]
    cosine = abs(x * normal[j, 0] + y * normal[j, 1] + z * normal[j, 2]) / np.sqrt(x * x + y * y + z * z)
    return z * z / (pinhole[0] * pinhole[1] * max(cosine, LEAST_COSINE))


@kernel
def explain(T: f8[:, ::1], reference: Points, frame: Points, view: PointImage, flatness: DepthNoise):
    """Sum the surface [m^2] of the reference that the frame shows in the same place under T (4, 4), and what it looks through.

    view : of the frame; surfaces are the same up to `flatness`
    What agrees counts less the farther apart the two are. What is hidden from the frame counts for neither.
    """
    xyz_r, normal_r, _ = reference
    xyz_i, normal_i, _ = frame
    row, pinhole = view
    height, width = row.shape
    explained, contradicted = 0.0, 0.0
    for j in range(len(xyz_r)):
        x, y, z = xyz_r[j, 0], xyz_r[j, 1], xyz_r[j, 2]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if not qz > Z_MIN:
            continue
        qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        u, v = pinhole[0] * qx / qz + pinhole[2] + 0.5, pinhole[1] * qy / qz + pinhole[3] + 0.5
        if not (u >= 0.0 and v >= 0.0 and u < width and v < height):
            continue
        i = row[int(v), int(u)]
        if i < 0:
            continue
        dx, dy, dz = qx - xyz_i[i, 0], qy - xyz_i[i, 1], qz - xyz_i[i, 2]
        n0, n1, n2 = normal_i[i, 0], normal_i[i, 1], normal_i[i, 2]
        x, y, z = normal_r[j, 0], normal_r[j, 1], normal_r[j, 2]
        cosine = n0 * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z)
        cosine += n1 * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z) + n2 * (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z)
        distance = abs(n0 * dx + n1 * dy + n2 * dz)
        allowed = depth_noise.sigma(xyz_r[j, 2], flatness)
        if distance < allowed and cosine > SAME_NORMAL:
            explained += _area(xyz_r, normal_r, pinhole, j) * (1.0 - (distance / allowed) ** 2)
        elif dz < -allowed:
            contradicted += _area(xyz_r, normal_r, pinhole, j)
    return explained, contradicted
