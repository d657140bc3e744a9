"""What of a map a robot can get to: how much of the floor, which rooms, and what is too narrow for the rest."""

import bisect
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from slamcli.navigation import cost_layers, planner
from slamcli.navigation.rooms import DOOR_WIDTH, LEAST_AREA, Room, find_rooms, reached_share
from slamcli.navigation.walls import Wall
from slamcli.schema import Grid

JAMB = 2.0  # cells beyond half of a gap's width, within which what bounds it lies
WORTH_A_WORD = 0.5  # [m^2] of free floor in one piece that is out of reach


@dataclass(frozen=True)
class Gap:
    """Where the way to other floor is too narrow, at its widest."""

    xy: tuple[float, float]  # [m], level frame
    width: float  # [m]
    is_unseen: bool  # on one side at least by cells that were never seen, so that it may be wider; else between obstacles

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {"xy": np.round(self.xy, 3).tolist(), "width": round(self.width, 3), "beside": "unknown" if self.is_unseen else "occupied"}


@dataclass(frozen=True)
class Reach:
    """The floor within reach of a robot from a place."""

    cells: np.ndarray  # (H, W) bool, that the robot can cover
    reached_area: float  # [m^2] of free floor
    free_area: float  # [m^2]
    rooms: list[tuple[Room, float]]  # rooms with free floor, and the share of it that is within reach
    area_beyond: float  # [m^2] of the largest piece of free floor that is out of reach
    gap: Gap | None  # on the widest way there; None where that piece is small, or no way leads there

    @property
    def rooms_left_out(self) -> list[Room]:
        """List the rooms of which nothing is within reach."""
        return [room for room, share in self.rooms if share == 0.0]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "reachable_m2": round(self.reached_area, 3),
            "free_m2": round(self.free_area, 3),
            "gap": None if self.gap is None else {**self.gap.to_dict(), "beyond_m2": round(self.area_beyond, 3)},
            "rooms": [
                {
                    "room": room.number,
                    "area_m2": round(room.area, 2),
                    "middle": np.round(room.middle, 3).tolist(),
                    "reached": round(share, 3),
                }
                for room, share in self.rooms
            ],
        }


def reach(grid: Grid, start: tuple[float, float], *, radius: float, allow_unknown: bool, walls: list[Wall]) -> Reach:
    """Find what a robot of `radius` [m] can cover from `start` [m, level frame]; SlamError where it does not fit there.

    walls : that rooms end at; without any they end at all obstacles
    """
    centres = cost_layers.reachable(grid, start, radius=radius, allow_unknown=allow_unknown)
    cells = cost_layers.swept(grid, centres, radius=radius)
    is_free, cell_area = grid.state == 0, float(grid.resolution) ** 2
    rooms = find_rooms(grid, walls, door_width=DOOR_WIDTH, least_area=LEAST_AREA)
    # A robot too wide for a door still covers floor beyond it: it is in a room only where its centre is.
    both = zip(*(reached_share(rooms, grid, some) for some in (cells, centres)), strict=True)
    shares = zip(rooms.rooms, (covered if entered > 0.0 else entered for covered, entered in both), strict=True)
    beyond = largest_piece(is_free & ~cells)
    area_beyond = np.count_nonzero(beyond) * cell_area
    is_worth_it = area_beyond >= WORTH_A_WORD
    return Reach(
        cells,
        np.count_nonzero(cells & is_free) * cell_area,
        np.count_nonzero(is_free) * cell_area,
        [(room, share) for room, share in shares if np.isfinite(share)],
        area_beyond,
        widest_gap(grid, start, beyond, radius=radius, allow_unknown=allow_unknown) if is_worth_it else None,
    )


def largest_piece(cells: np.ndarray) -> np.ndarray:
    """Return the largest connected piece of a mask (H, W), itself where it is empty."""
    labels, n = ndimage.label(cells, structure=planner.CROSS)
    return labels == 1 + int(np.argmax(np.bincount(labels.ravel(), minlength=n + 1)[1:])) if n else cells


def widest_gap(grid: Grid, start: tuple[float, float], beyond: np.ndarray, *, radius: float, allow_unknown: bool) -> Gap | None:
    """Find where the widest way from `start` [m, level frame] to the cells `beyond` (H, W) is narrowest; None where there is none at all.

    radius : m, of a robot that does not get there
    """
    distance = np.where(planner.blocked(grid, allow_unknown), -1.0, planner.obstacle_distance(grid, allow_unknown=allow_unknown))
    row, column = (int(i) for i in planner.cells_of(grid, np.array(start)))
    widths = np.unique(distance[(distance >= 0.0) & (distance <= radius)])

    def within(least: float) -> np.ndarray:
        labels, _ = ndimage.label(distance >= least, structure=planner.CROSS)
        return (labels == labels[row, column]) & (labels > 0)

    n_wide_enough = bisect.bisect_left(widths, True, key=lambda least: not (within(least) & beyond).any())
    if n_wide_enough == 0:
        return None
    least, wider = np.append(widths, np.inf)[n_wide_enough - 1 : n_wide_enough + 1]
    goal = tuple(np.argwhere(within(least) & beyond)[0])
    way = planner.cheapest(np.where(distance >= least, 1.0, np.inf), (row, column), goal)
    assert way is not None, "both ends are in one piece"
    # Where the way last leaves what a wider robot gets to: it may pass obstacles as closely before, without need.
    narrow = way[min(np.flatnonzero(within(wider)[tuple(way.T)]).max(initial=0) + 1, len(way) - 1)]
    unseen = np.argwhere(np.pad(grid.state == -1, 1, constant_values=True)) - 1  # what lies outside the grid was not seen either
    side = float(distance[tuple(narrow)]) / float(grid.resolution) + JAMB
    is_unseen = not allow_unknown and bool((np.linalg.norm(unseen - narrow, axis=1) <= side).any())
    xy = (narrow[::-1] + 0.5) * float(grid.resolution) + grid.origin
    return Gap((float(xy[0]), float(xy[1])), 2.0 * float(distance[tuple(narrow)]), is_unseen)
