"""Rooms of a navigation grid: where the way from one wide place to another narrows to a door, one room ends and another begins.

Distance to the nearest wall is flooded from its peaks downwards; two basins that meet where the floor is hardly narrower than in the
smaller of them, or wider than a door, are one room (watershed with merging by depth: S. Beucher, F. Meyer, 1993).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slamcli.navigation.walls import Wall, between_faces
from slamcli.schema import Grid

DOOR_WIDTH = 1.2  # [m] of the widest door, if not told
LEAST_AREA = 1.0  # [m^2] of the smallest room, likewise
NARROWED = 0.85  # of the smaller room's half width: at a door it is narrower
JAMBS = 2.0  # cells by which a door looks wider: at either side, a wall's last point lies short of the edge
OUTLINE = 1.5  # cells that a room's outline may stray from its cells: the steps of a slanted wall
NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))


@dataclass(frozen=True)
class Room:
    """A part of the floor between walls and doors, furniture and all."""

    number: int  # from 1, the largest first
    area: float  # [m^2]
    middle: np.ndarray  # (2,) m, level frame: the place farthest from the walls
    outline: np.ndarray  # (N, 2) m, a closed polygon


@dataclass(frozen=True)
class Door:
    """A passage between two rooms."""

    rooms: tuple[int, int]
    middle: np.ndarray  # (2,) m, level frame
    width: float  # [m]


@dataclass(frozen=True)
class Rooms:
    """The rooms of a grid and the doors between them: a graph."""

    label: np.ndarray  # (H, W) int32, number of the room, 0 = none; cells as of the grid, which walls may reach beyond
    origin: np.ndarray  # (2,) m, level frame: the outer corner of cell (0, 0)
    rooms: list[Room]
    doors: list[Door]


def reached_share(rooms: Rooms, grid: Grid, cells: np.ndarray) -> list[float]:
    """Compute for each room the share of its free floor that `cells` (H, W) of the grid cover; NaN where it has none."""
    column, row = np.rint((np.asarray(grid.origin) - rooms.origin) / float(grid.resolution)).astype(int)
    height, width = grid.state.shape
    label, is_free = rooms.label[row : row + height, column : column + width], np.asarray(grid.state) == 0
    free = [np.count_nonzero(is_free & (label == room.number)) for room in rooms.rooms]
    reached = [np.count_nonzero(is_free & cells & (label == room.number)) for room in rooms.rooms]
    return [a / b if b else float("nan") for a, b in zip(reached, free, strict=True)]


def find_rooms(grid: Grid, walls: list[Wall], *, door_width: float, least_area: float) -> Rooms:
    """Split the floor of a grid into rooms.

    walls : where the grid's own obstacles are furniture too, the walls tell where a room ends; without any, all obstacles do
    door_width : m, of the widest door; least_area : m^2, smaller rooms belong to the one that they have the widest door to
    """
    cell = float(grid.resolution)
    grid = _reaching(grid, walls)
    is_wall = _drawn(grid, walls)
    inside = _inside(grid, is_wall)
    distance = cv2.distanceTransform(np.pad(inside, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] * cell
    label = _flooded(distance, door_width=door_width + JAMBS * cell)
    label = _without_small(label, least_area / cell**2)
    rooms = [_room(grid, label == number, is_wall, distance, number) for number in range(1, int(label.max(initial=0)) + 1)]
    return Rooms(label, np.asarray(grid.origin), rooms, _doors(grid, label, distance))


def _reaching(grid: Grid, walls: list[Wall]) -> Grid:
    """Return the grid with so many unknown cells around it that all walls lie in it."""
    cell, state = float(grid.resolution), np.asarray(grid.state)
    ends = np.array([end for wall in walls for end in (wall.start, wall.end)]).reshape(-1, 2)
    places = np.floor((ends - grid.origin) / cell).astype(np.int64)
    before = np.maximum(1 - places.min(axis=0, initial=1), 0)
    after = np.maximum(places.max(axis=0, initial=0) + 2 - np.array(state.shape[::-1]), 0)
    padding = ((before[1], after[1]), (before[0], after[0]))
    columns = {"state": (state, -1), "p_occupied": (grid.p_occupied, np.nan), "n_seen": (grid.n_seen, 0)}
    padded = {name: np.pad(column, padding, constant_values=value) for name, (column, value) in columns.items()}
    return replace(grid, origin=np.asarray(grid.origin) - before * cell, **padded)


def _drawn(grid: Grid, walls: list[Wall]) -> np.ndarray:
    """Say which cells (H, W) walls run through, or lie between the two faces of one."""
    is_wall = np.zeros(grid.state.shape, dtype=np.uint8)

    def cells(*places: np.ndarray) -> np.ndarray:
        return np.rint((np.stack(places) - grid.origin) / float(grid.resolution) - 0.5).astype(np.int32)

    for k, wall in enumerate(walls):
        start, end = cells(wall.start, wall.end).tolist()
        cv2.line(is_wall, start, end, 1, 1, cv2.LINE_4)  # without a gap at which cells on both sides touch by their corners
        for other in walls[:k]:
            if (body := between_faces(wall, other)) is not None:
                cv2.fillConvexPoly(is_wall, cells(*body), 1)
    return is_wall > 0


def _inside(grid: Grid, is_wall: np.ndarray) -> np.ndarray:
    """Say which cells (H, W) are floor, or furniture on it: all that is known or enclosed by it, and is no wall."""
    from scipy import ndimage

    state = np.asarray(grid.state)
    if not is_wall.any():
        return state == 0
    enclosed = ndimage.binary_fill_holes((state >= 0) | is_wall) & ~is_wall
    # Beyond the walls only what was seen through them or past them is known: it is no room unless there is free floor.
    pieces, _ = ndimage.label(enclosed)
    has_floor = np.unique(pieces[(state == 0) & enclosed])
    return np.isin(pieces, has_floor[has_floor > 0])


def _flooded(distance: np.ndarray, *, door_width: float) -> np.ndarray:
    """Label the basins (H, W) of the distance to the walls [m], 0 where it is 0."""
    label = np.zeros(distance.shape, dtype=np.int32)
    parent, peak = [0], [0.0]

    def root(number: int) -> int:
        while parent[number] != number:
            parent[number] = parent[parent[number]]
            number = parent[number]
        return number

    flat = distance.ravel()
    rows, columns = distance.shape
    for k in np.argsort(-flat, kind="stable").tolist():
        depth = float(flat[k])
        if depth <= 0.0:
            break
        row, column = divmod(k, columns)
        around = [(row + down, column + right) for down, right in NEIGHBOURS]
        around = [(r, c) for r, c in around if 0 <= r < rows and 0 <= c < columns and label[r, c]]
        if not around:
            parent.append(len(parent))
            peak.append(depth)
            label[row, column] = len(parent) - 1
            continue
        label[row, column] = label[max(around, key=lambda place: distance[place])]
        meeting = sorted({root(int(label[place])) for place in around}, key=lambda number: -peak[number])
        for lower in meeting[1:]:
            if 2.0 * depth > door_width or depth > NARROWED * peak[lower]:
                parent[lower] = meeting[0]
    roots = np.array([root(number) for number in range(len(parent))])
    return roots[label].astype(np.int32)


def _without_small(label: np.ndarray, least: float) -> np.ndarray:
    """Give rooms of fewer than `least` cells to the neighbour that they share the longest border with; number all, the largest first."""
    while True:
        numbers, size = np.unique(label[label > 0], return_counts=True)
        if len(numbers) == 0 or size.min() >= least:
            break
        small = numbers[np.argmin(size)]
        beside = label[(cv2.dilate((label == small).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (label != small)]
        beside = beside[beside > 0]
        label = np.where(label == small, np.bincount(beside).argmax() if len(beside) else 0, label)
    order = np.zeros(int(label.max(initial=0)) + 1, dtype=np.int32)
    order[numbers[np.argsort(-size, kind="stable")]] = np.arange(1, len(numbers) + 1)
    return order[label]


def _room(grid: Grid, is_here: np.ndarray, is_wall: np.ndarray, distance: np.ndarray, number: int) -> Room:
    cell = float(grid.resolution)
    row, column = divmod(int(np.argmax(np.where(is_here, distance, -1.0))), distance.shape[1])
    # A wall's line runs through the middle of its cells: half of them is floor on this side.
    n_beside = np.count_nonzero((cv2.dilate(is_here.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & is_wall)
    # Contours run through the middles of the outermost cells of a mask; of one twice as fine they run nearly along their edges.
    fine = cv2.resize(is_here.astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outline = cv2.approxPolyDP(max(contours, key=cv2.contourArea), 2.0 * OUTLINE, True)[:, 0]
    return Room(
        number,
        (np.count_nonzero(is_here) + n_beside / 2) * cell**2,
        grid.origin + (np.array([column, row]) + 0.5) * cell,
        grid.origin + (outline + 0.5) / 2.0 * cell,
    )


def _doors(grid: Grid, label: np.ndarray, distance: np.ndarray) -> list[Door]:
    """Find the passages between rooms: connected pieces of the borders between their cells."""
    from scipy import ndimage

    cell, doors = float(grid.resolution), []
    touching = [(a[is_border], b[is_border]) for a, b, is_border in _borders(label)]
    pairs = sorted({(min(p, q), max(p, q)) for a, b in touching for p, q in zip(a.tolist(), b.tolist(), strict=True)})
    for a, b in pairs:
        near_b = cv2.dilate((label == b).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        pieces, n = ndimage.label((label == a) & near_b, structure=np.ones((3, 3)))
        for piece in range(1, n + 1):
            rows, columns = np.nonzero(pieces == piece)
            middle = grid.origin + (np.array([columns.mean(), rows.mean()]) + 0.5) * cell
            doors.append(Door((a, b), middle, 2.0 * float(distance[rows, columns].max())))
    return doors


def _borders(label: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the labels on both sides of all edges between cells, and whether two rooms meet there."""
    sides = [(label[:, :-1], label[:, 1:]), (label[:-1], label[1:])]
    return [(a, b, (a != b) & (a > 0) & (b > 0)) for a, b in sides]
