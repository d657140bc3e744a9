"""Paths on the grid: A* for a round robot that prefers to keep clear of obstacles.

A step costs its length times a factor of 1 in the open that grows to `1 + weight` where the robot would touch. The path of cells is
then pulled tight: a straight stretch replaces a run of cells where it costs no more. P. Hart, N. Nilsson, B. Raphael, IEEE TSSC 1968,
doi:10.1109/TSSC.1968.300136.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry.heap import doubled, pop, push
from slamcli.jit.kernel import kernel
from slamcli.navigation.tight_path import dense, pull_tight
from slamcli.schema import Grid

HALF_DIAGONAL = 0.5 * 2.0**0.5
LARGEST = 100.0  # [m] of a radius or a clearance, and of a weight
POCKET = 0.1  # of the largest region: a smaller one is a gap between things in which a robot could turn but not drive
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]])  # neighbours: a diagonal step needs both cells beside it, and so joins nothing more


class NoWay(SlamError):
    """Start and goal each have room, but no way leads from one to the other."""


@dataclass(frozen=True)
class Route:
    """A path through free space."""

    xy: np.ndarray  # (N, 2) m, level frame, one point per cell side or closer; the first is the start, the last the goal
    clearance: np.ndarray  # (N,) m, from each point to the nearest blocked cell's edge, less the robot's radius
    length: float  # m


def plan(
    grid: Grid, start: tuple[float, float], goal: tuple[float, float], *, radius: float = 0.2, clearance: float = 0.3,
    weight: float = 3.0, allow_unknown: bool = False,
) -> Route:  # fmt: skip
    """Plan from start to goal [m, level frame].

    radius : m, of the robot; no point of the path is nearer to a blocked cell
    clearance : m, beyond the radius, up to which nearness to obstacles costs
    weight : the factor by which a metre along an obstacle costs more than one in the open
    Raises SlamError for a start or goal outside the grid or not free, NoWay when no way leads from one to the other.
    """
    for name, value, least in (("radius", radius, 0.0), ("clearance", clearance, 0.0), ("weight", weight, 0.0)):
        if not (np.isfinite(value) and least <= value <= LARGEST):
            raise SlamError(f"{name} = {value:g}: must be from {least:g} to {LARGEST:g}")
    margin = room(grid, radius=radius, allow_unknown=allow_unknown)
    ends = [end_cell(grid, margin, name, xy, radius) for name, xy in (("start", start), ("goal", goal))]
    cost = _cell_cost(margin, clearance, weight)
    cells = cheapest(cost, ends[0], ends[1])
    if cells is None:
        raise NoWay(_unreachable(grid, cost, ends, allow_unknown))
    corners = pull_tight(cost, cells)
    xy = (corners[:, ::-1] + 0.5) * float(grid.resolution) + grid.origin
    xy = dense(np.concatenate([[start], xy[1:-1], [goal]]) if len(xy) > 1 else np.array([start, goal]), float(grid.resolution))
    rows, columns = cells_of(grid, xy)
    return Route(xy=xy, clearance=margin[rows, columns], length=float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum()))


def nearest_room(grid: Grid, places: Sequence[tuple[float, float]], *, radius: float, allow_unknown: bool) -> list[tuple[float, float]]:
    """Find, near each of `places` [m, level frame], one where a robot has room, all within one region that it can drive through.

    The region is the one that moves them least, pockets left out. A camera does not see the floor below itself, so where it stood is often
    unknown. Raises SlamError where the robot fits nowhere.
    """
    from scipy import ndimage

    margin = room(grid, radius=radius, allow_unknown=allow_unknown)
    labels, n_regions = ndimage.label(margin >= 0.0, structure=CROSS)
    if n_regions == 0:
        raise SlamError(f"a robot of {radius:g} m radius fits nowhere in this grid: try a smaller radius, or allow unknown cells")
    rows, columns = np.nonzero(labels)
    xy, region = (np.stack([columns, rows], axis=1) + 0.5) * float(grid.resolution) + grid.origin, labels[rows, columns]
    distance = [np.linalg.norm(xy - place, axis=1) for place in places]
    cells = np.bincount(labels.ravel(), minlength=n_regions + 1)[1:]
    index = 1 + np.flatnonzero(cells >= POCKET * cells.max())
    best = index[np.argmin(np.sum([ndimage.minimum(d, region, index) for d in distance], axis=0))]
    found = [np.flatnonzero(region == best)[d[region == best].argmin()] for d in distance]
    return [(float(xy[i, 0]), float(xy[i, 1])) for i in found]


def room(grid: Grid, *, radius: float, allow_unknown: bool) -> np.ndarray:
    """Return per cell (H, W) [m] the room beyond a robot's radius, negative where the robot would touch, -inf where a cell is blocked."""
    distance = obstacle_distance(grid, allow_unknown=allow_unknown)
    return np.where(blocked(grid, allow_unknown), -np.inf, distance - radius)


def obstacle_distance(grid: Grid, *, allow_unknown: bool) -> np.ndarray:
    """Return per cell (H, W) [m] the distance from its centre to the edge of the nearest blocked cell, 0 inside one.

    Outside the grid everything is unknown. Half a cell's diagonal is taken off the distance between centres: never too much.
    """
    import cv2

    is_blocked = blocked(grid, allow_unknown)
    pad = 0 if allow_unknown else 1
    free = np.pad((~is_blocked).astype(np.uint8), pad)
    if free.all():
        return np.full(grid.state.shape, np.inf)
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = distance[pad : distance.shape[0] - pad, pad : distance.shape[1] - pad]
    return np.maximum(distance.astype(np.float64) - HALF_DIAGONAL, 0.0) * float(grid.resolution)


def blocked(grid: Grid, allow_unknown: bool) -> np.ndarray:
    """Mark the cells (H, W) that a robot must not touch."""
    return grid.state == 1 if allow_unknown else grid.state != 0


def _cell_cost(margin: np.ndarray, clearance: float, weight: float) -> np.ndarray:
    """Return the factor (H, W) on a step's length, infinite where the robot would touch."""
    nearness = 1.0 - np.clip(margin / clearance, 0.0, 1.0) if clearance > 0.0 else np.zeros(margin.shape)
    return np.where(margin >= 0.0, 1.0 + weight * nearness**2, np.inf)


def cells_of(grid: Grid, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns (...) of the cells in which places (..., 2) [m, level frame] lie."""
    cell = np.floor((np.asarray(xy) - grid.origin) / float(grid.resolution)).astype(np.int64)
    return cell[..., 1], cell[..., 0]


def end_cell(grid: Grid, margin: np.ndarray, name: str, xy: tuple[float, float], radius: float) -> tuple[int, int]:
    """Find the cell (row, column) of a path's end; SlamError where the robot has no room there.

    margin : (H, W) m, room beyond the robot's radius
    """
    rows, columns = grid.state.shape
    high = grid.origin + float(grid.resolution) * np.array([columns, rows])
    place = f"{name} {xy[0]:g},{xy[1]:g}"
    if not (np.isfinite(xy).all() and grid.origin[0] <= xy[0] < high[0] and grid.origin[1] <= xy[1] < high[1]):
        extent = f"x {grid.origin[0]:.2f} to {high[0]:.2f} m, y {grid.origin[1]:.2f} to {high[1]:.2f} m"
        raise SlamError(f"{place}: outside the grid, which covers {extent}")
    row, column = (int(i) for i in cells_of(grid, np.array(xy)))
    if margin[row, column] >= 0.0:
        return row, column
    kind = {1: "inside an obstacle", -1: "in unknown space", 0: f"nearer than the robot's radius of {radius:g} m to what is not free"}
    raise SlamError(f"{place}: {kind[int(grid.state[row, column])]}{_nearest(grid, margin, row, column)}")


def _nearest(grid: Grid, margin: np.ndarray, row: int, column: int) -> str:
    rows, columns = np.nonzero(margin >= 0.0)
    if len(rows) == 0:
        return "; the robot fits nowhere in this grid: try a smaller radius, or allow unknown cells"
    i = np.argmin((rows - row) ** 2 + (columns - column) ** 2)
    xy = (np.array([columns[i], rows[i]]) + 0.5) * float(grid.resolution) + grid.origin
    return f"; the nearest place with room for the robot is {xy[0]:.2f},{xy[1]:.2f}"


def _unreachable(grid: Grid, cost: np.ndarray, ends: list[tuple[int, int]], allow_unknown: bool) -> str:
    from scipy import ndimage

    labels, _ = ndimage.label(np.isfinite(cost), structure=CROSS)
    area = [float((labels == labels[end]).sum()) * float(grid.resolution) ** 2 for end in ends]
    hint = "a smaller radius" if allow_unknown else "a smaller radius, or allow unknown cells"
    got = f"the robot's middle gets to {area[0]:.1f} m2 from the start, {area[1]:.1f} m2 from the goal"
    return f"no way leads from start to goal: {got}; try {hint}"


@kernel
def _a_star(cost, start, goal, before):
    """Fill `before` (H W) with each reached cell's predecessor on its cheapest 8-connected path; returns whether the goal was reached.

    Cells are numbered row by row. A diagonal step needs both cells beside it to be passable: it would cut a corner otherwise.
    """
    rows, columns = cost.shape
    diagonal = np.sqrt(2.0)
    so_far = np.full(rows * columns, np.inf)
    done = np.zeros(rows * columns, dtype=np.bool_)
    key, order, cell = np.empty(1024), np.empty(1024, dtype=np.int64), np.empty(1024, dtype=np.int64)
    so_far[start] = 0.0
    push(key, order, cell, 0, 0.0, 0, start)
    size, pushed = 1, 1
    while size > 0:
        pop(key, order, cell, size)
        size -= 1
        at = cell[size]
        if done[at]:
            continue
        done[at] = True
        if at == goal:
            return True
        if size + 8 > len(key):
            key, order, cell = doubled(key), doubled(order), doubled(cell)
        r, c = at // columns, at % columns
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                r2, c2 = r + dr, c + dc
                if r2 < 0 or c2 < 0 or r2 >= rows or c2 >= columns:
                    continue
                if cost[r, c2] == np.inf or cost[r2, c] == np.inf:
                    continue
                to = r2 * columns + c2
                total = so_far[at] + (diagonal if dr * dc != 0 else 1.0) * 0.5 * (cost[r, c] + cost[r2, c2])
                if total < so_far[to]:
                    so_far[to], before[to] = total, at
                    far, near = abs(goal // columns - r2), abs(goal % columns - c2)
                    if far < near:
                        far, near = near, far
                    push(key, order, cell, size, total + far + (diagonal - 1.0) * near, pushed, to)
                    size += 1
                    pushed += 1
    return False


def cheapest(cost: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> np.ndarray | None:
    """Return the cells (N, 2) of the cheapest path, None where there is none."""
    columns = cost.shape[1]
    before = np.full(cost.size, -1, dtype=np.int64)
    first, last = start[0] * columns + start[1], goal[0] * columns + goal[1]
    if not _a_star(cost, first, last, before):
        return None
    cells = [last]
    while cells[-1] != first:
        cells.append(int(before[cells[-1]]))
    return np.stack(np.divmod(np.array(cells[::-1]), columns), axis=1)
