"""Plain OpenCV ORB beside ours: how evenly key points are spread; [Z] Fig. 3."""

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.vision.orb import KeyPoints

CELL = 30  # [px] side of the cells in which points are counted


@dataclass(frozen=True)
class Evenness:
    """How points are spread over an image."""

    share: float  # of the cells that hold a point; more is more even
    ratio: float  # variance to mean of the counts per cell: 1 for points strewn at random, more for bunches; NaN without points


def evenness(xy: np.ndarray, width: int, height: int, *, cell: int = CELL) -> Evenness:
    """Count points xy (N, 2) [px] in the whole cells of an image."""
    n_columns, n_rows = width // cell, height // cell
    column, row = np.floor((np.asarray(xy).reshape(-1, 2) + 0.5) / cell).astype(np.int64).T  # the pixel's edge, not its centre
    inside = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
    count = np.bincount(row[inside] * n_columns + column[inside], minlength=n_columns * n_rows)
    mean = count.mean() if count.size else 0.0
    return Evenness(share=float((count > 0).mean()) if count.size else 0.0, ratio=float(count.var() / mean) if mean > 0 else float("nan"))


def plain_orb(grey: np.ndarray, features: int = 1000) -> KeyPoints:
    """Return the key points of OpenCV's ORB at its own settings."""
    points, desc = cv2.ORB.create(features).detectAndCompute(grey, None)
    return KeyPoints(
        xy=np.array([p.pt for p in points], dtype=np.float32).reshape(-1, 2),
        octave=np.array([p.octave for p in points], dtype=np.uint8),
        angle=np.deg2rad(np.array([p.angle for p in points], dtype=np.float32)),
        response=np.array([p.response for p in points], dtype=np.float32),
        desc=np.zeros((0, 32), dtype=np.uint8) if desc is None else desc,
    )


def draw(grey: np.ndarray, points: KeyPoints, title: str, *, scale: float = 1.2) -> np.ndarray:
    """Draw key points as circles of the size of their level with a stroke in their direction, (H + 28, W, 3) uint8 BGR."""
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    for (x, y), octave, angle in zip(points.xy, points.octave, points.angle, strict=True):
        radius = 2.5 * scale ** float(octave)
        centre, tip = (int(x * 16), int(y * 16)), (int((x + radius * np.cos(angle)) * 16), int((y + radius * np.sin(angle)) * 16))
        cv2.circle(picture, centre, int(radius * 16), (60, 220, 60), 1, cv2.LINE_AA, shift=4)
        cv2.line(picture, centre, tip, (60, 220, 60), 1, cv2.LINE_AA, shift=4)
    strip = np.full((28, grey.shape[1], 3), 255, dtype=np.uint8)
    cv2.putText(strip, title, (8, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([strip, picture])


def side_by_side(grey: np.ndarray, plain: KeyPoints, ours: KeyPoints, *, scale: float = 1.2) -> np.ndarray:
    """Draw the paper's Fig. 3 with the figures of evenness, BGR."""
    pictures = []
    for name, points in (("OpenCV ORB", plain), ("slamcli", ours)):
        even = evenness(points.xy, grey.shape[1], grey.shape[0])
        title = f"{name}: {len(points)} points in {even.share:.0%} of the {CELL} px cells, variance / mean {even.ratio:.1f}"
        pictures.append(draw(grey, points, title, scale=scale))
    gap = np.full((pictures[0].shape[0], 8, 3), 255, dtype=np.uint8)
    return np.concatenate([pictures[0], gap, pictures[1]], axis=1)
