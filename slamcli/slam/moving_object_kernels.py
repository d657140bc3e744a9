"""Kernels of moving_objects.py: depth images compared under known poses, and groups and regions of places."""

from typing import NamedTuple

import numpy as np
from numba import b1, f4, f8, i4, i8, u1, u2

from slamcli.jit.kernel import kernel

UNKNOWN, THROUGH, AGAIN, HIDDEN = range(4)  # what another view says of a place
Z_MIN = 0.3  # [m] nearer than this a camera sees nothing


class Others(NamedTuple):
    """Other views, which are looked from."""

    image: u2[:, :, ::1]  # (N, V, U) raw coarse depth images, times `unit` [m], 0 = none
    place: i4[:, ::1]  # (V, U) where in them a place without distortion is, -1 = nowhere
    T: f8[:, :, ::1]  # (N, 4, 4) from the camera whose view is looked at to theirs
    unit: f8  # [m]


@kernel
def smooth_places(z: f4[:, ::1], jump: f8):
    """Find the places of a depth image (V, U) [m], 0 = none, whose eight neighbours are known and differ by at most `jump` of the depth."""
    rows, columns = z.shape
    out = np.zeros((rows, columns), np.bool_)
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            here = z[row, column]
            is_smooth = here > 0.0
            for r in range(row - 1, row + 2):
                for c in range(column - 1, column + 2):
                    if z[r, c] == 0.0 or abs(z[r, c] - here) > jump * here:
                        is_smooth = False
            out[row, column] = is_smooth
    return out


@kernel
def compare(
    z: f4[:, ::1], is_smooth: b1[:, ::1], step: i8, others: Others, pinhole: f8[::1], tolerance: f8[::1], out: u1[:, :, ::1]
):  # fmt: skip
    """Look from other views at the places of one depth image (V, U) [m]; write THROUGH, AGAIN, HIDDEN or UNKNOWN.

    is_smooth : (V, U) places that may be compared, of which every `step`-th row and column is
    tolerance : base [m], share of the depth, growth with its square [1/m]
    out : (N, v, u)

    A view looks through a place when all it sees around there is farther.
    """
    fx, fy, cx, cy = pinhole
    rows, columns = z.shape
    image, place, T, unit = others
    for k in range(len(image)):
        other, t = image[k].ravel(), T[k]
        for v in range(out.shape[1]):
            for u in range(out.shape[2]):
                row, column = v * step + step // 2, u * step + step // 2
                if not is_smooth[row, column]:
                    continue
                d = z[row, column]
                x, y = (column - cx) / fx * d, (row - cy) / fy * d
                depth = t[2, 0] * x + t[2, 1] * y + t[2, 2] * d + t[2, 3]
                if depth < Z_MIN:
                    continue
                c = int(np.floor(fx * (t[0, 0] * x + t[0, 1] * y + t[0, 2] * d + t[0, 3]) / depth + cx + 0.5))
                r = int(np.floor(fy * (t[1, 0] * x + t[1, 1] * y + t[1, 2] * d + t[1, 3]) / depth + cy + 0.5))
                if r < 1 or c < 1 or r >= rows - 1 or c >= columns - 1 or place[r, c] < 0:
                    continue
                seen = other[place[r, c]] * unit
                if seen == 0.0:
                    continue
                allowed = _allowed(depth, seen, tolerance)
                if seen < depth - allowed:
                    out[k, v, u] = HIDDEN
                elif seen <= depth + allowed:
                    out[k, v, u] = AGAIN
                elif _is_farther(other, place, r, c, (depth + allowed) / unit):
                    out[k, v, u] = THROUGH


@kernel
def _is_farther(other, place, row, column, limit):
    """Say whether all around a place of a raw coarse image is known and farther than a limit."""
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            if place[r, c] < 0 or other[place[r, c]] < limit:
                return False
    return True


@kernel
def follow(
    z: f4[:, ::1], z_r: f4[:, ::1], value_r: f8[:, ::1], step: i8, T: f8[:, ::1], pinhole: f8[::1], tolerance: f8[::1], value: f8[:, ::1]
):  # fmt: skip
    """Take the values of a reference view (v, u) over to the places of another that see the same surface in the same place.

    z, z_r : (v, u) depth [m] at every `step`-th row and column of the coarse images, 0 = unknown
    value_r, value : (v, u), NaN = none; one that is there already stays
    T : (4, 4) from this camera to the reference; tolerance : as of `compare`
    """
    fx, fy, cx, cy = pinhole
    rows, columns = z.shape
    for v in range(rows):
        for u in range(columns):
            d = z[v, u]
            if d == 0.0 or value[v, u] == value[v, u]:
                continue
            x, y = (u * step + step // 2 - cx) / fx * d, (v * step + step // 2 - cy) / fy * d
            depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * d + T[2, 3]
            if depth < Z_MIN:
                continue
            c = int(np.floor((fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * d + T[0, 3]) / depth + cx + 0.5) / step))
            r = int(np.floor((fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * d + T[1, 3]) / depth + cy + 0.5) / step))
            if r < 0 or c < 0 or r >= rows or c >= columns or z_r[r, c] == 0.0:
                continue
            if abs(z_r[r, c] - depth) <= _allowed(depth, z_r[r, c], tolerance):
                value[v, u] = value_r[r, c]


@kernel
def _allowed(depth, seen, tolerance):
    """Return by how much [m] two views may differ about the depth of one surface."""
    far = max(depth, seen) - 0.4
    return tolerance[0] + tolerance[1] * depth + tolerance[2] * far * far


@kernel
def groups(seed: b1[:, ::1], z: f4[:, ::1], jump: f8, least: i8):
    """Keep of the seeds (v, u) those in connected groups of at least `least`; neighbours are connected where depth is continuous."""
    rows, columns = seed.shape
    out = np.zeros((rows, columns), np.bool_)
    open_ = seed.copy()
    stack = np.empty(rows * columns, np.int32)
    for start in range(rows * columns):
        if not open_[start // columns, start % columns]:
            continue
        open_[start // columns, start % columns] = False
        stack[0] = start
        n = _spread(open_, z, jump, stack, 1, rows * columns)
        if n >= least:
            for k in range(n):
                out[stack[k] // columns, stack[k] % columns] = True
    return out


@kernel
def grow(seed: b1[:, ::1], is_open: b1[:, ::1], z: f4[:, ::1], jump: f8, most: i8):
    """Grow a region (v, u) over open neighbours to which depth is continuous, by `most` places at most."""
    rows, columns = seed.shape
    open_ = is_open & ~seed
    stack = np.empty(rows * columns, np.int32)
    n = 0
    for k in range(rows * columns):
        if seed[k // columns, k % columns]:
            stack[n] = k
            n += 1
    n = _spread(open_, z, jump, stack, n, most)
    out = np.zeros((rows, columns), np.bool_)
    for k in range(n):
        out[stack[k] // columns, stack[k] % columns] = True
    return out


@kernel
def fill(region: b1[:, ::1], z: f4[:, ::1], jump: f8, least: i8):
    """Add the places (v, u) to a region of whose eight neighbours at least `least` belong to it and depth is continuous to them."""
    rows, columns = region.shape
    out = region.copy()
    for row in range(rows):
        for column in range(columns):
            if region[row, column] or z[row, column] == 0.0:
                continue
            n = 0
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    n += region[r, c] and abs(z[r, c] - z[row, column]) <= jump * z[row, column]
            out[row, column] = n >= least
    return out


@kernel
def _spread(open_, z, jump, stack, n, most):
    """Take open neighbours of the `n` places on the stack, and theirs, `most` times, onto it and close them; return how many it holds then."""
    rows, columns = open_.shape
    read, end, done = 0, n, 0
    while read < n:
        if read == end:
            end, done = n, done + 1
        if done == most:
            break
        r, c = stack[read] // columns, stack[read] % columns
        read += 1
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, columns)):
                if open_[rr, cc] and abs(z[rr, cc] - z[r, c]) <= jump * z[r, c]:
                    open_[rr, cc] = False
                    stack[n] = rr * columns + cc
                    n += 1
    return n
