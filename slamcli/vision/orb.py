"""Evenly spread ORB key points; [Z] 1.1.

A pyramid; on each level FAST corners, with a lower threshold in cells that stay empty; a quadtree that spreads them; orientation by
intensity centroid; rotated BRIEF. E. Rublee et al., ICCV 2011, doi:10.1109/ICCV.2011.6126544
"""

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.errors import SlamError
from slamcli.vision import brief, fast, filters, quadtree

MIN_SIDE = 2 * brief.BORDER + 1  # [px] of a level that can hold a key point
MAX_SIDE = 16384  # [px]


@dataclass(frozen=True)
class KeyPoints:
    """The key points of one image, ordered by level, row, column."""

    xy: np.ndarray  # (N, 2) float32 [px], raw (distorted) pixels of the full-size image, column then row
    octave: np.ndarray  # (N,) uint8, pyramid level
    angle: np.ndarray  # (N,) float32 [rad] of the intensity centroid, -pi to pi
    response: np.ndarray  # (N,) float32 [grey levels], [Z] (1)
    desc: np.ndarray  # (N, 32) uint8

    def __len__(self) -> int:
        return len(self.xy)


def detect(
    grey: np.ndarray,
    *,
    features: int = 1000,
    levels: int = 8,
    scale: float = 1.2,
    cell: int = 30,
    threshold: int = 8,
    threshold_low: int = 5,
    smooth: bool = True,
    pool: float = 1.3,
    rank_by: str = "fast",
    subpixel: bool = True,
) -> KeyPoints:
    """Find at most `features` key points of a grey image (H, W) uint8, spread over image and levels.

    levels, scale : of the pyramid; cell [px] : side of the cells in which FAST falls back from `threshold` to `threshold_low` [grey levels]
    smooth : seek corners in a slightly blurred copy; pool : corners kept for each key point wanted, 0 : all; rank_by : see `fast.corners`
    subpixel : move each point to the summit of the FAST score around it
    An image too small for one key point gives none. Raises SlamError where the array is no 8-bit grey image.
    """
    grey = _checked(grey)
    images = pyramid(grey, levels=levels, scale=scale)
    areas = [_usable_area(image) for image in images]
    corners = [
        fast.corners(
            filters.blur_1px(image) if smooth else image,
            border=brief.BORDER,
            cell=cell,
            threshold=threshold,
            threshold_low=threshold_low,
            at_most=round(pool * features * area / sum(areas)),
            rank_by=rank_by,
        )
        for image, area in zip(images, areas, strict=True)
    ]
    wanted = shares(features, areas, [len(level.xy) for level in corners])
    found = []
    for octave, (image, level, n) in enumerate(zip(images, corners, wanted, strict=True)):
        usable = (brief.BORDER, brief.BORDER, image.shape[1] - brief.BORDER, image.shape[0] - brief.BORDER)
        rows = quadtree.choose(level.xy, level.response, usable, n)
        if len(rows) == 0:
            continue
        xy = level.xy[rows]
        angle = brief.orientation(image, xy)
        desc = brief.descriptors(filters.blur_2px(image), xy, angle)
        place = full_size(level.summits(rows) if subpixel else xy, image, grey)
        found.append((place, np.full(len(xy), octave, np.uint8), angle, level.response[rows], desc))
    return KeyPoints(*(np.concatenate(column) for column in zip(*found, strict=True))) if found else no_key_points()


def no_key_points() -> KeyPoints:
    """Give the result for an image without any."""
    none = np.zeros(0, dtype=np.float32)
    return KeyPoints(xy=none.reshape(0, 2), octave=none.astype(np.uint8), angle=none, response=none, desc=np.zeros((0, 32), np.uint8))


def pyramid(grey: np.ndarray, *, levels: int, scale: float) -> list[np.ndarray]:
    """Give the image and its copies, each smaller by `scale`, down to the last that can hold a key point."""
    images = [grey] if min(grey.shape) >= MIN_SIDE else []
    for level in range(1, levels):
        width, height = (round(side / scale**level) for side in (grey.shape[1], grey.shape[0]))
        if min(width, height) < MIN_SIDE:
            break
        images.append(cv2.resize(images[-1], (width, height), interpolation=cv2.INTER_LINEAR_EXACT))
    return images


def full_size(xy: np.ndarray, image: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Map pixels of a level to pixels of the full-size image, float32.

    Resizing keeps the outer edges of the corner pixels in place, not their centres: leaving the half pixel out, as cv2.ORB does, would
    shift the points of level 7 by 1.3 px against those of level 0.
    """
    ratio = np.array([grey.shape[1] / image.shape[1], grey.shape[0] / image.shape[0]])
    return ((xy + 0.5) * ratio - 0.5).astype(np.float32)


def shares(features: int, areas: list[float], available: list[int]) -> list[int]:
    """Share the wanted number of key points over the levels by area; what a level has too few corners for goes to the others."""
    wanted = [0] * len(areas)
    open_levels = list(range(len(areas)))
    left = features
    while open_levels and left > 0:
        total = sum(areas[level] for level in open_levels)
        short = [level for level in open_levels if available[level] <= left * areas[level] / total]
        if not short:
            bounds = np.rint(left * np.cumsum([0] + [areas[level] for level in open_levels]) / total).astype(int)
            for level, share in zip(open_levels, np.diff(bounds), strict=True):
                wanted[level] = int(share)
            break
        for level in short:
            wanted[level] = available[level]
            left -= available[level]
            open_levels.remove(level)
    return wanted


def _usable_area(image: np.ndarray) -> int:
    return (image.shape[0] - 2 * brief.BORDER) * (image.shape[1] - 2 * brief.BORDER)


def _checked(grey: np.ndarray) -> np.ndarray:
    if not isinstance(grey, np.ndarray) or grey.ndim != 2 or grey.dtype != np.uint8:
        kind = f"{grey.dtype} array of shape {grey.shape}" if isinstance(grey, np.ndarray) else type(grey).__name__
        raise SlamError(f"key points need an 8-bit grey image (H, W); this is a {kind}: convert it first")
    if max(grey.shape, default=0) > MAX_SIDE:
        raise SlamError(f"key points need an image of at most {MAX_SIDE} px a side; this one is {grey.shape[1]} x {grey.shape[0]}")
    return np.ascontiguousarray(grey)
