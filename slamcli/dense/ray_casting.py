"""The cells that a scan's rays pass and end in, each marked once.

The rays walk over marks in the scan's bounding box, so that a map is touched once per cell and not once per ray and cell.

A. Hornung et al., OctoMap, Autonomous Robots 2013, doi:10.1007/s10514-012-9321-0; the arithmetic, float32 where the C++ library has
float, follows its `computeUpdate` and `computeRayKeys`, so that maps agree cell by cell.
"""

from typing import NamedTuple

import numpy as np
from numba import b1, f4, f8, i8, u1, u8

from slamcli.errors import SlamError
from slamcli.geometry import voxel
from slamcli.geometry.four import everywhere, lanes, load, where
from slamcli.geometry.octree import CENTRE
from slamcli.jit.kernel import kernel

MAX_MARKS = 1 << 30  # cells of one scan's bounding box, a byte each
FREE, OCCUPIED = 1, 2  # marks
BLOCK = 512  # rays whose times are held at once: they stay in the processor's nearest memory until they are walked
ROUNDING = 1e-9  # relative; far above what some hundred additions of float64 can lose, far below what a ray's path depends on


class _Rays(NamedTuple):
    """A block of a scan's rays."""

    end: f4[:, ::1]  # (N, 3) [m]
    end_cell: i8[:, ::1]  # (N, 3)
    t_next: f8[:, ::1]  # (3, N) [m] per axis, length at which the first face of a cell is crossed
    t_cell: f8[:, ::1]  # (3, N) [m] and from face to face
    reach: f4[::1]  # (N,) [m] length of each


class _Waiting(NamedTuple):
    """Rays that are walked together once there are four: per axis c, along its axes a, b and c."""

    t: f8[:, ::1]  # (9, 4) [m] lengths of the rays to the next face
    t_cell: f8[:, ::1]  # (9, 4) [m] and from face to face
    step: u8[:, ::1]  # (9, 4) in the marks
    n: f8[:, ::1]  # (3, 4) faces of axis c, whole; 0 where nothing waits
    stop: u8[:, ::1]  # (3, 4) place of the end cell, the start where nothing waits


class _Scan(NamedTuple):
    """Where the rays of a scan begin, and the cells in which it is marked."""

    origin: f4[::1]  # (3,) [m]
    resolution: f8  # [m]
    lower: i8[::1]  # (3,) first cell
    shape: i8[::1]  # (3,) cells along x, y and z


def mark_scan(
    x_w: np.ndarray, origin: np.ndarray, *, max_range: float, resolution: float, discretize: bool = False
) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the cells that a scan's rays pass and end in; arguments as `occupancy.OccupancyMap.insert`.

    Returns marks (Z, Y, X) uint8 of the scan's bounding box, 0 or FREE or OCCUPIED, and the cell (3,) x y z of marks[0, 0, 0], a multiple
    of 8 as the sides are; None for a scan without rays.
    """
    x_w = np.ascontiguousarray(x_w, dtype=np.float32).reshape(-1, 3)
    origin = np.ascontiguousarray(origin, dtype=np.float32)
    if discretize:
        x_w = _cell_centres(x_w, resolution)
    end, end_cell, is_hit = np.empty_like(x_w), np.empty(x_w.shape, dtype=np.int64), np.empty(len(x_w), dtype=np.bool_)
    box = np.empty((2, 3), dtype=np.int64)
    n = _ray_ends(x_w, origin, max_range if max_range > 0 else np.inf, resolution, end, end_cell, is_hit, box)
    if n == 0:
        return None
    # Whole blocks, with a margin of a cell: rounding can carry a ray past its end.
    lower = np.maximum(box[0] - 1, 0) >> 3 << 3
    shape = (((box[1] + 1) >> 3) + 1 << 3) - lower
    if shape.prod() > MAX_MARKS:
        raise SlamError(f"one scan spans {shape[0]} x {shape[1]} x {shape[2]} cells of {resolution:g} m: lower octree.max_range")
    marks = np.zeros(shape[::-1], dtype=np.uint8)
    _cast_rays(end[:n], end_cell[:n], _Scan(origin, resolution, lower, shape), marks.reshape(-1))
    _mark_ends(end_cell[:n], is_hit[:n], lower, marks)
    return marks, lower


def _cell_centres(x_w: np.ndarray, resolution: float) -> np.ndarray:
    x_w = x_w[np.isfinite(x_w).all(axis=1)]
    cell = np.floor(x_w.astype(np.float64) * (1.0 / resolution)) + CENTRE
    cell = cell[((cell >= 0) & (cell < 2 * CENTRE)).all(axis=1)]
    cell = voxel.unmorton(np.unique(voxel.morton(cell)))
    return ((cell - CENTRE + 0.5) * resolution).astype(np.float32)


@kernel
def _ray_ends(
    x_w: f4[:, ::1], origin: f4[::1], max_range: f8, resolution: f8, end: f4[:, ::1], end_cell: i8[:, ::1], is_hit: b1[::1], box: i8[:, ::1]
):
    """Cut rays off at the range, find their end cells and the bounding box of all cells; returns the number of rays kept."""
    factor = 1.0 / resolution
    ox, oy, oz = origin[0], origin[1], origin[2]
    x0, y0, z0 = np.floor(factor * ox) + CENTRE, np.floor(factor * oy) + CENTRE, np.floor(factor * oz) + CENTRE
    if not (0 <= x0 < 2 * CENTRE and 0 <= y0 < 2 * CENTRE and 0 <= z0 < 2 * CENTRE):
        return 0
    x1, y1, z1 = x0, y0, z0
    limit = np.float32(max_range)
    n = 0
    for i in range(len(x_w)):
        px, py, pz = x_w[i, 0], x_w[i, 1], x_w[i, 2]
        dx, dy, dz = px - ox, py - oy, pz - oz
        length = np.sqrt(np.float64(dx * dx + dy * dy + dz * dz))
        hit = length <= max_range
        if not hit:
            unit = np.float32(length)
            px, py, pz = ox + dx / unit * limit, oy + dy / unit * limit, oz + dz / unit * limit
        x, y, z = np.floor(factor * px) + CENTRE, np.floor(factor * py) + CENTRE, np.floor(factor * pz) + CENTRE
        if not (0 <= x < 2 * CENTRE and 0 <= y < 2 * CENTRE and 0 <= z < 2 * CENTRE):
            continue
        x0, y0, z0 = min(x, x0), min(y, y0), min(z, z0)
        x1, y1, z1 = max(x, x1), max(y, y1), max(z, z1)
        end[n, 0], end[n, 1], end[n, 2] = px, py, pz
        end_cell[n, 0], end_cell[n, 1], end_cell[n, 2] = int(x), int(y), int(z)
        is_hit[n] = hit
        n += 1
    box[0, 0], box[0, 1], box[0, 2] = int(x0), int(y0), int(z0)
    box[1, 0], box[1, 1], box[1, 2] = int(x1), int(y1), int(z1)
    return n


@kernel
def _cast_rays(end: f4[:, ::1], end_cell: i8[:, ::1], scan: _Scan, marks: u1[::1]):
    """Mark the cells that rays pass, without their end cells."""
    factor, origin = 1.0 / scan.resolution, scan.origin
    start_x, start_y, start_z = int(np.floor(factor * origin[0])), int(np.floor(factor * origin[1])), int(np.floor(factor * origin[2]))
    start_cell = (start_x + CENTRE, start_y + CENTRE, start_z + CENTRE)
    t_next, t_cell, reach = np.empty((3, BLOCK)), np.empty((3, BLOCK)), np.empty(BLOCK, np.float32)
    start = _flat(start_cell[0] - scan.lower[0], start_cell[1] - scan.lower[1], start_cell[2] - scan.lower[2], scan.shape)
    waiting = _Waiting(np.ones((9, 4)), np.ones((9, 4)), np.zeros((9, 4), np.uint64), np.zeros((3, 4)), np.full((3, 4), start))
    n_waiting = np.zeros(3, np.int64)
    for first in range(0, len(end), BLOCK):
        rays = _Rays(end[first : first + BLOCK], end_cell[first : first + BLOCK], t_next, t_cell, reach)
        _ray_times(rays, origin, scan.resolution)
        _cast_block(rays, start_cell, scan, waiting, n_waiting, marks)
    for axis_c in range(3):
        if n_waiting[axis_c] > 0:
            _walk_together(start, waiting, axis_c, marks)


@kernel(error_model="numpy")
def _ray_times(rays, origin, resolution):
    """Fill per axis the ray lengths at which the first cell face is crossed and between faces, and each ray's length.

    A pass of its own, as the compiler turns it into vector instructions: the divisions would else cost as much as the walk.
    """
    end, _, t_next, t_cell, reach = rays
    for i in range(len(end)):
        dx, dy, dz = end[i, 0] - origin[0], end[i, 1] - origin[1], end[i, 2] - origin[2]
        reach[i] = np.float32(np.sqrt(np.float64(dx * dx + dy * dy + dz * dz)))
    for axis in range(3):
        start = np.float64(origin[axis])
        middle = (np.floor(1.0 / resolution * origin[axis]) + 0.5) * resolution
        upper, lower = middle + np.float64(np.float32(0.5 * resolution)), middle + np.float64(np.float32(-0.5 * resolution))
        to_next, per_cell = t_next[axis], t_cell[axis]
        for i in range(len(end)):
            slope = np.float64((end[i, axis] - origin[axis]) / reach[i])
            to_next[i] = ((upper if slope > 0.0 else lower) - start) / slope if slope != 0.0 else np.inf
            per_cell[i] = resolution / abs(slope) if slope != 0.0 else np.inf


@kernel
def _cast_block(rays, start_cell, scan, waiting, n_waiting, marks):
    """Mark the cells that a block of rays passes, but for those of rays that are left waiting.

    Axis c is the one along which a ray crosses most faces. Rays on which rounding might matter are walked from face to face.
    """
    _, end_cell, t_next, t_cell, reach = rays
    lower, shape = scan.lower, scan.shape
    # Unsigned, as numba tests signed indices for being negative; adding the complement subtracts.
    stride_x, stride_y, stride_z = np.uint64(1), np.uint64(shape[0]), np.uint64(shape[0] * shape[1])
    start = _flat(start_cell[0] - lower[0], start_cell[1] - lower[1], start_cell[2] - lower[2], shape)
    nothing = np.uint64(0)
    for i in range(len(end_cell)):
        dx, dy, dz = end_cell[i, 0] - start_cell[0], end_cell[i, 1] - start_cell[1], end_cell[i, 2] - start_cell[2]
        if dx == 0 and dy == 0 and dz == 0:
            continue
        ta, tb, tc = t_next[0, i], t_next[1, i], t_next[2, i]
        ca, cb, cc = t_cell[0, i], t_cell[1, i], t_cell[2, i]
        na, nb, nc = abs(dx), abs(dy), abs(dz)
        sa = stride_x if dx > 0 else nothing - stride_x
        sb = stride_y if dy > 0 else nothing - stride_y
        sc = stride_z if dz > 0 else nothing - stride_z
        axis_c = 2
        if ca < cb and ca < cc:
            axis_c = 0
            sa, sb, sc, na, nb, nc, ta, tb, tc, ca, cb, cc = sb, sc, sa, nb, nc, na, tb, tc, ta, cb, cc, ca
        elif cb < cc:
            axis_c = 1
            sb, sc, nb, nc, tb, tc, cb, cc = sc, sb, nc, nb, tc, tb, cc, cb
        if not _is_regular((ta, tb, tc), (ca, cb, cc), (na, nb, nc), np.float64(reach[i])):
            _walk(start_cell, rays, i, scan, marks)
            continue
        lane, row = n_waiting[axis_c], 3 * axis_c
        waiting.t[row, lane], waiting.t[row + 1, lane], waiting.t[row + 2, lane] = ta, tb, tc
        waiting.t_cell[row, lane], waiting.t_cell[row + 1, lane], waiting.t_cell[row + 2, lane] = ca, cb, cc
        waiting.step[row, lane], waiting.step[row + 1, lane], waiting.step[row + 2, lane] = sa, sb, sc
        waiting.n[axis_c, lane] = nc
        waiting.stop[axis_c, lane] = _flat(end_cell[i, 0] - lower[0], end_cell[i, 1] - lower[1], end_cell[i, 2] - lower[2], shape)
        n_waiting[axis_c] = (lane + 1) & 3
        if lane == 3:
            _walk_together(start, waiting, axis_c, marks)


@kernel
def _walk_together(start, waiting, axis_c, marks):
    """Walk the four rays that wait for axis c, and let none wait."""
    # Where a ray runs through an edge, the face of the later axis comes first. As constants these cost nothing.
    if axis_c == 2:
        _march(start, waiting, axis_c, False, False, marks)
    elif axis_c == 1:
        _march(start, waiting, axis_c, False, True, marks)
    else:
        _march(start, waiting, axis_c, True, True, marks)
    waiting.n[axis_c], waiting.stop[axis_c] = 0.0, start


@kernel
def _march(start, waiting, axis_c, a_before_c, b_before_c, marks):
    """Mark the cells of four rays along all their faces of axis c, of which none of axis a or b crosses more.

    Between two faces of axis c a ray crosses at most one of a and one of b. So no round of the loop has a branch to mispredict, and four
    rays can go in step: six times as fast as a walk from face to face, and the same cells, for the same comparisons are made.
    """
    row = 3 * axis_c
    ta, tb, tc = load(waiting.t, row), load(waiting.t, row + 1), load(waiting.t, row + 2)
    ca, cb, cc = load(waiting.t_cell, row), load(waiting.t_cell, row + 1), load(waiting.t_cell, row + 2)
    sa, sb, sc = load(waiting.step, row), load(waiting.step, row + 1), load(waiting.step, row + 2)
    n, stop = load(waiting.n, axis_c), load(waiting.stop, axis_c)
    # A ray that has passed its last face stays where it is, and marks the start instead: that is passed by every ray that waits.
    start = everywhere(start)
    at, nothing, never, one, done = start, everywhere(np.uint64(0)), everywhere(-np.inf), everywhere(1.0), everywhere(0.0)
    for _ in range(int(waiting.n[axis_c].max())):
        is_on = done < n
        until = where(is_on, tc, never)
        is_a = ta <= until if a_before_c else ta < until
        is_b = tb <= until if b_before_c else tb < until
        step_a, step_b = where(is_a, sa, nothing), where(is_b, sb, nothing)
        here = where(is_on, at, start)
        _mark(here, marks)
        _mark(here + where(ta < tb, step_a, step_b), marks)
        _mark(here + (step_a + step_b), marks)
        at = at + (step_a + step_b) + where(is_on, sc, nothing)
        ta, tb, tc, done = where(is_a, ta + ca, ta), where(is_b, tb + cb, tb), tc + cc, done + one
    # What is left before the end cell: a face of a, one of b, or both.
    is_there, is_by_two = at == stop, at + (sa + sb) == stop
    _mark(where(is_there, start, at), marks)
    _mark(where(is_there, start, where(is_by_two, at + where(ta < tb, sa, sb), at)), marks)


@kernel
def _mark(at, marks):
    """Mark four cells as passed."""
    a, b, c, d = lanes(at)
    marks[a], marks[b], marks[c], marks[d] = FREE, FREE, FREE, FREE


@kernel
def _flat(x, y, z, shape):
    return np.uint64((z * shape[1] + y) * shape[0] + x)


@kernel
def _is_regular(t, per_cell, n_faces, reach):
    """Say whether the walk reaches its end cell by as many faces as lie between, clear of rounding; arguments along axes a, b and c."""
    ta, tb, tc = t
    ca, cb, cc = per_cell
    na, nb, nc = n_faces
    slack = ROUNDING * reach
    first, last = reach - slack, reach + slack
    return (
        ca > cc + slack
        and cb > cc + slack
        and ta + na * ca > last
        and tb + nb * cb > last
        and tc + nc * cc > last
        and (na == 0 or ta + (na - 1) * ca < first)
        and (nb == 0 or tb + (nb - 1) * cb < first)
        and (nc == 0 or tc + (nc - 1) * cc < first)
    )


@kernel
def _walk(start_cell, rays, i, scan, marks):
    """Mark the cells of ray `i` from face to face, by OctoMap's rules for ties and for rays that miss their end cell.

    J. Amanatides and A. Woo, A fast voxel traversal algorithm for ray tracing, Eurographics 1987.
    """
    end, end_cell, t_cell, reach = rays.end[i], rays.end_cell[i], rays.t_cell[:, i], np.float64(rays.reach[i])
    origin, _, lower, shape = scan
    x, y, z = start_cell[0], start_cell[1], start_cell[2]
    tx, ty, tz = rays.t_next[0, i], rays.t_next[1, i], rays.t_next[2, i]
    while True:
        marks[_flat(x - lower[0], y - lower[1], z - lower[2], shape)] = FREE
        if tx < ty and tx < tz:
            x += 1 if end[0] > origin[0] else -1
            tx += t_cell[0]
        elif not tx < ty and ty < tz:
            y += 1 if end[1] > origin[1] else -1
            ty += t_cell[1]
        else:
            z += 1 if end[2] > origin[2] else -1
            tz += t_cell[2]
        if (x == end_cell[0] and y == end_cell[1] and z == end_cell[2]) or (tx > reach and ty > reach and tz > reach):
            break


@kernel
def _mark_ends(end_cell: i8[:, ::1], is_hit: b1[::1], lower: i8[::1], marks: u1[:, :, ::1]):
    for i in range(len(end_cell)):
        if is_hit[i]:
            marks[end_cell[i, 2] - lower[2], end_cell[i, 1] - lower[1], end_cell[i, 0] - lower[0]] = OCCUPIED
