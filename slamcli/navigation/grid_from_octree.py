"""The 2-D grid from the octree: a column is occupied if any leaf in the robot's band is, free if floor or band was seen free.

The octree tells what no single line of sight does: how much of a column is unknown. Where unknown space joins the side of something
that hangs, it may be the inside of it; such columns stay unknown however well the floor below is seen.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from slamcli.config.options import GridConfig
from slamcli.geometry import elementary
from slamcli.geometry.octree import Octree
from slamcli.jit.kernel import kernel
from slamcli.navigation.grid import DEEPEST, FREE, OCCUPIED, UNKNOWN, check_size
from slamcli.navigation.grid_evidence import SLICES
from slamcli.schema import Grid

EDGE = 1e-6  # [cells] a leaf that ends on a border does not reach beyond it


class _Leaves(NamedTuple):
    """N leaves between the floor and the upper end of the band."""

    first: np.ndarray  # (N, 2) int64, column and row of the first cell that each covers
    last: np.ndarray  # (N, 2) int64, and of the last
    slices: np.ndarray  # (N,) uint16, see `_slices`
    is_occupied: np.ndarray  # (N,) bool
    log_odds: np.ndarray  # (N,) float32


class _Columns(NamedTuple):
    """What leaves say of each column (H, W)."""

    full: np.ndarray  # uint16, bits: slices of the band with an occupied leaf
    free: np.ndarray  # uint16, with a free one
    known: np.ndarray  # int32, leaves
    odds: np.ndarray  # float32, greatest log-odds in the band


def grid_from_octree(tree: Octree, *, settings: GridConfig) -> Grid:
    """Build the grid from an octree in the level frame; SlamError when it would not fit into memory."""
    resolution = settings.resolution
    low, high = _corners(tree)
    # The floor is seen in the leaves that the plane z = 0 passes through or bounds, up to the band.
    matters = (low[:, 2] < settings.band_high) & (high[:, 2] > -tree.resolution - EDGE)
    low, high = low[matters], high[matters]
    log_odds, is_occupied = tree.log_odds[matters], tree.is_occupied()[matters]
    if len(low) == 0:
        return _empty(resolution)
    first = np.floor(low[:, :2] / resolution + EDGE).astype(np.int64)
    last = np.ceil(high[:, :2] / resolution - EDGE).astype(np.int64) - 1
    corner = first.min(axis=0)
    columns, rows = (int(n) for n in last.max(axis=0) - corner + 1)
    check_size(rows, columns, resolution)
    leaves = _Leaves(first - corner, last - corner, _slices(low[:, 2], high[:, 2], settings), is_occupied, log_odds)
    full, free = np.zeros((rows, columns), np.uint16), np.zeros((rows, columns), np.uint16)
    known, odds = np.zeros((rows, columns), np.int32), np.full((rows, columns), -np.inf, np.float32)
    _fill(leaves, _Columns(full, free, known, odds))
    is_known = (known > 0) & ~may_be_inside(full, free, reach=int(np.ceil(DEEPEST / resolution)))
    state = np.full((rows, columns), UNKNOWN, dtype=np.int8)
    state[is_known] = FREE
    state[full > 0] = OCCUPIED
    p_occupied = np.where(
        full > 0, 1.0 / (1.0 + elementary.exp(-odds)), np.where(state == FREE, np.minimum(1.0 / (1.0 + elementary.exp(-odds)), 0.5), np.nan)
    )
    return Grid(
        p_occupied=p_occupied.astype(np.float32), n_seen=known, state=state, origin=corner * resolution, resolution=np.array(resolution)
    )


def _corners(tree: Octree) -> tuple[np.ndarray, np.ndarray]:
    half = 0.5 * tree.side[:, None]
    return tree.centre - half, tree.centre + half


def _empty(resolution: float) -> Grid:
    unknown = np.full((1, 1), UNKNOWN, dtype=np.int8)
    return Grid(np.full((1, 1), np.nan, np.float32), np.zeros((1, 1), np.int32), unknown, np.zeros(2), np.array(resolution))


def _slices(low: np.ndarray, high: np.ndarray, settings: GridConfig) -> np.ndarray:
    """Return the slices of the band (N,) uint16 that leaves from `low` to `high` [m] fill; 0 for those of the floor."""
    scale = SLICES / (settings.band_high - settings.band_low)
    first = np.clip(np.floor((low - settings.band_low) * scale + EDGE), 0, SLICES).astype(np.int64)
    last = np.clip(np.ceil((high - settings.band_low) * scale - EDGE), 0, SLICES).astype(np.int64)
    return ((1 << last) - (1 << np.minimum(first, last))).astype(np.uint16)


@kernel
def _fill(leaves, columns):
    first, last, slices, is_occupied, log_odds = leaves
    full, free, known, odds = columns
    for n in range(len(slices)):
        mask = slices[n]
        for i in range(first[n, 1], last[n, 1] + 1):
            for j in range(first[n, 0], last[n, 0] + 1):
                known[i, j] += 1
                if mask == 0:
                    continue
                odds[i, j] = max(odds[i, j], log_odds[n])
                if is_occupied[n]:
                    full[i, j] |= mask
                else:
                    free[i, j] |= mask


def may_be_inside(full: np.ndarray, free: np.ndarray, *, reach: int) -> np.ndarray:
    """Say which columns (H, W) may lie inside something that hangs: unknown slices that join its full ones within `reach` cells."""
    lowest = full & (~full + np.uint16(1))  # the lowest filled slice, as a bit
    below = np.where(full > 0, lowest - np.uint16(1), 0).astype(np.uint16)
    hangs = (full > 0) & ((free & below) > 0)
    inside = np.zeros(full.shape, dtype=bool)
    if not hangs.any():
        return inside
    rows, columns = np.nonzero(hangs)
    window = tuple(slice(max(0, int(i.min()) - reach), int(i.max()) + reach + 1) for i in (rows, columns))
    for k in range(SLICES):
        bit = np.uint16(1 << k)
        seeds = hangs[window] & ((full[window] & bit) > 0)
        unknown = ((full[window] | free[window]) & bit) == 0
        inside[window] |= ndimage.binary_dilation(seeds, mask=unknown | seeds, iterations=reach) & unknown
    return inside & (full == 0)
