"""Things that hang into the robot's band, from the faces that were seen of them: how deep they are, and the inside that nobody sees.

The outline is fitted as a rectangle by the closeness of its sides to the faces: X. Zhang, W. Xu, C. Dong, J. Dolan, IV 2017,
doi:10.1109/IVS.2017.7995698. The smallest rectangle would do for four faces; around two it may lie along their diagonal as well.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.geometry import elementary
from slamcli.geometry.algebra import product

GAP = 1  # [cells] between faces of one thing
GROWTH = 0.6  # [cells] by which a rectangle through the middles of cells is grown to hold the cells, rounding included
MARGIN = 4.0  # [cells] by which a thing may be larger than what was seen of its sides
DEEP = 5.0  # [cells] a narrower rectangle may be of one face and what stands beside it
COVERED = 0.75  # of two sides' length that must have been seen for their ends to be the thing's
FILLED = 0.6  # of a rectangle's cells that must have been seen for it to be the thing's, whichever of its sides were
ANGLE_STEP = 2.0  # [degrees] between rectangles that are tried
CLOSEST = 0.5  # [cells] a point nearer to a side counts no more: it is the cell's middle
SHALLOWEST = 3.0  # [cells] a narrower rectangle is around one face, which does not tell how deep its thing is


@dataclass(frozen=True)
class Things:
    """What hangs, as labels from 1 on; 0 = nothing."""

    face: np.ndarray  # (H, W) int32, cells of faces and those around them, of things whose depth is known
    around: np.ndarray  # (H, W) int32, cells to which such a thing may reach
    inside: np.ndarray  # (H, W) bool, cells in the rectangle around a thing's faces
    near: np.ndarray  # (H, W) bool, cells close enough to a face, of whatever depth, to be its thing's


def find(hangs: np.ndarray, *, widest: float) -> Things:
    """Join faces to things. The rectangle around the faces of one thing is its outline if two of its sides were seen.

    hangs : (H, W) uint16, bits: slices of the band that faces fill under which the floor was seen
    widest : cells, sides of larger rectangles are no one thing's
    """
    import cv2

    is_face = hangs > 0
    face, around = (np.zeros(hangs.shape, dtype=np.int32) for _ in range(2))
    inside = np.zeros(hangs.shape, dtype=bool)
    if not is_face.any():
        return Things(face, around, inside, inside)
    joined = cv2.dilate(is_face.astype(np.uint8), np.ones((2 * GAP + 1,) * 2, np.uint8))
    n_labels, label = cv2.connectedComponents(joined, connectivity=8)
    rows, columns = np.nonzero(is_face)
    of_cell = label[rows, columns]
    for k in range(1, n_labels):
        mine = of_cell == k
        xy = np.column_stack([columns[mine], rows[mine]]).astype(np.float64)
        rectangle = fit_rectangle(xy)
        if min(rectangle.sides) < SHALLOWEST or max(rectangle.sides) > widest:
            continue
        _fill(inside, rectangle, margin=GROWTH, value=True)
        if min(rectangle.sides) >= DEEP and (are_sides_covered(rectangle, xy) or is_filled(rectangle, xy)):
            face[label == k] = k
            _fill(around, rectangle, margin=MARGIN, value=k)
    distance = cv2.distanceTransform((~is_face).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return Things(face, around, inside, distance <= widest)


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in the plane."""

    centre: np.ndarray  # (2,)
    sides: np.ndarray  # (2,)
    angle: float  # [rad] of the first side from the x axis


def fit_rectangle(xy: np.ndarray) -> Rectangle:
    """Fit the rectangle around points (N, 2) [cells] whose sides are the closest to them."""
    angle = np.radians(np.arange(0.0, 90.0, ANGLE_STEP))
    axes = np.stack(
        [
            np.stack([elementary.cos(angle), elementary.sin(angle)], axis=1),
            np.stack([-elementary.sin(angle), elementary.cos(angle)], axis=1),
        ],
        axis=1,
    )
    along = product(axes, xy.T)  # (angles, 2, N)
    low, high = along.min(axis=2, keepdims=True), along.max(axis=2, keepdims=True)
    distance = np.minimum(along - low, high - along).min(axis=1)
    best = int(np.argmax((1.0 / np.maximum(distance, CLOSEST)).sum(axis=1)))
    middle = 0.5 * (low + high)[best, :, 0]
    return Rectangle(product(axes[best].T, middle), (high - low)[best, :, 0], float(angle[best]))


def are_sides_covered(rectangle: Rectangle, xy: np.ndarray) -> bool:
    """Say whether points (N, 2) follow two sides of a rectangle that meet, each along most of its length."""
    c, s = elementary.cos(rectangle.angle), elementary.sin(rectangle.angle)
    local = product(xy - rectangle.centre, np.array([[c, -s], [s, c]]))
    is_covered = []
    for across, along in ((0, 1), (1, 0)):
        for sign in (-1.0, 1.0):
            on_side = sign * local[:, across] >= 0.5 * rectangle.sides[across] - 1.0
            cells = len(np.unique(np.floor(local[on_side, along])))
            is_covered.append(cells >= COVERED * rectangle.sides[along])
    return bool((is_covered[0] or is_covered[1]) and (is_covered[2] or is_covered[3]))


def is_filled(rectangle: Rectangle, xy: np.ndarray) -> bool:
    """Say whether points (N, 2), each a cell, fill a rectangle: what was seen from above, as the seat of a chair, shows where it ends."""
    return len(xy) >= FILLED * float(rectangle.sides[0] * rectangle.sides[1])


def _fill(cells: np.ndarray, rectangle: Rectangle, *, margin: float, value: int) -> None:
    """Write a value to the cells whose centres lie in a rectangle grown by a margin."""
    reach = 0.5 * float(np.linalg.norm(rectangle.sides, axis=-1)) + margin + 1.0
    x, y = rectangle.centre
    first = [max(0, int(np.floor(v - reach))) for v in (y, x)]
    last = [min(n, int(np.ceil(v + reach)) + 1) for v, n in zip((y, x), cells.shape, strict=True)]
    i, j = np.mgrid[first[0] : last[0], first[1] : last[1]]
    c, s = elementary.cos(rectangle.angle), elementary.sin(rectangle.angle)
    along, across = (j - x) * c + (i - y) * s, (i - y) * c - (j - x) * s
    half = 0.5 * rectangle.sides + margin
    is_in = (np.abs(along) <= half[0]) & (np.abs(across) <= half[1])
    cells[i[is_in], j[is_in]] = value


def bodies(things: Things, *, is_under: np.ndarray, is_top: np.ndarray) -> np.ndarray:
    """Find the cells (H, W) within things: in a rectangle of faces, or below a level surface just above the band and near a face.

    is_under : (H, W) bool, cells whose floor was seen, yet only under something that hangs
    is_top : (H, W) bool, cells with a level surface just above the band
    """
    return is_under & (things.inside | (is_top & things.near))
