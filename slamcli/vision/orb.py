"""Evenly spread ORB key points; [Z] 1.1.

A pyramid; on each level FAST corners, with a lower threshold in cells that stay empty; a quadtree that spreads them; orientation by
intensity centroid; rotated BRIEF. E. Rublee et al., ICCV 2011, doi:10.1109/ICCV.2011.6126544
"""

import threading
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from slamcli.config.options import ExtractConfig
from slamcli.errors import SlamError
from slamcli.vision import brief, fast, filters, pyramid, quadtree

MIN_SIDE = 2 * brief.BORDER + 1  # [px] of a level that can hold a key point
MAX_SIDE = 16384  # [px]
DEFAULTS = ExtractConfig()


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
    settings: ExtractConfig = DEFAULTS,
) -> KeyPoints:
    """Find at most `settings.features` key points of a grey image (H, W) uint8, spread over image and levels.

    An image too small for one key point gives none. Raises SlamError where the array is no 8-bit grey image.
    """
    grey = _checked(grey)
    space = _space(grey.shape, settings.levels, settings.scale)
    box = space.box
    if len(box) == 0:
        return no_key_points()
    pyramid.fill(space.levels, grey)
    if settings.smooth:
        filters.blur_1px(space.image, box, space.blurred)
    corners = space.finder.corners(
        space.blurred if settings.smooth else space.image,
        cell=settings.cell,
        threshold=settings.fast_threshold,
        threshold_low=settings.fast_threshold_low,
        at_most=np.array(
            [max(round(settings.pool * settings.features * area / space.area), 1) if settings.pool else 0 for area in space.areas]
        ),
        weak=settings.weak,
        rank_by=settings.rank_by,
    )
    wanted = shares(settings.features, space.areas, np.diff(corners.first).tolist())
    rows, octave = quadtree.choose(corners.xy, corners.response, corners.first, space.roots, wanted)
    xy = corners.xy.take(rows, axis=0)
    angle = brief.orientation(space.image, xy)
    filters.blur_2px(space.image, box, space.blurred)
    return KeyPoints(
        xy=space.full_size(corners.summits(rows) if settings.subpixel else xy.astype(np.float64), octave),
        octave=octave,
        angle=angle,
        response=corners.response.take(rows),
        desc=brief.descriptors(space.blurred, xy, angle),
    )


def no_key_points() -> KeyPoints:
    """Return the result for an image without any."""
    none = np.zeros(0, dtype=np.float32)
    return KeyPoints(xy=none.reshape(0, 2), octave=none.astype(np.uint8), angle=none, response=none, desc=np.zeros((0, 32), np.uint8))


def shares(features: int, areas: list[float], available: list[int]) -> list[int]:
    """Share the wanted number of key points over the levels by area; what a level has too few corners for goes to the others."""
    wanted = [0] * len(areas)
    open_levels = list(range(len(areas)))
    left = features
    while open_levels and left > 0:
        total = sum(areas[level] for level in open_levels)
        short = [level for level in open_levels if available[level] <= left * areas[level] / total]
        if not short:
            bounds = [round(left * reach / total) for reach in accumulate((areas[level] for level in open_levels), initial=0)]
            for level, low, high in zip(open_levels, bounds[:-1], bounds[1:], strict=True):
                wanted[level] = high - low
            break
        for level in short:
            wanted[level] = available[level]
            left -= available[level]
            open_levels.remove(level)
    return wanted


class _Space:
    """The memory in which images of one size are worked on."""

    def __init__(self, box: np.ndarray) -> None:
        """Reserve it for levels that lie so on their canvas; none at all for none."""
        self.box = box
        if len(box):
            self.image, self.blurred = pyramid.canvas(box), pyramid.canvas(box)
            self.levels = pyramid.levels(self.image, box)
            self.finder, self.full_size = fast.Finder(box, border=brief.BORDER), pyramid.FullSize(box)
            top, height, width = box.T
            self.areas = ((height - 2 * brief.BORDER) * (width - 2 * brief.BORDER)).tolist()
            self.area = sum(self.areas)
            sides = [np.full(len(box), brief.BORDER), top + brief.BORDER, width - brief.BORDER, top + height - brief.BORDER]
            self.roots = np.stack(sides, axis=1).astype(np.int32)


_mine = threading.local()


def _space(shape: tuple[int, int], levels: int, scale: float) -> _Space:
    """Return this thread's work space for images of this size: the last one where it fits."""
    key = (*shape, levels, scale)
    if getattr(_mine, "key", None) != key:
        _mine.key, _mine.space = key, _Space(pyramid.boxes(*shape, levels=levels, scale=scale, least=MIN_SIDE))
    return _mine.space


def _checked(grey: np.ndarray) -> np.ndarray:
    if not isinstance(grey, np.ndarray) or grey.ndim != 2 or grey.dtype != np.uint8:
        kind = f"{grey.dtype} array of shape {grey.shape}" if isinstance(grey, np.ndarray) else type(grey).__name__
        raise SlamError(f"key points need an 8-bit grey image (H, W); this is a {kind}: convert it first")
    if max(grey.shape, default=0) > MAX_SIDE:
        raise SlamError(f"key points need an image of at most {MAX_SIDE} px a side; this one is {grey.shape[1]} x {grey.shape[0]}")
    return np.ascontiguousarray(grey)
