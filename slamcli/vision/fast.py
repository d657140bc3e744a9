"""FAST-9 corners: the score of every pixel, then a selection per cell with a fall-back threshold.

E. Rosten, T. Drummond, Machine learning for high-speed corner detection, ECCV 2006, doi:10.1007/11744023_34
"""

from dataclasses import dataclass

import numpy as np
from numba import b1, f8, i4, i8, u1, u8, uint8, uint64

from slamcli.kernels import kernel

RADIUS = 3  # [px] of the circle of 16 pixels
FIT_RADIUS = 2  # [px] of the square of scores to which a parabola is fitted


@kernel
def _low(a, b):
    return a if a < b else b


@kernel
def _high(a, b):
    return a if a > b else b


@kernel
def corner_score(image: u1[:, ::1], margin: i8, score: u1[:, ::1]):
    """Write the FAST-9 score of every pixel: the largest t for which nine neighbours in a row on the circle differ by t or more.

    image, score : (H, W) uint8; the outer `margin` px, at least 3, score 0. A corner at threshold t is a pixel whose score is greater than t.

    A run of nine that starts at an odd place k is the eight from k and one of the two beside them, so eight runs of eight, built by doubling,
    give all sixteen runs of nine. There is no branch in the loop: the compiler turns it into 32 pixels a step, which is faster
    than testing candidates first (0.3 ms against 1.0 ms of cv2.FAST on 640 x 480).
    """
    height, width = image.shape
    score[:margin] = 0
    score[height - margin :] = 0
    left, right = margin - RADIUS, width - margin + RADIUS
    for y in range(margin, height - margin):
        r0, r1, r2, r3 = image[y - 3, left:right], image[y - 2, left:right], image[y - 1, left:right], image[y, left:right]
        r4, r5, r6 = image[y + 1, left:right], image[y + 2, left:right], image[y + 3, left:right]
        score[y, :margin] = 0
        score[y, width - margin :] = 0
        out = score[y, margin : width - margin]
        for x in range(width - 2 * margin):
            c = r3[x + 3]
            p0, p1, p2, p3 = r6[x + 3], r6[x + 4], r5[x + 5], r4[x + 6]
            p4, p5, p6, p7 = r3[x + 6], r2[x + 6], r1[x + 5], r0[x + 4]
            p8, p9, p10, p11 = r0[x + 3], r0[x + 2], r1[x + 1], r2[x]
            p12, p13, p14, p15 = r3[x], r4[x], r5[x + 1], r6[x + 2]
            # the brightest of the darkest of each run, minus the centre
            a1, a3, a5, a7 = _low(p1, p2), _low(p3, p4), _low(p5, p6), _low(p7, p8)
            a9, a11, a13, a15 = _low(p9, p10), _low(p11, p12), _low(p13, p14), _low(p15, p0)
            b1, b3, b5, b7 = _low(a1, a3), _low(a3, a5), _low(a5, a7), _low(a7, a9)
            b9, b11, b13, b15 = _low(a9, a11), _low(a11, a13), _low(a13, a15), _low(a15, a1)
            c1, c3 = _low(_low(b1, b5), _high(p0, p9)), _low(_low(b3, b7), _high(p2, p11))
            c5, c7 = _low(_low(b5, b9), _high(p4, p13)), _low(_low(b7, b11), _high(p6, p15))
            c9, c11 = _low(_low(b9, b13), _high(p8, p1)), _low(_low(b11, b15), _high(p10, p3))
            c13, c15 = _low(_low(b13, b1), _high(p12, p5)), _low(_low(b15, b3), _high(p14, p7))
            bright = _high(_high(_high(c1, c3), _high(c5, c7)), _high(_high(c9, c11), _high(c13, c15)))
            # the same the other way round for circles darker than the centre
            a1, a3, a5, a7 = _high(p1, p2), _high(p3, p4), _high(p5, p6), _high(p7, p8)
            a9, a11, a13, a15 = _high(p9, p10), _high(p11, p12), _high(p13, p14), _high(p15, p0)
            b1, b3, b5, b7 = _high(a1, a3), _high(a3, a5), _high(a5, a7), _high(a7, a9)
            b9, b11, b13, b15 = _high(a9, a11), _high(a11, a13), _high(a13, a15), _high(a15, a1)
            c1, c3 = _high(_high(b1, b5), _low(p0, p9)), _high(_high(b3, b7), _low(p2, p11))
            c5, c7 = _high(_high(b5, b9), _low(p4, p13)), _high(_high(b7, b11), _low(p6, p15))
            c9, c11 = _high(_high(b9, b13), _low(p8, p1)), _high(_high(b11, b15), _low(p10, p3))
            c13, c15 = _high(_high(b13, b1), _low(p12, p5)), _high(_high(b15, b3), _low(p14, p7))
            dark = _low(_low(_low(c1, c3), _low(c5, c7)), _low(_low(c9, c11), _low(c13, c15)))
            out[x] = _high(uint8(_high(bright, c) - c), uint8(c - _low(dark, c)))


@kernel
def local_maxima(score: u1[:, ::1], margin: i8, threshold: i8, peak: u1[:, ::1]):
    """Keep the scores above the threshold that are the largest of their 3 x 3 neighbours; of equal ones the last in reading order.

    score : (H, W) uint8; peak : (H, >= W) uint8, 0 elsewhere; its outer `margin` rows, at least 1, are left as they are
    """
    height, width = score.shape
    least = uint8(threshold)
    for y in range(margin, height - margin):
        above, row, below = score[y - 1], score[y], score[y + 1]
        out = peak[y]
        out[0] = 0
        out[width - 1 :] = 0
        for x in range(width - 2):
            s = row[x + 1]
            earlier = _high(_high(above[x], above[x + 1]), _high(above[x + 2], row[x]))
            later = _high(_high(below[x], below[x + 1]), _high(below[x + 2], row[x + 2]))
            out[x + 1] = s if (s > least) & (s >= earlier) & (s > later) else uint8(0)


@kernel
def collect(
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
    """List the peaks at least `border` px inside, in reading order, with their scores and cells.

    words : (H, ceil(W / 8)) uint64, the peaks, eight pixels in one number: nearly all are 0 and skipped at once
    xy : (N, 2) int32, strength : (N,) uint8, cell_of : (N,) int32; best : (cells,) uint8, largest score of each; histogram : (256,) int32
    Returns the number of peaks.
    """
    height, n_columns = len(words), (width - 2 * border + cell - 1) // cell
    n = 0
    for y in range(border, height - border):
        first_cell = (y - border) // cell * n_columns
        for w in range(border // 8, (width - border + 7) // 8):
            word = words[y, w]
            x = 8 * w
            while word != 0:
                if word & uint64(0xFFFFFFFF) == 0:
                    word, x = word >> uint64(32), x + 4
                if word & uint64(0xFFFF) == 0:
                    word, x = word >> uint64(16), x + 2
                s = uint8(word & uint64(0xFF))
                if s > 0 and border <= x < width - border:
                    c = first_cell + (x - border) // cell
                    xy[n, 0], xy[n, 1], strength[n], cell_of[n] = x, y, s, c
                    best[c] = _high(best[c], s)
                    histogram[s] += 1
                    n += 1
                word, x = word >> uint64(8), x + 1
    return n


@kernel
def keep(strength: u1[::1], cell_of: i4[::1], best: u1[::1], threshold: i8, only_best: b1, rows: i4[::1]):
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
def response(image, xy, out):
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
def summit(score: u1[:, ::1], xy: i4[:, ::1], fit: f8[:, ::1], out: f8[:, ::1]):
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
        summit(self.score, self.xy[rows], _FIT, out)
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
    score, peak = np.empty_like(image), np.empty((height, -(-width // 8) * 8), dtype=np.uint8)
    corner_score(image, border - FIT_RADIUS, score)
    local_maxima(score, border, min(threshold, threshold_low), peak)
    room = (height // 2 + 1) * (width // 2 + 1)  # no two peaks touch
    xy, strength, cell_of = np.empty((room, 2), dtype=np.int32), np.empty(room, dtype=np.uint8), np.empty(room, dtype=np.int32)
    best = np.zeros((-(-(height - 2 * border) // cell)) * (-(-(width - 2 * border) // cell)), dtype=np.uint8)
    histogram = np.zeros(256, dtype=np.int32)
    n = collect(peak.view(np.uint64), width, border, cell, xy, strength, cell_of, best, histogram)
    if at_most:
        threshold = max(threshold, _level_of_rank(histogram, at_most))
    rows = np.empty(n, dtype=np.int32)
    rows = rows[: keep(strength[:n], cell_of, best, threshold, at_most > 0, rows)]
    xy = xy[rows]
    if rank_by == "fast":
        return Corners(xy, strength[rows].astype(np.float32), score)
    total = np.empty(len(xy), dtype=np.float32)
    response(image, xy, total)
    return Corners(xy, total, score)


def _level_of_rank(histogram: np.ndarray, rank: int) -> int:
    """Give the largest threshold that at least `rank` of the scores counted in the histogram (256,) exceed, 0 where there are fewer."""
    reach = np.cumsum(histogram[::-1])[::-1]  # reach[t]: how many are t or more
    return max(int(np.count_nonzero(reach >= rank)) - 2, 0)
