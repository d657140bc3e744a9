"""Signs that a recording's images are not what a camera sees: a stream that stands still, depth that is no depth, units of no known camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.datasets import depth_unit
from slamcli.datasets.depth_unit import DepthUnit
from slamcli.depth.coarse_images import CoarseImages
from slamcli.schema import Features
from slamcli.slam import doubt
from slamcli.slam.doubt import Finding

FROZEN_FRAMES, FROZEN_SECONDS = 8, 0.25  # equal images in a row: shorter stretches are those of a stream whose rate was raised
FEW_FEATURES = 20  # a picture with fewer may be blank, and blank pictures are equal
LINES, PAIRS = 30, 80  # rows of a depth image, and pairs of neighbours in each, that are enough to judge its readings
ONE_DISTANCE = 1e-3  # spread of an image's readings as a share of them: sensors scatter more even before a wall
ROUGH = 0.1  # difference of neighbouring readings as a share of them, median; real depth has 0.01 at most, noise 0.3 and more
MOSTLY = 0.5  # share of the images from which all are called so
LOW, MIDDLE, HIGH = 0.02, 0.5, 0.98  # quantiles of the readings: their spread is from the lowest to the highest


@dataclass(frozen=True)
class Readings:
    """What one depth image holds."""

    share: float  # of the pixels, that have a reading
    distance: float  # [m] median, NaN without a reading
    spread: float  # from the quantile LOW to HIGH, as a share of the median
    roughness: float  # median difference between neighbours, as a share of the nearer; 0 where no two are side by side


NO_READINGS = Readings(0.0, np.nan, np.nan, np.nan)


def look(depth: np.ndarray) -> Readings:
    """Judge a depth image (H, W) float32 [m], NaN = none, by some of its pairs of neighbours."""
    line_step, pair_step = (max(n // wanted, 1) for n, wanted in zip(depth.shape, (LINES, PAIRS), strict=True))
    lines = depth[line_step // 2 :: line_step]
    first, second = lines[:, :-1:pair_step], lines[:, 1::pair_step]
    is_read = np.isfinite(first)
    if not is_read.any():
        return NO_READINGS
    low, middle, high = _quantiles(first[is_read], (LOW, MIDDLE, HIGH))
    change = np.abs(first - second) / np.maximum(np.minimum(first, second), np.float32(1e-6))
    change = change[np.isfinite(change)]
    roughness = _quantiles(change, (MIDDLE,))[0] if len(change) else 0.0
    return Readings(float(is_read.mean()), middle, (high - low) / max(middle, 1e-6), roughness)


def _quantiles(values: np.ndarray, shares: tuple[float, ...]) -> list[float]:
    """Return values that exceed these shares of all; `np.quantile` takes three times as long for each image."""
    places = [int(share * (len(values) - 1)) for share in shares]
    return np.partition(values, places)[places].tolist()


def about_readings(images: Sequence[Readings | None]) -> list[Finding]:
    """Judge the depth images of a recording, None = the frame has none."""
    there = [image for image in images if image is not None]
    if not there:
        return []
    full = [image for image in there if image.share > 0.0]
    if not full:
        text = f"none of {len(there)} depth images holds a reading: depth was recorded empty or in another format (16 bits, 0 = none)"
        return [Finding("depth_readings", f"{text}, and without it there is no map", is_grave=True)]
    found = []
    same = [image for image in full if image.spread < ONE_DISTANCE]
    if len(same) > MOSTLY * len(full):
        distance = np.median([image.distance for image in same])
        text = f"{len(same)} of {len(full)} depth images show one distance in all pixels ({distance:.2f} m), which no camera measures"
        found.append(Finding("depth_readings", f"{text}: the depth stream is a placeholder; record depth again", is_grave=True))
    rough = [image for image in full if image.roughness > ROUGH]
    if len(rough) > MOSTLY * len(full):
        share = np.median([image.roughness for image in rough])
        text = f"neighbouring depth readings differ by {share:.0%} where surfaces differ by 1 %"
        cause = "they are noise, or read in the wrong format (order of bytes, packing, colours for viewing); look at a depth image"
        found.append(Finding("depth_readings", f"{text}: {cause}", is_grave=True))
    return found


def about_unit(counts: np.ndarray, scale: float) -> list[Finding]:
    """Judge the unit of depth by the readings of each raw value (65536,) at `scale` units per metre."""
    return unit_finding(depth_unit.judge(counts, scale), scale)


def unit_finding(unit: DepthUnit, scale: float) -> list[Finding]:
    """Say what speaks against a depth scale."""
    likely = unit.likely_scale
    if likely is None:
        return []
    how = (
        f"the map is {likely / scale:.2g} times as large as the room" if likely > scale else f"the map has {likely / scale:.2g} of its size"
    )
    text = f"the depth scale {scale:g} is doubtful, as {unit.reason}: if so, {how}, and camera.depth_scale = {likely:g} is right"
    return [Finding("depth_scale", text, is_grave=True)]


def same_pictures(features: Features) -> np.ndarray:
    """Find the frames (F,) whose features are those of the frame before, to the last bit: no camera takes the same picture twice."""
    offset = np.asarray(features.offset)
    is_same = np.zeros(len(offset) - 1, dtype=bool)
    for i in range(1, len(is_same)):
        n = offset[i + 1] - offset[i]
        if n == offset[i] - offset[i - 1] and n >= FEW_FEATURES:
            here, before = slice(offset[i], offset[i + 1]), slice(offset[i - 1], offset[i])
            is_same[i] = np.array_equal(features.desc[here], features.desc[before]) and np.array_equal(
                features.xy[here], features.xy[before]
            )
    return is_same


def same_depth(images: CoarseImages) -> np.ndarray:
    """Find the frames (F,) whose coarse depth image (V, U) is that of the frame before, and not of one distance or empty."""
    is_same = np.zeros(len(images), dtype=bool)
    for i in range(1, len(is_same)):
        if np.array_equal(images.code(i), images.code(i - 1)):
            values = images[i][images[i] > 0]
            is_same[i] = len(values) > 0 and values.max() > (1.0 + ONE_DISTANCE) * values.min()
    return is_same


def about_motion(stamp: np.ndarray, colour: np.ndarray, depth: np.ndarray) -> list[Finding]:
    """Find stretches in which a stream stands still.

    stamp : (F,) [s]; colour, depth : (F,) bool, whether the image is that of the frame before
    """
    colour, depth = _long(stamp, colour), _long(stamp, depth)
    both = colour & depth
    cases = (
        (
            "frozen",
            both,
            "colour and depth",
            "the recorder hung, or a camera without noise stood still; what is missing there no map shows",
        ),
        ("frozen_colour", colour & ~both, "colour", "the colour stream stood still while depth went on, so poses are wrong there"),
        ("frozen_depth", depth & ~both, "depth", "the depth stream stood still while colour went on, so poses and maps are wrong there"),
    )
    found = []
    for name, is_frozen, what, cause in cases:
        spans = doubt.doubtful_frames(is_frozen)
        if spans:
            first, last = max(spans, key=lambda span: span[1] - span[0])
            more = f" ({int(is_frozen.sum())} frames in all)" if len(spans) > 1 else ""
            text = f"the {what} images of frames {first} to {last} are one and the same{more}: {cause}; record again, or leave these out"
            found.append(Finding(name, text, is_grave=bool(is_frozen.mean() >= doubt.MANY)))
    return found


def _long(stamp: np.ndarray, is_same: np.ndarray) -> np.ndarray:
    """Keep the stretches of equal images that are long enough, their first image with them."""
    out = np.zeros_like(is_same)
    for first, last in doubt.doubtful_frames(is_same):
        if last - first + 2 >= FROZEN_FRAMES and stamp[last] - stamp[first - 1] >= FROZEN_SECONDS:
            out[first - 1 : last + 1] = True
    return out
