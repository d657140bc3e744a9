"""What the true trajectory says about features: where a pixel of one frame appears in another, and which frames see the same place."""

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from slamcli.datasets import open_dataset
from slamcli.errors import SlamError
from slamcli.geometry import se3

LONGEST_GAP = 0.1  # [s] between true poses across which a pose is interpolated
SAME_STAMP = 0.002  # [s]
HIDDEN_SHARE, HIDDEN_BY = 0.05, 0.02  # a point is hidden where the depth read is nearer by this share and this many metres
GRID = 16  # [px] between the pixels that are carried over to tell how much of a view two frames share


def pairs_within(a: np.ndarray, b: np.ndarray, radius: float, octave_a: np.ndarray, octave_b: np.ndarray, *, octaves: float) -> int:
    """Count pairs of points a (N, 2) and b (M, 2) within `radius` whose octaves differ by at most `octaves`.

    Each point is in one pair at most; the nearest pair comes first, of equals that with the lower rows.
    """
    near = cKDTree(a).sparse_distance_matrix(cKDTree(b), radius, output_type="coo_matrix")
    is_alike = np.abs(octave_a.astype(int)[near.row] - octave_b.astype(int)[near.col]) <= octaves
    row, column, distance = near.row[is_alike], near.col[is_alike], near.data[is_alike]
    free_a, free_b, n = np.ones(len(a), dtype=bool), np.ones(len(b), dtype=bool), 0
    for k in np.lexsort((column, row, distance)):
        if free_a[row[k]] and free_b[column[k]]:
            free_a[row[k]] = free_b[column[k]] = False
            n += 1
    return n


class Recording:
    """A recording with its true camera pose at every colour stamp, NaN where it is not known."""

    def __init__(self, target: str, *, data: str | None = None) -> None:
        self.dataset = open_dataset(target, data=data)
        self.camera = self.dataset.camera
        truth = self.dataset.ground_truth()
        if truth is None:
            raise SlamError(f"{target}: has no true trajectory (groundtruth.txt), which these figures need")
        after = np.clip(np.searchsorted(truth.stamp, self.dataset.stamp), 1, len(truth.stamp) - 1)
        gap = truth.stamp[after] - truth.stamp[after - 1]
        alpha = (self.dataset.stamp - truth.stamp[after - 1]) / gap
        self.T_wc = se3.interpolate(truth.T_wc[after - 1], truth.T_wc[after], alpha)
        nearest = np.minimum(np.abs(alpha), np.abs(1 - alpha)) * gap
        self.T_wc[((alpha < 0) | (alpha > 1) | (gap > LONGEST_GAP)) & (nearest > SAME_STAMP)] = np.nan
        self.is_usable = np.isfinite(self.T_wc[:, 0, 0]) & np.isfinite(self.dataset.depth_stamp)
        self.grey = lru_cache(maxsize=None)(self.dataset.grey)
        self.depth = lru_cache(maxsize=None)(self.dataset.depth)

    def pairs(self, *, apart: int, wanted: int) -> list[tuple[int, int]]:
        """Give up to `wanted` pairs of frames (i, i + apart), spread over the recording."""
        first = np.arange(len(self.dataset) - apart)
        first = first[self.is_usable[first] & self.is_usable[first + apart]]
        chosen = first[np.linspace(0, len(first) - 1, min(wanted, len(first))).astype(int)]
        return [(int(i), int(i) + apart) for i in chosen]

    def carry(self, raw: np.ndarray, i: int, j: int) -> np.ndarray:
        """Give where raw pixels (N, 2) of frame i appear in frame j, undistorted (N, 2) [px]; NaN: no depth, out of view, or hidden."""
        column, row = np.rint(raw).astype(int).T
        x_i = self.camera.backproject(self.camera.undistort(raw), self.depth(i)[row, column])
        x_j = se3.transform(se3.inverse(self.T_wc[j]) @ self.T_wc[i], x_i)
        x_j[~(x_j[:, 2] > 0.1)] = np.nan
        seen = self.camera.project(x_j)
        pixel = np.rint(np.nan_to_num(self.camera.distort(seen), nan=-1.0)).astype(int)
        is_inside = (pixel >= 0).all(axis=1) & (pixel < [self.camera.width, self.camera.height]).all(axis=1)
        measured = np.full(len(raw), np.nan)
        measured[is_inside] = self.depth(j)[pixel[is_inside, 1], pixel[is_inside, 0]]
        seen[~is_inside | (measured < x_j[:, 2] * (1 - HIDDEN_SHARE) - HIDDEN_BY)] = np.nan
        return seen

    def shared_view(self, i: int, j: int) -> float:
        """Give the share of frame i's pixels with depth that frame j sees too."""
        raw = np.stack(np.meshgrid(np.arange(GRID // 2, self.camera.width, GRID), np.arange(GRID // 2, self.camera.height, GRID)), axis=-1)
        raw = raw.reshape(-1, 2).astype(np.float64)
        raw = raw[np.isfinite(self.depth(i)[raw[:, 1].astype(int), raw[:, 0].astype(int)])]
        return float(np.isfinite(self.carry(raw, i, j)[:, 0]).mean()) if len(raw) else 0.0

    def key_frames(self, *, least_shared: float) -> np.ndarray:
        """Choose frames so that each shares less than this with the one before."""
        chosen: list[int] = []
        for i in np.flatnonzero(self.is_usable):
            if not chosen or self.shared_view(int(i), chosen[-1]) < least_shared:
                chosen.append(int(i))
        return np.array(chosen)
