"""The 2-D navigation grid, [L] section 3: what stands in a robot's way, what is free, what was never seen.

Seeing the floor does not make a cell free: the floor is seen under a hanging box, too. So a first pass over the views gathers where, and
at what height, something stands, and where lines of sight crossed the band; a second one believes a floor point only when its line of
sight passed under nothing that may reach as far as the point. The second pass adds up the views by [L] (20) to (23), (24) decides.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import b1, f4, f8, i4, i8, u2

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.errors import SlamError
from slamcli.geometry import elementary
from slamcli.geometry.camera import Camera
from slamcli.jit.kernel import kernel
from slamcli.navigation import hanging
from slamcli.navigation.grid_evidence import NOT_SEEN, SEEN, SLICES, View, look
from slamcli.navigation.terrain import LEVEL_FLOOR, NO_LEVELS, Surfaces, Terrain, find_terrain
from slamcli.schema import Grid

MAX_CELLS = 1 << 25  # 290 m x 290 m at 0.05 m: some 600 MB of work arrays
MAX_WINDOW = 4000  # cells within reach of one view: 110 MB
DEEPEST = 1.0  # [m] how far something that hangs may go on behind the face that was seen
BESIDE = 0.15  # [m] from the seen faces of something that hangs, within which it may go on to the side
FAR_EDGE = 0.3  # [m] before a hole's far edge in which the wall below it ends the lines of sight
TOP_SLICE = 1 << (SLICES - 1)
INSIDE = 0.9  # P(F) of a cell that was never seen but must lie within something that hangs
OCCUPIED, FREE, UNKNOWN = 1, 0, -1


def build_grid(frames: Iterable[tuple[np.ndarray, np.ndarray]], camera: Camera, *, settings: GridConfig, sensor: SensorConfig) -> Grid:
    """Build the grid from frames.

    frames : per frame, in order, (depth (H, W) float32 [m], NaN = none; T_lk (4, 4) camera to level frame)
    Raises SlamError for settings that contradict each other and when the grid would not fit into memory.
    """
    check(settings)
    rays, frames = np.ascontiguousarray(camera.rays), list(frames)

    def views(floor: Terrain) -> Iterable[View]:
        return (look(depth, rays, T_lk, settings=settings, sensor=sensor, floor=floor) for depth, T_lk in frames)

    return fuse_over_floor(views, settings=settings)


def fuse_over_floor(views: Callable[[Terrain], Iterable[View]], *, settings: GridConfig) -> Grid:
    """Fuse the views to one grid; where the floor turns out to slope, look again with heights above it.

    views : gives the views, in order, with heights counted from a floor
    """
    surfaces = Surfaces()

    def flat() -> Iterable[View]:
        for view in views(LEVEL_FLOOR):
            surfaces.add(view.levels)
            yield view

    made = fuse(flat(), settings=settings)
    floor = find_terrain(surfaces.together(), settings=settings, max_cells=MAX_CELLS)
    return made if floor is None else fuse(views(floor), settings=settings, floor=floor)


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
    most = elementary.cos(np.radians(degrees))
    for i in np.flatnonzero(np.isfinite(T_lc[:, :3]).all(axis=(1, 2))):
        if chosen:
            T = T_lc[chosen[-1]]
            cosine = 0.5 * (np.sum(T[:3, :3] * T_lc[i, :3, :3]) - 1.0)  # trace of the rotation between them
            if np.linalg.norm(T_lc[i, :3, 3] - T[:3, 3], axis=-1) < metres and cosine > most:
                continue
        chosen.append(int(i))
    return np.array(chosen, dtype=np.int64)


def fuse(views: Iterable[View], *, settings: GridConfig, floor: Terrain = LEVEL_FLOOR) -> Grid:
    """Fuse the views, in order, whose heights are counted from `floor`, to one grid."""
    views, crossings = _without_crossings(views, settings.resolution)
    low, shape = extent(views, settings.resolution)
    standing, is_hole = _standing(views, low, shape, settings), _holes(views, low, shape, settings.resolution)
    is_open, outline, ground = crossings.open_slices(low, shape), _with_neighbours(standing), floor.window(low, shape)
    p_empty = np.full(shape, np.nan, dtype=np.float32)
    n_seen, n_under, n_top = (np.zeros(shape, dtype=np.int32) for _ in range(3))
    sights = [_sight(view, low, settings) for view in views]
    hangs, nothing = np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.int32)
    for view, sight in zip(views, sights, strict=True):
        is_floor = (view.floor != NOT_SEEN) & ~is_hole[sight.rows, sight.columns]
        is_free = is_floor.copy()
        _drop_hidden(is_free, outline, is_open, hangs, nothing, nothing, ground, sight)
        is_under = is_floor & ~is_free
        n_under[sight.rows[is_under], sight.columns[is_under]] += 1
        n_top[sight.rows[view.is_top], sight.columns[view.is_top]] += 1
    things = hanging.find(standing & hangs, widest=DEEPEST / settings.resolution)
    is_doubtful = _beside_hanging(standing & hangs, is_open, settings.resolution)
    update = paper_update if settings.update == "paper" else evidence_update
    for view, sight in zip(views, sights, strict=True):
        is_free = (view.floor != NOT_SEEN) & ~is_hole[sight.rows, sight.columns]
        _drop_hidden(is_free, outline, is_open, hangs, things.face, things.around, ground, sight)
        is_free &= ~is_doubtful[sight.rows, sight.columns]
        told = is_free | (view.n_band >= settings.n_low)
        update(p_empty, n_seen, sight.rows[told], sight.columns[told], view.n_band[told], settings)
    p_occupied = (1.0 - p_empty).astype(np.float32)
    state = decide(p_occupied, low=settings.m_low, high=settings.m_high)
    body = hanging.bodies(things, is_under=(n_under >= 2) & (state == UNKNOWN), is_top=n_top > 0)
    p_occupied[body], n_seen[body], state[body] = INSIDE, n_under[body], OCCUPIED
    return Grid(p_occupied, n_seen, state, origin=low * settings.resolution, resolution=np.array(settings.resolution))


class CellSights(NamedTuple):
    """The lines of sight from one camera to cells of the grid."""

    rows: i8[::1]  # (N,)
    columns: i8[::1]  # (N,)
    x: f8  # of the camera [cells]
    y: f8
    z: f8  # [m]
    low: f8  # [m] of the robot's height band
    high: f8  # [m]
    reach: f8  # [cells] how far something that hangs may go on


def _sight(view: View, low: np.ndarray, settings: GridConfig) -> CellSights:
    """Return the lines of sight to a view's cells."""
    x, y = view.camera[:2] / settings.resolution - low
    rows, columns = view.cell[:, 1] - low[1], view.cell[:, 0] - low[0]
    band = settings.band_low, settings.band_high
    return CellSights(rows, columns, x, y, view.camera[2], *band, reach=DEEPEST / settings.resolution)


def _without_crossings(views: Iterable[View], resolution: float) -> tuple[list[View], "Crossings"]:
    """Add up the views' lines of sight and give the views without them: they are most of what a view holds."""
    crossings, kept = Crossings(resolution), []
    for view in views:
        crossings.add(view.open_cell, view.open_slices)
        kept.append(replace(view, open_cell=view.open_cell[:0], open_slices=view.open_slices[:0], levels=NO_LEVELS))
    return kept, crossings


class Crossings:
    """Which slices of which cells lines of sight crossed: in any view, and in two at least."""

    def __init__(self, resolution: float) -> None:
        """Start without any; `resolution` [m] is for what is said of a grid too large."""
        self._resolution = resolution
        self._low = np.zeros(2, dtype=np.int64)
        self._once = self._twice = np.zeros((0, 0), dtype=np.uint16)

    def add(self, cell: np.ndarray, slices: np.ndarray) -> None:
        """Add one view's cells (N, 2), each once, and their slices (N,) uint16."""
        if not len(cell):
            return
        self._grow(cell.min(axis=0).astype(np.int64), cell.max(axis=0).astype(np.int64) + 1)
        rows, columns = cell[:, 1] - self._low[1], cell[:, 0] - self._low[0]
        self._twice[rows, columns] |= self._once[rows, columns] & slices
        self._once[rows, columns] |= slices

    def open_slices(self, low: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Cut out, for a grid, the slices (H, W) uint16 that two views or more saw through."""
        out = np.zeros(shape, dtype=np.uint16)
        rows, columns = self._twice.shape
        if self._twice.size:
            first = np.maximum(low, self._low)
            last = np.minimum(low + shape[::-1], self._low + [columns, rows])
            if (first < last).all():
                a, b, c, d = first - low, last - low, first - self._low, last - self._low
                out[a[1] : b[1], a[0] : b[0]] = self._twice[c[1] : d[1], c[0] : d[0]]
        return out

    def _grow(self, low: np.ndarray, high: np.ndarray) -> None:
        size = np.array(self._once.shape[::-1])
        if self._once.size:
            if (low >= self._low).all() and (high <= self._low + size).all():
                return
            # Half as much again on the side that lacks room: growth costs little then, however long the drive.
            room = size // 2 * ((low < self._low) | (high > self._low + size))
            low = np.where(low < self._low, np.minimum(low, self._low - room), self._low)
            high = np.where(high > self._low + size, np.maximum(high, self._low + size + room), self._low + size)
        columns, rows = (int(n) for n in high - low)
        check_size(rows, columns, self._resolution)
        at = (self._low - low) if self._once.size else np.zeros(2, dtype=np.int64)
        window = (slice(at[1], at[1] + size[1]), slice(at[0], at[0] + size[0]))
        once, twice = (np.zeros((rows, columns), dtype=np.uint16) for _ in range(2))
        once[window], twice[window] = self._once, self._twice
        self._low, self._once, self._twice = low, once, twice


def _standing(views: list[View], low: np.ndarray, shape: tuple[int, int], settings: GridConfig) -> np.ndarray:
    """Give, as bits per cell (H, W) uint16, the slices of the band in which any view saw something."""
    standing = np.zeros(shape, dtype=np.uint16)
    for view in views:
        is_hit = view.n_band >= settings.n_low
        standing[view.cell[is_hit, 1] - low[1], view.cell[is_hit, 0] - low[0]] |= view.slices[is_hit]  # a cell is in a view once
    return standing


def _holes(views: list[View], low: np.ndarray, shape: tuple[int, int], resolution: float) -> np.ndarray:
    """Say which cells (H, W) are holes in the floor: seen through in two views, and in half as many as saw a floor there.

    Lines of sight end so close below a hole's far edge that they tell of no depth; there, and only there, a line that passes below the
    band does not tell of a floor. A reflecting floor is taken for a hole: neither is fit to drive on, nor an obstacle.
    """
    import cv2

    n_hole, n_floor = (np.zeros(shape, dtype=np.int32) for _ in range(2))
    for view in views:
        for count, has in ((n_hole, view.is_hole), (n_floor, view.floor == SEEN)):
            count[view.cell[has, 1] - low[1], view.cell[has, 0] - low[0]] += 1
    is_hole = (n_hole >= 2) & (2 * n_hole >= n_floor)
    if not is_hole.any():
        return is_hole
    reach = int(np.ceil(FAR_EDGE / resolution))
    near = cv2.dilate(is_hole.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0
    return is_hole | (near & (n_floor == 0))


def _with_neighbours(standing: np.ndarray) -> np.ndarray:
    """Add to each cell the slices of the four beside it: a line of sight must not slip through a gap of one cell in an outline."""
    padded = np.pad(standing, 1)
    return standing | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]


def _beside_hanging(hangs: np.ndarray, is_open: np.ndarray, resolution: float) -> np.ndarray:
    """Say which cells (H, W) are so near to something that hangs that it may go on over them, while no line of sight crossed its heights there.

    A side that is seen at a grazing angle, or from too near, shows nothing, and the floor under the thing is seen past it.

    hangs, is_open : (H, W) uint16, bits: slices of the band that hang, and that lines of sight crossed
    """
    import cv2

    # The lowest and the highest slice may be filled in part; what is above the band goes on.
    core = hangs & (hangs << 1) & ((hangs >> 1) | (hangs & TOP_SLICE))
    reach = int(np.ceil(BESIDE / resolution))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    heights = np.zeros_like(hangs)  # of what hangs around
    for slice_ in range(SLICES):
        is_here = (core >> slice_) & 1
        if is_here.any():
            heights |= cv2.dilate(is_here.astype(np.uint8), disc).astype(np.uint16) << slice_
    return (heights > 0) & (is_open & heights == 0)


def extent(views: list[View], resolution: float) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the lowest cell (2,) and the grid's shape (rows, columns) that hold all that was seen and the cameras themselves."""
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
            "check the trajectory, or raise grid2d.resolution"
        )


@kernel
def _drop_hidden(
    is_free: b1[::1],
    standing: u2[:, ::1],
    is_open: u2[:, ::1],
    hangs: u2[:, ::1],
    face: i4[:, ::1],
    around: i4[:, ::1],
    ground: f4[:, ::1],
    sight: CellSights,
):
    """Clear `is_free` (N,) of each cell whose floor's line of sight to the camera passes under something that hangs into the band.

    It passes under something in a cell where slices above the line are filled, while those around the line are not: a line that goes
    through filled slices only grazes the cell's corner, or what stood there has moved. A line may pass over a low box: what is above
    the line beyond the box was open to view. What hangs does not reach as far as the floor's cell if lines of sight crossed that cell at
    its heights, `is_open` (H, W), or if it is the face of a thing (H, W) of known outline that is not `around` it. The slices that hide
    are added to `hangs` (H, W). Heights are counted from those of the floor, `ground` (H, W) [m].
    """
    rows, columns, camera_x, camera_y, camera_z, low, high, reach = sight
    highest = high + max(ground.max(), 0.0)
    for n in range(len(rows)):
        if not is_free[n]:
            continue
        x, y = columns[n] + 0.5, rows[n] + 0.5
        dx, dy = camera_x - x, camera_y - y
        foot = np.float64(ground[rows[n], columns[n]])
        steps = math.ceil(abs(dx) if abs(dx) > abs(dy) else abs(dy))
        for s in range(steps + 1):
            t = s / steps if steps > 0 else 0.0
            height = foot + t * (camera_z - foot)
            if height >= highest or t * t * (dx * dx + dy * dy) > reach * reach:
                break
            i, j = math.floor(y + t * dy), math.floor(x + t * dx)
            if not (0 <= i < standing.shape[0] and 0 <= j < standing.shape[1]):
                break
            height -= ground[i, j]
            if standing[i, j] and height < high:
                at = int(SLICES * (height - low) / (high - low)) if height > low else 0
                beside = (31 << at) >> 2  # two slices to either side
                above = (standing[i, j] >> (at + 3)) << (at + 3)
                if face[i, j] and around[rows[n], columns[n]] != face[i, j]:
                    continue
                # The lowest and the highest slice may be filled in part; what is above the band goes on.
                core = above & (above << 1) & ((above >> 1) | (above & TOP_SLICE))
                is_passed = core != 0 and not (core & ~is_open[rows[n], columns[n]])
                if above and not is_passed and not (standing[i, j] & beside):
                    is_free[n] = False
                    hangs[i, j] |= np.uint16(above)
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
    """Return P(E) of cells with n points in one view, [L] (20)."""
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
