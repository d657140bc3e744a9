"""Optical flow: where a key point went in the next image, whatever its descriptor says.

J.-Y. Bouguet, Pyramidal implementation of the Lucas Kanade feature tracker, 2000, by OpenCV; what does not come back is dropped (Z. Kalal,
K. Mikolajczyk, J. Matas, Forward-backward error, ICPR 2010, doi:10.1109/ICPR.2010.675).
"""

import cv2
import numpy as np

WINDOW = (15, 15)  # px
LEVELS = 4  # above the image itself, each half as large: motions of some hundred pixels
RETURN_PX = 1.0  # from its start, within which a point that is followed back must arrive


def follow(grey: np.ndarray, following: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Follow points xy (N, 2) [px, raw] of an image (H, W) uint8 into the following one; (N, 2) float32, NaN where they are lost."""
    start = np.ascontiguousarray(xy, dtype=np.float32)
    if len(start) == 0:
        return start.reshape(0, 2)
    there, is_found = _track(grey, following, start)
    back, is_back = _track(following, grey, there)
    height, width = following.shape
    is_inside = ((there >= 0) & (there <= [width - 1, height - 1])).all(axis=1)
    is_kept = is_found & is_back & is_inside & (np.linalg.norm(back - start, axis=1) < RETURN_PX)
    return np.where(is_kept[:, None], there, np.float32(np.nan))


def _track(grey: np.ndarray, following: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Follow points by Lucas and Kanade's method in a pyramid; returns where they went and which were found."""
    there, status, _ = cv2.calcOpticalFlowPyrLK(grey, following, xy, np.empty_like(xy), winSize=WINDOW, maxLevel=LEVELS)
    return there, status[:, 0] > 0


def match(xy_i: np.ndarray, flowed_j: np.ndarray, *, is_free_i: np.ndarray, is_free_j: np.ndarray, radius: float) -> np.ndarray:
    """Match key points to those whose flow ends beside them: each the other's nearest, within `radius` [px].

    xy_i : (N, 2) key points of a frame; flowed_j : (M, 2) where those of the frame before went, NaN = lost; is_free : may be matched
    Returns rows (P, 2) of i and j, increasing in i.
    """
    from scipy.spatial import cKDTree  # takes as long to load as the stage that seldom needs it

    free_i, free_j = np.flatnonzero(is_free_i), np.flatnonzero(is_free_j & np.isfinite(flowed_j).all(axis=1))
    if len(free_i) == 0 or len(free_j) == 0:
        return np.empty((0, 2), dtype=np.int32)
    here, there = xy_i[free_i], flowed_j[free_j]
    distance, nearest = cKDTree(here).query(there, distance_upper_bound=radius)
    nearest_j = cKDTree(there).query(here)[1]
    j = np.flatnonzero(np.isfinite(distance))
    j = j[nearest_j[nearest[j]] == j]
    rows = np.stack([free_i[nearest[j]], free_j[j]], axis=1).astype(np.int32)
    return rows[np.argsort(rows[:, 0], kind="stable")]
