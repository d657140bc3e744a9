"""The robot's own parts in view: what stays at the same depth wherever the camera is and however it turns."""

import numpy as np

from slamcli.geometry import elementary
from slamcli.geometry.algebra import product

NEAREST_VIEWS = 12  # fewer do not tell
TURN = np.radians(60.0)  # that the views must span: along a corridor, walls keep their depth, too
FARTHEST = 1.0  # [m] of a part of the robot
SAME = 0.02  # of its depth by which a reading of a fixed part changes
SAME_BASE = 0.01  # [m]
SHARE = 0.9  # of the views in which it is there


def fixed_parts(depth: np.ndarray, height: np.ndarray, T_lc: np.ndarray, *, band_low: float) -> np.ndarray:
    """Find the pixels (V, U) that show the robot itself.

    depth : (N, V, U) [m] of views spread over the drive, NaN = none
    height : (N, V, U) [m] of their points above the floor, which a camera on wheels sees at constant depth as well
    T_lc : (N, 4, 4) camera to level frame
    band_low : m, the robot passes over what is lower, whatever it is
    """
    none = np.zeros(depth.shape[1:], dtype=bool)
    if len(depth) < NEAREST_VIEWS or turned(T_lc) < TURN:
        return none
    has = np.isfinite(depth)
    often = has.mean(axis=0) >= SHARE
    if not often.any():
        return none
    middle = np.full(depth.shape[1:], np.nan)
    middle[often] = np.nanmedian(depth[:, often], axis=0)
    with np.errstate(invalid="ignore"):
        is_same = has & (np.abs(depth - middle) <= SAME_BASE + SAME * middle)
        is_above = has & (height > band_low)
    return often & (middle <= FARTHEST) & (is_same.mean(axis=0) >= SHARE) & (is_above.mean(axis=0) >= SHARE)


def turned(T_lc: np.ndarray) -> float:
    """Compute the largest angle [rad] between the first view's direction and another's."""
    ahead = T_lc[:, :3, 2]
    return float(elementary.arccos(np.clip(product(ahead, ahead[0]), -1.0, 1.0)).max())


def to_pixels(blocks: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Spread a mask of blocks (V, U), and of those around each, over the pixels of an image (H, W)."""
    import cv2

    side = shape[0] // blocks.shape[0]
    grown = cv2.dilate(blocks.astype(np.uint8), np.ones((3, 3), np.uint8))
    pixels = np.kron(grown, np.ones((side, side), np.uint8))
    out = np.zeros(shape, dtype=bool)
    out[: pixels.shape[0], : pixels.shape[1]] = pixels[: shape[0], : shape[1]] > 0
    return out
