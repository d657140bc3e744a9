"""Oriented points of a depth image: readings on one surface, smoothed, with their normals."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import f4, f8, i4, i8

from slamcli.config.options import SensorConfig, SurfaceConfig
from slamcli.depth import noise_model
from slamcli.geometry import depth_noise, elementary
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_noise import DepthNoise
from slamcli.jit.kernel import kernel

JUMP_SIGMA = 4.0  # a depth step is a jump from this many sigma on, beyond what the steepest slope allowed would give
PAIR_SIGMA = 3.0  # a pair of pixels agrees with the one between when their mean is within this many sigma
MIN_PAIRS = 3  # that must agree for a reading to be on a surface
NEAREST = 1e-3  # [m] a depth of 0 would be infinitely near
MAX_WINDOW = 6  # px; beyond, smoothing costs time and takes detail


class Sought(NamedTuple):
    """Which pixels of a depth image are looked at, and what counts as a surface."""

    stride: i8  # every stride-th row and column
    near: f8  # [m] at less than half of this depth, every second or fourth of these
    edge: i8  # [px] from a depth jump, within which readings are dropped
    window: f8  # [px/m] half width of the smoothing window, per metre of distance
    low: f8  # [1/m] inverse of the greatest depth
    high: f8  # [1/m] inverse of the least
    min_cosine: f8  # between the normal and the ray
    steepest: f8  # [1/px] relative change of depth from pixel to pixel that this allows


@dataclass(frozen=True)
class Surface:
    """The pixels of one depth image that show a surface."""

    pixel: np.ndarray  # (N,) int32, row * width + column
    xyz_c: np.ndarray  # (N, 3) float32 [m]
    normal_c: np.ndarray  # (N, 3) float32, unit, towards the camera
    weight: np.ndarray  # (N,) float32 [1/m^2], inverse variance along the ray


def surface(
    depth: np.ndarray,
    camera: Camera,
    *,
    settings: SurfaceConfig,
    sensor: SensorConfig,
    stride: int,
    spacing: float,
) -> Surface:
    """Find the pixels of a depth image (H, W) [m] that lie on a surface; smooth their depth and give the normals.

    Left out are readings out of range, those near a depth jump (where sensors report points that hang in the air between two
    surfaces), and surfaces seen at a grazing angle.

    A plane's inverse depth is linear in the pixel. So two pixels opposite each other, as seen from a third, have its inverse depth on
    average, however slanted the plane: such pairs are averaged where they agree within the noise, and their differences give the normal.

    sensor : how well a single reading measures, and in what range
    stride : every stride-th row and column is looked at, and where that is so near that the points lie closer together than `spacing`
        [m], every second or fourth of these
    """
    n = (depth.shape[0] // stride + 1) * (depth.shape[1] // stride + 1)
    out = Surface(np.empty(n, np.int32), np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.float32))
    with np.errstate(divide="ignore"):  # a depth of 0 has no place here, and is left out as infinitely near
        inverse = 1.0 / np.asarray(depth, dtype=np.float32)
    steepest = float(np.radians(settings.max_angle_deg))
    sought = Sought(
        stride=stride,
        near=float(spacing * max(camera.fx, camera.fy) / stride),
        edge=settings.edge,
        window=float(settings.window),
        low=1.0 / sensor.depth_max,
        high=1.0 / max(sensor.depth_min, NEAREST),
        min_cosine=float(elementary.cos(steepest)),
        steepest=float(elementary.tan(steepest)) / camera.fx,
    )
    noise = noise_model.reading_noise(sensor)
    n = _find_surface(inverse, _rays(camera), sought, noise, out.pixel, out.xyz_c, out.normal_c, out.weight)
    return Surface(out.pixel[:n], out.xyz_c[:n], out.normal_c[:n], out.weight[:n])


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> np.ndarray:
    """Return the camera's rays, worked out once for equal cameras: every stage has an object of its own."""
    return camera.rays


@kernel(error_model="numpy")
def _find_surface(
    inverse: f4[:, ::1],
    rays: f4[:, :, ::1],
    sought: Sought,
    noise: DepthNoise,
    pixel: i4[::1],
    xyz_c: f4[:, ::1],
    normal_c: f4[:, ::1],
    weight: f4[::1],
):
    """Fill the surface's pixels, points, normals and weights; returns their number. Missing readings are NaN and fail every test."""
    stride, near, edge, window, low, high, min_cosine, steepest = sought
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
            sigma = depth_noise.sigma(z, noise) * q * q  # of inverse depth
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
