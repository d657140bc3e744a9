"""The 2-D navigation grid, [L] section 3: what stands in a robot's way, what is free, what was never seen.

Seeing the floor does not make a cell free: the floor is seen under a hanging box, too. So a first pass over the views gathers where, and
at what height, something stands; a second one believes a floor point only when its line of sight passed under nothing. The second
pass adds up the views by [L] (20) to (23), (24) decides.
"""

import math
from collections.abc import Iterable

import numpy as np
from numba import b1, f8, i8, u2

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.errors import SlamError
from slamcli.geometry.camera import Camera
from slamcli.jit.kernel import kernel
from slamcli.navigation.grid_evidence import SLICES, View, look
from slamcli.schema import Grid

MAX_CELLS = 1 << 25  # 290 m x 290 m at 0.05 m: some 600 MB of work arrays
MAX_WINDOW = 4000  # cells within reach of one view: 110 MB
DEEPEST = 1.0  # [m] how far something that hangs may go on behind the face that was seen
OCCUPIED, FREE, UNKNOWN = 1, 0, -1


def build_grid(frames: Iterable[tuple[np.ndarray, np.ndarray]], camera: Camera, *, settings: GridConfig, sensor: SensorConfig) -> Grid:
    """Build the grid from key frames.

    frames : per key frame, in order, (depth (H, W) float32 [m], NaN = none; T_lk (4, 4) camera to level frame)
    Raises SlamError for settings that contradict each other and when the grid would not fit into memory.
    """
    check(settings)
    rays = np.ascontiguousarray(camera.rays)
    return fuse([look(depth, rays, T_lk, settings=settings, sensor=sensor) for depth, T_lk in frames], settings=settings)


def check(settings: GridConfig) -> None:
    """Raise SlamError for settings that contradict each other."""
    for low, high in (("band_low", "band_high"), ("min_range", "max_range"), ("n_low", "n_high"), ("m_low", "m_high")):
        a, b = getattr(settings, low), getattr(settings, high)
        if a > b or (a == b and low != "n_low"):
            raise SlamError(f"grid2d.{low} = {a:g} must be below grid2d.{high} = {b:g}")
    if 2.0 * settings.max_range / settings.resolution > MAX_WINDOW:
        raise SlamError(f"grid2d.resolution = {settings.resolution:g}: too fine for grid2d.max_range = {settings.max_range:g}")


def spaced(T_lc: np.ndarray, *, metres: float, degrees: float) -> np.ndarray:
    """Choose frames: the first, then each that has moved or turned so far since the last chosen; rows of NaN are left out.

    T_lc : (F, 4, 4) camera poses. Key frames are fewer than a grid needs: they see all landmarks, but not all floor, twice.
    """
    chosen: list[int] = []
    most = np.cos(np.radians(degrees))
    for i in np.flatnonzero(np.isfinite(T_lc[:, :3]).all(axis=(1, 2))):
        if chosen:
            T = T_lc[chosen[-1]]
            cosine = 0.5 * (np.sum(T[:3, :3] * T_lc[i, :3, :3]) - 1.0)  # trace of the rotation between them
            if np.linalg.norm(T_lc[i, :3, 3] - T[:3, 3]) < metres and cosine > most:
                continue
        chosen.append(int(i))
    return np.array(chosen, dtype=np.int64)


def fuse(views: list[View], *, settings: GridConfig) -> Grid:
    """Fuse the views, in order, to one grid."""
    low, shape = extent(views, settings.resolution)
    standing = _with_neighbours(_standing(views, low, shape, settings))
    p_empty = np.full(shape, np.nan, dtype=np.float32)
    n_seen = np.zeros(shape, dtype=np.int32)
    update = paper_update if settings.update == "paper" else evidence_update
    for view in views:
        rows, columns = view.cell[:, 1] - low[1], view.cell[:, 0] - low[0]
        x, y = view.camera[:2] / settings.resolution - low
        band, reach = (settings.band_low, settings.band_high), DEEPEST / settings.resolution
        is_free = view.is_floor.copy()
        _drop_hidden(is_free, standing, rows, columns, x, y, view.camera[2], *band, reach)
        told = is_free | (view.n_band >= settings.n_low)
        update(p_empty, n_seen, rows[told], columns[told], view.n_band[told], settings)
    p_occupied = (1.0 - p_empty).astype(np.float32)
    state = decide(p_occupied, low=settings.m_low, high=settings.m_high)
    return Grid(p_occupied, n_seen, state, origin=low * settings.resolution, resolution=np.array(settings.resolution))


def _standing(views: list[View], low: np.ndarray, shape: tuple[int, int], settings: GridConfig) -> np.ndarray:
    """Give, as bits per cell (H, W) uint16, the slices of the band in which any view saw something."""
    standing = np.zeros(shape, dtype=np.uint16)
    for view in views:
        is_hit = view.n_band >= settings.n_low
        standing[view.cell[is_hit, 1] - low[1], view.cell[is_hit, 0] - low[0]] |= view.slices[is_hit]  # a cell is in a view once
    return standing


def _with_neighbours(standing: np.ndarray) -> np.ndarray:
    """Add to each cell the slices of the four beside it: a line of sight must not slip through a gap of one cell in an outline."""
    padded = np.pad(standing, 1)
    return standing | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]


def extent(views: list[View], resolution: float) -> tuple[np.ndarray, tuple[int, int]]:
    """Give the lowest cell (2,) and the grid's shape (rows, columns) that hold all that was seen and the cameras themselves."""
    cells = [np.concatenate([view.cell, np.floor(view.camera[None, :2] / resolution)]) for view in views if len(view.cell)]
    if not cells:
        return np.zeros(2, dtype=np.int64), (1, 1)
    low = np.min([c.min(axis=0) for c in cells], axis=0).astype(np.int64)
    high = np.max([c.max(axis=0) for c in cells], axis=0).astype(np.int64)
    columns, rows = (int(n) for n in high - low + 1)
    check_size(rows, columns, resolution)
    return low, (rows, columns)


def check_size(rows: int, columns: int, resolution: float) -> None:
    """Raise SlamError for a grid too large for memory, before any is reserved."""
    if rows * columns > MAX_CELLS:
        raise SlamError(
            f"grid2d: the grid would have {columns} x {rows} cells ({columns * resolution:.0f} m x {rows * resolution:.0f} m); "
            "check the trajectory (slamcli eval ape), or raise grid2d.resolution"
        )


@kernel
def _drop_hidden(
    is_free: b1[::1],
    standing: u2[:, ::1],
    rows: i8[::1],
    columns: i8[::1],
    camera_x: f8,
    camera_y: f8,
    camera_z: f8,
    low: f8,
    high: f8,
    reach: f8,
):
    """Clear `is_free` (N,) of each cell whose floor's line of sight to the camera passes under something that hangs into the band.

    It passes under something in a cell where slices above the line are filled, while those around the line are not: a line that goes
    through filled slices only grazes the cell's corner, or what stood there has moved. A line may pass over a low box: what is above
    the line beyond the box was open to view.
    """
    for n in range(len(rows)):
        if not is_free[n]:
            continue
        x, y = columns[n] + 0.5, rows[n] + 0.5
        dx, dy = camera_x - x, camera_y - y
        steps = math.ceil(abs(dx) if abs(dx) > abs(dy) else abs(dy))
        for s in range(steps + 1):
            t = s / steps if steps > 0 else 0.0
            height = t * camera_z
            if height >= high or t * t * (dx * dx + dy * dy) > reach * reach:
                break
            i, j = math.floor(y + t * dy), math.floor(x + t * dx)
            if not (0 <= i < standing.shape[0] and 0 <= j < standing.shape[1]):
                break
            if standing[i, j]:
                at = int(SLICES * (height - low) / (high - low)) if height > low else 0
                around = (31 << at) >> 2  # two slices to either side
                if (standing[i, j] >> (at + 3)) and not (standing[i, j] & around):
                    is_free[n] = False
                    break


def paper_update(p_empty: np.ndarray, n_seen: np.ndarray, rows: np.ndarray, columns: np.ndarray, n: np.ndarray, s: GridConfig) -> None:
    """Enter one view's counts n of band points into the cells it saw, in place, as printed in [L] (20) to (23)."""
    seen = view_probability(n, n_low=s.n_low, n_high=s.n_high)
    before = np.clip(p_empty[rows, columns], s.p_floor, 1.0 - s.p_floor)  # a probability of exactly 0 or 1 would divide by 0
    given_empty = s.p_empty_empty * seen / before
    given_full = s.p_full_empty * seen / (1.0 - before)
    after = np.clip(s.blend * given_empty + (1.0 - s.blend) * given_full, 0.0, 1.0)
    p_empty[rows, columns] = np.where(n_seen[rows, columns] > 0, after, seen)
    n_seen[rows, columns] += 1


def view_probability(n: np.ndarray, *, n_low: int, n_high: int) -> np.ndarray:
    """Give P(E) of cells with n points in one view, [L] (20)."""
    p_empty = 1.0 - n / max(int(n.max(initial=1)), 1)
    return np.where(n < n_low, 1.0, np.where(n > n_high, 0.0, p_empty))


def evidence_update(p_empty: np.ndarray, n_seen: np.ndarray, rows: np.ndarray, columns: np.ndarray, n: np.ndarray, s: GridConfig) -> None:
    """Enter one view's counts by Bayes' rule, P(E1|E2) and P(F1|E2) being the reliability of one view: log-odds add up.

    (22), (23) as printed forget: from P(E) = 0.05 one empty view leads to P(E) = 1, however many full views went before. And (20) calls
    a cell with a few points nearly empty as soon as another cell of the view has many; here n_l points leave it open, n_h say full.
    """
    share = np.where(n < s.n_low, 0.0, 0.5 + 0.5 * np.minimum((n - s.n_low + 1) / (s.n_high - s.n_low + 1), 1.0))
    reliable = (1.0 - share) * s.p_empty_empty + share * s.p_full_empty
    before = np.where(n_seen[rows, columns] > 0, p_empty[rows, columns], 0.5)
    odds = before / (1.0 - before) * reliable / (1.0 - reliable)
    p_empty[rows, columns] = np.clip(odds / (1.0 + odds), s.p_floor, 1.0 - s.p_floor)
    n_seen[rows, columns] += 1


def decide(p_occupied: np.ndarray, *, low: float, high: float) -> np.ndarray:
    """Decide 1 occupied, 0 free, -1 unknown or never seen (NaN), [L] (24)."""
    state = np.full(p_occupied.shape, UNKNOWN, dtype=np.int8)
    state[p_occupied > high] = OCCUPIED
    state[p_occupied < low] = FREE
    return state
