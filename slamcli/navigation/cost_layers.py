"""Layers over the grid for nav2: the cost of being near obstacles, and places that a robot is told to keep out of or to pass slowly."""

import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry import elementary
from slamcli.navigation.planner import CROSS, LARGEST, end_cell, obstacle_distance, room
from slamcli.schema import Grid

LETHAL, INSCRIBED, NEAREST = 100, 99, 98  # an obstacle; the robot would touch; the cost just beyond, which falls off from there
UNKNOWN = -1
NO_LIMIT, FULL_SPEED = 0, 100  # [%] as nav2's speed filter reads a mask
MAX_CORNERS = 100_000


def inflated(grid: Grid, *, radius: float, reach: float, falloff: float) -> np.ndarray:
    """Compute the cost (H, W) int8 of each cell, 0 to 100, -1 = unknown, as nav2's inflation layer does.

    radius : m, of the robot; nearer to an obstacle's edge the cost is `INSCRIBED`
    reach : m, from an obstacle's edge at which the cost ends
    falloff : 1/m, how fast the cost falls: its `cost_scaling_factor`
    """
    for name, value in (("radius", radius), ("reach", reach), ("falloff", falloff)):
        if not (np.isfinite(value) and 0.0 <= value <= LARGEST):
            raise SlamError(f"{name} = {value:g}: must be from 0 to {LARGEST:g}")
    distance = obstacle_distance(grid, allow_unknown=True)
    cost = np.rint(NEAREST * elementary.exp(-falloff * np.maximum(distance - radius, 0.0)))
    cost = np.where(distance > reach, 0, np.where(distance < radius, INSCRIBED, cost))
    cost = np.where(grid.state == 1, LETHAL, np.where(grid.state < 0, UNKNOWN, cost))
    return cost.astype(np.int8)


def inside_polygons(grid: Grid, polygons: list[list[list[float]]]) -> np.ndarray:
    """Say which cells (H, W) have their centre within any polygon, a list of corners x, y [m, level frame]; even-odd rule."""
    rows, columns = grid.state.shape
    x = grid.origin[0] + (np.arange(columns) + 0.5) * float(grid.resolution)
    y = grid.origin[1] + (np.arange(rows) + 0.5) * float(grid.resolution)
    inside = np.zeros((rows, columns), dtype=bool)
    for polygon in polygons:
        corners = np.asarray(polygon, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or not 3 <= len(corners) <= MAX_CORNERS or not np.isfinite(corners).all():
            raise SlamError("a polygon is a list of three corners [x, y] in metres, or more")
        is_odd = np.zeros((rows, columns), dtype=bool)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            crosses = np.flatnonzero((y >= min(y0, y1)) & (y < max(y0, y1)))
            at = x0 + (y[crosses] - y0) / (y1 - y0) * (x1 - x0) if y1 != y0 else np.zeros(0)
            is_odd[crosses] ^= x[None, :] < at[:, None]
        inside |= is_odd
    return inside


def speed_limits(grid: Grid, areas: list[tuple[float, list[list[float]]]]) -> np.ndarray:
    """Give the cells (H, W) int16 whose centre lies within an area its percentage of full speed, 1 to 100, and all others `NO_LIMIT`.

    areas : percentage and polygon of each, as `inside_polygons` takes it; where several overlap, the slowest counts
    """
    limits = np.full(grid.state.shape, FULL_SPEED + 1, dtype=np.int16)
    for percentage, polygon in areas:
        value = float(percentage)
        if isinstance(percentage, bool) or not 1.0 <= value <= FULL_SPEED or value != int(value):
            raise SlamError(f"a speed is a whole percentage of full speed from 1 to {FULL_SPEED}; {percentage!r} is none")
        inside = inside_polygons(grid, [polygon])
        limits[inside] = np.minimum(limits[inside], int(value))
    return np.where(limits > FULL_SPEED, NO_LIMIT, limits).astype(np.int16)


def speeds_of_shades(shades: np.ndarray) -> np.ndarray:
    """Turn a drawn mask (H, W) uint8 into percentages of full speed (H, W) int16: black `NO_LIMIT`, else from dark, slow, to white, full speed."""
    percentage = np.maximum(np.rint(shades * (FULL_SPEED / 255.0)), 1.0)
    return np.where(shades == 0, NO_LIMIT, percentage).astype(np.int16)


def reachable(grid: Grid, start: tuple[float, float], *, radius: float, allow_unknown: bool = False) -> np.ndarray:
    """Find the cells (H, W) that a robot's centre can get to from a place [m, level frame]; SlamError where it does not fit there."""
    from scipy import ndimage

    margin = room(grid, radius=radius, allow_unknown=allow_unknown)
    row, column = end_cell(grid, margin, "start", start, radius)
    labels, _ = ndimage.label(margin >= 0.0, structure=CROSS)
    return labels == labels[row, column]


def swept(grid: Grid, cells: np.ndarray, *, radius: float) -> np.ndarray:
    """Find the cells (H, W) that a robot covers whose centre goes to `cells` (H, W)."""
    import cv2

    if not cells.any():
        return cells
    distance = cv2.distanceTransform((~cells).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance * float(grid.resolution) <= radius
