"""FAST-9 corners: the score of every pixel, then a selection per cell with a fall-back threshold.

E. Rosten, T. Drummond, Machine learning for high-speed corner detection, ECCV 2006, doi:10.1007/11744023_34
"""

from dataclasses import dataclass

import numpy as np
from numba import b1, f8, i4, i8, int64, types, u1, u8, uint8
from numba.extending import intrinsic

from slamcli.kernels import kernel

RADIUS = 3  # [px] of the circle of 16 pixels
FIT_RADIUS = 2  # [px] of the square of scores to which a parabola is fitted
ONE, TWO, THREE = np.uintp(1), np.uintp(2), np.uintp(3)  # unsigned: an index that may be negative is tested for and wrapped
BYTE, EIGHTH, WHOLE_BYTES = np.uint64(255), np.uint64(3), np.uint64(56)


def _low(builder, a, b):
    return builder.select(builder.icmp_unsigned("<", a, b), a, b)


def _high(builder, a, b):
    return builder.select(builder.icmp_unsigned(">", a, b), a, b)


@intrinsic
def _highest(_typing, a, b):
    """Give the greater of two uint8."""
    return types.uint8(types.uint8, types.uint8), lambda _context, builder, _signature, pair: _high(builder, *pair)


@intrinsic
def _score(_typing, centre, circle):
    """Give the FAST-9 score of a pixel, uint8, and its circle, 16 uint8.

    A run of nine that starts at an odd place k is the eight from k and one of the two beside them, so eight runs of eight, built by doubling,
    give all sixteen runs of nine. Written straight into the instructions of the kernel: as two hundred calls of Python they took
    0.5 s longer to compile.
    """

    def best_run(builder, p, least, most):
        twos = [least(builder, p[k], p[(k + 1) % 16]) for k in range(1, 16, 2)]
        fours = [least(builder, twos[k], twos[(k + 1) % 8]) for k in range(8)]
        eights = [least(builder, fours[k], fours[(k + 2) % 8]) for k in range(8)]
        nines = [least(builder, eights[k], most(builder, p[2 * k], p[(2 * k + 9) % 16])) for k in range(8)]
        while len(nines) > 1:
            nines = [most(builder, a, b) for a, b in zip(nines[::2], nines[1::2], strict=True)]
        return nines[0]

    def generate(_context, builder, _signature, arguments):
        c, p = arguments[0], [builder.extract_value(arguments[1], k) for k in range(16)]
        brighter = builder.sub(_high(builder, best_run(builder, p, _low, _high), c), c)
        darker = builder.sub(c, _low(builder, best_run(builder, p, _high, _low), c))
        return _high(builder, brighter, darker)

    return types.uint8(types.uint8, types.UniTuple(types.uint8, 16)), generate


@kernel
def _score_inside(image: u1[::1], width: u8, margin: u8, score: u1[::1]):
    """Write the score of every pixel at least `margin` px inside, 0 elsewhere. image, score : (H W,) uint8.

    There is no branch in the loop: the compiler turns it into 32 pixels a step, which is faster than testing
    candidates first (0.3 ms against 1.0 ms of cv2.FAST on 640 x 480).
    """
    for k in range(len(score)):
        score[k] = 0
    w1, w2, w3 = width, width * TWO, width * THREE
    for start in range(margin * width + margin, np.uintp(len(image)) - margin * width, width):
        for k in range(start, start + width - margin * TWO):
            a, b, c, d, e, f = k + w3, k + w2, k + w1, k - w1, k - w2, k - w3
            circle = (
                image[a], image[a + ONE], image[b + TWO], image[c + THREE], image[k + THREE], image[d + THREE], image[e + TWO], image[f + ONE],
                image[f], image[f - ONE], image[e - TWO], image[d - THREE], image[k - THREE], image[c - THREE], image[b - TWO], image[a - ONE],
            )  # fmt: skip
            score[k] = _score(image[k], circle)


def corner_score(image: np.ndarray, margin: int) -> np.ndarray:
    """Give the FAST-9 score (H, W) uint8 of every pixel: the largest t for which nine neighbours in a row on the circle differ by t or more.

    image : (H, W) uint8; the outer `margin` px, at least RADIUS, score 0. A corner at threshold t is a pixel whose score is greater than t.
    """
    score = np.empty_like(image)  # set to 0 by the kernel, which does not hold the GIL
    _score_inside(image.ravel(), np.uintp(image.shape[1]), np.uintp(margin), score.ravel())
    return score


@kernel
def _local_maxima(score: u1[:, ::1], margin: u8, threshold: u1, peak: u1[:, ::1]):
    """Keep the scores above the threshold that are the largest of their 3 x 3 neighbours; of equal ones the last in reading order.

    score : (H, W) uint8; peak : (H, >= W) uint8, 0 elsewhere and in the outer `margin` px, at least 1
    """
    for y in range(peak.shape[0]):
        for x in range(peak.shape[1]):
            peak[y, x] = 0
    for y in range(margin, np.uintp(score.shape[0]) - margin):
        for x in range(margin, np.uintp(score.shape[1]) - margin):
            s, up, down, left, right = score[y, x], y - ONE, y + ONE, x - ONE, x + ONE
            earlier = _highest(_highest(score[up, left], score[up, x]), _highest(score[up, right], score[y, left]))
            later = _highest(_highest(score[down, left], score[down, x]), _highest(score[down, right], score[y, right]))
            peak[y, x] = s if (s > threshold) & (s >= earlier) & (s > later) else uint8(0)


@intrinsic
def _trailing_zeros(_typing, word):
    """Count the bits below the lowest set one of a uint64, as one instruction."""
    return types.uint64(types.uint64), lambda context, builder, _signature, word: builder.cttz(
        word[0], context.get_constant(types.boolean, 1)
    )


@kernel(error_model="numpy")
def _collect(
    words: u8[:, ::1],
    width: i8,
    border: i8,
    cell: i8,
    xy: i4[:, ::1],
    strength: u1[::1],
    cell_of: i4[::1],
    best: u1[::1],
    histogram: i4[::1],
):
    """List the peaks in reading order, with their scores and cells.

    words : (H, ceil(W / 8)) uint64, the peaks, all at least `border` px inside, eight pixels in one number: nearly all are 0
    xy : (N, 2) int32, strength : (N,) uint8, cell_of : (N,) int32; best : (cells,) uint8, largest score of each; histogram : (256,) int32
    Returns the number of peaks.
    """
    n_columns, n = (width - 2 * border + cell - 1) // cell, 0
    for y in range(border, len(words) - border):
        first_cell = (y - border) // cell * n_columns
        for w in range(words.shape[1]):
            word = words[y, w]
            while word != 0:
                shift = _trailing_zeros(word) & WHOLE_BYTES
                s, x = uint8(word >> shift), 8 * w + int64(shift >> EIGHTH)
                word &= ~(BYTE << shift)
                c = first_cell + (x - border) // cell
                xy[n, 0], xy[n, 1], strength[n], cell_of[n] = x, y, s, c
                best[c] = _highest(best[c], s)
                histogram[s] += 1
                n += 1
    return n


@kernel
def _keep(strength: u1[::1], cell_of: i4[::1], best: u1[::1], threshold: i8, only_best: b1, rows: i4[::1]):
    """Choose corners cell by cell: those above the threshold; where a cell has none, all of it, or only the best (of equals the first).

    rows : (N,) int32, filled with the chosen; `best` is used up. Returns their number.
    """
    n = 0
    for k in range(len(strength)):
        s, c = strength[k], cell_of[k]
        if s > threshold or (best[c] <= threshold and (s == best[c] or not only_best)):
            rows[n] = k
            n += 1
            if s <= threshold and only_best:
                best[c] = 0  # satisfied: no peak has this score
    return n


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


def _quadratic_fit() -> np.ndarray:
    """Give the (25, 5) weights that turn 5 x 5 values into b_x, b_y, a_xx, a_yy, a_xy of the parabola of least weighted squares."""
    v, u = (axis.ravel() for axis in np.mgrid[-2:3, -2:3].astype(np.float64))
    terms = np.stack([np.ones(25), u, v, 0.5 * u * u, 0.5 * v * v, u * v], axis=1)
    root = np.exp(-0.25 * (u * u + v * v))  # square root of a Gaussian weight of 1 px
    return np.ascontiguousarray((np.linalg.pinv(terms * root[:, None]) * root)[1:].T)


_FIT = _quadratic_fit()


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
    """The corners of one pyramid level, in reading order."""

    xy: np.ndarray  # (N, 2) int32 [px] of the level
    response: np.ndarray  # (N,) float32 [grey levels]
    score: np.ndarray  # (H, W) uint8, FAST score of the whole level

    def summits(self, rows: np.ndarray) -> np.ndarray:
        """Give the sub-pixel places (N, 2) float64 [px] of the chosen corners."""
        out = np.empty((len(rows), 2))
        _summit(self.score, self.xy[rows], _FIT, out)
        return out


def corners(
    image: np.ndarray, *, border: int, cell: int, threshold: int, threshold_low: int, at_most: int = 0, rank_by: str = "sum"
) -> Corners:
    """Find the FAST corners of a level.

    image : (H, W) uint8, sides greater than 2 border; border [px] : kept free, >= 6
    cell [px] : a cell without a corner at `threshold` gives those at `threshold_low` [grey levels]
    at_most : where more corners pass than this, the threshold is raised until about as many are left, and a cell without any gives only
    its best one; 0 : the threshold stays, and such a cell gives all it has
    rank_by : "sum" for the response of [Z] (1), "fast" for the FAST score
    """
    height, width = image.shape
    score, peak = corner_score(image, border - FIT_RADIUS), np.empty((height, -(-width // 8) * 8), dtype=np.uint8)
    _local_maxima(score, np.uintp(border), np.uint8(min(threshold, threshold_low)), peak)
    words = peak.view(np.uint64)
    room = 4 * np.count_nonzero(words)  # no two of the eight pixels of a word that are peaks touch
    xy, strength, cell_of = np.empty((room, 2), dtype=np.int32), np.empty(room, dtype=np.uint8), np.empty(room, dtype=np.int32)
    best = np.zeros((-(-(height - 2 * border) // cell)) * (-(-(width - 2 * border) // cell)), dtype=np.uint8)
    histogram = np.zeros(256, dtype=np.int32)
    n = _collect(words, width, border, cell, xy, strength, cell_of, best, histogram)
    if at_most:
        threshold = max(threshold, _level_of_rank(histogram, at_most))
    rows = np.empty(n, dtype=np.int32)
    rows = rows[: _keep(strength[:n], cell_of, best, threshold, at_most > 0, rows)]
    xy = xy[rows]
    if rank_by == "fast":
        return Corners(xy, strength[rows].astype(np.float32), score)
    total = np.empty(len(xy), dtype=np.float32)
    _response(image, xy, total)
    return Corners(xy, total, score)


def _level_of_rank(histogram: np.ndarray, rank: int) -> int:
    """Give the largest threshold that at least `rank` of the scores counted in the histogram (256,) exceed, 0 where there are fewer."""
    reach = np.cumsum(histogram[::-1])[::-1]  # reach[t]: how many are t or more
    return max(int(np.count_nonzero(reach >= rank)) - 2, 0)
