"""A floor plan: walls as straight lines, rooms with their areas, and the doors between them."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from slamcli.navigation.rooms import Rooms, find_rooms
from slamcli.navigation.walls import Wall, find_walls, joined_behind_furniture
from slamcli.schema import Grid


@dataclass(frozen=True)
class FloorPlan:
    """What a floor plan shows, in the level frame."""

    walls: list[Wall]
    rooms: Rooms

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: lengths in metres to the millimetre, areas in square metres."""
        return {
            "frame": "level: x, y [m]",
            "walls": [
                {"from": _rounded(wall.start), "to": _rounded(wall.end), "length_m": round(wall.length, 3), "height_m": round(wall.top, 2)}
                for wall in self.walls
            ],
            "rooms": [
                {"room": room.number, "area_m2": round(room.area, 2), "middle": _rounded(room.middle), "outline": _rounded(room.outline)}
                for room in self.rooms.rooms
            ],
            "doors": [
                {"rooms": list(door.rooms), "middle": _rounded(door.middle), "width_m": round(door.width, 2)} for door in self.rooms.doors
            ],
        }


def make_floor_plan(
    grid: Grid, xyz: np.ndarray, normal: np.ndarray, *, wall_height: float, door_width: float, least_area: float
) -> FloorPlan:
    """Draw the floor plan of a grid and the cloud of the same run.

    xyz, normal : (N, 3) of the cloud [m], level frame; wall_height : m that walls reach up to at least
    door_width : m, of the widest door; least_area : m^2, of the smallest room
    """
    walls = walls_of(grid, xyz, normal, wall_height=wall_height)
    return FloorPlan(walls, find_rooms(grid, walls, door_width=door_width, least_area=least_area))


def walls_of(grid: Grid, xyz: np.ndarray, normal: np.ndarray, *, wall_height: float) -> list[Wall]:
    """Find the walls in a cloud, joined where the grid shows no free floor between their pieces; arguments as of `make_floor_plan`."""
    return joined_behind_furniture(find_walls(xyz, normal, least_height=wall_height), partial(_is_free, grid))


def _is_free(grid: Grid, places: np.ndarray) -> np.ndarray:
    column, row = np.floor((places - grid.origin) / float(grid.resolution)).astype(np.int64).T
    height, width = grid.state.shape
    is_in = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return is_in & (grid.state[row.clip(0, height - 1), column.clip(0, width - 1)] == 0)


def _rounded(values: np.ndarray) -> Any:
    return (np.round(values, 3) + 0.0).tolist()
