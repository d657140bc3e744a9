"""Stray points of a voxel cloud."""

import numpy as np
from numba import f4, i8

from slamcli.geometry import voxel
from slamcli.geometry.voxel import Index, find_or_add, find_row, gather, spread
from slamcli.jit.kernel import kernel

HALF_EXTENT = 1 << (voxel.AXIS_BITS - 1)  # voxels from the origin to the map's border, per axis
CELL_BITS = 2
CELL_VOXELS = 1 << CELL_BITS  # per side of the cells in which neighbours are sought


def not_stray(xyz: np.ndarray, key: np.ndarray, *, side: float, neighbours: int, max_deviation: float) -> np.ndarray:
    """Find the points that are as close to their neighbours as most: statistical outlier removal.

    xyz : (N, 3) float32 [m], one point a voxel
    key : (N,) int64, the voxels' Morton keys, increasing, cell HALF_EXTENT starting at coordinate 0
    side : of a voxel [m]
    neighbours : whose mean distance is looked at; those farther than CELL_VOXELS voxels count as being so far
    max_deviation : standard deviations above the mean up to which a point is kept
    Returns (N,) bool.

    R. Rusu et al., Robotics and Autonomous Systems 2008, doi:10.1016/j.robot.2008.08.005, section 4.1
    """
    if neighbours == 0 or len(key) == 0:
        return np.ones(len(key), dtype=bool)
    cell_key = key >> 3 * CELL_BITS  # points in Morton order: those of a cell follow each other
    first = np.flatnonzero(np.diff(cell_key, prepend=-1))
    cells = voxel.VoxelRows()
    cells.reserve(len(first))
    _index_cells(cell_key[first], cells.index)
    distance = np.empty(len(xyz), dtype=np.float32)
    nearest = np.empty(neighbours, dtype=np.float32)
    begin = np.append(first, len(xyz))
    most = 27 * int(np.diff(begin).max())
    candidates, squares = np.empty((3, most), dtype=np.float32), np.empty(most, dtype=np.float32)
    _mean_distances(xyz, begin, cells.index, np.float32(CELL_VOXELS * side), candidates, squares, nearest, distance)
    return distance <= distance.mean(dtype=np.float64) + max_deviation * distance.std(dtype=np.float64)


@kernel
def _index_cells(key: i8[::1], index: Index):
    for row in range(len(key)):
        find_or_add(index, row, key[row])


@kernel
def _mean_distances(
    xyz: f4[:, ::1], first: i8[::1], index: Index, reach: f4, candidates: f4[:, ::1], squares: f4[::1], nearest: f4[::1], distance: f4[::1]
):
    """Fill each point's mean distance to its nearest neighbours, those beyond `reach`, a cell's side, counted at `reach`.

    candidates (3, M), squares (M,), nearest (neighbours,) : room to work in, M as many as the points of 27 cells can be
    """
    neighbours = len(nearest)
    for cell in range(len(first) - 1):
        n = _gather_around(xyz, first, index, cell, candidates)
        xs, ys, zs = candidates[0, :n], candidates[1, :n], candidates[2, :n]
        for i in range(first[cell], first[cell + 1]):
            # A loop of its own, as the compiler turns it into vector instructions.
            for j in range(n):
                dx, dy, dz = xs[j] - xyz[i, 0], ys[j] - xyz[i, 1], zs[j] - xyz[i, 2]
                squares[j] = dx * dx + dy * dy + dz * dz
            squares[i - first[cell]] = np.inf  # the point itself
            nearest[:] = reach * reach
            farthest = reach * reach
            for j in range(n):
                square = squares[j]
                if square < farthest:
                    # Passed down the whole list, so that there is no branch to mispredict.
                    for k in range(neighbours):
                        nearest[k], square = min(nearest[k], square), max(nearest[k], square)
                    farthest = nearest[neighbours - 1]
            total = np.float32(0.0)
            for k in range(neighbours):
                total += np.sqrt(nearest[k])
            distance[i] = total / np.float32(neighbours)


@kernel
def _gather_around(xyz, first, index, cell, out):
    """Copy the points of a cell and of the 26 round about into out (3, M); returns how many."""
    key = index.row_key[cell]
    cx, cy, cz = gather(key), gather(key >> 1), gather(key >> 2)
    n = 0
    for k in range(27):
        k = (k + 13) % 27  # the cell itself first: with its points known, most others are too far to matter
        row = find_row(index, spread(cx + k % 3 - 1) | spread(cy + k // 3 % 3 - 1) << 1 | spread(cz + k // 9 - 1) << 2)
        if row >= 0:
            for i in range(first[row], first[row + 1]):
                out[0, n], out[1, n], out[2, n] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
                n += 1
    return n
