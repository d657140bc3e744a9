"""What single depth images tell about the cells of the grid: points in the robot's height band, floor, and lines of sight just above it."""

import math
from dataclasses import dataclass

import numpy as np
from numba import f4, f8, i4, i8, u1, u2

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.errors import SlamError
from slamcli.jit.kernel import kernel

SLICES = 16  # of the band's height, one bit each
ALL_SLICES = (1 << SLICES) - 1


@dataclass(frozen=True)
class View:
    """What one frame saw, per cell touched."""

    cell: np.ndarray  # (N, 2) int32, column (x) and row (y) counted from level x = y = 0
    n_band: np.ndarray  # (N,) int32, points in the band
    slices: np.ndarray  # (N,) uint16, bits: height slices of the band with points
    is_floor: np.ndarray  # (N,) bool, the floor was seen, or a line of sight passed below the band
    camera: np.ndarray  # (3,) m, level frame


def look(depth: np.ndarray, rays: np.ndarray, T_lk: np.ndarray, *, settings: GridConfig, sensor: SensorConfig) -> View:
    """Sort one frame's depth into the cells of a window around the camera.

    depth : (H, W) float32 [m], NaN = none
    rays : (H, W, 2) float32, of `Camera.rays`
    """
    cell, half = settings.resolution, int(np.ceil(settings.max_range / settings.resolution)) + 1
    centre = np.floor(T_lk[:2, 3] / cell)
    if not (np.abs(centre) < 1e8).all():
        raise SlamError("grid2d: a key frame lies absurdly far away; check the trajectory (slamcli eval ape)")
    side = 2 * half + 1
    n_band = np.zeros((side, side), dtype=np.int32)
    slices = np.zeros((side, side), dtype=np.uint16)
    floor = np.zeros((side, side), dtype=np.uint8)
    depth, T_lk = np.ascontiguousarray(depth, dtype=np.float32), np.ascontiguousarray(T_lk, dtype=np.float64)
    _sort_points(
        depth, rays, T_lk, centre - half, settings.stride, cell, settings.min_range, settings.max_range, settings.band_low, settings.band_high,
        sensor.depth_noise_base, sensor.depth_noise_quadratic, n_band, slices, floor,
    )  # fmt: skip
    if settings.extend_down:
        _extend_down(depth, rays, T_lk, centre - half, settings, n_band, slices)
    rows, columns = np.nonzero((n_band > 0) | (floor > 0))
    return View(
        cell=np.stack([columns + int(centre[0]) - half, rows + int(centre[1]) - half], axis=1).astype(np.int32),
        n_band=n_band[rows, columns],
        slices=slices[rows, columns],
        is_floor=floor[rows, columns] > 0,
        camera=T_lk[:3, 3].copy(),
    )


@kernel
def _sort_points(
    depth: f4[:, ::1],
    rays: f4[:, :, ::1],
    T: f8[:, ::1],
    corner: f8[::1],
    stride: i8,
    cell: f8,
    near: f8,
    far: f8,
    low: f8,
    high: f8,
    noise_base: f8,
    noise_quadratic: f8,
    n_band: i4[:, ::1],
    slices: u2[:, ::1],
    floor: u1[:, ::1],
):
    """Count band points per cell and mark cells whose floor is seen or over which a line of sight passes below the band.

    Points closer to the floor than `low` plus twice their height's noise are the floor's; the noise of a height is the depth's noise
    times the slope of the ray, small at the flat angles under which a robot sees the far floor.
    """
    side = n_band.shape[0]
    for v in range(stride // 2, depth.shape[0], stride):
        for u in range(stride // 2, depth.shape[1], stride):
            z = depth[v, u]
            if not (z >= near and z <= far):
                continue
            rx, ry = rays[v, u, 0], rays[v, u, 1]
            dx = T[0, 0] * rx + T[0, 1] * ry + T[0, 2]
            dy = T[1, 0] * rx + T[1, 1] * ry + T[1, 2]
            dz = T[2, 0] * rx + T[2, 1] * ry + T[2, 2]
            height = T[2, 3] + z * dz
            if height >= high:
                continue
            x, y = (T[0, 3] + z * dx) / cell - corner[0], (T[1, 3] + z * dy) / cell - corner[1]
            i, j = math.floor(y), math.floor(x)
            if not (0 <= i < side and 0 <= j < side):
                continue
            noise = abs(dz) * (noise_base + noise_quadratic * (z - 0.4) * (z - 0.4))
            if height >= low + 2.0 * noise:
                n_band[i, j] += 1
                slices[i, j] |= np.uint16(1 << int(SLICES * (height - low) / (high - low)))
            elif height > -low - 2.0 * noise and dz < 0.0 and v >= stride:
                # The pixel above must be as low, or this is the foot of something upright, which noise may have put behind it.
                z2 = depth[v - stride, u]
                dz2 = T[2, 0] * rays[v - stride, u, 0] + T[2, 1] * rays[v - stride, u, 1] + T[2, 2]
                if not (abs(T[2, 3] + z2 * dz2 - height) < 0.5 * z * (dz2 - dz)):
                    continue
                floor[i, j] = 1
                # Back along the ray, as long as it is below the band.
                rise = low - height if height > 0.0 else low
                if rise > T[2, 3] - height:
                    rise = T[2, 3] - height
                reach = rise / -dz
                steps = int(reach * math.sqrt(dx * dx + dy * dy) / cell)
                for s in range(1, steps + 1):
                    back = reach * s / (steps + 1)
                    i2, j2 = math.floor(y - back * dy / cell), math.floor(x - back * dx / cell)
                    if 0 <= i2 < side and 0 <= j2 < side:
                        floor[i2, j2] = 1


def _extend_down(
    depth: np.ndarray, rays: np.ndarray, T_lk: np.ndarray, corner: np.ndarray, s: GridConfig, n_band: np.ndarray, slices: np.ndarray
) -> None:
    """Count upright surfaces that leave the picture downwards above the band as standing in it: a box seen from close by, a wall.

    Upright: over a twelfth of the picture, 5 cm at 0.7 m and so more than the edge of a table top, the height changes by three times
    as much as the place.
    """
    height, width = depth.shape
    u = np.arange(s.stride // 2, width, s.stride)
    lowest = depth[height - height // 16 :, u][::-1]
    is_reading = (lowest >= s.min_range) & (lowest <= s.max_range)
    u, v = u[is_reading.any(axis=0)], height - 1 - is_reading.argmax(axis=0)[is_reading.any(axis=0)]
    at, above = (
        np.column_stack([depth[v, u, None] * rays[v, u], depth[v, u]]).astype(np.float64) @ T_lk[:3, :3].T + T_lk[:3, 3]
        for v in (v, v - height // 12)
    )
    step = np.abs(at - above)
    is_upright = (at[:, 2] >= s.band_high) & (step[:, 2] > 3.0 * np.hypot(step[:, 0], step[:, 1]))
    j, i = np.floor(at[is_upright, :2] / s.resolution - corner).astype(np.int64).T
    inside = (i >= 0) & (j >= 0) & (i < n_band.shape[0]) & (j < n_band.shape[1])
    np.add.at(n_band, (i[inside], j[inside]), 1)
    slices[i[inside], j[inside]] = ALL_SLICES
