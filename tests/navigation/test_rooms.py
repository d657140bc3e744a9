"""Rooms of a grid: where they part, how large they are, and what joins them."""

import numpy as np
import pytest

from slamcli.navigation.reach import reach
from slamcli.navigation.rooms import Rooms, find_rooms
from slamcli.navigation.walls import Wall
from slamcli.schema import Grid

CELL = 0.05


def grid_of(state: np.ndarray, origin=(-1.0, -2.0)) -> Grid:
    state = state.astype(np.int8)
    return Grid(
        np.where(state < 0, np.nan, state).astype(np.float32), (state >= 0).astype(np.int32), state, np.array(origin), np.array(CELL)
    )


def flat(*, door: int = 18) -> np.ndarray:
    """Three rooms: two side by side, a long one beside both; walls two cells thick, doors of so many cells between each two."""
    state = np.ones((160, 240), np.int8)
    state[10:80, 10:110] = state[10:80, 112:230] = state[82:150, 10:230] = 0
    state[40 : 40 + door, 110:112] = state[80:82, 50 : 50 + door] = state[80:82, 170 : 170 + door] = 0
    return state


def found(state: np.ndarray, walls=(), *, door_width: float = 1.2, least_area: float = 1.0) -> Rooms:
    return find_rooms(grid_of(state), list(walls), door_width=door_width, least_area=least_area)


def around(low, high) -> list[Wall]:
    """The four walls of a rectangle, seen from inside."""
    (x0, y0), (x1, y1) = low, high
    corners = [np.array(c, float) for c in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    normals = [np.array(n, float) for n in ((0, 1), (-1, 0), (0, -1), (1, 0))]
    return [Wall(corners[k], corners[(k + 1) % 4], normals[k], 2.0) for k in range(4)]


def test_rooms_part_at_doors_and_areas_are_right() -> None:
    rooms = found(flat())
    assert [room.area for room in rooms.rooms] == pytest.approx([68 * 220 * CELL**2, 70 * 118 * CELL**2, 70 * 100 * CELL**2], rel=0.01)
    assert sorted(door.rooms for door in rooms.doors) == [(1, 2), (1, 3), (2, 3)]
    for door, middle in zip(sorted(rooms.doors, key=lambda d: d.rooms), ((7.95, 2.05), (1.95, 2.05), (4.55, 0.45)), strict=True):
        assert door.width == pytest.approx(0.9, abs=0.11)
        assert np.abs(door.middle - middle).max() < 0.1
    for room in rooms.rooms:
        row, column = np.floor((room.middle - rooms.origin) / CELL).astype(int)[::-1]
        assert rooms.label[row, column] == room.number
        assert np.abs(room.outline.max(axis=0) - room.outline.min(axis=0)).min() > 3.0


def test_the_same_rooms_however_the_grid_lies() -> None:
    upright, turned = found(flat()), found(np.rot90(flat()).copy())
    assert [room.area for room in turned.rooms] == pytest.approx([room.area for room in upright.rooms], rel=0.01)
    assert sorted(door.rooms for door in turned.doors) == sorted(door.rooms for door in upright.doors)


def test_a_wide_opening_joins_two_rooms() -> None:
    assert len(found(flat(door=50)).rooms) < 3
    assert len(found(flat(door=22), door_width=0.6).rooms) == 1, "openings wider than a door part nothing"


def test_furniture_neither_parts_a_room_nor_takes_from_its_area() -> None:
    state = np.full((120, 160), -1, np.int8)
    state[10:110, 10:150] = 0
    state[10:70, 74:86] = 1  # a sideboard that leaves a passage of 2 m, and behind it
    state[88:110, 74:86] = 1  # another that leaves 0.9 m
    walls = around((-0.5, -1.5), (6.5, 3.5))
    with_walls, without = found(state, walls), found(state)
    assert [room.area for room in with_walls.rooms] == pytest.approx([35.0], rel=0.01)
    assert len(without.rooms) == 2, "without walls all obstacles end a room"


def test_walls_beyond_what_the_grid_knows_enclose_the_room() -> None:
    state = np.full((60, 60), -1, np.int8)
    state[20:40, 20:40] = 0
    rooms = found(state, around((-2.0, -3.0), (3.0, 2.0)))
    assert [room.area for room in rooms.rooms] == pytest.approx([25.0], rel=0.02)
    assert (rooms.origin < [-2.0, -3.0]).all()


def test_a_closet_belongs_to_the_room_it_opens_to() -> None:
    state = flat()
    state[20:34, 112:126] = 1
    state[21:33, 113:125] = 0
    state[26:30, 125:126] = 0  # 0.36 m2 behind a slit
    assert len(found(state).rooms) == 3
    assert len(found(state, least_area=0.2).rooms) == 4


def test_a_grid_without_floor_has_no_rooms() -> None:
    rooms = found(np.full((20, 30), -1, np.int8))
    assert rooms.rooms == [] and rooms.doors == [] and not rooms.label.any()


def test_rooms_that_a_robot_cannot_get_to_are_named() -> None:
    grid = grid_of(flat(door=10))  # 0.5 m
    thin, wide = (reach(grid, (2.0, 0.0), radius=radius, allow_unknown=False, walls=[]) for radius in (0.2, 0.4))
    assert [share for _, share in thin.rooms] == pytest.approx([1.0] * 3, abs=0.02) and thin.rooms_left_out == []
    assert [room.number for room in wide.rooms_left_out] == [1, 2]
    assert wide.reached_area == pytest.approx(70 * 100 * CELL**2, rel=0.03) and wide.free_area == thin.free_area
    assert [told["reached"] for told in wide.to_dict()["rooms"]] == pytest.approx([0.0, 0.0, 1.0], abs=0.03)
