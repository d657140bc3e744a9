"""Guided matching: landmarks projected into a frame meet the features near by."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import f4, f8, i4, i8, u1, u8

from slamcli.geometry import elementary
from slamcli.geometry.bits import hamming
from slamcli.geometry.camera import Camera
from slamcli.jit.kernel import kernel

CELL = 20  # px, side of the buckets that features are sorted into
NEAREST = 0.05  # [m] before the camera, from where on a landmark is looked for
LAST_OCTAVE = 9  # in which a landmark is looked for; one that should appear beyond it is too far away


@dataclass(frozen=True)
class FrameFeatures:
    """The features of one frame and the camera that saw them, in the form the kernels take."""

    camera: Camera
    xy: np.ndarray  # (N, 2) float32 px, undistorted
    depth: np.ndarray  # (N,) float32 m, NaN where there is none or it is not trusted
    octave: np.ndarray  # (N,) uint8
    angle: np.ndarray  # (N,) float32 rad
    desc: np.ndarray  # (N, 4) uint64
    sigma_px: np.ndarray  # (N,) float64 px
    sigma_z: np.ndarray  # (N,) float64 m, NaN where depth is
    first_row: int  # row of feature 0 in the table of all features
    bucket_start: np.ndarray  # (n_buckets + 1,) int32
    bucket_rows: np.ndarray  # (N,) int32, features sorted by bucket

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True)
class Landmarks:
    """Landmarks that may be seen, in the form the kernels take."""

    xyz: np.ndarray  # (L, 3) float64 m, world
    desc: np.ndarray  # (L, 4) uint64
    direction: np.ndarray  # (L, 3) float64, mean unit vector from the key frames that saw it
    reach: np.ndarray  # (L,) float64 m, distance at which the landmark appears at octave 0
    octave_scale: float  # size ratio of neighbouring octaves


@dataclass(frozen=True)
class SearchLimits:
    """How far from a landmark's projection a feature may lie, and how much it may differ."""

    radius_px: float  # half the side of the window at octave 0; it grows with the octave that the landmark should appear in
    max_distance: int  # bits, of descriptors
    ratio: float  # of the distance to that of the second best feature of the same octave

    def widened(self, times: float) -> "SearchLimits":
        """Return limits whose window is so many times as large."""
        return replace(self, radius_px=times * self.radius_px)


def sort_into_buckets(xy: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Sort features (N, 2) px by square buckets of the image; those undistorted beyond its rim go to the bucket next to them."""
    columns, rows = -(-camera.width // CELL), -(-camera.height // CELL)
    start, order = np.zeros(columns * rows + 1, dtype=np.int32), np.empty(len(xy), dtype=np.int32)
    _sort_into_buckets(xy, columns, rows, start, order)
    return start, order


@kernel
def _sort_into_buckets(xy: f4[:, ::1], columns: i8, rows: i8, start: i4[::1], order: i4[::1]):
    """Fill start (columns rows + 1,), 0, and order (N,): rows of xy (N, 2) sorted by bucket, in a bucket increasing."""
    bucket = np.empty(len(xy), dtype=np.int32)
    for k in range(len(xy)):
        column = min(max(int(np.floor(float(xy[k, 0]) / CELL)), 0), columns - 1)
        row = min(max(int(np.floor(float(xy[k, 1]) / CELL)), 0), rows - 1)
        bucket[k] = row * columns + column
        start[bucket[k] + 1] += 1
    for b in range(columns * rows):
        start[b + 1] += start[b]
    place = start.copy()
    for k in range(len(xy)):
        order[place[bucket[k]]] = k
        place[bucket[k]] += 1


def search(T_cw: np.ndarray, landmarks: Landmarks, frame: FrameFeatures, limits: SearchLimits) -> tuple[np.ndarray, np.ndarray]:
    """Match each landmark to the feature most like it near its projection.

    T_cw : (4, 4) world to camera
    Returns feature : (L,) int32, -1 where none, each feature at most once; is_visible : (L,) bool, the landmark should have been seen.
    """
    camera = frame.camera
    return _search(
        np.ascontiguousarray(T_cw),
        _Sought(landmarks.xyz, landmarks.desc, landmarks.direction, landmarks.reach, float(landmarks.octave_scale)),
        _Seen(frame.xy, frame.octave, frame.desc, frame.bucket_start, frame.bucket_rows),
        _Pinhole(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
        _Limits(float(limits.radius_px), int(limits.max_distance), float(limits.ratio)),
    )


class _Sought(NamedTuple):
    """`Landmarks`, for the kernel."""

    xyz: f8[:, ::1]
    desc: u8[:, ::1]
    direction: f8[:, ::1]
    reach: f8[::1]
    octave_scale: f8


class _Seen(NamedTuple):
    """`FrameFeatures`, for the kernel."""

    xy: f4[:, ::1]
    octave: u1[::1]
    desc: u8[:, ::1]
    bucket_start: i4[::1]
    bucket_rows: i4[::1]


class _Pinhole(NamedTuple):
    """`Camera` without its lens, for the kernel."""

    fx: f8
    fy: f8
    cx: f8
    cy: f8
    width: i8
    height: i8


class _Limits(NamedTuple):
    """`SearchLimits`, for the kernel."""

    radius_px: f8
    max_distance: i8
    ratio: f8


class _Ordered(NamedTuple):
    """`_Seen` in the order of the buckets: what one window needs lies side by side, which takes 0.6 times the time."""

    x: f8[::1]
    y: f8[::1]
    octave: i8[::1]
    desc: u8[:, ::1]
    row: i4[::1]
    bucket_start: i4[::1]
    n_columns: i8  # of buckets
    n_rows: i8


@kernel
def _search(T_cw: f8[:, ::1], sought: _Sought, seen: _Seen, pinhole: _Pinhole, limits: _Limits):
    """Do what `search` says: a feature that several landmarks choose goes to the one most like it, of equals the first."""
    n_lm, n = len(sought.xyz), len(seen.xy)
    feature, is_visible = np.full(n_lm, -1, dtype=np.int32), np.zeros(n_lm, dtype=np.bool_)
    owner, owner_distance = np.full(n, -1, dtype=np.int32), np.full(n, 257, dtype=np.int32)
    power, border = _octave_sizes(sought.octave_scale)
    centre, ordered = _centre(T_cw), _in_bucket_order(seen, pinhole)
    for k in range(n_lm):
        u, v, octave = _appearance(T_cw, centre, sought, k, pinhole, border)
        if octave < 0:
            continue
        is_visible[k] = True
        best_row, best, second, is_rivalled = _most_alike(sought.desc, k, ordered, u, v, limits.radius_px * power[octave], octave)
        if best > limits.max_distance or (is_rivalled and best > limits.ratio * second):
            continue
        if best >= owner_distance[best_row]:
            continue
        if owner[best_row] >= 0:
            feature[owner[best_row]] = -1
        owner[best_row], owner_distance[best_row] = k, best
        feature[k] = best_row
    return feature, is_visible


@kernel
def _octave_sizes(octave_scale):
    """Return the sizes of octaves, and the borders between shares of a landmark's reach that belong to one.

    A landmark is looked for in the octave that it should appear in, rounded; two octaves nearer than ever it still counts as octave 0.
    """
    power, border = np.empty(LAST_OCTAVE + 1), np.empty(LAST_OCTAVE + 4)
    for step in range(LAST_OCTAVE + 1):
        power[step] = elementary.whole_power(octave_scale, step)
    for step in range(LAST_OCTAVE + 4):
        border[step] = elementary.whole_power(octave_scale, step) / (octave_scale * octave_scale * np.sqrt(octave_scale))
    return power, border


@kernel
def _centre(T_cw):
    """Return where the camera is in the world."""
    return (
        -(T_cw[0, 0] * T_cw[0, 3] + T_cw[1, 0] * T_cw[1, 3] + T_cw[2, 0] * T_cw[2, 3]),
        -(T_cw[0, 1] * T_cw[0, 3] + T_cw[1, 1] * T_cw[1, 3] + T_cw[2, 1] * T_cw[2, 3]),
        -(T_cw[0, 2] * T_cw[0, 3] + T_cw[1, 2] * T_cw[1, 3] + T_cw[2, 2] * T_cw[2, 3]),
    )


@kernel
def _in_bucket_order(seen, pinhole):
    xy, octave, desc, bucket_start, bucket_rows = seen
    n = len(xy)
    sorted_x, sorted_y, sorted_octave, sorted_desc = np.empty(n), np.empty(n), np.empty(n, np.int64), np.empty((n, 4), np.uint64)
    for position in range(n):
        j = bucket_rows[position]
        sorted_x[position], sorted_y[position], sorted_octave[position] = xy[j, 0], xy[j, 1], octave[j]
        for i in range(4):
            sorted_desc[position, i] = desc[j, i]
    n_columns, n_rows = -(-pinhole.width // CELL), -(-pinhole.height // CELL)
    return _Ordered(sorted_x, sorted_y, sorted_octave, sorted_desc, bucket_rows, bucket_start, n_columns, n_rows)


@kernel
def _appearance(T_cw, centre, sought, k, pinhole, border):
    """Return where in the image landmark k should be seen, and in which octave; -1 where it should not."""
    fx, fy, cx, cy, width, height = pinhole
    x, y, z = sought.xyz[k, 0], sought.xyz[k, 1], sought.xyz[k, 2]
    depth = T_cw[2, 0] * x + T_cw[2, 1] * y + T_cw[2, 2] * z + T_cw[2, 3]
    if not depth > NEAREST:
        return 0.0, 0.0, -1
    u = fx * (T_cw[0, 0] * x + T_cw[0, 1] * y + T_cw[0, 2] * z + T_cw[0, 3]) / depth + cx
    v = fy * (T_cw[1, 0] * x + T_cw[1, 1] * y + T_cw[1, 2] * z + T_cw[1, 3]) / depth + cy
    if u < 0.0 or v < 0.0 or u >= width or v >= height:
        return u, v, -1
    dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    if dx * sought.direction[k, 0] + dy * sought.direction[k, 1] + dz * sought.direction[k, 2] < 0.5 * distance:
        return u, v, -1  # seen from more than 60 degrees aside a patch looks different
    share, octave = sought.reach[k] / distance, 0
    if not border[0] <= share <= border[LAST_OCTAVE + 3]:
        return u, v, -1  # much nearer or farther than it was ever seen
    while share > border[octave + 3]:
        octave += 1
    return u, v, octave


@kernel
def _most_alike(lm_desc, k, ordered, u, v, radius, octave):
    """Find the feature most like landmark k within `radius` of (u, v) and one octave.

    Returns its row, -1 = none, its distance [bits], that of the second best, and whether these two are of one octave.
    """
    best, second, best_row, best_octave, second_octave = 257, 257, -1, -1, -1
    column_to = min(int((u + radius) / CELL), ordered.n_columns - 1)
    column_from = min(int(max(u - radius, 0.0) / CELL), ordered.n_columns - 1)
    row_to = min(int((v + radius) / CELL), ordered.n_rows - 1)
    for row in range(min(int(max(v - radius, 0.0) / CELL), ordered.n_rows - 1), row_to + 1):
        first = row * ordered.n_columns
        for position in range(ordered.bucket_start[first + column_from], ordered.bucket_start[first + column_to + 1]):
            o = ordered.octave[position]
            is_outside = (abs(ordered.x[position] - u) > radius) | (abs(ordered.y[position] - v) > radius)
            if is_outside | (o < octave - 1) | (o > octave + 1):
                continue
            bits = int(hamming(lm_desc, k, ordered.desc, position))
            if bits < best:
                second, second_octave = best, best_octave
                best, best_octave, best_row = bits, o, ordered.row[position]
            elif bits < second:
                second, second_octave = bits, o
    return best_row, best, second, best_octave == second_octave
