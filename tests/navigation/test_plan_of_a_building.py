"""The floor plan of a simulated building: every room, the corridor and every door come out, and rooms out of reach are named."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_walls import NOISE

from slamcli.datasets.simulate import Simulation, build
from slamcli.datasets.simulated import building
from slamcli.evaluation.grid_truth import TrueRoom, footprint
from slamcli.geometry import se3
from slamcli.navigation.floor_plan import FloorPlan, make_floor_plan
from slamcli.navigation.reach import reach
from slamcli.schema import Grid

N_ROOMS = 4
CELL, MARGIN = 0.05, 0.5  # [m]
SEEN_UP_TO, STEP = 1.6, 0.04  # [m] of walls, and between their points
BAND = 0.05, 0.5
BEFORE = 0.06  # [m] before a face: what stands there hides it


@cache
def seen(seed: int, turn: float) -> tuple[Grid, np.ndarray, np.ndarray, np.ndarray]:
    """Grid and cloud (xyz, normal) of a building as somebody who was everywhere would have them, and T_gb (3, 3) into their frame."""
    about = build(Simulation(building=True, rooms=N_ROOMS, laps=1.0, frames=2, seed=seed))[0].to_dict()
    low, high = (np.array(about["room"][end], float) for end in ("min", "max"))
    scene = TrueRoom(low, high, about["obstacles"])
    T_gb = se3.exp(np.array([0.3173, -0.221, 0.0, 0.0, 0.0, turn]))
    R = T_gb[:2, :2]
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])]) @ R.T + T_gb[:2, 3]
    origin = np.floor((corners.min(axis=0) - MARGIN) / CELL) * CELL
    columns, rows = np.ceil((corners.max(axis=0) + MARGIN - origin) / CELL).astype(int)
    xy = origin + (np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1) + 0.5) * CELL
    is_filled = scene.occupied((xy - T_gb[:2, 3]) @ R, *BAND)
    beside_floor = np.zeros_like(is_filled)
    for down, right in np.ndindex(3, 3):
        beside_floor |= np.roll(~is_filled, (down - 1, right - 1), axis=(0, 1))
    state = np.where(is_filled, np.where(beside_floor, 1, -1), 0).astype(np.int8)
    grid = Grid(np.where(state < 0, np.nan, state).astype(np.float32), (state >= 0).astype(np.int32), state, origin, np.array(CELL))
    shell = {"type": "box", "centre": 0.5 * (low + high), "size": high - low, "yaw": 0.0}
    faces = [points_of(scene, shell, inwards=True), *(points_of(scene, solid) for solid in scene.solids if solid["type"] == "box")]
    xyz, normal = (np.concatenate(columns) for columns in zip(*faces, strict=True))
    rng = np.random.default_rng(seed)
    xyz[:, :2] += rng.normal(0.0, NOISE, (len(xyz), 1)) * normal[:, :2]
    return grid, se3.transform(T_gb, xyz), normal @ T_gb[:3, :3].T, T_gb


def points_of(scene: TrueRoom, solid: dict, *, inwards: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the upright faces of a box, where nothing stands right before them."""
    centre, half = np.array(solid["centre"]), 0.5 * np.array(solid["size"])
    c, s = np.cos(solid["yaw"]), np.sin(solid["yaw"])
    axes = np.array([[c, s, 0.0], [-s, c, 0.0]])
    z = np.arange(max(centre[2] - half[2], 0.02), min(centre[2] + half[2], SEEN_UP_TO), STEP)
    found = []
    for across, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        along = np.arange(-half[1 - across] + 0.01, half[1 - across], STEP)
        place, height = (grid.ravel() for grid in np.meshgrid(along, z))
        xyz = centre + sign * half[across] * axes[across] + place[:, None] * axes[1 - across]
        xyz[:, 2] = height
        normal = (-sign if inwards else sign) * axes[across]
        before = xyz[:, :2] + BEFORE * normal[:2]
        is_hidden = ((before < scene.low[:2]) | (before > scene.high[:2])).any(axis=1)
        for other in scene.solids:
            bottom = other["centre"][2] - 0.5 * (other["size"][2] if other["type"] == "box" else other["height"])
            top = 2.0 * other["centre"][2] - bottom
            is_hidden |= footprint(other, before, -np.inf, np.inf) & (height >= bottom) & (height <= top)
        found.append((xyz[~is_hidden], np.tile(normal, (np.count_nonzero(~is_hidden), 1))))
    return np.concatenate([xyz for xyz, _ in found]), np.concatenate([normal for _, normal in found])


def plan_of(seed: int, turn: float) -> FloorPlan:
    grid, xyz, normal, _ = seen(seed, turn)
    return make_floor_plan(grid, xyz, normal, wall_height=1.2, door_width=1.2, least_area=1.0)


def true_doors(T_gb: np.ndarray) -> np.ndarray:
    """Middles (N_ROOMS, 2) of the doors."""
    columns = (np.arange(N_ROOMS) // 2) * building.PITCH + building.SIDE / 2
    y = building.SIDE + building.WALL / 2 + (np.arange(N_ROOMS) % 2) * (building.CORRIDOR + building.WALL)
    return se3.transform(T_gb, np.column_stack([columns, y, np.zeros(N_ROOMS)]))[:, :2]


@pytest.mark.parametrize(("seed", "turn"), [(1, 0.0), (1, 0.36), (2, 0.36), (5, 0.0)])
def test_every_room_and_door_of_a_building_comes_out(seed: int, turn: float) -> None:
    plan, doors = plan_of(seed, turn), true_doors(seen(seed, turn)[3])
    middles = [se3.transform(seen(seed, turn)[3], np.array([[x, y, 0.0]]))[0, :2] for x, y in room_middles()]
    numbers = [number_at(plan, middle) for middle in middles]
    assert sorted(numbers) == [1, 2, 3, 4, 5], "four rooms and the corridor, each once"
    areas = [plan.rooms.rooms[number - 1].area for number in numbers]
    assert areas[:N_ROOMS] == pytest.approx([building.SIDE**2] * N_ROOMS, abs=0.8)
    assert areas[N_ROOMS] == pytest.approx(building.CORRIDOR * building.extent(N_ROOMS)[1][0], abs=0.8)
    corridor = numbers[N_ROOMS]
    assert len(plan.rooms.doors) == N_ROOMS
    for number, middle in zip(numbers, doors, strict=False):
        (door,) = (door for door in plan.rooms.doors if set(door.rooms) == {corridor, number})
        assert np.linalg.norm(door.middle - middle) < 0.25
        assert door.width == pytest.approx(building.DOOR, abs=0.12)


def room_middles() -> list[tuple[float, float]]:
    """Middles of the rooms, and of the corridor last."""
    far, y = building.extent(N_ROOMS)[1][0], building.SIDE + building.WALL + building.CORRIDOR / 2
    rooms = [(k // 2 * building.PITCH + building.SIDE / 2, y + (2 * (k % 2) - 1) * (building.CORRIDOR / 2 + building.WALL + building.SIDE / 2))
             for k in range(N_ROOMS)]  # fmt: skip
    return [*rooms, (far / 2, y)]


def number_at(plan: FloorPlan, place: np.ndarray) -> int:
    column, row = np.floor((place - plan.rooms.origin) / CELL).astype(int)
    return int(plan.rooms.label[row, column])


@pytest.mark.parametrize("turn", [0.0, 0.36])
def test_walls_lie_where_they_are_and_none_runs_through_a_room(turn: float) -> None:
    T_gb, plan = seen(1, turn)[3], plan_of(1, turn)
    low, high = building.extent(N_ROOMS)
    x = [low[0], building.SIDE, building.PITCH, high[0]]
    north = building.PITCH + building.CORRIDOR  # face of the corridor's wall
    y = [low[1], building.SIDE, building.PITCH, north, north + building.WALL, high[1]]
    for wall in plan.walls:
        if wall.top < 1.5:
            continue  # tall furniture
        ends = np.array([end - T_gb[:2, 3] for end in (wall.start, wall.end)]) @ T_gb[:2, :2]
        off = min(np.abs(ends[:, axis, None] - lines).max(axis=0).min() for axis, lines in ((0, x), (1, y)))
        assert off < 0.03, f"a wall from {wall.start} to {wall.end} lies where there is none"
        assert wall.length < 1.01 * high.max()


def test_a_room_behind_a_closed_door_is_named() -> None:
    grid, _, _, T_gb = seen(1, 0.0)
    plan, state = plan_of(1, 0.0), grid.state.copy()
    door, number = true_doors(T_gb)[2], number_at(plan_of(1, 0.0), se3.transform(T_gb, np.array([[*room_middles()[2], 0.0]]))[0, :2])
    column, row = np.floor((door - grid.origin) / CELL).astype(int)
    state[row - 3 : row + 4, column - 15 : column + 16] = 1
    start = se3.transform(T_gb, np.array([[*room_middles()[-1], 0.0]]))[0, :2]
    closed = replace(grid, state=state)
    everywhere, left = (reach(one, tuple(start), radius=0.25, allow_unknown=False, walls=plan.walls) for one in (grid, closed))
    assert everywhere.rooms_left_out == []
    (room,) = left.rooms_left_out
    assert np.linalg.norm(room.middle - plan.rooms.rooms[number - 1].middle) < 0.5


def test_rooms_behind_doors_too_narrow_for_a_robot_are_named_though_it_reaches_into_them() -> None:
    grid, _, _, T_gb = seen(1, 0.0)
    start = se3.transform(T_gb, np.array([[*room_middles()[-1], 0.0]]))[0, :2]
    found = reach(grid, tuple(start), radius=building.DOOR / 2 + CELL, allow_unknown=False, walls=plan_of(1, 0.0).walls)
    assert len(found.rooms_left_out) == N_ROOMS
