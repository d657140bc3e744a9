"""Is the depth scale right? A camera that triangulates betrays it: its readings come in steps that grow with the square of the distance.

Such a camera measures disparity in fractions of a pixel, so neighbouring readings v (in units of 1/u m) differ by ``v^2 / (u q)``, where
q [1/m] = focal length x baseline x steps per pixel belongs to the camera, whatever the scene. Under a scale that is k times too
large the same readings show a k times smaller q. Cameras of other kinds, and depth that was resampled, show no such steps.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slamcli.geometry.camera import DEPTH_VALUES, NO_READING

# q of known cameras. Kinect, Xtion and PrimeSense: 580 px x 75 mm x 8; ICL-NUIM's simulated Kinect is the same. RealSense: x 32; depth
# at another resolution has another focal length, and keeps the q of its own when it is registered to colour.
KINECT = 344.0
CAMERAS = {
    "Kinect or Xtion": KINECT,
    "RealSense D435 at 640 x 480": 616.0,
    "RealSense D435 at 848 x 480": 680.0,
    "RealSense D435 at 1280 x 720": 1024.0,
    "RealSense D455 at 640 x 480": 1170.0,
    "RealSense D455 at 848 x 480": 1292.0,
    "RealSense D455 at 1280 x 720": 1950.0,
}
TOLERANCE = 0.05  # by which q of one kind of camera varies
STRANGE = 0.12  # by which q differs from all known ones where the scale is at fault: another camera of a known kind is nearer
COMMON_SCALES = (1000.0, 5000.0, 10000.0, 4000.0, 2000.0, 256.0, 100.0, 6553.5)  # depth units per metre in use, the likelier first
FACTORS = (4.0, 5.0, 10.0)  # by which a scale is off when it is wrong: millimetres, tenths of them, TUM's 5000, RealSense's 4000
FINEST_WHOLE_UNIT = 50.0  # depth units per metre from which readings are whole numbers
MILLIMETRES = 1000.0
DEPTH_STEP = 4  # every fourth row and column of a depth image is counted
OFF_BY = 0.06  # by which a ratio of scales may differ from such a factor
RARE, RARE_SHARE = 3.0, 1e-7  # pixels, and their share of all: values that fewer have are errors
ROUNDED = 40.0  # of two digits: above, only multiples of 5 are likely to have been chosen
DOUBLE = 1.6  # times the usual step: a reading that does not occur leaves a double one
WINDOWS = np.geomspace(100.0, 60000.0, 64)  # raw readings between which steps are looked for
LEAST_VALUES = 5  # different readings within a window
LEAST_WINDOWS = 5
LEAST_STEP = 4.0  # raw units: smaller steps are rounded too coarsely
SPREAD = 1.25  # ratio of the constants of windows (80 % to 20 %) up to which they agree
NEAREST = 0.35  # [m]; a quarter of all readings nearer than this is not a room seen by such a camera
FARTHEST = 9.0  # [m]; likewise half of all farther
TYPICAL = (0.5, 6.0)  # [m] median depth of a room
PERCENTILES = (1, 5, 25, 50, 75, 95, 99)


@dataclass(frozen=True)
class DepthUnit:
    """Whether a depth scale is believed, and which one fits better."""

    percentiles: dict[str, float]  # [m] of the readings as they are
    q: float | None  # [1/m] under the scale as it is, None where readings show no disparity steps
    camera: str  # whose q that is, "" = of none known
    likely_scale: float | None  # depth units per metre, where another one fits much better
    reason: str


def counted(images: Iterable[np.ndarray]) -> np.ndarray:
    """Count the readings of each raw value in depth images (h, w) uint16, (65536,); readings that mean none are left out."""
    counts = np.zeros(DEPTH_VALUES, dtype=np.int64)
    for raw in images:
        counts += np.bincount(raw.ravel(), minlength=DEPTH_VALUES)
    counts[list(NO_READING)] = 0
    return counts


def counting_scale(depth_scale: float) -> float:
    """Return the units per metre in which readings are counted: the recording's own, millimetres for floating-point metres."""
    return depth_scale if depth_scale >= FINEST_WHOLE_UNIT else MILLIMETRES


def counted_metres(depth: np.ndarray, scale: float) -> np.ndarray:
    """Count the readings of each raw value, at `scale` units per metre, in some rows of depth (h, w) [m], NaN = none; (65536,)."""
    some = depth[::DEPTH_STEP, ::DEPTH_STEP]
    raw = np.rint(some[np.isfinite(some)] * scale).clip(0, DEPTH_VALUES - 1).astype(np.int64)
    return np.bincount(raw, minlength=DEPTH_VALUES)


def judge(counts: np.ndarray, scale: float) -> DepthUnit:
    """Judge a depth scale from the readings of each raw value, (65536,)."""
    counts = counts.copy()
    counts[list(NO_READING)] = 0
    n = int(counts.sum())
    if n == 0:
        return DepthUnit({}, None, "", None, "no reading")
    share = np.cumsum(counts) / n
    percentiles = {f"p{p:02d}": float(np.searchsorted(share, p / 100) / scale) for p in PERCENTILES}
    constant = disparity_constant(counts)
    q = constant / scale if constant is not None else None
    if q is not None:
        name = _camera_of(q)
        if name:
            return DepthUnit(percentiles, q, name, None, f"the steps between readings are those of a {name}")
        likely = _likely_scale(constant or 0.0, scale, typical=percentiles["p50"])
        if likely is not None:
            name = _camera_of((constant or 0.0) / likely)
            reason = f"the steps between readings fit a {name} only if distances are {scale / likely:.2g} times as large"
            return DepthUnit(percentiles, q, name, likely, reason)
        if not _is_near_a_camera(q):
            likely = _round_scale((constant or 0.0) / KINECT)
            reason = f"the steps between readings are those of no known camera (q = {q:.0f}/m; a Kinect or Xtion has {KINECT:.0f}/m)"
            return DepthUnit(percentiles, q, "", likely, reason)
    return _judge_range(percentiles, q, scale)


def measure(counts: np.ndarray) -> tuple[float | None, str]:
    """Find the depth scale of readings from their steps: (depth units per metre, the camera's name); None where they do not show it."""
    constant = disparity_constant(counts)
    if constant is not None:
        for scale in COMMON_SCALES:
            name = _camera_of(constant / scale)
            if name:
                return scale, name
    return None, ""


def disparity_constant(counts: np.ndarray) -> float | None:
    """Measure u q = v^2 / step in raw units; None where the readings do not come in steps that grow with the square of the distance."""
    used = np.flatnonzero(counts > max(RARE, RARE_SHARE * counts.sum()))
    constants = []
    for low, high in zip(WINDOWS[:-1], WINDOWS[1:], strict=True):
        values = used[(used >= low) & (used < high)].astype(np.float64)
        if len(values) >= LEAST_VALUES:
            step = np.diff(values)
            usual = step[step < DOUBLE * np.median(step)]
            if usual.mean() >= LEAST_STEP:
                constants.append(float(np.median(values)) ** 2 / float(usual.mean()))
    if len(constants) < LEAST_WINDOWS:
        return None
    low, middle, high = np.percentile(constants, [20, 50, 80])
    return float(middle) if high < SPREAD * low else None


def _camera_of(q: float) -> str:
    return next((name for name, known in CAMERAS.items() if abs(q / known - 1.0) <= TOLERANCE), "")


def _is_near_a_camera(q: float) -> bool:
    return any(abs(q / known - 1.0) <= STRANGE for known in CAMERAS.values())


def _round_scale(scale: float) -> float:
    """Round to a number that somebody would have chosen: two digits, the second a 0 or a 5 above 40."""
    unit = 10.0 ** (math.floor(math.log10(scale)) - 1)
    step = 5.0 if scale / unit > ROUNDED else 1.0
    return float(round(scale / unit / step) * step * unit)


def _likely_scale(constant: float, scale: float, *, typical: float) -> float | None:
    """Find the scale under which readings are a known camera's in a room, if the present one is off by a usual factor.

    typical : [m] median depth under the present scale
    """
    for other in COMMON_SCALES:
        ratio = max(other / scale, scale / other)
        is_usual = any(abs(ratio / factor - 1.0) < OFF_BY for factor in FACTORS)
        if is_usual and _camera_of(constant / other) and TYPICAL[0] <= typical * scale / other <= TYPICAL[1]:
            return other
    return None


def _judge_range(percentiles: dict[str, float], q: float | None, scale: float) -> DepthUnit:
    likely, reason = None, "the range of the readings is that of a room"
    if percentiles["p25"] < NEAREST and scale > COMMON_SCALES[0]:
        likely, reason = 1000.0, f"a quarter of all readings is nearer than {percentiles['p25']:.2f} m, where such cameras are blind"
    elif percentiles["p50"] > FARTHEST:
        raw = percentiles["p50"] * scale
        likely = next((other for other in COMMON_SCALES if TYPICAL[0] <= raw / other <= TYPICAL[1]), None)
        reason = f"half of all readings is farther than {percentiles['p50']:.1f} m, which no room is"
    return DepthUnit(percentiles, q, "", likely if likely != scale else None, reason)
