"""FAST-9 corners of all levels of a pyramid: the score of every pixel, then a selection per cell with a fall-back threshold.

E. Rosten, T. Drummond, Machine learning for high-speed corner detection, ECCV 2006, doi:10.1007/11744023_34
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import f4, f8, i4, i8, int64, types, u1, u8, uint8, uintp
from numba.extending import intrinsic

from slamcli.geometry import elementary
from slamcli.geometry.algebra import product, solve
from slamcli.jit.kernel import kernel
from slamcli.vision.pyramid import HEIGHT, TOP, WIDTH, canvas

RADIUS = 3  # [px] of the circle of 16 pixels
FIT_RADIUS = 2  # [px] of the square of scores to which a parabola is fitted
ONE, TWO, THREE = np.uintp(1), np.uintp(2), np.uintp(3)  # unsigned: an index that may be negative is tested for and wrapped
SEVEN, EIGHT = np.uintp(7), np.uintp(8)
BYTE, EIGHTH, WHOLE_BYTES = np.uint64(255), np.uint64(3), np.uint64(56)


def _low(sparse_map, a, b):
    return sparse_map.select(sparse_map.icmp_unsigned("<", a, b), a, b)


def _high(sparse_map, a, b):
    return sparse_map.select(sparse_map.icmp_unsigned(">", a, b), a, b)


@intrinsic
def _highest(_typing, a, b):
    """Return the greater of two uint8."""
    return types.uint8(types.uint8, types.uint8), lambda _context, sparse_map, _signature, pair: _high(sparse_map, *pair)


@intrinsic
def _score(_typing, centre, circle):
    """Return the FAST-9 score of a pixel, uint8, and its circle, 16 uint8.

    A run of nine that starts at an odd place k is the eight from k and one of the two beside them, so eight runs of eight, built by doubling,
    give all sixteen runs of nine. Written straight into the instructions of the kernel: as two hundred calls of Python they took
    0.5 s longer to compile.
    """

    def best_run(sparse_map, p, least, most):
        twos = [least(sparse_map, p[k], p[(k + 1) % 16]) for k in range(1, 16, 2)]
        fours = [least(sparse_map, twos[k], twos[(k + 1) % 8]) for k in range(8)]
        eights = [least(sparse_map, fours[k], fours[(k + 2) % 8]) for k in range(8)]
        nines = [least(sparse_map, eights[k], most(sparse_map, p[2 * k], p[(2 * k + 9) % 16])) for k in range(8)]
        while len(nines) > 1:
            nines = [most(sparse_map, a, b) for a, b in zip(nines[::2], nines[1::2], strict=True)]
        return nines[0]

    def generate(_context, sparse_map, _signature, arguments):
        c, p = arguments[0], [sparse_map.extract_value(arguments[1], k) for k in range(16)]
        brighter = sparse_map.sub(_high(sparse_map, best_run(sparse_map, p, _low, _high), c), c)
        darker = sparse_map.sub(c, _low(sparse_map, best_run(sparse_map, p, _high, _low), c))
        return _high(sparse_map, brighter, darker)

    return types.uint8(types.uint8, types.UniTuple(types.uint8, 16)), generate


@kernel
def _score_inside(image: u1[::1], width: u8, box: i8[:, ::1], margin: u8, score: u1[::1]):
    """Write the score of every pixel at least `margin` px inside its level. image, score : (H W,) uint8 canvas of this width.

    There is no branch in the loop: the compiler turns it into 32 pixels a step, which is faster than testing
    candidates first (0.3 ms against 1.0 ms of cv2.FAST on 640 x 480).
    """
    w1, w2, w3 = width, width * TWO, width * THREE
    for level in range(len(box)):
        first, last = uintp(box[level, TOP]) + margin, uintp(box[level, TOP] + box[level, HEIGHT]) - margin
        inside = uintp(box[level, WIDTH]) - margin * TWO
        for start in range(first * width + margin, last * width, width):
            for k in range(start, start + inside):
                a, b, c, d, e, f = k + w3, k + w2, k + w1, k - w1, k - w2, k - w3
                circle = (
                    image[a], image[a + ONE], image[b + TWO], image[c + THREE], image[k + THREE], image[d + THREE], image[e + TWO],
                    image[f + ONE], image[f], image[f - ONE], image[e - TWO], image[d - THREE], image[k - THREE], image[c - THREE],
                    image[b - TWO], image[a - ONE],
                )  # fmt: skip
                score[k] = _score(image[k], circle)


def corner_score(image: np.ndarray, box: np.ndarray, margin: int, score: np.ndarray) -> None:
    """Write the FAST-9 score of every pixel: the largest t for which nine neighbours in a row on the circle differ by t or more.

    image, score : (H, W) uint8 canvas; the outer `margin` px of each level, at least RADIUS, are not written
    A corner at threshold t is a pixel whose score is greater than t.
    """
    _score_inside(image.ravel(), np.uintp(image.shape[1]), box, np.uintp(margin), score.ravel())


class _Peaks(NamedTuple):
    """Peaks of the score, N of them at most, in cells."""

    xy: i4[:, ::1]  # (N, 2) [px] on the canvas
    strength: u1[::1]  # (N,)
    cell_of: i4[::1]  # (N,)
    best: u1[::1]  # (cells,) largest score of each
    histogram: i4[:, ::1]  # (levels, 256) of the scores
    first: i8[::1]  # (levels + 1,) row of each level's first


@intrinsic
def _trailing_zeros(_typing, word):
    """Count the bits below the lowest set one of a uint64, as one instruction."""
    return types.uint64(types.uint64), lambda context, sparse_map, _signature, word: sparse_map.cttz(
        word[0], context.get_constant(types.boolean, 1)
    )


@kernel(error_model="numpy")
def _peaks(score: u1[:, ::1], box: i8[:, ::1], border: i8, cell: i8, threshold: u1, row: u1[::1], words: u8[::1], found: _Peaks):
    """List the peaks of each level in reading order: scores above the threshold, largest of their 3 x 3 neighbours, of equals the last.

    score : (H, W) uint8 canvas; border [px] : kept free at the sides of each level
    row : (W,) uint8, scratch, and words : the same bytes, eight pixels in one number: nearly all are 0
    found : to be written; its `best` and `histogram` are 0
    """
    xy, strength, cell_of, best, histogram, first = found
    n, first_cell = 0, 0
    for level in range(len(box)):
        first[level] = n
        start, end = uintp(border), uintp(box[level, WIDTH] - border)
        n_columns = (box[level, WIDTH] - 2 * border + cell - 1) // cell
        top, n_rows = box[level, TOP] + border, box[level, HEIGHT] - 2 * border
        for x in range(len(row)):
            row[x] = 0
        for line in range(n_rows):
            y = uintp(top + line)
            for x in range(start, end):
                s, up, down, left, right = score[y, x], y - ONE, y + ONE, x - ONE, x + ONE
                earlier = _highest(_highest(score[up, left], score[up, x]), _highest(score[up, right], score[y, left]))
                later = _highest(_highest(score[down, left], score[down, x]), _highest(score[down, right], score[y, right]))
                row[x] = s if (s > threshold) & (s >= earlier) & (s > later) else uint8(0)
            cell_row = first_cell + line // cell * n_columns
            for w in range(start // EIGHT, (end + SEVEN) // EIGHT):
                word = words[w]
                while word != 0:
                    shift = _trailing_zeros(word) & WHOLE_BYTES
                    s, x = uint8(word >> shift), 8 * int64(w) + int64(shift >> EIGHTH)
                    word &= ~(BYTE << shift)
                    c = cell_row + (x - border) // cell
                    xy[n, 0], xy[n, 1], strength[n], cell_of[n] = x, y, s, c
                    best[c] = _highest(best[c], s)
                    histogram[level, s] += 1
                    n += 1
        first_cell += (n_rows + cell - 1) // cell * n_columns
    first[len(box)] = n


@kernel
def _keep(threshold: i8, weak: f8, at_most: i8[::1], first_cell: i8[::1], found: _Peaks, response: f4[::1]):
    """Choose peaks cell by cell: those above the threshold; where a cell has none, all of it, or only the best (of equals the first).

    at_most : (levels,) int64; where more than so many of a level pass, its threshold is the highest that as many exceed, and such a
    cell gives only its best; of these the strongest count, as many as are the share `weak` of `at_most`, or as the others leave open; 0 : no bound
    first_cell : (levels + 1,) int64, of each level
    The chosen are moved to the front of `found` and of response (N,) float32; its `first` is made to fit, its `best` is used up.
    """
    xy, strength, cell_of, best, histogram, first = found
    n, weaker = 0, np.zeros(256, dtype=np.int64)
    for level in range(len(at_most)):
        least, floor, is_bounded = threshold, 0, at_most[level] > 0
        if is_bounded:
            score, n_above = 255, 0
            while score > threshold and n_above + histogram[level, score] < at_most[level]:
                n_above += histogram[level, score]
                score -= 1
            least, n_open = (score - 1, 0.0) if score > threshold else (threshold, float(at_most[level] - n_above))
            n_weak_most = max(weak * at_most[level], n_open)
            weaker[:] = 0
            for c in range(first_cell[level], first_cell[level + 1]):
                if best[c] <= least:
                    weaker[best[c]] += 1
            floor, n_weak = least, 0
            while floor > 0 and n_weak + weaker[floor] <= n_weak_most:
                n_weak += weaker[floor]
                floor -= 1
        start, first[level] = first[level], n
        for k in range(start, first[level + 1]):
            s, c = strength[k], cell_of[k]
            if s > least or (best[c] <= least and (not is_bounded or (s == best[c] and s > floor))):
                if s <= least and is_bounded:
                    best[c] = 0  # satisfied: no peak has this score
                xy[n, 0], xy[n, 1], strength[n], response[n] = xy[k, 0], xy[k, 1], s, s
                n += 1
    first[len(at_most)] = n


@kernel
def _response(image, xy, out):
    """Write the response of each corner: the sum over the circle of |I_circle - I_centre|; [Z] (1). xy : (N, 2) int32, out : (N,) float32."""
    for k in range(len(xy)):
        x, y = xy[k, 0], xy[k, 1]
        c = np.int32(image[y, x])
        total = abs(image[y + 3, x] - c) + abs(image[y + 3, x + 1] - c) + abs(image[y + 2, x + 2] - c) + abs(image[y + 1, x + 3] - c)
        total += abs(image[y, x + 3] - c) + abs(image[y - 1, x + 3] - c) + abs(image[y - 2, x + 2] - c) + abs(image[y - 3, x + 1] - c)
        total += abs(image[y - 3, x] - c) + abs(image[y - 3, x - 1] - c) + abs(image[y - 2, x - 2] - c) + abs(image[y - 1, x - 3] - c)
        total += abs(image[y, x - 3] - c) + abs(image[y + 1, x - 3] - c) + abs(image[y + 2, x - 2] - c) + abs(image[y + 3, x - 1] - c)
        out[k] = total


@functools.cache
def _quadratic_fit() -> np.ndarray:
    """Return the (25, 5) weights that turn 5 x 5 values into b_x, b_y, a_xx, a_yy, a_xy of the parabola of least weighted squares."""
    v, u = (axis.ravel() for axis in np.mgrid[-2:3, -2:3].astype(np.float64))
    terms = np.stack([np.ones(25), u, v, 0.5 * u * u, 0.5 * v * v, u * v], axis=1)
    root = elementary.exp(-0.25 * (u * u + v * v))  # square root of a Gaussian weight of 1 px
    weighted = terms * root[:, None]
    return np.ascontiguousarray((solve(product(weighted.T, weighted), weighted.T) * root)[1:].T)


@kernel
def _summit(score: u1[:, ::1], xy: i4[:, ::1], fit: f8[:, ::1], out: f8[:, ::1]):
    """Write where the parabola through the 5 x 5 scores around each corner is highest, [px], at most 1 px from it on each axis."""
    for k in range(len(xy)):
        x, y = xy[k, 0], xy[k, 1]
        bx, by, axx, ayy, axy = 0.0, 0.0, 0.0, 0.0, 0.0
        for v in range(5):
            for u in range(5):
                s, place = np.float64(score[y + v - 2, x + u - 2]), 5 * v + u
                bx += fit[place, 0] * s
                by += fit[place, 1] * s
                axx += fit[place, 2] * s
                ayy += fit[place, 3] * s
                axy += fit[place, 4] * s
        determinant = axx * ayy - axy * axy
        dx, dy = 0.0, 0.0
        if determinant > 0.0 and axx < 0.0:
            dx = min(max((axy * by - ayy * bx) / determinant, -1.0), 1.0)
            dy = min(max((axy * bx - axx * by) / determinant, -1.0), 1.0)
        out[k, 0], out[k, 1] = x + dx, y + dy


@dataclass(frozen=True)
class Corners:
    """The corners of all levels of a pyramid, level by level in reading order."""

    xy: np.ndarray  # (N, 2) int32 [px] on the canvas
    response: np.ndarray  # (N,) float32 [grey levels]
    first: np.ndarray  # (levels + 1,) int64, the row of each level's first corner
    score: np.ndarray  # (H, W) uint8 canvas, FAST score

    def summits(self, rows: np.ndarray) -> np.ndarray:
        """Return the sub-pixel places (N, 2) float64 [px] on the canvas of the chosen corners."""
        out = np.empty((len(rows), 2))
        _summit(self.score, self.xy.take(rows, axis=0), _quadratic_fit(), out)
        return out


class Finder:
    """Finds the corners of pyramids that lie on a canvas in one way; what it gives lasts until the next are sought.

    Its memory is used again for each image: new memory would cost the time of a page fault for each 4 KiB, in every image.
    """

    def __init__(self, box: np.ndarray, *, border: int) -> None:
        """Reserve memory. box : (levels, 3) int64, sides greater than 2 border; border [px] : kept free, >= 6."""
        self.box, self.border = box, border
        self._inside = (box[:, [HEIGHT, WIDTH]] - 2 * border).tolist()
        room = sum((height + 1) // 2 * ((width + 1) // 2) for height, width in self._inside)  # no two peaks touch
        self._score = canvas(box)
        self._row = np.empty(self._score.shape[1], dtype=np.uint8)
        self._xy, self._strength, self._cell_of = np.empty((room, 2), np.int32), np.empty(room, np.uint8), np.empty(room, np.int32)
        self._response = np.empty(room, np.float32)

    def corners(
        self,
        image: np.ndarray,
        *,
        cell: int,
        threshold: int,
        threshold_low: int,
        at_most: np.ndarray,
        weak: float = 1.0,
        rank_by: str = "sum",
    ) -> Corners:
        """Find the FAST corners of all levels.

        image : (H, W) uint8 canvas
        cell [px] : a cell without a corner at `threshold` gives those at `threshold_low` [grey levels]
        at_most : (levels,) int64; where more corners of a level pass than this, its threshold is raised until about as many are left,
        and a cell without any gives only its best one; 0 : the threshold stays, and such a cell gives all it has
        weak : such best ones, the strongest first, are at most this share of `at_most`, or what the others leave of it
        rank_by : "sum" for the response of [Z] (1), "fast" for the FAST score
        """
        corner_score(image, self.box, self.border - FIT_RADIUS, self._score)
        first_cell = np.cumsum([0] + [-(-height // cell) * -(-width // cell) for height, width in self._inside], dtype=np.int64)
        best = np.zeros(first_cell[-1], dtype=np.uint8)
        histogram, first = np.zeros((len(self.box), 256), dtype=np.int32), np.empty(len(self.box) + 1, dtype=np.int64)
        found = _Peaks(self._xy, self._strength, self._cell_of, best, histogram, first)
        low = np.uint8(min(threshold, threshold_low))
        _peaks(self._score, self.box, self.border, cell, low, self._row, self._row.view(np.uint64), found)
        _keep(threshold, weak, at_most, first_cell, found, self._response)
        xy, response = self._xy[: first[-1]], self._response[: first[-1]]
        if rank_by == "sum":
            _response(image, xy, response)
        return Corners(xy, response, first, self._score)
