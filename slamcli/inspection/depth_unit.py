"""Is the depth scale right? A structured-light camera betrays it: its readings come in steps that grow with the square of the distance.

Such a camera measures disparity in eighths of a pixel, so neighbouring readings differ by ``z^2 / (8 f b)``: 2.87 mm at 1 m for the first
Kinect, Xtion and PrimeSense (f = 580 px, b = 75 mm). If a wrong scale makes every distance k times too large, the steps become k times
too large as well, their ratio to the square k times too small. Other cameras show no such steps; then only the range can be judged.
"""

from dataclasses import dataclass

import numpy as np

STEP_AT_1M = 1.0 / (8 * 580.0 * 0.075)  # [1/m]
TOLERANCE = 1.5  # factor by which step or range may be off before the scale is doubted
COMMON_SCALES = (1.0, 100.0, 256.0, 1000.0, 5000.0, 10000.0)  # depth units per metre in use
WINDOWS = np.geomspace(0.15, 12.0, 40)  # [m] edges of the distances at which steps are looked for
LEAST_VALUES = 5  # different readings within a window
LEAST_WINDOWS = 6
NEAREST = 0.35  # [m]; a quarter of all readings nearer than this is not a room seen by such a camera
FARTHEST = 9.0  # [m]; likewise half of all farther


@dataclass(frozen=True)
class DepthUnit:
    """The verdict on a depth scale."""

    percentiles: dict[str, float]  # [m] of the readings as they are
    step_at_1m: float | None  # [1/m], None where readings show no disparity steps
    likely_scale: float | None  # depth units per metre, where another one fits much better
    reason: str


def judge(counts: np.ndarray, scale: float) -> DepthUnit:
    """Judge a depth scale from the readings of each raw value, (65536,), raw 0 being none."""
    counts = counts.copy()
    counts[0] = 0
    n = int(counts.sum())
    if n == 0:
        return DepthUnit({}, None, None, "no reading")
    share = np.cumsum(counts) / n
    percentiles = {f"p{q:02d}": float(np.searchsorted(share, q / 100) / scale) for q in (1, 5, 25, 50, 75, 95, 99)}
    constant = disparity_step(counts, scale)
    if constant is not None:
        factor = STEP_AT_1M / constant  # distances are this many times too large
        if 1.0 / TOLERANCE < factor < TOLERANCE:
            return DepthUnit(percentiles, constant, None, "the steps between readings are those of a structured-light camera")
        likely = _nearest_common(scale * factor)
        if likely is not None and likely != scale:
            reason = f"the steps between readings fit a structured-light camera only if distances are {1 / factor:.2g} times as large"
            return DepthUnit(percentiles, constant, likely, reason)
    return _judge_range(percentiles, constant, scale)


def disparity_step(counts: np.ndarray, scale: float) -> float | None:
    """Measure ``step / z^2`` [1/m]; None where the readings do not come in steps that grow with the square of the distance."""
    used = np.flatnonzero(counts > max(3.0, 1e-7 * counts.sum()))
    constants = []
    for low, high in zip(WINDOWS[:-1], WINDOWS[1:], strict=True):
        values = used[(used >= low * scale) & (used < high * scale)]
        if len(values) >= LEAST_VALUES:
            step, z = np.median(np.diff(values)), np.median(values)
            if step >= 2.0:  # a step of one unit may be the file's resolution as well as the sensor's
                constants.append(step / scale / (z / scale) ** 2)
    if len(constants) < LEAST_WINDOWS:
        return None
    low, middle, high = np.percentile(constants, [20, 50, 80])
    return float(middle) if high < 1.5 * low else None


def _judge_range(percentiles: dict[str, float], constant: float | None, scale: float) -> DepthUnit:
    likely, reason = None, "the range of the readings is that of a room"
    if percentiles["p25"] < NEAREST:
        likely = _nearest_common(scale / 5.0)
        reason = f"a quarter of all readings is nearer than {percentiles['p25']:.2f} m, where such cameras are blind"
    elif percentiles["p50"] > FARTHEST:
        likely = _nearest_common(scale * 5.0)
        reason = f"half of all readings is farther than {percentiles['p50']:.1f} m, which no room is"
    return DepthUnit(percentiles, constant, likely if likely != scale else None, reason)


def _nearest_common(scale: float) -> float | None:
    ratio = [max(scale / common, common / scale) for common in COMMON_SCALES]
    best = int(np.argmin(ratio))
    return COMMON_SCALES[best] if ratio[best] < TOLERANCE else None
