"""The time stamps of a recording: rates, gaps, how colour and depth meet, and whether the file names agree."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from slamcli.datasets import Dataset
from slamcli.datasets.association import MAX_DIFFERENCE

NAME_TOLERANCE = 2e-3  # [s] between a stamp and the one in the file's name: names round
GAP_PERIODS = 8.0  # a pause this many times as long as usual is a gap,
GAP_SECONDS = 0.5  # but nothing shorter than this
OFFSET_EDGES = np.linspace(-MAX_DIFFERENCE, MAX_DIFFERENCE, 9)  # [s]


@dataclass(frozen=True)
class StampTiming:
    """What the stamps say."""

    duration: float  # [s]
    rate: float  # [Hz] of colour, from the median period
    gaps: list[tuple[float, float]]  # (start since the first frame, length) [s] without colour images
    depth_gaps: list[tuple[float, float]]  # without paired depth images
    n_with_depth: int
    offset_median: float  # [s] absolute, depth minus colour
    offset_p95: float
    offset_histogram: list[tuple[float, float, int]]  # (from, to, frames) [s]
    misnamed: list[int]  # frames whose stamp is not that in the file's name, beyond what all have in common
    depth_names_offset: float | None  # [s] by which depth stamps are later than the file names say


def judge(dataset: Dataset) -> StampTiming:
    """Judge the stamps of a recording."""
    stamp, depth_stamp = dataset.stamp, dataset.depth_stamp
    has_depth = np.isfinite(depth_stamp)
    offset = (depth_stamp - stamp)[has_depth]
    histogram, _ = np.histogram(offset, OFFSET_EDGES)
    period = float(np.median(np.diff(stamp))) if len(stamp) > 1 else 0.0
    colour_misnamed, _ = _compare_names(stamp, dataset.colour_name)
    depth_misnamed, depth_offset = _compare_names(depth_stamp, dataset.depth_name)
    return StampTiming(
        duration=float(stamp[-1] - stamp[0]),
        rate=1.0 / period if period > 0 else 0.0,
        gaps=_gaps(stamp, stamp[0]),
        depth_gaps=_gaps(stamp[has_depth], stamp[0]),
        n_with_depth=int(has_depth.sum()),
        offset_median=float(np.median(np.abs(offset))) if len(offset) else float("nan"),
        offset_p95=float(np.percentile(np.abs(offset), 95)) if len(offset) else float("nan"),
        offset_histogram=[(float(a), float(b), int(n)) for a, b, n in zip(OFFSET_EDGES[:-1], OFFSET_EDGES[1:], histogram, strict=True)],
        misnamed=sorted(set(colour_misnamed) | set(depth_misnamed)),
        depth_names_offset=depth_offset,
    )


def _gaps(stamp: np.ndarray, start: float) -> list[tuple[float, float]]:
    if len(stamp) < 3:
        return []
    pause = np.diff(stamp)
    is_gap = pause > max(GAP_SECONDS, GAP_PERIODS * float(np.median(pause)))
    return [(float(stamp[k] - start), float(pause[k])) for k in np.flatnonzero(is_gap)]


def _compare_names(stamp: np.ndarray, paths: Sequence[str]) -> tuple[list[int], float | None]:
    """Compare stamps with file names that are stamps themselves: (frames that stand out, offset all others share)."""
    rows, difference = [], []
    for i, path in enumerate(paths):
        try:
            named = float(PurePosixPath(path.replace("\\", "/")).stem)
        except ValueError:
            continue
        if np.isfinite(stamp[i]):
            rows.append(i)
            difference.append(stamp[i] - named)
    if len(rows) < 0.5 * np.isfinite(stamp).sum() or not rows:
        return [], None
    shared = float(np.median(difference))
    if abs(shared) > 1.0 or np.mean(np.abs(np.array(difference) - shared) < NAME_TOLERANCE) < 0.5:
        return [], None  # the names are numbers of another kind, such as frame numbers
    stands_out = np.abs(np.array(difference) - shared) >= NAME_TOLERANCE
    return [rows[k] for k in np.flatnonzero(stands_out)], shared
