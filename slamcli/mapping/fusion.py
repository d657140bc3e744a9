"""Depth images of key frames to one coloured cloud: clean, average in voxels, drop stray points.

A voxel holds weighted sums only, so memory grows with the surface seen and not with the number of frames.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import f4, f8, i4, i8, u1

from slamcli.config import SurfaceConfig
from slamcli.geometry import se3, voxel
from slamcli.geometry.camera import Camera
from slamcli.geometry.voxel import find_or_add, spread
from slamcli.kernels import kernel
from slamcli.mapping import outliers

HALF_EXTENT = outliers.HALF_EXTENT
JUMP_SIGMA = 4.0  # a depth step is a jump from this many sigma on, beyond what the steepest slope allowed would give
PAIR_SIGMA = 3.0  # a pair of pixels agrees with the one between when their mean is within this many sigma
MIN_PAIRS = 3  # that must agree for a reading to be on a surface
MAX_WINDOW = 6  # px; beyond, smoothing costs time and takes detail


@dataclass(frozen=True)
class Cloud:
    """Points in Morton order of their voxels."""

    xyz: np.ndarray  # (N, 3) float32 [m]
    rgb: np.ndarray  # (N, 3) uint8
    normal: np.ndarray  # (N, 3) float32, unit, towards the cameras that saw the point

    def __len__(self) -> int:
        return len(self.xyz)

    def moved(self, T_ab: np.ndarray) -> "Cloud":
        """Give the cloud of frame b in frame a; the order stays."""
        xyz = se3.transform(T_ab, self.xyz.astype(np.float64)).astype(np.float32)
        return Cloud(xyz, self.rgb, (self.normal @ T_ab[:3, :3].T).astype(np.float32))


@dataclass(frozen=True)
class Surface:
    """The pixels of one depth image that show a surface."""

    pixel: np.ndarray  # (N,) int32, row * width + column
    xyz_c: np.ndarray  # (N, 3) float32 [m]
    normal_c: np.ndarray  # (N, 3) float32, unit, towards the camera
    weight: np.ndarray  # (N,) float32 [1/m^2], inverse variance along the ray


def surface(
    depth: np.ndarray, camera: Camera, *, settings: SurfaceConfig, stride: int, spacing: float, depth_min: float, depth_max: float
) -> Surface:
    """Find the pixels of a depth image (H, W) [m] that lie on a surface; smooth their depth and give the normals.

    Left out are readings out of range, those near a depth jump (where sensors report points that hang in the air between two
    surfaces), and surfaces seen at a grazing angle.

    A plane's inverse depth is linear in the pixel. So two pixels opposite each other, as seen from a third, have its inverse depth on
    average, however slanted the plane: such pairs are averaged where they agree within the noise, and their differences give the normal.

    stride : every stride-th row and column is looked at, and where that is so near that the points lie closer together than `spacing`
        [m], every second or fourth of these
    """
    n = (depth.shape[0] // stride + 1) * (depth.shape[1] // stride + 1)
    out = Surface(np.empty(n, np.int32), np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.float32))
    with np.errstate(divide="ignore"):  # a depth of 0 has no place here, and is left out as infinitely near
        inverse = 1.0 / np.asarray(depth, dtype=np.float32)
    n = _find_surface(
        inverse,
        _rays(camera),
        stride,
        spacing * max(camera.fx, camera.fy) / stride,
        settings.edge,
        settings.window,
        1.0 / depth_max,
        1.0 / max(depth_min, 1e-3),
        settings.noise_base,
        settings.noise_quadratic,
        np.cos(np.radians(settings.max_angle_deg)),
        np.tan(np.radians(settings.max_angle_deg)) / camera.fx,
        out.pixel,
        out.xyz_c,
        out.normal_c,
        out.weight,
    )
    return Surface(out.pixel[:n], out.xyz_c[:n], out.normal_c[:n], out.weight[:n])


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> np.ndarray:
    """Give the camera's rays, worked out once for equal cameras: every stage has an object of its own."""
    return camera.rays


@kernel(error_model="numpy")
def _find_surface(
    inverse: f4[:, ::1],
    rays: f4[:, :, ::1],
    stride: i8,
    near: f8,
    edge: i8,
    window: f8,
    low: f8,
    high: f8,
    noise_base: f8,
    noise_quadratic: f8,
    min_cosine: f8,
    steepest: f8,
    pixel: i4[::1],
    xyz_c: f4[:, ::1],
    normal_c: f4[:, ::1],
    weight: f4[::1],
):
    """Fill the surface's pixels, points, normals and weights; returns their number. Missing readings are NaN and fail every test."""
    height, width = inverse.shape
    n = 0
    for v in range(max(stride // 2, 1), height - 1, stride):
        for u in range(max(stride // 2, 1), width - 1, stride):
            q = inverse[v, u]
            if not (low <= q <= high):
                continue
            thinning = 1 if near * q < 2.0 else 2 if near * q < 4.0 else 4
            if (u // stride | v // stride) & (thinning - 1) != 0:
                continue
            z = 1.0 / q
            sigma = (noise_base + noise_quadratic * (z - 0.4) ** 2) * q * q  # of inverse depth
            if _is_at_jump(inverse, v, u, edge, JUMP_SIGMA * sigma + edge * steepest * q):
                continue
            half = min(MAX_WINDOW, max(1, int(window * z + 0.5)), v, u, height - 1 - v, width - 1 - u)
            n_pairs, total, slope_u, slope_v = _fit_pairs(inverse, v, u, half, np.float32(2.0 * PAIR_SIGMA * sigma))
            if n_pairs < MIN_PAIRS:
                continue
            q = (q + total) / (1 + 2 * n_pairs)
            # The plane n . p = -1 has inverse depth -n . (x, y, 1): -nx and -ny are its slopes along the ray's x and y.
            xu, yu = 0.5 * (rays[v, u + 1, 0] - rays[v, u - 1, 0]), 0.5 * (rays[v, u + 1, 1] - rays[v, u - 1, 1])
            xv, yv = 0.5 * (rays[v + 1, u, 0] - rays[v - 1, u, 0]), 0.5 * (rays[v + 1, u, 1] - rays[v - 1, u, 1])
            scale = 1.0 / (xu * yv - xv * yu)
            nx, ny = (slope_v * yu - slope_u * yv) * scale, (slope_u * xv - slope_v * xu) * scale
            rx, ry = rays[v, u, 0], rays[v, u, 1]
            nz = -q - nx * rx - ny * ry
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if not q > min_cosine * length * np.sqrt(rx * rx + ry * ry + 1.0):
                continue
            z = 1.0 / q
            pixel[n] = v * width + u
            xyz_c[n, 0], xyz_c[n, 1], xyz_c[n, 2] = z * rx, z * ry, z
            scale = 1.0 / length
            normal_c[n, 0], normal_c[n, 1], normal_c[n, 2] = nx * scale, ny * scale, nz * scale
            weight[n] = (1 + 2 * n_pairs) * (q * q / sigma) ** 2
            n += 1
    return n


@kernel(error_model="numpy")
def _fit_pairs(inverse, v, u, half, limit):
    """Sum the pairs of opposite pixels that agree with (v, u) and fit the slopes of inverse depth.

    Returns the number of pairs, the sum of their inverse depths, and the slopes per column and per row, least squares over the pairs;
    no pairs when they do not fix both slopes. Float32 and whole-numbered offsets, as this is where the time goes.
    """
    step = 1 if half < 3 else 2
    twice = np.float32(2.0) * inverse[v, u]
    total, uq, vq = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    n, uu, uv, vv = 0, 0, 0, 0
    for dv in range(0, half + 1, step):
        for du in range(-half if dv else step, half + 1, step):
            a, b = inverse[v + dv, u + du], inverse[v - dv, u - du]
            both, difference = a + b, a - b
            if abs(both - twice) <= limit:
                n += 1
                total += both
                uu += du * du
                uv += du * dv
                vv += dv * dv
                uq += np.float32(du) * difference
                vq += np.float32(dv) * difference
    determinant = 2.0 * (uu * vv - uv * uv)
    if determinant == 0.0:
        return 0, 0.0, 0.0, 0.0
    scale = 1.0 / determinant
    return n, np.float64(total), (vv * uq - uv * vq) * scale, (uu * vq - uv * uq) * scale


@kernel
def _is_at_jump(inverse, v, u, distance, limit):
    """Say whether a neighbour up, down, left or right differs by more than the limit, or two opposite ones are missing."""
    height, width = inverse.shape
    q, nothing = inverse[v, u], np.float32(np.nan)
    above = inverse[v - distance, u] if v >= distance else nothing
    below = inverse[v + distance, u] if v + distance < height else nothing
    left = inverse[v, u - distance] if u >= distance else nothing
    right = inverse[v, u + distance] if u + distance < width else nothing
    if abs(above - q) > limit or abs(below - q) > limit or abs(left - q) > limit or abs(right - q) > limit:
        return True
    return (above != above and below != below) or (left != left and right != right)


class VoxelCloud:
    """A growing cloud: per voxel the weighted means of position, normal and colour."""

    def __init__(self, side: float) -> None:
        """Start empty; `side` is the voxels' [m]."""
        self.side = float(side)
        self._rows = voxel.VoxelRows(sums=((10,), np.float32, 0.0), count=((), np.int32, 0))

    def add(self, seen: Surface, rgb: np.ndarray, T_wc: np.ndarray) -> None:
        """Add what one key frame saw; `rgb` (H, W, 3) uint8."""
        self._rows.reserve(len(seen.pixel))
        rows = self._rows
        rows.n = _add_points(
            seen.pixel,
            seen.xyz_c,
            seen.normal_c,
            seen.weight,
            np.ascontiguousarray(rgb).reshape(-1, 3),
            np.ascontiguousarray(T_wc, dtype=np.float64),
            1.0 / self.side,
            rows.slot_row,
            rows.row_key,
            rows.n,
            rows.columns["sums"],
            rows.columns["count"],
        )

    def cloud(self, *, min_points: int = 1, neighbours: int = 0, max_deviation: float = np.inf) -> Cloud:
        """Give the voxels with at least `min_points` readings, in Morton order.

        neighbours, max_deviation : points whose mean distance to so many neighbours exceeds the mean over the cloud by more than so
            many standard deviations are dropped; 0 neighbours keep all
        """
        n = self._rows.n
        row = np.flatnonzero(self._rows.columns["count"][:n] >= min_points)
        key = self._rows.row_key[row]
        order = np.argsort(key)
        row, key = row[order], key[order]
        sums = self._rows.columns["sums"][row]
        mean = sums[:, 1:] / sums[:, :1]
        xyz = (voxel.unmorton(key) - HALF_EXTENT + 0.5 + mean[:, :3]) * self.side
        length = np.linalg.norm(mean[:, 3:6], axis=1, keepdims=True)
        normal = mean[:, 3:6] / np.where(length > 0, length, 1.0)
        rgb = np.clip(np.rint(mean[:, 6:9]), 0, 255).astype(np.uint8)
        keep = outliers.not_stray(xyz, key, side=self.side, neighbours=neighbours, max_deviation=max_deviation)
        return Cloud(xyz[keep].astype(np.float32), rgb[keep], normal[keep])


@kernel
def _add_points(
    pixel: i4[::1],
    xyz_c: f4[:, ::1],
    normal_c: f4[:, ::1],
    weight: f4[::1],
    rgb: u1[:, ::1],
    T_wc: f8[:, ::1],
    per_side: f8,
    slot_row: i4[::1],
    row_key: i8[::1],
    n_rows: i8,
    sums: f4[:, ::1],
    count: i4[::1],
):
    """Add weighted points to their voxels; sums are weight, offset from the centre [voxels], normal, colour. Returns the rows in use."""
    half = 1 << 20
    for i in range(len(pixel)):
        x, y, z = xyz_c[i, 0], xyz_c[i, 1], xyz_c[i, 2]
        px = (T_wc[0, 0] * x + T_wc[0, 1] * y + T_wc[0, 2] * z + T_wc[0, 3]) * per_side
        py = (T_wc[1, 0] * x + T_wc[1, 1] * y + T_wc[1, 2] * z + T_wc[1, 3]) * per_side
        pz = (T_wc[2, 0] * x + T_wc[2, 1] * y + T_wc[2, 2] * z + T_wc[2, 3]) * per_side
        fx, fy, fz = np.floor(px), np.floor(py), np.floor(pz)
        if not (abs(fx) < half and abs(fy) < half and abs(fz) < half):
            continue
        key = spread(int(fx) + half) | spread(int(fy) + half) << 1 | spread(int(fz) + half) << 2
        row = find_or_add(slot_row, row_key, n_rows, key)
        n_rows = max(n_rows, row + 1)
        w = weight[i]
        a, b, c = normal_c[i, 0], normal_c[i, 1], normal_c[i, 2]
        sums[row, 0] += w
        sums[row, 1] += w * (px - fx - 0.5)
        sums[row, 2] += w * (py - fy - 0.5)
        sums[row, 3] += w * (pz - fz - 0.5)
        sums[row, 4] += w * (T_wc[0, 0] * a + T_wc[0, 1] * b + T_wc[0, 2] * c)
        sums[row, 5] += w * (T_wc[1, 0] * a + T_wc[1, 1] * b + T_wc[1, 2] * c)
        sums[row, 6] += w * (T_wc[2, 0] * a + T_wc[2, 1] * b + T_wc[2, 2] * c)
        sums[row, 7] += w * rgb[pixel[i], 0]
        sums[row, 8] += w * rgb[pixel[i], 1]
        sums[row, 9] += w * rgb[pixel[i], 2]
        count[row] += 1
    return n_rows
