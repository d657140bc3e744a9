"""One coloured cloud from the surfaces that key frames see: averaged in voxels, stray points dropped.

A voxel holds weighted sums only, so that what is kept grows with the surface seen and not with the number of frames.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import f4, f8, i4, i8, u1

from slamcli import mapped_memory
from slamcli.dense import outlier_removal
from slamcli.depth.oriented_points import Surface
from slamcli.geometry import se3, voxel
from slamcli.geometry.voxel import Index, find_or_add, gather, spread
from slamcli.jit.kernel import kernel

HALF_EXTENT = outlier_removal.HALF_EXTENT


@dataclass(frozen=True)
class Cloud:
    """Points in Morton order of their voxels."""

    xyz: np.ndarray  # (N, 3) float32 [m]
    rgb: np.ndarray  # (N, 3) uint8
    normal: np.ndarray  # (N, 3) float32, unit, towards the cameras that saw the point

    def __len__(self) -> int:
        return len(self.xyz)

    def moved(self, T_ab: np.ndarray) -> "Cloud":
        """Return the cloud of frame b in frame a; the order stays."""

        def xyz(rows: slice) -> np.ndarray:
            return se3.transform(T_ab, self.xyz[rows].astype(np.float64))

        def normal(rows: slice) -> np.ndarray:
            return se3.rotate(T_ab[:3, :3], self.normal[rows])

        return Cloud(_vectors(xyz, len(self)), self.rgb, _vectors(normal, len(self)))


class VoxelCloud:
    """A growing cloud: per voxel the weighted means of position, normal and colour."""

    def __init__(self, side: float) -> None:
        """Start empty; `side` is the voxels' [m]."""
        self.side = float(side)
        self._rows = voxel.VoxelRows(sums=((10,), np.float32, 0.0), count=((), np.int32, 0))

    def add(self, seen: Surface, rgb: np.ndarray, T_wc: np.ndarray) -> None:
        """Add what one key frame saw; `rgb` (H, W, 3) uint8."""
        self._rows.reserve(len(seen.pixel))
        rows = self._rows
        points = _Points(seen.pixel, seen.xyz_c, seen.normal_c, seen.weight, np.ascontiguousarray(rgb).reshape(-1, 3))
        T_wc = np.ascontiguousarray(T_wc, dtype=np.float64)
        voxels = _Voxels(**rows.columns)
        rows.n = _add_points(points, T_wc, 1.0 / self.side, rows.index, rows.n, voxels)

    def cloud(self, *, min_points: int = 1, neighbours: int = 0, max_deviation: float = np.inf) -> Cloud:
        """Return the voxels with at least `min_points` readings, in Morton order.

        neighbours, max_deviation : points whose mean distance to so many neighbours exceeds the mean over the cloud by more than so
            many standard deviations are dropped; 0 neighbours keep all
        """
        n = self._rows.n
        row = np.flatnonzero(self._rows.columns["count"][:n] >= min_points)
        key = self._rows.key[row]
        order = np.argsort(key)
        row, key = row[order], key[order]
        xyz, normal, rgb = (mapped_memory.empty((len(row), 3), of) for of in (np.float32, np.float32, np.uint8))
        for rows in mapped_memory.blocks(xyz):
            _average(self._rows.columns["sums"], row[rows], key[rows], self.side, xyz[rows], normal[rows], rgb[rows])
            mapped_memory.release_beyond(mapped_memory.MOST_RESIDENT)
        keep = outlier_removal.not_stray(xyz, key, side=self.side, neighbours=neighbours, max_deviation=max_deviation)
        return Cloud(*(_kept(of, np.flatnonzero(keep)) for of in (xyz, rgb, normal)))


def _kept(of: np.ndarray, row: np.ndarray) -> np.ndarray:
    return mapped_memory.by_blocks(lambda rows: of[row[rows]], len(row), (3,), of.dtype)


def _vectors(values: Callable[[slice], np.ndarray], n: int) -> np.ndarray:
    return mapped_memory.by_blocks(values, n, (3,), np.float32)


class _Points(NamedTuple):
    """`Surface`, with the picture that has its colours."""

    pixel: i4[::1]
    xyz_c: f4[:, ::1]
    normal_c: f4[:, ::1]
    weight: f4[::1]
    rgb: u1[:, ::1]  # (H W, 3)


class _Voxels(NamedTuple):
    """What is known of each voxel."""

    sums: f4[:, ::1]  # (R, 10) of the weights; weighted, of the offset from the voxel's centre [voxels], the normal and the colour
    count: i4[::1]  # (R,) readings


@kernel
def _add_points(points: _Points, T_wc: f8[:, ::1], per_side: f8, index: Index, n_rows: i8, voxels: _Voxels):
    """Add weighted points to their voxels. Returns the rows in use."""
    pixel, xyz_c, normal_c, weight, rgb = points
    sums, count = voxels
    half = 1 << 20
    last, row = np.int64(-1), np.int64(-1)
    for i in range(len(pixel)):
        x, y, z = xyz_c[i, 0], xyz_c[i, 1], xyz_c[i, 2]
        px = (T_wc[0, 0] * x + T_wc[0, 1] * y + T_wc[0, 2] * z + T_wc[0, 3]) * per_side
        py = (T_wc[1, 0] * x + T_wc[1, 1] * y + T_wc[1, 2] * z + T_wc[1, 3]) * per_side
        pz = (T_wc[2, 0] * x + T_wc[2, 1] * y + T_wc[2, 2] * z + T_wc[2, 3]) * per_side
        fx, fy, fz = np.floor(px), np.floor(py), np.floor(pz)
        if not (abs(fx) < half and abs(fy) < half and abs(fz) < half):
            continue
        key = spread(int(fx) + half) | spread(int(fy) + half) << 1 | spread(int(fz) + half) << 2
        if key != last:  # neighbouring pixels often show the same voxel
            last, row = key, np.int64(find_or_add(index, n_rows, key))
            n_rows = max(n_rows, row + 1)
        w = weight[i]
        a, b, c = normal_c[i, 0], normal_c[i, 1], normal_c[i, 2]
        sums[row, 0] += w
        sums[row, 1] += w * (px - fx - 0.5)
        sums[row, 2] += w * (py - fy - 0.5)
        sums[row, 3] += w * (pz - fz - 0.5)
        sums[row, 4] += w * (T_wc[0, 0] * a + T_wc[0, 1] * b + T_wc[0, 2] * c)
        sums[row, 5] += w * (T_wc[1, 0] * a + T_wc[1, 1] * b + T_wc[1, 2] * c)
        sums[row, 6] += w * (T_wc[2, 0] * a + T_wc[2, 1] * b + T_wc[2, 2] * c)
        sums[row, 7] += w * rgb[pixel[i], 0]
        sums[row, 8] += w * rgb[pixel[i], 1]
        sums[row, 9] += w * rgb[pixel[i], 2]
        count[row] += 1
    return n_rows


@kernel(error_model="numpy")
def _average(sums: f4[:, ::1], row: i8[::1], key: i8[::1], side: f8, xyz: f4[:, ::1], normal: f4[:, ::1], rgb: u1[:, ::1]):
    """Fill the position, the unit normal and the colour of the voxels in some rows, whose Morton keys are given."""
    for i in range(len(row)):
        of = sums[row[i]]
        weight = of[0]
        for k in range(3):
            xyz[i, k] = (gather(key[i] >> k) - HALF_EXTENT + 0.5 + of[1 + k] / weight) * side
            rgb[i, k] = np.uint8(min(max(np.rint(of[7 + k] / weight), np.float32(0.0)), np.float32(255.0)))
        a, b, c = of[4] / weight, of[5] / weight, of[6] / weight
        length = np.sqrt(a * a + b * b + c * c)
        if length > 0:
            a, b, c = a / length, b / length, c / length
        normal[i, 0], normal[i, 1], normal[i, 2] = a, b, c
