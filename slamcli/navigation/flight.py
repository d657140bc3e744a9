"""Paths through the octree for what flies: A* in three dimensions for a sphere that prefers to keep clear of obstacles.

As on the grid, see `planner`, a step costs its length times a factor that grows towards obstacles; what was never seen is an obstacle.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry import voxel
from slamcli.geometry.heap import doubled, pop, push
from slamcli.geometry.octree import Octree, expand
from slamcli.jit.kernel import kernel
from slamcli.navigation.tight_path import dense, pull_tight

HALF_DIAGONAL = 0.5 * 3.0**0.5  # of a cell
MAX_CELLS = 40_000_000  # of the box around the free space


@dataclass(frozen=True)
class Airspace:
    """The free space of an octree as a box of cells."""

    margin: np.ndarray  # (X, Y, Z) float32 m from each cell's centre to the nearest one that is not free, at least
    low: np.ndarray  # (3,) m, level frame: the outer corner of cell (0, 0, 0)
    resolution: float  # m, side of a cell

    def cell(self, xyz: np.ndarray) -> np.ndarray:
        """Return the cells (..., 3) int64 that hold places [m]."""
        return np.floor((np.asarray(xyz, dtype=np.float64) - self.low) / self.resolution).astype(np.int64)

    def centre(self, cell: np.ndarray) -> np.ndarray:
        """Return the centres (..., 3) of cells [m]."""
        return (np.asarray(cell) + 0.5) * self.resolution + self.low


@dataclass(frozen=True)
class Flight:
    """A path through free space."""

    xyz: np.ndarray  # (N, 3) m, level frame; the first is the start, the last the goal
    clearance: np.ndarray  # (N,) m, beyond the radius, from each point to what is not free
    length: float  # m


def airspace(tree: Octree) -> Airspace:
    """Find how far each place of an octree is from what is not free; SlamError where nothing is, or too much for memory."""
    from scipy import ndimage

    is_free = ~tree.is_occupied()
    if not is_free.any():
        raise SlamError("the octree has no free space: nothing can fly there")
    cells = voxel.unmorton(expand(Octree(tree.resolution, tree.key[is_free], tree.depth[is_free], tree.log_odds[is_free])).key)
    first = cells.min(axis=0) - 1
    shape = cells.max(axis=0) - first + 2  # a rim of what is not free all round
    if int(np.prod(shape)) > MAX_CELLS:
        raise SlamError(f"the free space spans {' x '.join(map(str, shape))} cells: too many; raise octree.resolution")
    free = np.zeros(shape, dtype=bool)
    free[tuple((cells - first).T)] = True
    margin = np.maximum(ndimage.distance_transform_edt(free) - HALF_DIAGONAL, 0.0) * tree.resolution
    low = (first - (1 << 15)) * tree.resolution
    return Airspace(np.where(free, margin, -1.0).astype(np.float32), low, tree.resolution)


def fly(space: Airspace, start: Sequence[float], goal: Sequence[float], *, radius: float, clearance: float, weight: float) -> Flight:
    """Plan from start to goal (x, y, z) [m, level frame] for a sphere of `radius` [m].

    clearance : m, beyond the radius, up to which nearness to obstacles costs; weight : how many times more a metre along them costs
    Raises SlamError for a start or goal without room for the sphere, and when no way leads from one to the other.
    """
    room = space.margin - radius
    ends = [_end_cell(space, room, name, place, radius) for name, place in (("start", start), ("goal", goal))]
    nearness = 1.0 - np.clip(room / clearance, 0.0, 1.0) if clearance > 0.0 else np.zeros(room.shape)
    cost = np.where(room >= 0.0, 1.0 + weight * nearness**2, np.inf)
    before = np.full(cost.size, -1, dtype=np.int64)
    if not _a_star(cost, ends[0], ends[1], before):
        raise SlamError("no way leads from start to goal through space that was seen to be free; try a smaller radius")
    cells = [int(np.ravel_multi_index(tuple(ends[1]), cost.shape))]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    path = pull_tight(cost, np.stack(np.unravel_index(cells[::-1], cost.shape), axis=1))
    xyz = space.centre(path)
    xyz[0], xyz[-1] = start, goal
    if len(xyz) == 1:
        xyz = np.array([start, goal])
    xyz = dense(xyz, space.resolution)
    return Flight(xyz, room[tuple(space.cell(xyz).T)], float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum()))


def nearest_free(space: Airspace, place: np.ndarray, radius: float) -> np.ndarray:
    """Find the place nearest to one [m, level frame] where a sphere of `radius` [m] has room; SlamError where it fits nowhere."""
    free = np.argwhere(space.margin >= radius)
    if len(free) == 0:
        raise SlamError(f"nothing of {radius:g} m radius fits into the space that was seen to be free: try a smaller radius")
    return space.centre(free[np.argmin(((space.centre(free) - place) ** 2).sum(axis=1))])


def _end_cell(space: Airspace, room: np.ndarray, name: str, place: Sequence[float], radius: float) -> np.ndarray:
    """Find the cell (3,) of a path's end; SlamError, with the nearest place that does, where the sphere has no room there."""
    cell = space.cell(np.array(place)) if np.isfinite(place).all() else np.full(3, -1)
    if ((cell >= 0) & (cell < room.shape)).all() and room[tuple(cell)] >= 0.0:
        return cell
    near = nearest_free(space, np.nan_to_num(np.array(place), posinf=0.0, neginf=0.0), radius)
    told = ",".join(f"{value:g}" for value in place)
    raise SlamError(
        f"{name} {told}: no room for {radius:g} m around it; the nearest place with room is {near[0]:.2f},{near[1]:.2f},{near[2]:.2f}"
    )


@kernel
def _a_star(cost, start, goal, before):
    """Fill `before` (X Y Z) with each reached cell's predecessor on its cheapest 26-connected path; returns whether the goal was reached.

    Cells are numbered with z fastest. A step along a diagonal needs all cells that it brushes past to be passable.
    """
    nx, ny, nz = cost.shape
    first, last = (start[0] * ny + start[1]) * nz + start[2], (goal[0] * ny + goal[1]) * nz + goal[2]
    so_far = np.full(nx * ny * nz, np.inf)
    done = np.zeros(nx * ny * nz, dtype=np.bool_)
    key, order, cell = np.empty(1024), np.empty(1024, dtype=np.int64), np.empty(1024, dtype=np.int64)
    so_far[first] = 0.0
    push(key, order, cell, 0, 0.0, 0, first)
    size, pushed = 1, 1
    while size > 0:
        pop(key, order, cell, size)
        size -= 1
        at = cell[size]
        if done[at]:
            continue
        done[at] = True
        if at == last:
            return True
        if size + 26 > len(key):
            key, order, cell = doubled(key), doubled(order), doubled(cell)
        x, y, z = at // (ny * nz), at // nz % ny, at % nz
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    x2, y2, z2 = x + dx, y + dy, z + dz
                    if x2 < 0 or y2 < 0 or z2 < 0 or x2 >= nx or y2 >= ny or z2 >= nz:
                        continue
                    brushed = max(
                        max(max(cost[x2, y, z], cost[x, y2, z]), max(cost[x, y, z2], cost[x2, y2, z])),
                        max(max(cost[x2, y, z2], cost[x, y2, z2]), cost[x2, y2, z2]),
                    )
                    if brushed == np.inf:
                        continue
                    to = (x2 * ny + y2) * nz + z2
                    step = np.sqrt(float(dx * dx + dy * dy + dz * dz))
                    total = so_far[at] + step * 0.5 * (cost[x, y, z] + cost[x2, y2, z2])
                    if total < so_far[to]:
                        so_far[to], before[to] = total, at
                        away = np.sqrt(float((goal[0] - x2) ** 2 + (goal[1] - y2) ** 2 + (goal[2] - z2) ** 2))
                        push(key, order, cell, size, total + away, pushed, to)
                        size += 1
                        pushed += 1
    return False
