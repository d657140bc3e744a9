"""A building: rooms of different furniture on both sides of a corridor whose doors and walls look alike, and a drive through all of them."""

from dataclasses import replace

import numpy as np

from slamcli.datasets.simulated import picture as p
from slamcli.datasets.simulated import room
from slamcli.datasets.simulated import texture as t
from slamcli.datasets.simulated.brush import Painter, pick
from slamcli.datasets.simulated.drive import evened, smoothed
from slamcli.datasets.simulated.scene import Scene, Solid, box, room_shell

MOST_ROOMS = 40
SIDE = 4.0  # [m] of a room, square
WALL = 0.12  # [m] thickness of a wall between rooms
CORRIDOR = 2.0  # [m] its width
DOOR, DOOR_HEIGHT = 1.1, 2.1  # [m] of an opening
PITCH = SIDE + WALL  # [m] from room to room
TURN_RADIUS = 0.7  # [m] of the round within a room
LANE = 0.15  # [m] from the middle of a door, of the ways in and out
APPROACH = 0.5  # [m] before the middle of a door, where the way leaves its lane
U_TURN, END = 0.4, 0.9  # [m] radius of the turn at either end of the corridor, and its middle's distance from the wall
ROUNDED = 0.15  # [m] over which the corners of the way are rounded
THRESHOLD = 0.9  # [m] inside a door that no furniture stands on
WALL_TOP = room.HEIGHT


def extent(n_rooms: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (3,) [m] of a building with so many rooms."""
    columns = (n_rooms + 1) // 2
    return np.zeros(3), np.array([columns * PITCH - WALL, 2 * (SIDE + WALL) + CORRIDOR, WALL_TOP])


def _room(k: int) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the corners (2,) [m] of room k, and whether it lies north of the corridor."""
    is_north = k % 2 == 1
    low = np.array([(k // 2) * PITCH, SIDE + 2 * WALL + CORRIDOR if is_north else 0.0])
    return low, low + SIDE, is_north


def way(n_rooms: int) -> np.ndarray:
    """Return the closed way (DENSE, 2) [m] along the corridor, into every room and round in it, and back to where it began."""
    middle, far = SIDE + WALL + CORRIDOR / 2, extent(n_rooms)[1][0]
    out = middle - U_TURN
    corners = [np.array([END, out])]
    for k in range(n_rooms):
        low, _, is_north = _room(k)
        sign = 1.0 if is_north else -1.0
        centre, door_y = low + SIDE / 2, middle + sign * (CORRIDOR / 2 + WALL / 2)
        angle = np.radians(np.linspace(-110.0, -430.0, 33))  # clockwise, beginning and ending beside the door
        around = centre + TURN_RADIUS * np.column_stack([np.cos(angle), sign * np.sin(angle)])
        corners += [np.array([centre[0] - APPROACH, out]), np.array([centre[0] - LANE, door_y]), *around]
        corners += [np.array([centre[0] + LANE, door_y]), np.array([centre[0] + APPROACH, out])]
    for x, first in ((far - END, -90.0), (END, 90.0)):
        angle = np.radians(np.linspace(first, first + 180.0, 9))
        corners += list(np.array([x, middle]) + U_TURN * np.column_stack([np.cos(angle), np.sin(angle)]))
    legs = np.array(corners)
    length = np.linalg.norm(np.diff(legs, axis=0, append=legs[:1]), axis=1).sum()
    return evened(smoothed(evened(legs), ROUNDED / length))


def house(n_rooms: int, path: np.ndarray, *, seed: int) -> Scene:
    """Build and furnish a building so that the way through it stays clear.

    path : (N, 2) [m], of `way`
    """
    rng = np.random.default_rng([seed, 4])
    low, high = extent(n_rooms)
    solids: list[Solid] = []
    for k in range(n_rooms):
        solids += _walls_of(k, n_rooms, rng) + _furniture_of(k, path, seed)
    outer: dict[str, Painter] = {}
    for name, length in (("south", high[0]), ("north", high[0]), ("west", high[1]), ("east", high[1])):
        outer[name] = p.wall(t.plaster(pick(rng, room.WALL_COLOURS)), room.wall_items(float(length), WALL_TOP, rng, []))
    lamps = np.array([*((*(_room(k)[0] + SIDE / 2), WALL_TOP) for k in range(n_rooms)), *_corridor_lamps(n_rooms)])
    ceiling = p.ceiling(tuple((float(x), float(y)) for x, y, _ in lamps))
    return Scene(low, high, solids, room_shell(low, high, outer, t.tiles((206, 198, 184), 0.25), ceiling), lamps, seed)


def _corridor_lamps(n_rooms: int) -> list[tuple[float, float, float]]:
    return [((column + 0.5) * PITCH, SIDE + WALL + CORRIDOR / 2, WALL_TOP) for column in range((n_rooms + 1) // 2)]


def _walls_of(k: int, n_rooms: int, rng: np.random.Generator) -> list[Solid]:
    """Build the wall between room k and the corridor, with its door, and the wall to the next room on its side."""
    low, high, is_north = _room(k)
    y = (low[1] if is_north else high[1] + WALL) - WALL / 2
    to_room, to_corridor = ("back", "front") if is_north else ("front", "back")
    plaster = t.plaster(pick(rng, room.WALL_COLOURS))
    side = (SIDE - DOOR) / 2
    solids = []
    for part, x, width, bottom, things in (
        ("left", low[0] + side / 2, side, 0.0, ((0.3, 0.6, 0.5, 0.7, p.notice), (0.35, 1.5, 0.4, 0.4, p.mosaic))),
        ("right", high[0] - side / 2, side, 0.0, ((0.25, WALL_TOP - 2.1, 0.95, 2.1, p.door((150, 110, 80), "OFFICE")),)),
        ("above", low[0] + SIDE / 2, DOOR, DOOR_HEIGHT, ()),
    ):
        shown = room.wall_items(width, WALL_TOP - bottom, rng, []) if bottom == 0.0 else ()
        painters = {"": t.flat((226, 222, 214)), to_room: p.wall(plaster, shown), to_corridor: p.wall(t.plaster((232, 230, 222)), things)}
        wall = box(f"wall_{k}_{part}", (x, y, bottom), (width, WALL, WALL_TOP - bottom), painters)
        solids.append(replace(wall, shared={to_corridor: f"corridor_{part}"}))
    if k + 2 < n_rooms:
        painters = {"": t.flat((226, 222, 214))}
        for name in ("left", "right"):
            painters[name] = p.wall(t.plaster(pick(rng, room.WALL_COLOURS)), room.wall_items(SIDE, WALL_TOP, rng, []))
        solids.append(box(f"wall_{k}_next", (high[0] + WALL / 2, low[1] + SIDE / 2, 0.0), (WALL, SIDE, WALL_TOP), painters))
    return solids


def _furniture_of(k: int, path: np.ndarray, seed: int) -> list[Solid]:
    """Furnish room k along its walls."""
    low, high, is_north = _room(k)
    rng = np.random.default_rng([seed, 5, k])
    here = path[((path > low - 0.5) & (path < high + 0.5)).all(axis=1)]
    free = room.FreeSpace(np.append(low, 0.0), np.append(high, WALL_TOP), np.column_stack([here, np.zeros(len(here))]))
    middle = low[0] + SIDE / 2
    door = np.array([low[1], low[1] + THRESHOLD] if is_north else [high[1] - THRESHOLD, high[1]])
    free.take((np.array([middle - DOOR / 2, door[0]]), np.array([middle + DOOR / 2, door[1]])))
    solids: list[Solid] = []
    room.along_walls(solids, free, rng)
    return [replace(solid, name=f"room{k}_{solid.name}") for solid in solids]
