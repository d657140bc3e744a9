"""The image pyramid, all levels on one canvas: each step of extraction is one call of a kernel for the whole image, not one for each level."""

from itertools import pairwise

import cv2
import numpy as np

TOP, HEIGHT, WIDTH = range(3)  # columns of a box: where a level lies on the canvas [px]; its first column is the canvas's
ALIGNMENT = 8  # [px] that a kernel reads as one number: the canvas is as wide as a whole number of these


def boxes(height: int, width: int, *, levels: int, scale: float, least: int) -> np.ndarray:
    """Lay out an image and its copies, each smaller by `scale`, down to the last whose sides are at least `least` px.

    Returns (levels, 3) int64: TOP, HEIGHT, WIDTH of each, one beneath the other; no row where the image itself is too small
    """
    rows, top = [], 0
    for level in range(levels):
        h, w = (round(side / scale**level) for side in (height, width))
        if min(h, w) < least:
            break
        rows.append((top, h, w))
        top += h
    return np.array(rows, dtype=np.int64).reshape(-1, 3)


def canvas(box: np.ndarray) -> np.ndarray:
    """Reserve a canvas (H, W) uint8 for levels that lie so; its content is arbitrary."""
    return np.empty((box[-1, TOP] + box[-1, HEIGHT], -(-box[:, WIDTH].max() // ALIGNMENT) * ALIGNMENT), dtype=np.uint8)


def levels(image: np.ndarray, box: np.ndarray) -> list[np.ndarray]:
    """Return the levels of a canvas, views."""
    return [image[top : top + height, :width] for top, height, width in box.tolist()]


def fill(images: list[np.ndarray], grey: np.ndarray) -> None:
    """Write the pyramid of a grey image into the levels of a canvas, each made from the one before."""
    images[0][:] = grey
    for larger, smaller in pairwise(images):
        cv2.resize(larger, smaller.shape[::-1], dst=smaller, interpolation=cv2.INTER_LINEAR_EXACT)


class FullSize:
    """Maps places on a canvas to the full-size image.

    Resizing keeps the outer edges of the corner pixels in place, not their centres: leaving the half pixel out, as cv2.ORB does, would
    shift the points of level 7 by 1.3 px against those of level 0.
    """

    def __init__(self, box: np.ndarray) -> None:
        """Take the boxes of the levels, (levels, 3) int64."""
        self._first, self._ratio = np.zeros((len(box), 2)), box[:1, [WIDTH, HEIGHT]] / box[:, [WIDTH, HEIGHT]]
        self._first[:, 1] = box[:, TOP]

    def __call__(self, place: np.ndarray, octave: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) float32 of places (N, 2) float64 [px] of levels octave (N,) uint8."""
        out = place - self._first.take(octave, axis=0)  # take: the index in brackets is six times slower
        out += 0.5
        out *= self._ratio.take(octave, axis=0)
        out -= 0.5
        return out.astype(np.float32)
