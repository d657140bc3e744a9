"""Where the floor slopes: its height cell by cell, followed from the level floor over ramps and steps that the robot climbs.

Heights of level surfaces are gathered per cell from all views, then grown from the floor's plane outwards: a surface goes on to a
neighbouring cell where no floor within `REACH` lies more than a step above or below it, and stays where it is no steeper than allowed.
Elevation maps of many views: P. Fankhauser, M. Bloesch, M. Hutter, RA-L 2018, doi:10.1109/LRA.2018.2849506; here a cell may have several
surfaces, and only the one that the floor leads to counts.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import f4, f8, i4

from slamcli.config.options import GridConfig
from slamcli.errors import SlamError
from slamcli.geometry import elementary
from slamcli.jit.kernel import kernel

BIN = 0.04  # [m] of height, within which a cell's readings are of one surface
BINS = 128  # from -2.56 m to 2.56 m: farther up or down is another storey
HALF_BINS = BINS // 2
CELL_BITS, HALF_CELLS = 28, 1 << 27  # a row, a column and a bin are one number of 63 bits
LEAST_READINGS = 4  # of a surface in a cell
FLAT = 0.025  # [m] from the plane: what its fit, depth and poses are off by
REACH = 2  # [cells] over which a step is a step: across the readings that mix both of its sides
SLOPE_WINDOW = 3  # [cells] to either side, in which slopes between neighbours but one are compared
LEAST_SLOPES = 6  # of these: fewer tell of no slope
FILLED = 4  # [cells] beside a sloping floor that too few readings tell of take its height
LEAST_CELLS = 20  # that lead out of the plane: fewer are noise
PENDING = 1 << 20  # rows of single views that are kept before they are added up
CHUNK = 1 << 14  # cells whose slopes are compared at once


@dataclass(frozen=True)
class Levels:
    """Heights of level surfaces in the cells of one view or of many."""

    key: np.ndarray  # (L,) int64, row, column and bin of height, ascending
    n: np.ndarray  # (L,) int32, readings
    total: np.ndarray  # (L,) float64, sum of their heights [m]


NO_LEVELS = Levels(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0))


@dataclass(frozen=True)
class Terrain:
    """The floor's height above its plane: 0 wherever it is level or unknown."""

    low: np.ndarray  # (2,) int64, column and row of the first cell
    height: np.ndarray  # (H, W) float32 [m]

    def window(self, low: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Cut out the heights (rows, columns) of cells from column and row `low` on."""
        out = np.zeros(shape, dtype=np.float32)
        first = np.maximum(low, self.low)
        last = np.minimum(low + shape[::-1], self.low + self.height.shape[::-1])
        if (first < last).all():
            a, b, c, d = (v.astype(np.int64) for v in (first - low, last - low, first - self.low, last - self.low))
            out[a[1] : b[1], a[0] : b[0]] = self.height[c[1] : d[1], c[0] : d[0]]
        return out


LEVEL_FLOOR = Terrain(np.zeros(2, np.int64), np.zeros((0, 0), np.float32))


def add_up(cell: np.ndarray, height: np.ndarray) -> Levels:
    """Sort heights (N,) [m] of cells (N, 2), column and row, into surfaces."""
    bins = np.floor(height / BIN).astype(np.int64) + HALF_BINS
    inside = (bins >= 0) & (bins < BINS)
    x, y = cell[inside].astype(np.int64).T + HALF_CELLS
    key, row = np.unique(((y << CELL_BITS) | x) * BINS + bins[inside], return_inverse=True)
    n = np.bincount(row, minlength=len(key)).astype(np.int32)
    return Levels(key, n, np.bincount(row, weights=height[inside], minlength=len(key)))


class Surfaces:
    """The level surfaces of all views."""

    def __init__(self) -> None:
        """Start without any."""
        self._pending: list[Levels] = []

    def add(self, levels: Levels) -> None:
        """Add one view's."""
        self._pending.append(levels)
        if sum(len(one.key) for one in self._pending) > PENDING:
            self._pending = [self.together()]

    def together(self) -> Levels:
        """Return the sums over all views."""
        if not self._pending:
            return NO_LEVELS
        key, row = np.unique(np.concatenate([one.key for one in self._pending]), return_inverse=True)
        n = np.bincount(row, weights=np.concatenate([one.n for one in self._pending]), minlength=len(key))
        total = np.bincount(row, weights=np.concatenate([one.total for one in self._pending]), minlength=len(key))
        return Levels(key, n.astype(np.int32), total)


def find_terrain(levels: Levels, *, settings: GridConfig, max_cells: int) -> Terrain | None:
    """Follow the floor over ramps and steps; None where it is level throughout.

    Raises SlamError where the cells would not fit into memory.
    """
    if not len(levels.key):
        return None
    cell, bins = levels.key // BINS, levels.key % BINS
    xy = np.column_stack([cell & ((1 << CELL_BITS) - 1), cell >> CELL_BITS]) - HALF_CELLS
    low = xy.min(axis=0)
    columns, rows = (int(n) for n in xy.max(axis=0) - low + 1)
    if rows * columns > max_cells:
        raise SlamError("grid2d: the floor would be followed over too many cells; check the trajectory, or raise grid2d.resolution")
    place = (xy[:, 1] - low[1]) * columns + xy[:, 0] - low[0]
    first = np.searchsorted(place, np.arange(rows * columns + 1)).astype(np.int32)
    mean = (levels.total / levels.n).astype(np.float32)
    is_floor = np.abs(mean) <= FLAT
    n, total = (np.bincount(place[is_floor], weights=of[is_floor], minlength=rows * columns) for of in (levels.n, levels.total))
    height = np.where(n >= LEAST_READINGS, total / np.maximum(n, 1), np.nan).astype(np.float32).reshape(rows, columns)
    is_level = np.isfinite(height)
    _grow(first, bins.astype(np.int32), levels.n, mean, settings.band_low, height)
    slopes = ~is_level & np.isfinite(height)
    if np.count_nonzero(slopes & (np.abs(height) > settings.band_low)) < LEAST_CELLS:  # in most rooms: what follows only leaves out more
        return None
    steep = _steep(height, slopes, settings)
    kept = _joined(np.isfinite(height) & ~steep, is_level) & ~is_level
    if np.count_nonzero(kept & (np.abs(height) > settings.band_low)) < LEAST_CELLS:  # the robot's height band begins above the rest
        return None
    has_surface = np.zeros(rows * columns, dtype=bool)
    has_surface[place[levels.n >= LEAST_READINGS]] = True
    return Terrain(low, _filled(np.where(kept, height, np.float32(0.0)), kept, has_surface.reshape(rows, columns)))


def _steep(height: np.ndarray, of: np.ndarray, settings: GridConfig) -> np.ndarray:
    """Say which cells (H, W) of these slope more than allowed, by the median of the slopes around each: a single step does not count."""
    reach = SLOPE_WINDOW
    padded = np.pad(height, reach + 1, constant_values=np.nan)
    dx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2.0 * settings.resolution)
    dy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2.0 * settings.resolution)
    rows, columns = np.nonzero(of)
    i, j = (offset.ravel() for offset in np.mgrid[: 2 * reach + 1, : 2 * reach + 1])
    steep = np.zeros(height.shape, dtype=bool)
    most = elementary.tan(np.radians(settings.max_slope))
    for at in range(0, len(rows), CHUNK):
        part = rows[at : at + CHUNK], columns[at : at + CHUNK]
        along, across = (_median(of_axis[part[0][:, None] + i, part[1][:, None] + j]) for of_axis in (dx, dy))
        steep[part] = along * along + across * across > most * most
    return steep


def _median(values: np.ndarray) -> np.ndarray:
    """Return the median (K,) of the numbers among (K, N), 0 where there are hardly any."""
    ordered = np.sort(values, axis=1)  # NaN come last
    n = np.isfinite(ordered).sum(axis=1)
    row = np.arange(len(ordered))
    middle = 0.5 * (ordered[row, np.maximum(n - 1, 0) // 2] + ordered[row, np.minimum(n // 2, ordered.shape[1] - 1)])
    return np.where(n >= LEAST_SLOPES, middle, 0.0)


def _joined(cells: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Keep the parts of `cells` (H, W), corners joined, that hold one of `to`."""
    from scipy import ndimage  # takes as long to load as all of grid2d, which seldom needs it

    label, n = ndimage.label(cells, structure=np.ones((3, 3), dtype=int))
    holds = np.zeros(n + 1, dtype=bool)
    holds[label[to & cells]] = True
    holds[0] = False
    return holds[label]


def _filled(height: np.ndarray, known: np.ndarray, has_surface: np.ndarray) -> np.ndarray:
    """Give cells (H, W) of no surface the height of the nearest sloping floor, if it is near: what stands on a ramp, and gaps in it."""
    from scipy import ndimage

    distance, (i, j) = ndimage.distance_transform_edt(~known, return_indices=True)
    return np.where(~has_surface & (distance <= FILLED), height[i, j], height)


@kernel
def _grow(first: i4[::1], bins: i4[::1], n: i4[::1], mean: f4[::1], step: f8, height: f4[:, ::1]):
    """Give heights (H, W) to the cells that a surface leads to from those that have one, in place, nearest first.

    first : (H * W + 1,) rows of `bins`, `n` and `mean` of each cell's surfaces
    step : [m] by which no cell within REACH may be higher or lower
    """
    rows, columns = height.shape
    queue = np.empty(rows * columns, dtype=np.int32)
    end = 0
    for place in range(rows * columns):
        if not math.isnan(height[place // columns, place % columns]):
            queue[end] = place
            end += 1
    at = 0
    while at < end:
        i, j = queue[at] // columns, queue[at] % columns
        at += 1
        for i2 in range(max(i - 1, 0), min(i + 2, rows)):
            for j2 in range(max(j - 1, 0), min(j + 2, columns)):
                if not math.isnan(height[i2, j2]):
                    continue
                place = i2 * columns + j2
                found = _nearest(first[place], first[place + 1], bins, n, mean, height[i, j])
                if not abs(found - height[i, j]) <= step:  # nor where there is none
                    continue
                is_step = False
                for i3 in range(max(i2 - REACH, 0), min(i2 + REACH + 1, rows)):
                    for j3 in range(max(j2 - REACH, 0), min(j2 + REACH + 1, columns)):
                        is_step |= abs(height[i3, j3] - found) > step
                if not is_step:
                    height[i2, j2] = found
                    queue[end] = place
                    end += 1


@kernel
def _nearest(start, stop, bins, n, mean, wanted):
    """Return the height of the surface that is nearest to the one wanted, NaN where there is none.

    Readings on both sides of a bin's border are of one surface: a bin is taken together with the next.
    """
    best = np.nan
    for k in range(start, stop):
        total, count = np.float64(n[k]) * mean[k], n[k]
        if k + 1 < stop and bins[k + 1] == bins[k] + 1 and mean[k + 1] - mean[k] < BIN:
            total, count = total + np.float64(n[k + 1]) * mean[k + 1], count + n[k + 1]
        if count < LEAST_READINGS:
            continue
        found = total / count
        if math.isnan(best) or abs(found - wanted) < abs(best - wanted):
            best = found
    return best
