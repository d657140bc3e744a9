"""What of a map a robot can get to: how much of the floor, and which rooms."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from slamcli.navigation import cost_layers
from slamcli.navigation.rooms import DOOR_WIDTH, LEAST_AREA, Room, find_rooms, reached_share
from slamcli.navigation.walls import Wall
from slamcli.schema import Grid


@dataclass(frozen=True)
class Reach:
    """The floor within reach of a robot from a place."""

    cells: np.ndarray  # (H, W) bool, that the robot can cover
    reached_area: float  # [m^2] of free floor
    free_area: float  # [m^2]
    rooms: list[tuple[Room, float]]  # rooms with free floor, and the share of it that is within reach

    @property
    def rooms_left_out(self) -> list[Room]:
        """List the rooms of which nothing is within reach."""
        return [room for room, share in self.rooms if share == 0.0]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "reachable_m2": round(self.reached_area, 3),
            "free_m2": round(self.free_area, 3),
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
    return Reach(
        cells,
        np.count_nonzero(cells & is_free) * cell_area,
        np.count_nonzero(is_free) * cell_area,
        [(room, share) for room, share in shares if np.isfinite(share)],
    )
