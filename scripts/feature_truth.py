"""What the true trajectory says about features: where a pixel of one frame appears in another, and which frames see the same place.

A motion capture system sees a camera's place well and its direction less so: that of the TUM recordings turns by 0.2 to 0.4 degrees from frame
to frame, 2 to 4 px, which is all that a feature may be off. So between two frames it is only where to start: pixels on a grid, whatever
is there, are followed from one image into the other, and the motion is that which explains where they went.
"""

from functools import lru_cache, partial

import cv2
import numpy as np
from scipy.spatial import cKDTree

from slamcli.datasets import open_dataset
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera

LONGEST_GAP = 0.1  # [s] between true poses across which a pose is interpolated
SAME_STAMP = 0.002  # [s]
HIDDEN_SHARE, HIDDEN_BY = 0.05, 0.02  # a point is hidden where the depth read is nearer by this share and this many metres
FOLLOWED = 10  # [px] between the pixels whose way from image to image tells how the camera moved
WINDOW, LEVELS = (21, 21), 2  # [px] that are followed, and above the image itself the levels, each half as large
RETURN_PX = 0.5  # from its start, within which a pixel that is followed back arrives
AGREEMENT_PX = 2.0  # of a pixel with the motion
LEAST_FOLLOWED = 100  # pixels that agree: fewer, and the true trajectory has the last word
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


def pixel_grid(camera: Camera, spacing: int) -> np.ndarray:
    """Return pixels (N, 2) all over the image, this many apart."""
    columns, rows = np.meshgrid(np.arange(spacing // 2, camera.width, spacing), np.arange(spacing // 2, camera.height, spacing))
    return np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)


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
        self.is_exact = (self.dataset.root / "scene.json").exists()  # a simulated recording, which knows its path
        self._motion = lru_cache(maxsize=None)(self.motion)

    def pairs(self, *, apart: int, wanted: int) -> list[tuple[int, int]]:
        """Return up to `wanted` pairs of frames (i, i + apart), spread over the recording."""
        first = np.arange(len(self.dataset) - apart)
        first = first[self.is_usable[first] & self.is_usable[first + apart]]
        chosen = first[np.linspace(0, len(first) - 1, min(wanted, len(first))).astype(int)]
        return [(int(i), int(i) + apart) for i in chosen]

    def motion(self, i: int, j: int) -> np.ndarray:
        """Return the pose (4, 4) of camera i in camera j: of all motions near the true trajectory's that which the images show."""
        T_ji = se3.inverse(self.T_wc[j]) @ self.T_wc[i]
        raw = pixel_grid(self.camera, FOLLOWED)
        raw = raw[np.isfinite(self.seen_from(raw, i, j, T_ji)[:, 0])]
        if self.is_exact or len(raw) < LEAST_FOLLOWED:
            return T_ji
        guess = self.camera.distort(self.seen_from(raw, i, j, T_ji))
        start, guess = raw.astype(np.float32), guess.astype(np.float32)
        follow = partial(cv2.calcOpticalFlowPyrLK, winSize=WINDOW, maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        there, is_found, _ = follow(self.grey(i), self.grey(j), start, guess.copy())
        back, is_back, _ = follow(self.grey(j), self.grey(i), there, start.copy())
        is_kept = (is_found[:, 0] > 0) & (is_back[:, 0] > 0) & (np.linalg.norm(back - start, axis=1) < RETURN_PX)
        if is_kept.sum() < LEAST_FOLLOWED:
            return T_ji
        x_i, seen = self.lift(raw[is_kept], i), self.camera.undistort(there[is_kept])
        turn, shift = cv2.Rodrigues(T_ji[:3, :3])[0], T_ji[:3, 3:].copy()
        cv2.setRNGSeed(0)
        _, turn, shift, agreeing = cv2.solvePnPRansac(
            x_i, seen, self.camera.K, None, turn, shift, useExtrinsicGuess=True, iterationsCount=200, reprojectionError=AGREEMENT_PX
        )
        if agreeing is None or len(agreeing) < LEAST_FOLLOWED:
            return T_ji
        agreeing = agreeing[:, 0]
        turn, shift = cv2.solvePnPRefineLM(x_i[agreeing], seen[agreeing], self.camera.K, None, turn, shift)
        T_ji[:3, :3], T_ji[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        return T_ji

    def lift(self, raw: np.ndarray, i: int) -> np.ndarray:
        """Return the points (N, 3) that raw pixels (N, 2) of frame i show, in its camera; NaN where there is no depth."""
        column, row = np.rint(raw).astype(int).T
        return self.camera.backproject(self.camera.undistort(raw), self.depth(i)[row, column])

    def carry(self, raw: np.ndarray, i: int, j: int) -> np.ndarray:
        """Return where raw pixels (N, 2) of frame i appear in frame j, undistorted (N, 2) [px]; NaN: no depth, out of view, or hidden."""
        return self.seen_from(raw, i, j, self._motion(i, j) if i < j else se3.inverse(self._motion(j, i)))

    def seen_from(self, raw: np.ndarray, i: int, j: int, T_ji: np.ndarray) -> np.ndarray:
        """Do as `carry` under the motion `T_ji`."""
        x_j = se3.transform(T_ji, self.lift(raw, i))
        x_j[~(x_j[:, 2] > 0.1)] = np.nan
        seen = self.camera.project(x_j)
        pixel = np.rint(np.nan_to_num(self.camera.distort(seen), nan=-1.0)).astype(int)
        is_inside = (pixel >= 0).all(axis=1) & (pixel < [self.camera.width, self.camera.height]).all(axis=1)
        measured = np.full(len(raw), np.nan)
        measured[is_inside] = self.depth(j)[pixel[is_inside, 1], pixel[is_inside, 0]]
        seen[~is_inside | (measured < x_j[:, 2] * (1 - HIDDEN_SHARE) - HIDDEN_BY)] = np.nan
        return seen

    def shared_view(self, i: int, j: int) -> float:
        """Return the share of frame i's pixels with depth that frame j sees too."""
        raw = pixel_grid(self.camera, GRID)
        raw = raw[np.isfinite(self.lift(raw, i)[:, 2])]
        if len(raw) == 0:
            return 0.0
        return float(np.isfinite(self.seen_from(raw, i, j, se3.inverse(self.T_wc[j]) @ self.T_wc[i])[:, 0]).mean())

    def key_frames(self, *, least_shared: float) -> np.ndarray:
        """Choose frames so that each shares less than this with the one before."""
        chosen: list[int] = []
        for i in np.flatnonzero(self.is_usable):
            if not chosen or self.shared_view(int(i), chosen[-1]) < least_shared:
                chosen.append(int(i))
        return np.array(chosen)
