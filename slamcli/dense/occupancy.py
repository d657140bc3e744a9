"""Occupied and free space: log-odds in a hash of 8 x 8 x 8 blocks, updated scan by scan as OctoMap does.

Each scan updates a cell at most once: a cell that holds an end point is hit, any other cell that a ray passes is missed.

A. Hornung et al., OctoMap, Autonomous Robots 2013, doi:10.1007/s10514-012-9321-0; the arithmetic, float32 where the C++ library has
float, follows its `updateNodeLogOdds`, so that maps agree cell by cell.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import f4, i4, i8, u1, u8

from slamcli.dense.ray_casting import OCCUPIED, mark_scan
from slamcli.errors import SlamError
from slamcli.geometry import elementary, voxel
from slamcli.geometry.octree import CENTRE, DEPTH, Octree
from slamcli.geometry.voxel import Index, find_or_add, spread
from slamcli.jit.kernel import kernel

BLOCK_CELLS = 512  # 8 x 8 x 8, within a block in Morton order
MAX_BLOCKS = 400_000  # 2 GiB, twice that while the table grows; 25 000 m3 at 0.05 m
UNTOUCHED, TOUCHED = -1, -2  # blocks of a scan's bounding box, until their row is known


class Scan(NamedTuple):
    """What one depth image says of the space around."""

    x: np.ndarray  # (N, 3) end points [m]
    origin: np.ndarray  # (3,) where the rays start [m]
    frame: int = 0


class _Marked(NamedTuple):
    """The cells that a scan marks, within the box of blocks that holds them."""

    rows_of_8: u8[:, :, ::1]  # (Z, Y, X / 8) marks, eight cells along x in each number
    lower: i8[::1]  # (3,) first cell
    block_row: i4[:, :, ::1]  # (Z / 8, Y / 8, X / 8) row of each block, UNTOUCHED or TOUCHED


class _Update(NamedTuple):
    """What a look changes a cell's log-odds by, and their bounds."""

    miss: f4
    hit: f4
    lowest: f4
    highest: f4


class _Cells(NamedTuple):
    """What is known of the cells of each block."""

    log_odds: f4[:, ::1]  # (R, 512), NaN = never seen
    misses: u1[:, ::1]  # since the last hit
    last_hit: i4[:, ::1]  # scan


def log_odds(probability: float) -> np.float32:
    """Return ln(p / (1 - p)); (12) of Zhao et al."""
    return np.float32(elementary.log(probability / (1.0 - probability)))


class OccupancyMap:
    """Log-odds of cells, NaN where nothing is known."""

    def __init__(self, resolution: float, *, hit: float, miss: float, clamp_min: float, clamp_max: float) -> None:
        """Start empty.

        resolution : side of a cell [m]
        hit, miss : probability that a cell is occupied, given that a ray ends in it, or passes it
        clamp_min, clamp_max : bounds of a cell's probability; the narrower, the sooner a moved object fades
        """
        self.resolution = float(resolution)
        self._update = _Update(log_odds(miss), log_odds(hit), log_odds(clamp_min), log_odds(clamp_max))
        row = (BLOCK_CELLS,)
        self._blocks = voxel.VoxelRows(log_odds=(row, np.float32, np.nan), misses=(row, np.uint8, 0), last_hit=(row, np.int32, 0))

    @property
    def looks(self) -> int:
        """Return how many misses make the surest cell free."""
        by = self._update
        return int(np.ceil((by.highest - np.maximum(by.lowest, 0.0)) / -by.miss))

    def insert(self, x_w: np.ndarray, origin: np.ndarray, *, max_range: float, discretize: bool = False, frame: int = 0) -> None:
        """Insert one scan.

        x_w : (N, 3) end points [m]; one that is not finite is skipped
        origin : (3,) where the rays start [m]
        max_range : farther points only free the space up to this range [m]; 0 = no limit
        discretize : cast one ray per end cell, to its centre, instead of one per point
        frame : number of the scan, for `doubted`

        Raises SlamError where the map would outgrow memory.
        """
        found = mark_scan(x_w, origin, max_range=max_range, resolution=self.resolution, discretize=discretize)
        if found is None:
            return
        marks, lower = found
        marked = _Marked(marks.view(np.uint64), lower, np.full(np.array(marks.shape) >> 3, UNTOUCHED, dtype=np.int32))
        blocks = self._blocks
        n_touched = _touch_blocks(marked)
        if max(n_touched, blocks.n) > MAX_BLOCKS:
            size = MAX_BLOCKS * BLOCK_CELLS * sum(column.itemsize for column in blocks.columns.values()) / (1 << 30)
            raise SlamError(
                f"an octree of {self.resolution:g} m cells would fill more than {size:.0f} GiB of memory: raise octree.resolution"
            )
        blocks.reserve(n_touched)
        cells = _Cells(**blocks.columns)
        blocks.n = _update_cells(marked, blocks.index, blocks.n, cells, self._update, frame)

    def doubted(self, misses: int) -> tuple[np.ndarray, np.ndarray]:
        """Find cells that are occupied, but that the last so many scans that touched them saw free.

        Returns their numbers (N, 3) x y z and the frame of the last scan that hit each (N,).
        """
        columns = {name: column[: self._blocks.n] for name, column in self._blocks.columns.items()}
        block, local = np.nonzero((columns["log_odds"] > 0.0) & (columns["misses"] >= misses))
        cell = voxel.unmorton((self._blocks.key[block] << 9) + local)
        return cell, columns["last_hit"][block, local]

    def centre(self, cell: np.ndarray) -> np.ndarray:
        """Return the centres (N, 3) [m] of cells (N, 3)."""
        return (cell - CENTRE + 0.5) * self.resolution

    def leaves(self) -> Octree:
        """Return the known cells as an octree that is not pruned."""
        n = self._blocks.n
        order = np.argsort(self._blocks.key)
        value = self._blocks.columns["log_odds"][:n][order]
        row, local = np.nonzero(np.isfinite(value))
        key = (self._blocks.key[order][row] << 9) + local
        return Octree(self.resolution, key, np.full(len(key), DEPTH, dtype=np.uint8), value[row, local])


@dataclass(frozen=True)
class Accuracy:
    """How a tree agrees with scans: cells over all scans."""

    correct: int
    wrong: int
    unknown: int  # cells of which the tree knows nothing; not counted as wrong, as in OctoMap's own evaluation

    @property
    def share(self) -> float:
        """Return the share of known cells whose state is the scan's, NaN when none is known."""
        return self.correct / (self.correct + self.wrong) if self.correct + self.wrong else np.nan


def accuracy(tree: Octree, scans: Iterable[Scan], *, max_range: float, threshold: float = 0.0) -> Accuracy:
    """Replay scans, given in the tree's frame, and count the cells whose state agrees, as OctoMap's `eval_octree_accuracy` does."""
    is_occupied = tree.is_occupied(threshold)
    correct = wrong = unknown = 0
    for scan in scans:
        marked = mark_scan(scan.x, scan.origin, max_range=max_range, resolution=tree.resolution)
        if marked is None:
            continue
        marks, lower = marked
        z, y, x = np.nonzero(marks)
        row = tree.find(np.column_stack([x, y, z]) + lower)
        known = row >= 0
        agrees = is_occupied[row[known]] == (marks[z, y, x][known] == OCCUPIED)
        correct += int(agrees.sum())
        wrong += int((~agrees).sum())
        unknown += int((~known).sum())
    return Accuracy(correct, wrong, unknown)


@kernel
def _touch_blocks(marked: _Marked):
    """Flag the blocks that hold a marked cell; returns their number."""
    rows_of_8, _, block_row = marked
    n = 0
    for z in range(rows_of_8.shape[0]):
        for y in range(rows_of_8.shape[1]):
            for x in range(rows_of_8.shape[2]):
                if rows_of_8[z, y, x] != 0 and block_row[z >> 3, y >> 3, x] == UNTOUCHED:
                    block_row[z >> 3, y >> 3, x] = TOUCHED
                    n += 1
    return n


@kernel
def _update_cells(marked: _Marked, index: Index, n_rows: i8, cells: _Cells, by: _Update, frame: i8):
    """Update every marked cell once, (11) and (13) of Zhao et al. with clamping; returns the number of blocks."""
    rows_of_8, lower, block_row = marked
    value, misses, last_hit = cells
    block_x, block_y, block_z = lower[0] >> 3, lower[1] >> 3, lower[2] >> 3
    for z in range(rows_of_8.shape[0]):
        for y in range(rows_of_8.shape[1]):
            in_zy = spread(z & 7) << 2 | spread(y & 7) << 1
            for x in range(rows_of_8.shape[2]):
                marks = rows_of_8[z, y, x]
                if marks == 0:
                    continue
                row = block_row[z >> 3, y >> 3, x]
                if row == TOUCHED:
                    key = spread(x + block_x) | spread((y >> 3) + block_y) << 1 | spread((z >> 3) + block_z) << 2
                    row = find_or_add(index, n_rows, key)
                    n_rows = max(n_rows, row + 1)
                    block_row[z >> 3, y >> 3, x] = row
                for k in range(8):
                    mark = (marks >> np.uint64(8 * k)) & np.uint64(255)
                    if mark == 0:
                        continue
                    at = in_zy | spread(k)
                    old = value[row, at]
                    if old != old:
                        old = np.float32(0.0)
                    new = old + (by.hit if mark == OCCUPIED else by.miss)
                    value[row, at] = min(max(new, by.lowest), by.highest)
                    if mark == OCCUPIED:
                        misses[row, at], last_hit[row, at] = 0, frame
                    elif misses[row, at] < 255:
                        misses[row, at] += 1
    return n_rows
