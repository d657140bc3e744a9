"""One look at every image of a recording: exposure, blur, texture, depth readings, and whether the pictures follow one another."""

import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slamcli.datasets import Dataset, depth_unit
from slamcli.errors import BadFrame
from slamcli.geometry.camera import DEPTH_VALUES
from slamcli.parallel import ordered_map
from slamcli.slam import stream_doubt

THUMBNAIL = (32, 24)  # px, width and height of the small pictures that are compared with one another
SATURATED = 250  # grey level from which a pixel counts as burnt out
FAST_THRESHOLD = 20  # grey levels
BLUR_SPAN = 9 / 640  # of the picture's width; of the filter that blur is judged with
LINE_STEP = 4  # every fourth row and column is enough to judge a whole picture
STRANGER = 1.7  # times the difference between its neighbours: in an even motion the ratio is 0.5
SWAPPED = 0.75  # of the difference as listed: in an even motion the ratio is 2, after a swap 0.5
JUMP = 5.0  # times the largest difference nearby

Progress = Callable[..., Iterable]


@dataclass(frozen=True)
class Pictures:
    """What was seen. `F` frames; NaN where an image cannot be read or, in the depth columns, where there is none."""

    mean_grey: np.ndarray  # (F,) grey levels
    saturated: np.ndarray  # (F,) share of the pixels
    blur: np.ndarray  # (F,) 0 sharp .. 1
    corners: np.ndarray  # (F,) FAST corners per 640 x 480 px
    thumbnail: np.ndarray  # (F, 24, 32) float32 grey levels
    picture_sum: np.ndarray  # (F,) int64 check sum of the picture, -1 = blank or none
    holes: np.ndarray  # (F,) share of the pixels without depth
    depth_thumbnail: np.ndarray  # (F, 24, 32) float32 [1/m]
    depth_sum: np.ndarray  # (F,) int64 check sum of the depth image, -1 = empty, of one distance, or none
    readings: np.ndarray  # (F,) Readings, or None
    never_seen: float  # share of the pixels that have no depth in any frame
    depth_counts: np.ndarray  # (65536,) readings of each raw value
    errors: list[str]  # of the images that cannot be used


def look(dataset: Dataset, *, workers: int, progress: Progress, frames: Sequence[int] | None = None) -> Pictures:
    """Decode every image once, or those of some frames; rows are then of these alone."""
    chosen = range(len(dataset)) if frames is None else frames
    rows: list[dict[str, Any]] = []
    errors: list[str] = []
    has_seen = np.zeros((dataset.camera.height, dataset.camera.width), dtype=bool)
    counts = np.zeros(DEPTH_VALUES, dtype=np.int64)
    found = ordered_map(lambda i: _frame(dataset, i), chosen, workers=workers)
    for row, seen, frame_counts, frame_errors in progress(found, "inspect", total=len(chosen)):
        rows.append(row)
        errors += frame_errors
        if seen is not None:
            has_seen |= seen
            counts += frame_counts
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return Pictures(**columns, never_seen=float(1.0 - has_seen.mean()), depth_counts=counts, errors=errors)


def _frame(dataset: Dataset, i: int) -> tuple[dict[str, Any], np.ndarray | None, np.ndarray | None, list[str]]:
    errors = []
    row: dict[str, Any] = dict.fromkeys(("mean_grey", "saturated", "blur", "corners", "holes"), np.nan)
    row |= {"picture_sum": -1, "depth_sum": -1, "readings": None}
    row["thumbnail"] = row["depth_thumbnail"] = np.full(THUMBNAIL[::-1], np.nan, dtype=np.float32)
    try:
        row.update(_judge_grey(dataset.grey(i)))
    except BadFrame as error:
        errors.append(str(error))
    try:
        depth = dataset.depth(i)
    except BadFrame as error:
        errors.append(str(error))
        depth = None
    if depth is None:
        return row, None, None, errors
    seen = np.isfinite(depth)
    row["holes"] = float(1.0 - seen.mean())
    row["depth_thumbnail"] = _inverse_depth_thumbnail(depth, seen)
    row["readings"] = readings = stream_doubt.look(depth)
    if readings.spread > stream_doubt.ONE_DISTANCE:
        row["depth_sum"] = zlib.crc32(depth.tobytes())
    counts = depth_unit.counted_metres(depth, depth_unit.counting_scale(dataset.camera.depth_scale))
    return row, seen, counts, errors


def _judge_grey(grey: np.ndarray) -> dict[str, Any]:
    corners = cv2.FastFeatureDetector.create(FAST_THRESHOLD).detect(grey)
    return {
        "mean_grey": float(grey.mean()),
        "saturated": float((grey >= SATURATED).mean()),
        "blur": blur_effect(grey),
        "corners": len(corners) * 640 * 480 / grey.size,
        "picture_sum": zlib.crc32(grey.tobytes()) if int(grey.max()) > int(grey.min()) else -1,
        "thumbnail": cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32),
    }


def blur_effect(grey: np.ndarray) -> float:
    """Judge blur from 0 (sharp) to 1 by how little a picture changes when it is blurred, in its worse direction; NaN when it is blank.

    F. Crete et al., The blur effect: perception and estimation with a new no-reference perceptual blur metric, SPIE 2007,
    doi:10.1117/12.702790
    """
    worst, span = 0.0, max(3, round(BLUR_SPAN * grey.shape[1]) | 1)
    for lines in (grey[::LINE_STEP], np.ascontiguousarray(grey.T[::LINE_STEP])):
        sharp = lines.astype(np.float32)
        change = np.abs(np.diff(sharp, axis=1))
        change_blurred = np.abs(np.diff(cv2.blur(sharp, (span, 1)), axis=1))
        total = float(change.sum())
        if total == 0.0:
            return float("nan")
        worst = max(worst, 1.0 - float(np.maximum(change - change_blurred, 0.0).sum()) / total)
    return worst


def _inverse_depth_thumbnail(depth: np.ndarray, seen: np.ndarray) -> np.ndarray:
    inverse = np.where(seen, 1.0 / np.maximum(depth, np.float32(1e-3)), 0.0).astype(np.float32)
    weight = cv2.resize(seen.astype(np.float32), THUMBNAIL, interpolation=cv2.INTER_AREA)
    total = cv2.resize(inverse, THUMBNAIL, interpolation=cv2.INTER_AREA)
    return np.where(weight > 0.2, total / np.maximum(weight, np.float32(0.2)), np.float32(np.nan)).astype(np.float32)


def misplaced(thumbnail: np.ndarray, stamp: np.ndarray) -> np.ndarray:
    """Find frames that do not follow from their neighbours, such as those whose stamps were swapped.

    thumbnail : (F, h, w) NaN = nothing there; stamp : (F,) [s], increasing
    Returns frame numbers, increasing. Three patterns count: a frame unlike both neighbours while these are alike; two neighbouring
    frames that would follow better the other way round; a jump of the picture where time has none.
    """
    step, skip = _difference(thumbnail, 1), _difference(thumbnail, 2)
    if len(stamp) < 8 or not np.isfinite(step).any():
        return np.empty(0, dtype=np.int64)
    floor, typical = np.nanpercentile(step, [5, 50])
    clear = max(3 * float(floor), float(typical), 1e-9)  # while the camera rests there is only noise, and order cannot be told
    is_regular = np.diff(stamp) < 1.8 * float(np.median(np.diff(stamp)))
    found: set[int] = set()
    for k in range(1, len(stamp) - 1):
        if is_regular[k - 1 : k + 1].all() and min(step[k - 1], step[k]) > max(STRANGER * skip[k - 1], clear):
            found.add(k)
    for k in range(1, len(stamp) - 2):
        as_is, other_way = step[k - 1] + step[k + 1], skip[k - 1] + skip[k]
        if is_regular[k - 1 : k + 2].all() and as_is > 2 * clear and other_way < SWAPPED * as_is:
            found.update((k, k + 1))
    for k in range(2, len(stamp) - 3):
        around = max(step[k - 2 : k].max(), step[k + 1 : k + 3].max())
        if is_regular[k - 2 : k + 3].all() and step[k] > JUMP * max(around, 0.67 * clear):
            found.update((k, k + 1))
    return np.array(sorted(found), dtype=np.int64)


def _difference(thumbnail: np.ndarray, distance: int) -> np.ndarray:
    """Return the mean absolute difference of pictures `distance` apart, (F - distance,), brightness taken out; NaN where one is missing."""
    a, b = thumbnail[:-distance], thumbnail[distance:]
    difference = b - a
    is_valid = np.isfinite(difference)
    n = is_valid.sum(axis=(1, 2))
    difference = np.where(is_valid, difference, 0.0)
    mean = difference.sum(axis=(1, 2)) / np.maximum(n, 1)
    spread = np.abs(difference - mean[:, None, None]) * is_valid
    result = spread.sum(axis=(1, 2)) / np.maximum(n, 1)
    return np.where(n >= 0.25 * thumbnail[0].size, result, np.nan) if len(a) else result
