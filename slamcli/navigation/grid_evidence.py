"""What one depth image tells about the cells of the grid: points in the robot's height band, floor or its absence, and open lines of sight."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import f4, f8, i4, i8, u1, u2

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.depth import noise_model
from slamcli.errors import SlamError
from slamcli.geometry import depth_noise, se3
from slamcli.geometry.depth_noise import DepthNoise
from slamcli.jit.kernel import kernel
from slamcli.navigation import terrain
from slamcli.navigation.terrain import LEVEL_FLOOR, NO_LEVELS, Levels, Terrain

SLICES = 16  # of the band's height, one bit each
ALL_SLICES = (1 << SLICES) - 1
NOT_SEEN, PASSED, SEEN = 0, 1, 2  # of a cell's floor: PASSED is a line of sight below the band, which ends on the floor farther on
HOLE_POINTS = 2  # readings through the floor's plane that make a cell a hole: one may be a slip
ROWS = 120  # of an image: a surface is level by a pixel this share above; a nearer one would show the noise instead of the slope
OPEN_STRIDE = 3  # open lines of sight are followed at every so many of the pixels whose points are sorted
NOISE_SIGMAS = 2.0  # that a reading may be off: a point's height, and the end of a line of sight
LEVEL = 1e-9  # slope of a line of sight that never leaves the height it begins at
FARTHEST_CELL = 1e8  # cells from the origin: beyond, numbers of cells are no longer exact
LOWEST, UPRIGHT_SPAN = 16, 12  # of an image's rows: one in so many at its lower edge, and from there up, tell what leaves the picture
UPRIGHT_SLOPE = 3.0  # height over distance, between the ends of the span, of a surface that is upright
CROSSINGS = 4  # of a line of sight with a sloping floor: tries to find the cell in which it meets it
TOP_REACH = 0.3  # [m] above the band: what is seen there from above may be the top of something that reaches into the band


@dataclass(frozen=True)
class View:
    """What one frame saw, per cell touched."""

    cell: np.ndarray  # (N, 2) int32, column (x) and row (y) counted from level x = y = 0
    n_band: np.ndarray  # (N,) int32, points in the band
    slices: np.ndarray  # (N,) uint16, bits: height slices of the band with points
    floor: np.ndarray  # (N,) uint8, NOT_SEEN, PASSED or SEEN
    is_hole: np.ndarray  # (N,) bool, lines of sight went down through the floor's plane
    is_top: np.ndarray  # (N,) bool, a level surface just above the band was seen from above
    camera: np.ndarray  # (3,) m, level frame
    open_cell: np.ndarray  # (O, 2) int32, cells that lines of sight crossed within the band
    open_slices: np.ndarray  # (O,) uint16, bits: the slices they crossed
    levels: Levels = NO_LEVELS  # heights of level surfaces, floor among them


class DepthImage(NamedTuple):
    """A depth image, and where it was taken."""

    depth: f4[:, ::1]  # (H, W) [m], NaN = none
    rays: f4[:, :, ::1]  # (H, W, 2), of `Camera.rays`
    T_lk: f8[:, ::1]  # (4, 4) camera to level


class Sight(NamedTuple):
    """Where depth is sorted into cells, and what counts."""

    corner: f8[::1]  # (2,) column and row of the window's first cell, whole numbers
    cell: float  # [m] side
    near: float  # [m] nearer readings are ignored
    far: float  # [m] farther readings are no points
    low: float  # [m] of the robot's height band
    high: float  # [m]
    drop: float  # [m] below the floor, from which on a point shows a hole


class Cells(NamedTuple):
    """What the points of one view tell of the cells (S, S) of a window."""

    n_band: i4[:, ::1]  # points in the band
    slices: u2[:, ::1]  # bits: slices of the band with points
    floor: u1[:, ::1]  # NOT_SEEN, PASSED or SEEN
    hole: u1[:, ::1]  # lines of sight through the floor's plane
    top: u1[:, ::1]  # 1 where a level surface just above the band was seen from above


def blank_cells(side: int) -> Cells:
    """Return the cells of a window of `side` cells of which nothing was seen."""
    return Cells(*(np.zeros((side, side), dtype=of) for of in (np.int32, np.uint16, np.uint8, np.uint8, np.uint8)))


def look(
    depth: np.ndarray,
    rays: np.ndarray,
    T_lk: np.ndarray,
    *,
    settings: GridConfig,
    sensor: SensorConfig,
    floor: Terrain = LEVEL_FLOOR,
) -> View:
    """Sort one frame's depth into the cells of a window around the camera.

    depth : (H, W) float32 [m], NaN = none
    rays : (H, W, 2) float32, of `Camera.rays`
    floor : heights are counted from it
    """
    cell, half = settings.resolution, int(np.ceil(settings.max_range / settings.resolution)) + 1
    centre = np.floor(T_lk[:2, 3] / cell)
    if not (np.abs(centre) < FARTHEST_CELL).all():
        raise SlamError("grid2d: a view lies absurdly far away; check the trajectory")
    side = 2 * half + 1
    seen, crossed = blank_cells(side), np.zeros((side, side), dtype=np.uint16)
    image = DepthImage(np.ascontiguousarray(depth, dtype=np.float32), rays, np.ascontiguousarray(T_lk, dtype=np.float64))
    sight = Sight(centre - half, cell, settings.min_range, settings.max_range, settings.band_low, settings.band_high, settings.drop)
    noise = noise_model.depth_noise(sensor)
    first = centre.astype(np.int64) - half
    ground, above = floor.window(first, (side, side)), max(settings.stride, depth.shape[0] // ROWS)
    _sort_points(image, sight, noise, settings.stride, above, ground, seen)
    _cross(image, sight, noise, OPEN_STRIDE * settings.stride, ground, crossed)
    if settings.extend_down:
        _extend_down(image, centre - half, settings, seen)
    rows, columns = np.nonzero((seen.n_band > 0) | (seen.floor > 0) | (seen.hole >= HOLE_POINTS) | (seen.top > 0))
    open_rows, open_columns = np.nonzero(crossed)
    return View(
        cell=np.stack([columns + first[0], rows + first[1]], axis=1).astype(np.int32),
        n_band=seen.n_band[rows, columns],
        slices=seen.slices[rows, columns],
        floor=seen.floor[rows, columns],
        is_hole=seen.hole[rows, columns] >= HOLE_POINTS,
        is_top=seen.top[rows, columns] > 0,
        camera=T_lk[:3, 3].copy(),
        open_cell=np.stack([open_columns + first[0], open_rows + first[1]], axis=1).astype(np.int32),
        open_slices=crossed[open_rows, open_columns],
        levels=_levels(image, sight, OPEN_STRIDE * settings.stride, above) if settings.max_slope > 0.0 else NO_LEVELS,
    )


def _levels(image: DepthImage, sight: Sight, stride: int, above: int) -> Levels:
    """Gather the heights of level surfaces, floor and table tops alike, at every `stride`-th pixel."""
    height, width = image.depth.shape
    most = -(-height // stride) * -(-width // stride)
    cell, level = np.empty((most, 2), dtype=np.int32), np.empty(most)
    n = _gather_levels(image, sight, stride, above, cell, level)
    return terrain.add_up(cell[:n], level[:n])


@kernel
def _sort_points(image: DepthImage, sight: Sight, noise: DepthNoise, stride: i8, above: i8, ground: f4[:, ::1], seen: Cells):
    """Count band points per cell; mark cells whose floor is seen or over which a line of sight passes below the band, holes, and tops.

    A line of sight that ends deeper than `drop` below the floor makes the cell in which it crosses the floor's plane a hole; the cells
    beyond, over which it runs below that plane, may have a floor if it was a reflection. Points closer to the floor than `low` plus twice
    their height's noise are the floor's; the noise of a height is the depth's noise times the slope of the ray, small at the flat angles
    under which a robot sees the far floor.

    above : rows up to the pixel that tells whether a surface is level
    ground : (S, S) [m] height of the floor in the cells, from which heights are counted
    """
    depth, rays, T = image
    corner, cell, near, far, low, high, drop = sight
    n_band, slices, floor, hole, top = seen
    side = n_band.shape[0]
    for v in range(stride // 2, depth.shape[0], stride):
        for u in range(stride // 2, depth.shape[1], stride):
            z = depth[v, u]
            if not z >= near:
                continue
            rx, ry = rays[v, u, 0], rays[v, u, 1]
            dx = T[0, 0] * rx + T[0, 1] * ry + T[0, 2]
            dy = T[1, 0] * rx + T[1, 1] * ry + T[1, 2]
            dz = T[2, 0] * rx + T[2, 1] * ry + T[2, 2]
            slack = NOISE_SIGMAS * abs(dz) * depth_noise.sigma(z, noise)
            x, y = (T[0, 3] + z * dx) / cell - corner[0], (T[1, 3] + z * dy) / cell - corner[1]
            height = T[2, 3] + z * dz - _height(ground, x, y)
            if height < -drop - slack and T[2, 3] > 0.0:
                _mark_hole(T, dx, dy, dz, sight, ground, hole)
                continue
            if z > far or height >= high + TOP_REACH:
                continue
            i, j = math.floor(y), math.floor(x)
            if not (0 <= i < side and 0 <= j < side):
                continue
            if height >= high:
                if dz < 0.0 and v >= above and _is_level(image, u, v, above, z, dz):
                    top[i, j] = 1
            elif height >= low + slack:
                n_band[i, j] += 1
                slices[i, j] |= np.uint16(1 << int(SLICES * (height - low) / (high - low)))
            elif height > -low - slack and dz < 0.0 and v >= above:
                # The pixel `above` must be as low, or this is the foot of something upright, which noise may have put behind it.
                if not _is_level(image, u, v, above, z, dz):
                    continue
                floor[i, j] = SEEN
                rise = low - height if height > 0.0 else low
                if rise > -z * dz:
                    rise = -z * dz
                _mark_passed(x, y, dx, dy, rise / -dz, sight, ground, floor)


@kernel
def _mark_hole(T, dx, dy, dz, sight, ground, hole):
    """Count the cell in which a line of sight of this direction meets the floor, if it does so within range."""
    corner, cell, low, far, side = sight.corner, sight.cell, sight.low, sight.far, hole.shape[0]
    at, is_met, i, j = T[2, 3] / -dz, False, 0, 0
    for _ in range(CROSSINGS):
        j, i = math.floor((T[0, 3] + at * dx) / cell - corner[0]), math.floor((T[1, 3] + at * dy) / cell - corner[1])
        on_floor = (T[2, 3] - _height(ground, j, i)) / -dz
        is_met = abs(on_floor - at) * -dz <= low
        if is_met:
            break
        at = on_floor
    if is_met and at <= far and 0 <= i < side and 0 <= j < side and hole[i, j] < 255:
        hole[i, j] += 1


@kernel
def _mark_passed(x, y, dx, dy, reach, sight, ground, floor):
    """Mark the cells over which a line of sight runs below the band: back along it, by `reach`, from the place on the floor where it ends."""
    side, at_end = floor.shape[0], ground[math.floor(y), math.floor(x)]
    steps = int(reach * math.sqrt(dx * dx + dy * dy) / sight.cell)
    for s in range(1, steps + 1):
        back = reach * s / (steps + 1)
        i, j = math.floor(y - back * dy / sight.cell), math.floor(x - back * dx / sight.cell)
        is_new = 0 <= i < side and 0 <= j < side and floor[i, j] == NOT_SEEN
        if is_new and abs(ground[i, j] - at_end) <= sight.low:  # not over an edge that the floor ends at
            floor[i, j] = PASSED


@kernel
def _height(ground, x, y):
    """Return the floor's height [m] at a place in cells, 0 outside the window."""
    i, j = math.floor(y), math.floor(x)
    return np.float64(ground[i, j]) if 0 <= i < ground.shape[0] and 0 <= j < ground.shape[1] else 0.0


@kernel
def _is_level(image, u, v, above, z, dz):
    """Say whether the surface at a pixel of depth z rises to the pixel `above` by less than half of what an upright one would."""
    depth, rays, T = image
    dz2 = T[2, 0] * rays[v - above, u, 0] + T[2, 1] * rays[v - above, u, 1] + T[2, 2]
    return abs(depth[v - above, u] * dz2 - z * dz) < 0.5 * z * (dz2 - dz)


@kernel
def _gather_levels(image: DepthImage, sight: Sight, stride: i8, above: i8, cells: i4[:, ::1], heights: f8[::1]):
    """Write cell (N, 2), column and row, and height (N,) [m] of each point of a level surface that is seen from above; return their number."""
    depth, rays, T = image
    _, cell, near, far, _, _, _ = sight
    n = 0
    for v in range(stride // 2, depth.shape[0], stride):
        for u in range(stride // 2, depth.shape[1], stride):
            z = depth[v, u]
            if v < above or not near <= z <= far:
                continue
            rx, ry = rays[v, u, 0], rays[v, u, 1]
            dz = T[2, 0] * rx + T[2, 1] * ry + T[2, 2]
            if not (dz < 0.0 and _is_level(image, u, v, above, z, dz)):
                continue
            cells[n, 0] = math.floor((T[0, 3] + z * (T[0, 0] * rx + T[0, 1] * ry + T[0, 2])) / cell)
            cells[n, 1] = math.floor((T[1, 3] + z * (T[1, 0] * rx + T[1, 1] * ry + T[1, 2])) / cell)
            heights[n] = T[2, 3] + z * dz
            n += 1
    return n


@kernel
def _cross(image: DepthImage, sight: Sight, noise: DepthNoise, stride: i8, ground: f4[:, ::1], crossed: u2[:, ::1]):
    """Mark, as bits per cell, the slices of the band that lines of sight cross: up to a cell and the noise before their end, or to `far`.

    A reading beyond `far` is too inexact to be a point, but tells that nothing is nearer.
    """
    depth, rays, T = image
    corner, cell, near, far, low, high, _ = sight
    side = crossed.shape[0]
    lowest, highest = low + min(ground.min(), 0.0), high + max(ground.max(), 0.0)
    for v in range(stride // 2, depth.shape[0], stride):
        for u in range(stride // 2, depth.shape[1], stride):
            z = depth[v, u]
            if not z >= near:
                continue
            rx, ry = rays[v, u, 0], rays[v, u, 1]
            dx = T[0, 0] * rx + T[0, 1] * ry + T[0, 2]
            dy = T[1, 0] * rx + T[1, 1] * ry + T[1, 2]
            dz = T[2, 0] * rx + T[2, 1] * ry + T[2, 2]
            first, last = near, z - NOISE_SIGMAS * depth_noise.sigma(z, noise) - cell
            if last > far:
                last = far
            if abs(dz) > LEVEL:
                a, b = (lowest - T[2, 3]) / dz, (highest - T[2, 3]) / dz
                if a > b:
                    a, b = b, a
                if a > first:
                    first = a
                if b < last:
                    last = b
            elif not lowest <= T[2, 3] < highest:
                continue
            if not first < last:
                continue
            along = abs(dx) if abs(dx) > abs(dy) else abs(dy)
            steps = math.ceil((last - first) * along / cell)
            for s in range(steps + 1):
                t = first + (last - first) * (s + 0.5) / (steps + 1)
                i, j = math.floor((T[1, 3] + t * dy) / cell - corner[1]), math.floor((T[0, 3] + t * dx) / cell - corner[0])
                if 0 <= i < side and 0 <= j < side:
                    at = math.floor(SLICES * (T[2, 3] + t * dz - ground[i, j] - low) / (high - low))
                    if 0 <= at < SLICES:
                        crossed[i, j] |= np.uint16(1 << at)


def _extend_down(image: DepthImage, corner: np.ndarray, s: GridConfig, seen: Cells) -> None:
    """Count upright surfaces that leave the picture downwards above the band as standing in it: a box seen from close by, a wall.

    Upright: over a twelfth of the picture, 5 cm at 0.7 m and so more than the edge of a table top, the height changes by three times
    as much as the place.
    """
    depth, rays, T_lk = image
    n_band, slices = seen.n_band, seen.slices
    height, width = depth.shape
    u = np.arange(s.stride // 2, width, s.stride)
    lowest = depth[height - height // LOWEST :, u][::-1]
    is_reading = (lowest >= s.min_range) & (lowest <= s.max_range)
    u, v = u[is_reading.any(axis=0)], height - 1 - is_reading.argmax(axis=0)[is_reading.any(axis=0)]
    at, above = (
        se3.transform(T_lk, np.column_stack([depth[v, u, None] * rays[v, u], depth[v, u]])) for v in (v, v - height // UPRIGHT_SPAN)
    )
    step = np.abs(at - above)
    is_upright = (at[:, 2] >= s.band_high) & (step[:, 2] > UPRIGHT_SLOPE * np.linalg.norm(step[:, :2], axis=1))
    j, i = np.floor(at[is_upright, :2] / s.resolution - corner).astype(np.int64).T
    inside = (i >= 0) & (j >= 0) & (i < n_band.shape[0]) & (j < n_band.shape[1])
    np.add.at(n_band, (i[inside], j[inside]), 1)
    slices[i[inside], j[inside]] = ALL_SLICES
