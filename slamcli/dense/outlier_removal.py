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
    around, nearest = np.empty((27, 5), dtype=np.int64), np.empty(neighbours, dtype=np.float32)
    reach = np.float32(CELL_VOXELS * side)
    _mean_distances(xyz, np.append(first, len(xyz)), cells.index, reach, around, nearest, distance)
    return distance <= distance.mean(dtype=np.float64) + max_deviation * distance.std(dtype=np.float64)


@kernel
def _index_cells(key: i8[::1], index: Index):
    for row in range(len(key)):
        find_or_add(index, row, key[row])


@kernel
def _mean_distances(xyz: f4[:, ::1], first: i8[::1], index: Index, reach: f4, around: i8[:, ::1], nearest: f4[::1], distance: f4[::1]):
    """Fill each point's mean distance to its nearest neighbours, those beyond `reach`, a cell's side, counted at `reach`.

    around (27, 5), nearest (neighbours,) : room to work in; the first holds the point rows and the place of each cell round about
    """
    neighbours, row_key = len(nearest), index.row_key
    half = 1 << (20 - CELL_BITS)
    zero = np.float32(0.0)
    for cell in range(len(first) - 1):
        cx, cy, cz = gather(row_key[cell]), gather(row_key[cell] >> 1), gather(row_key[cell] >> 2)
        n_cells = 0
        for k in range(27):
            # The cell itself comes first: with its points known, most others are too far to matter.
            k = (k + 13) % 27
            x, y, z = k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1
            row = find_row(index, spread(cx + x) | spread(cy + y) << 1 | spread(cz + z) << 2)
            if row >= 0:
                around[n_cells, 0], around[n_cells, 1] = first[row], first[row + 1]
                around[n_cells, 2], around[n_cells, 3], around[n_cells, 4] = x, y, z
                n_cells += 1
        left, below, front = np.float32(reach * (cx - half)), np.float32(reach * (cy - half)), np.float32(reach * (cz - half))
        for i in range(first[cell], first[cell + 1]):
            px, py, pz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            for k in range(neighbours):
                nearest[k] = reach * reach
            for k in range(n_cells):
                gx = _gap(px - left, around[k, 2], reach)
                gy = _gap(py - below, around[k, 3], reach)
                gz = _gap(pz - front, around[k, 4], reach)
                if gx * gx + gy * gy + gz * gz >= nearest[neighbours - 1]:
                    continue
                for j in range(around[k, 0], around[k, 1]):
                    dx, dy, dz = xyz[j, 0] - px, xyz[j, 1] - py, xyz[j, 2] - pz
                    square = dx * dx + dy * dy + dz * dz
                    if square < nearest[neighbours - 1] and j != i:
                        at = neighbours - 1
                        while at > 0 and nearest[at - 1] > square:
                            nearest[at] = nearest[at - 1]
                            at -= 1
                        nearest[at] = square
            total = zero
            for k in range(neighbours):
                total += np.sqrt(nearest[k])
            distance[i] = total / np.float32(neighbours)


@kernel
def _gap(x, side, reach):
    """Return the distance along one axis from x, measured from the cell's lower face, to the cell beside it on that side."""
    if side < 0:
        return x
    return reach - x if side > 0 else np.float32(0.0)
