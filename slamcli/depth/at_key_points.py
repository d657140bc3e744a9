"""What a depth image says at key points: how far away, how slanted, and whether an outline hides the surface there."""

import numpy as np
from numba import b1, f4, f8, i8

from slamcli.jit.kernel import kernel

USUAL_WIDTH = 640  # px
JUMP_REACH = 3  # px of its octave to either side of a key point where a jump of depth is looked for: as far as FAST looks
SLOPE_REACH = 8  # px to either side of a key point from which the slope of its surface is read
SLOPE_STEP = 2  # px between the pixels looked at: neighbours share most of their noise
ONE, TWO = np.float32(1.0), np.float32(2.0)
LEVEL = 0.1  # px^2, of some 1000: how strongly a direction is believed to be level where no pair says otherwise
SLOPE_BEND = 0.03  # share by which inverse depth may bend over a pair of pixels that still shows one surface


def depth_at(depth: np.ndarray, xy: np.ndarray, *, window: int = 1) -> np.ndarray:
    """Read depth (H, W) [m] around raw points xy (N, 2) inside the image, (N,) float32.

    window [px], odd : 1 reads the nearest pixel; more gives the median of the readings in a square, the nearer of two, NaN where there is none
    """
    column, row = np.rint(xy).astype(np.int64).T
    if window == 1:
        return depth[row, column]
    reach = np.arange(window) - window // 2
    rows = np.clip(row[:, None] + reach, 0, depth.shape[0] - 1)
    columns = np.clip(column[:, None] + reach, 0, depth.shape[1] - 1)
    readings = np.sort(depth[rows[:, :, None], columns[:, None, :]].reshape(len(xy), window * window), axis=1)  # NaN last
    n = np.isfinite(readings).sum(axis=1)
    return readings[np.arange(len(xy)), np.maximum(n - 1, 0) // 2]


def is_behind_outline(depth: np.ndarray, xy: np.ndarray, scale: np.ndarray, *, jump: float) -> np.ndarray:
    """Say beside which raw points xy (N, 2) something else is nearer by more than the share `jump` of depth (H, W) [m], (N,) bool.

    scale : (N,) by how many times the image was made smaller where a point was found; as far around it an outline may be what was found

    Where a surface goes behind the outline of another is no fixed point in space, and a pixel more to that side the depth is the other's.
    On the nearer side the corner of a thing mostly is one, so it keeps its depth.
    Along a line over a plane, however slanted, the inverse of depth is linear in pixels: beside something nearer it bends up. In an image
    less than 640 pixels wide as many pixels span a wider angle, and each fold of a surface bends more, as it does farther from it: `jump`
    grows in proportion.
    """
    is_behind, least = np.empty(len(xy), dtype=np.bool_), jump * _coarseness(depth)
    at, reach = np.rint(xy).astype(np.int64), np.rint(JUMP_REACH * scale).astype(np.int64)
    _is_behind_outline(np.ascontiguousarray(depth, dtype=np.float32), at, reach, np.float32(least), is_behind)
    return is_behind


@kernel(error_model="numpy")
def _is_behind_outline(depth: f4[:, ::1], at: i8[:, ::1], farthest: i8[::1], least: f4, is_behind: b1[::1]) -> None:
    height, width = depth.shape
    for n in range(len(at)):
        column, row = at[n, 0], at[n, 1]
        here = ONE / depth[row, column]
        both = TWO * here
        is_behind[n] = False
        for step in range(JUMP_REACH, farthest[n] + JUMP_REACH, JUMP_REACH):
            reach = min(step, farthest[n])
            limit = least * here * np.float32(reach) / np.float32(JUMP_REACH)
            up, down = max(row - reach, 0), min(row + reach, height - 1)
            left, right = max(column - reach, 0), min(column + reach, width - 1)
            if (
                (ONE / depth[row, right] + ONE / depth[row, left]) - both > limit
                or (ONE / depth[down, column] + ONE / depth[up, column]) - both > limit
                or (ONE / depth[down, right] + ONE / depth[up, left]) - both > limit
                or (ONE / depth[down, left] + ONE / depth[up, right]) - both > limit
            ):
                is_behind[n] = True
                break


def inverse_depth_slope(depth: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return by how much the inverse of depth (H, W) [m] grows per pixel to the right and downwards at raw points xy (N, 2), (N, 2) [1/m/px].

    A plane's inverse depth is linear in pixels, and what lies opposite each other around a point shows its slope; pairs over which it
    bends are of two surfaces and left out. Level where no pair is left.
    """
    slope = np.zeros((len(xy), 2), dtype=np.float32)
    at = np.rint(xy).astype(np.int64)
    _inverse_depth_slope(np.ascontiguousarray(depth, dtype=np.float32), at, SLOPE_REACH, SLOPE_BEND * _coarseness(depth), slope)
    return slope


def _coarseness(depth: np.ndarray) -> float:
    return max(1.0, USUAL_WIDTH / depth.shape[1])


@kernel
def _inverse_depth_slope(depth: f4[:, ::1], at: i8[:, ::1], reach: i8, bend: f8, slope: f4[:, ::1]) -> None:
    height, width = depth.shape
    for n in range(len(at)):
        column, row = at[n, 0], at[n, 1]
        here = 1.0 / depth[row, column]
        if not np.isfinite(here):
            continue
        across = min(reach, column, width - 1 - column)
        down = min(reach, row, height - 1 - row)
        xx = yy = LEVEL
        xy = xd = yd = 0.0
        for dy in range(0, down + 1, SLOPE_STEP):
            for dx in range(-across, across + 1, SLOPE_STEP):
                if dy == 0 and dx <= 0:
                    continue
                ahead, behind = 1.0 / depth[row + dy, column + dx], 1.0 / depth[row - dy, column - dx]
                if abs(ahead + behind - 2.0 * here) <= bend * here:
                    difference = 0.5 * (ahead - behind)
                    xx += dx * dx
                    xy += dx * dy
                    yy += dy * dy
                    xd += dx * difference
                    yd += dy * difference
        determinant = xx * yy - xy * xy
        slope[n, 0] = (yy * xd - xy * yd) / determinant
        slope[n, 1] = (xx * yd - xy * xd) / determinant
