"""The floor a robot has driven over is free, though a camera that looks ahead never saw what was below it."""

from dataclasses import replace

import numpy as np

from slamcli.config.options import GridConfig
from slamcli.navigation.grid import FREE, UNKNOWN, check_size
from slamcli.schema import Grid

LONGEST_STEP = 0.5  # [m] between neighbouring frames: beyond it nobody knows what was driven over in between


def mark_driven(grid: Grid, xy: np.ndarray, *, settings: GridConfig) -> Grid:
    """Mark as free what is unknown within `grid2d.driven` of the path of the camera; what was seen to stand there stays occupied.

    xy : (N, 2) [m, level frame] camera centres in the order of time, NaN = lost
    Returns a grid that may be larger; raises SlamError where it would not fit into memory.
    """
    places = _along(xy, step=float(grid.resolution))
    if settings.driven <= 0.0 or not len(places):
        return grid
    grid = _grown(grid, places, settings.driven)
    resolution, (rows, columns) = float(grid.resolution), grid.state.shape
    reach = int(np.ceil(settings.driven / resolution)) + 1
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    is_driven = np.zeros(grid.state.shape, dtype=bool)
    cells = np.floor((places - grid.origin) / resolution).astype(np.int64)
    for (x, y), (column, row) in zip(places, cells, strict=True):
        centre_x, centre_y = grid.origin + (np.array([column, row]) + 0.5) * resolution
        is_near = (centre_x + dx * resolution - x) ** 2 + (centre_y + dy * resolution - y) ** 2 <= settings.driven**2
        near_rows, near_columns = row + dy[is_near], column + dx[is_near]
        is_in = (near_rows >= 0) & (near_columns >= 0) & (near_rows < rows) & (near_columns < columns)
        is_driven[near_rows[is_in], near_columns[is_in]] = True
    is_new = is_driven & (grid.state == UNKNOWN)
    return replace(
        grid,
        state=np.where(is_new, np.int8(FREE), grid.state),
        p_occupied=np.where(is_new, np.float32(settings.p_floor), grid.p_occupied),
    )


def _along(xy: np.ndarray, *, step: float) -> np.ndarray:
    """Return places (M, 2) no more than `step` [m] apart along the path, without those between frames that lie too far apart."""
    xy = xy[np.isfinite(xy).all(axis=1)]
    found = [xy[:1]]
    for a, b in zip(xy[:-1], xy[1:], strict=True):
        length = float(np.linalg.norm(b - a, axis=-1))
        n = int(np.ceil(length / step)) if length <= LONGEST_STEP else 1
        found.append(a + (b - a) * np.arange(1, n + 1)[:, None] / max(n, 1))
    return np.concatenate(found)


def _grown(grid: Grid, places: np.ndarray, radius: float) -> Grid:
    """Return the grid with unknown cells added at its sides so that it covers `radius` [m] around the places."""
    resolution, (rows, columns) = float(grid.resolution), grid.state.shape
    low = np.floor((places.min(axis=0) - radius - grid.origin) / resolution).astype(np.int64)
    high = np.floor((places.max(axis=0) + radius - grid.origin) / resolution).astype(np.int64)
    before, after = np.maximum(-low, 0), np.maximum(high + 1 - [columns, rows], 0)
    check_size(int(rows + before[1] + after[1]), int(columns + before[0] + after[0]), resolution)
    width = ((int(before[1]), int(after[1])), (int(before[0]), int(after[0])))
    return replace(
        grid,
        p_occupied=np.pad(grid.p_occupied, width, constant_values=np.nan),
        n_seen=np.pad(grid.n_seen, width),
        state=np.pad(grid.state, width, constant_values=UNKNOWN),
        origin=grid.origin - before * resolution,
    )
