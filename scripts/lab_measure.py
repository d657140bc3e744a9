"""Lengths and angles measured on a grid, [L] 4.2: straight outlines of walls and furniture, and what lies between them.

An outline is sought within a hand's breadth of where the scene has it, so that the right one is measured; its place and direction then
come from the grid alone: along its length, rows of cells are followed from free to occupied, and a line is fitted to the places where
they change.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from slamcli.evaluation.grid_truth import TrueRoom
from slamcli.geometry import se3
from slamcli.navigation.grid import FREE, OCCUPIED
from slamcli.schema import Grid

SEARCH = 0.12  # [m] to either side
LEAST = 0.4  # [m] of an outline that must be found
STEP = 0.02  # [m] between the rows followed


@dataclass(frozen=True)
class Outline:
    """A straight stretch of a wall's or a box's outline in the scene."""

    name: str
    middle: np.ndarray  # (2,) m
    along: np.ndarray  # (2,) unit
    outwards: np.ndarray  # (2,) unit, into free space
    half: float  # m, half its length


@dataclass(frozen=True)
class Line:
    """What was measured of an outline, in the scene's frame."""

    outline: Outline
    offset: float  # m, of its middle, outwards
    turn: float  # rad, of its direction, counter-clockwise
    found: float  # m, length found


def outlines(scene: TrueRoom, height: float) -> list[Outline]:
    """List the walls and the sides of the boxes that are there at a height [m]."""
    (x0, y0), (x1, y1) = scene.low[:2], scene.high[:2]
    mx, my = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    x, y = np.eye(2)
    found = [
        Outline("west wall", np.array([x0, my]), y, x, 0.5 * (y1 - y0)), Outline("east wall", np.array([x1, my]), y, -x, 0.5 * (y1 - y0)),
        Outline("south wall", np.array([mx, y0]), x, y, 0.5 * (x1 - x0)), Outline("north wall", np.array([mx, y1]), x, -y, 0.5 * (x1 - x0)),
    ]  # fmt: skip
    for solid in scene.solids:
        if solid["type"] != "box" or abs(solid["centre"][2] - height) >= solid["size"][2] / 2:
            continue
        c, s = np.cos(solid["yaw"]), np.sin(solid["yaw"])
        axes, half = np.array([[c, s], [-s, c]]), 0.5 * np.array(solid["size"][:2])
        for k in (0, 1):
            for sign in (-1.0, 1.0):
                middle = np.array(solid["centre"][:2]) + sign * half[k] * axes[k]
                found.append(Outline(solid["name"], middle, axes[1 - k], sign * axes[k], float(half[1 - k])))
    return [outline for outline in found if 2.0 * outline.half >= LEAST]


def measure(grid: Grid, outline: Outline, T_sl: np.ndarray) -> Line | None:
    """Fit a line to an outline; None where less than LEAST of it is in the grid."""
    T_ls = se3.inverse(T_sl)
    along = np.arange(-outline.half + 0.05, outline.half - 0.05, STEP)
    across = np.arange(SEARCH, -SEARCH, -0.25 * float(grid.resolution))  # from free space inwards
    xy = outline.middle + along[:, None, None] * outline.along + across[None, :, None] * outline.outwards
    state = _look_up(grid, xy @ T_ls[:2, :2].T + T_ls[:2, 3])
    is_change = (state[:, 1:] == OCCUPIED) & (state[:, :-1] == FREE)
    has = is_change.any(axis=1)
    if has.sum() * STEP < LEAST:
        return None
    # The outline lies somewhere within the first occupied cell: half a cell behind its edge on average.
    width = np.abs(T_ls[:2, :2] @ outline.outwards).sum() * float(grid.resolution)
    place = across[np.argmax(is_change[has], axis=1)] - 0.125 * float(grid.resolution) - 0.5 * width
    slope, offset = _robust_line(along[has], place)
    side = outline.along[0] * outline.outwards[1] - outline.along[1] * outline.outwards[0]  # 1: outwards lies to the left of along
    return Line(outline, offset, float(np.arctan(slope) * side), float(has.sum() * STEP))


def _look_up(grid: Grid, xy: np.ndarray) -> np.ndarray:
    rows, columns = grid.state.shape
    cell = np.floor((xy - grid.origin) / float(grid.resolution)).astype(np.int64)
    inside = (cell >= 0).all(axis=-1) & (cell[..., 0] < columns) & (cell[..., 1] < rows)
    column, row = np.where(inside, cell[..., 0], 0), np.where(inside, cell[..., 1], 0)
    return np.where(inside, grid.state[row, column], -1)


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Fit y = slope x + offset by least squares, dropping what lies farther off than three times the median deviation."""
    keep = np.abs(y - np.median(y)) <= SEARCH
    slope, offset = 0.0, 0.0
    for _ in range(5):
        slope, offset = np.polyfit(x[keep], y[keep], 1)
        residual = np.abs(y - slope * x - offset)
        keep = residual <= max(3.0 * float(np.median(residual[keep])), 0.01)
    return float(slope), float(offset)


@dataclass(frozen=True)
class Reading:
    """One row of Table 2."""

    name: str
    unit: str
    true: float
    measured: dict[str, float]  # by grid


def table_2(lines: dict[str, dict[int, Line]], faces: list[Outline], *, lengths: int = 4, angles: int = 2) -> list[Reading]:
    """Choose the longest outlines that all grids have and read lengths between opposite ones, angles between those at right angles.

    lines : per grid, by number of the face
    """
    common = sorted(set.intersection(*(set(found) for found in lines.values())))
    sure = {i: min(found[i].found for found in lines.values()) for i in common}
    pairs = sorted(itertools.combinations(common, 2), key=lambda pair: -min(sure[pair[0]], sure[pair[1]]))
    facing = [(i, j) for i, j in pairs if _face_each_other(faces[i], faces[j])]
    square = [(i, j) for i, j in pairs if abs(faces[i].outwards @ faces[j].outwards) < 1e-3]
    readings = [
        Reading(f"{faces[i].name} to {faces[j].name}", "m", float((faces[j].middle - faces[i].middle) @ faces[i].outwards),
                {grid: _length(found[i], found[j]) for grid, found in lines.items()})
        for i, j in _different(facing, lengths)
    ]  # fmt: skip
    return readings + [
        Reading(
            f"{faces[i].name} against {faces[j].name}", "deg", 90.0, {grid: _angle(found[i], found[j]) for grid, found in lines.items()}
        )
        for i, j in _different(square, angles)
    ]


def _different(pairs: list[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Take the first pairs, each with an outline that no earlier one has."""
    taken: list[tuple[int, int]] = []
    used: set[int] = set()
    for pair in pairs:
        if len(taken) < count and not used.issuperset(pair):
            taken.append(pair)
            used.update(pair)
    return taken


def _face_each_other(a: Outline, b: Outline) -> bool:
    """Say whether free space at least a metre wide lies between two parallel outlines."""
    apart = (b.middle - a.middle) @ a.outwards
    beside = abs((b.middle - a.middle) @ a.along)
    return bool(a.outwards @ b.outwards < -0.999 and apart > 1.0 and beside < a.half + b.half - 0.2)


def _length(a: Line, b: Line) -> float:
    return float((b.outline.middle - a.outline.middle) @ a.outline.outwards) - a.offset - b.offset


def _angle(a: Line, b: Line) -> float:
    return 90.0 + float(np.degrees(b.turn - a.turn))
