"""Walls of a floor plan: straight lines in the vertical surfaces of a cloud, seen from above and joined at their corners.

Every point votes with its own normal for the line that it would lie on (a Hough transform of oriented points: R. Duda, P. Hart,
CACM 1972, doi:10.1145/361237.361242); the lines with the most votes are fitted to their points and cut where the wall is interrupted.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

LEAST_HEIGHT = 1.2  # [m] that walls reach up to, if not told
UPRIGHT = 0.25  # |z| of the normal of a point on a wall, at most
CELL = 0.05  # [m] one point stands for all in a cube of this side: walls seen often shall not outvote others
N_ANGLES = 360  # of the votes, over the full turn: a wall has two faces
DISTANCE = 0.02  # [m] step of the votes
LEAST_VOTES = 160  # of points on one line: 0.4 m2 of wall
# Points that a line is fitted to: within so many metres of it, and of normals with so large a cosine, again with the line found.
FITS = ((0.06, 0.9), (0.04, 0.95), (0.03, 0.97), (0.03, 0.97))
CLAIMED, CLAIMED_COSINE = 0.08, 0.8  # [m] points beside a line that are noise of the same wall, and vote for no other
GAP = 0.5  # [m] an interruption from which on it is two walls
LEAST_LENGTH = 0.6  # [m]
LEAST_FILL = 0.5  # share of a wall's area, from its lowest to its highest point, that shows points
FILL_CELL = 0.1  # [m] of that area's raster
ONE_LINE, ONE_LINE_COSINE = 0.06, 0.9986  # [m] apart, and cosine of the turn, of two pieces of one wall at most
THICKEST = 0.4  # [m] of a wall whose two faces were seen
SAMPLED = 0.025  # [m] step in which the gap between them is looked at
CORNER = 0.5  # [m] from the ends of two walls to where their lines meet, at most, for a corner
HIDDEN_CORNER = 2.5  # [m] likewise, where no free floor was seen on the way: furniture hides the ends
OVERSHOOT = 0.2  # [m] beyond a corner that points of something else may draw the end of a wall; a wall seen farther beyond it goes on there
CORNER_SINE = 0.5  # of the angle between them


@dataclass(frozen=True)
class Wall:
    """A straight piece of wall, seen from above."""

    start: np.ndarray  # (2,) m, level frame
    end: np.ndarray  # (2,)
    normal: np.ndarray  # (2,) unit, towards the room that it was seen from
    top: float  # [m] of the highest points

    @property
    def length(self) -> float:
        """Return its length [m]."""
        return float(np.linalg.norm(self.end - self.start))


def find_walls(xyz: np.ndarray, normal: np.ndarray, *, least_height: float) -> list[Wall]:
    """Find the walls in a cloud, the one with the most points first.

    xyz : (N, 3) [m], level frame; normal : (N, 3) unit, towards the camera
    least_height : [m] that a wall's points reach up to, at least: furniture is lower
    """
    is_upright = np.abs(normal[:, 2]) < UPRIGHT
    points, normals = _thinned(xyz[is_upright].astype(np.float64), normal[is_upright].astype(np.float64))
    xy, facing = points[:, :2], normals[:, :2] / np.linalg.norm(normals[:, :2], axis=1, keepdims=True)
    votes, is_left, walls = _Votes(xy, facing), np.ones(len(points), dtype=bool), []
    while (line := votes.best(is_left)) is not None:
        n, rho, on = _fit(xy, facing, np.flatnonzero(is_left), *line)
        claimed = (np.abs(xy @ n - rho) < CLAIMED) & (facing @ n > CLAIMED_COSINE)
        claimed[on] = True
        claimed[votes.voters] = True  # so that the search ends, whatever the fit did
        is_left &= ~claimed
        if len(on):
            walls += _cut(points[on], n, rho, least_height)
    return _joined(walls)


def _thinned(xyz: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the first point of each small cube."""
    _, first = np.unique(np.floor(xyz / CELL).astype(np.int64), axis=0, return_index=True)
    return xyz[first], normal[first]


class _Votes:
    """The votes of oriented points for lines n . xy = rho."""

    def __init__(self, xy: np.ndarray, facing: np.ndarray) -> None:
        self._angle = np.round(np.arctan2(facing[:, 1], facing[:, 0]) * (N_ANGLES / (2 * np.pi))).astype(np.int64) % N_ANGLES
        turn = 2 * np.pi / N_ANGLES * self._angle
        distance = np.round((xy[:, 0] * np.cos(turn) + xy[:, 1] * np.sin(turn)) / DISTANCE).astype(np.int64)
        self._least = int(distance.min(initial=0)) - 1
        self._n_distances = int(distance.max(initial=0)) - self._least + 2
        self._bin = self._angle * self._n_distances + distance - self._least
        self.voters = np.empty(0, dtype=np.int64)  # points behind the last answer

    def best(self, is_left: np.ndarray) -> tuple[np.ndarray, float] | None:
        """Return the line (n, rho) with the most votes of points that are left; None where there are too few."""
        count = np.bincount(self._bin[is_left], minlength=N_ANGLES * self._n_distances).reshape(N_ANGLES, -1)
        around = count + np.roll(count, 1, axis=0) + np.roll(count, -1, axis=0)
        around[:, 1:-1] = around[:, 1:-1] + around[:, :-2] + around[:, 2:]
        # Of neighbours that all count the same votes, the one that most of them are for: beside it, a line would miss them far from the origin.
        angle, distance = divmod(int(np.argmax(around * (count.max() + 1) + count)), self._n_distances)
        if around[angle, distance] < LEAST_VOTES:
            return None
        apart = (self._angle - angle + 1) % N_ANGLES
        is_near = np.abs(self._bin - self._angle * self._n_distances - distance) <= 1
        self.voters = np.flatnonzero(is_left & (apart <= 2) & is_near)
        turn = 2 * np.pi / N_ANGLES * angle
        return np.array([np.cos(turn), np.sin(turn)]), (distance + self._least) * DISTANCE


def _fit(xy: np.ndarray, facing: np.ndarray, left: np.ndarray, n: np.ndarray, rho: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Fit a line to the points near it; returns its normal, its distance from the origin, and its points: none where too few lie on one line."""
    on = left[:0]
    for width, cosine in FITS:
        is_on = (np.abs(xy[left] @ n - rho) < width) & (facing[left] @ n > cosine)
        if np.count_nonzero(is_on) < LEAST_VOTES // 2:
            break
        on = left[is_on]
        middle = xy[on].mean(axis=0)
        across = np.linalg.eigh(np.cov((xy[on] - middle).T))[1][:, 0]
        n = across if across @ n > 0 else -across
        rho = float(n @ middle)
    return n, rho, on


def _cut(points: np.ndarray, n: np.ndarray, rho: float, least_height: float) -> list[Wall]:
    """Cut the points (N, 3) of a line where the wall is interrupted; pieces that are too short, too low or full of holes are left out."""
    along = np.array([-n[1], n[0]])
    s = points[:, :2] @ along
    order = np.argsort(s, kind="stable")
    pieces = np.split(order, np.flatnonzero(np.diff(s[order]) > GAP) + 1)
    walls = []
    for piece in pieces:
        first, last, z = s[piece[0]], s[piece[-1]], points[piece, 2]
        low, top = np.percentile(z, [2.0, 98.0])
        if last - first < LEAST_LENGTH or top < least_height:
            continue
        cells = np.unique(np.floor(np.column_stack([s[piece] - first, z - low]) / FILL_CELL), axis=0)
        if len(cells) * FILL_CELL**2 >= LEAST_FILL * (last - first) * (top - low):
            walls.append(Wall(rho * n + first * along, rho * n + last * along, n, float(top)))
    return walls


def joined_behind_furniture(walls: list[Wall], is_free: Callable[[np.ndarray], np.ndarray]) -> list[Wall]:
    """Join pieces of one wall between which no free floor was seen: furniture stands there, no door.

    is_free : says which of places (N, 2) [m] are known to be free floor
    """
    left, done = sorted(walls, key=lambda wall: -wall.length), []
    while left:
        wall = left.pop(0)
        while (other := next((one for one in left if _go_on(wall, one) and not _is_open(wall, one, is_free)), None)) is not None:
            left = [one for one in left if one is not other]
            along = np.array([-wall.normal[1], wall.normal[0]])
            ends = sorted((wall.start, wall.end, other.start, other.end), key=lambda end: float(end @ along))
            wall = replace(wall, start=ends[0], end=ends[-1], top=max(wall.top, other.top))
        done.append(wall)
    return _joined(done, is_free)


def _go_on(a: Wall, b: Wall) -> bool:
    """Say whether two walls lie on one line, with the same side seen."""
    off = np.abs([(end - a.start) @ a.normal for end in (b.start, b.end)])
    return bool(a.normal @ b.normal > ONE_LINE_COSINE and off.max() < ONE_LINE)


def _is_open(a: Wall, b: Wall, is_free: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Say whether free floor was seen on the line between two pieces of wall, as wide as a door."""
    pairs = [(p, q) for p in (a.start, a.end) for q in (b.start, b.end)]
    return _has_door(*min(pairs, key=lambda pair: float(np.linalg.norm(pair[1] - pair[0]))), is_free)


def _has_door(start: np.ndarray, end: np.ndarray, is_free: Callable[[np.ndarray], np.ndarray]) -> bool:
    n = int(np.ceil(np.linalg.norm(end - start) / SAMPLED)) + 1
    free = is_free(start + np.linspace(0.0, 1.0, n)[:, None] * (end - start))
    runs = np.diff(np.flatnonzero(np.concatenate([[True], ~free, [True]])))
    return bool((runs.max(initial=1) - 1) * SAMPLED >= GAP)


def _joined(walls: list[Wall], is_free: Callable[[np.ndarray], np.ndarray] | None = None) -> list[Wall]:
    """Move the ends of walls to the corners where two of them meet; with `is_free`, also to those that furniture hides."""
    ends = [[wall.start, wall.end] for wall in walls]
    for k, wall in enumerate(walls):
        for e, end in enumerate((wall.start, wall.end)):
            corners = [corner for other in walls if other is not wall and (corner := _corner(wall, other, is_free)) is not None]
            other_end, reach = wall.end if e == 0 else wall.start, CORNER if is_free is None else HIDDEN_CORNER
            outwards = (end - other_end) / max(float(np.linalg.norm(end - other_end)), SAMPLED)
            near = [corner for corner in corners if -OVERSHOOT < (corner - end) @ outwards < reach]
            if near:
                ends[k][e] = min(near, key=lambda corner: float(np.linalg.norm(corner - end)))
    return [replace(wall, start=start, end=end) for wall, (start, end) in zip(walls, ends, strict=True)]


def _corner(a: Wall, b: Wall, is_free: Callable[[np.ndarray], np.ndarray] | None) -> np.ndarray | None:
    """Find where the lines of two walls meet; None where they hardly do, far beyond an end of either, or beyond free floor."""
    normals = np.stack([a.normal, b.normal])
    if abs(np.linalg.det(normals)) < CORNER_SINE:
        return None
    corner = np.linalg.solve(normals, np.array([a.normal @ a.start, b.normal @ b.start]))
    for wall in (a, b):
        s = float((corner - wall.start) @ (wall.end - wall.start)) / wall.length
        end, apart = (wall.start, -s) if s < 0.5 * wall.length else (wall.end, s - wall.length)  # negative: where another wall meets it
        if apart >= CORNER and (is_free is None or apart >= HIDDEN_CORNER or _has_door(end, corner, is_free)):
            return None
    return corner


def between_faces(a: Wall, b: Wall) -> tuple[np.ndarray, ...] | None:
    """Return the corners (2,) of what lies between two walls where they are the two faces of one; None where they are not."""
    if a.normal @ b.normal > -ONE_LINE_COSINE:
        return None
    along = (a.end - a.start) / a.length
    thick = (b.start - a.start) @ a.normal  # negative: b is behind a
    first, last = sorted(((b.start - a.start) @ along, (b.end - a.start) @ along))
    first, last = max(first, 0.0), min(last, a.length)
    if not -THICKEST < thick < 0.0 or first >= last:
        return None
    near, far = a.start + first * along, a.start + last * along
    return near, far, far + thick * a.normal, near + thick * a.normal
