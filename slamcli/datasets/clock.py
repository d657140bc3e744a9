"""Time stamps made seconds: their unit, lists that are no clock, counters that roll over, sessions that were joined."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from slamcli.hints import hint

ASSUMED_RATE = 30.0  # [Hz] of recordings without a clock
UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # of each in a second: a quotient of exact numbers is rounded once
EPOCH = (5e8, 4.3e9)  # [s] since 1970 of any recording: 1985 to 2106
FASTEST = 1e-3  # [s] between frames of any camera, at least
SLOWEST = 3600.0  # [s] between frames, likewise at most
SLOWEST_STEP = 3.0  # a median step of more than this many of a unit belongs to the next smaller unit
MANY_REPEATED = 0.2  # share of the steps without any advance from which stamps are no clock
MANY_BACK = 0.1  # share of the steps backwards, likewise
IRREGULAR = 6.0  # ratio of long to short steps (90 % to 10 %) of sorted stamps from which they are no clock
ENOUGH = 8  # stamps from which regularity can be judged
SESSION = 10  # frames that a session has at least
INTERLEAVED = 5  # frames of one session between those of another that sorting would mix up
SESSION_PAUSE = 1.0  # [s] put between sessions whose clocks began anew
MOSTLY_ONE = 0.8  # share of the steps that are one, of whole seconds
MULTIPLES, ALIKE = 0.9, 0.6  # shares of the steps that are multiples of the usual one, and equal to it, of frame numbers
LARGEST_NUMBER_STEP = 10  # frame numbers advance by this at most
RATES = (1.0, 300.0)  # [Hz] that whole seconds may show
NEAR_ROLL_OVER = 2.5  # steps from the top, and to the bottom, within which a counter rolls over
ROLL_OVERS = (*(float(1 << bits) for bits in (8, 16, 24, 31, 32)), 60.0, 1000.0, 3600.0, 86400.0, 1e6, 1e9)


@dataclass(frozen=True)
class Clock:
    """The stamps of one stream as seconds."""

    stamp: np.ndarray  # (K,) float64 [s], strictly increasing
    row: np.ndarray  # (K,) int64 rows of the stream that they belong to: some may be left out, some moved
    is_clock: bool  # the stamps told the time; else a rate was assumed
    seconds: Callable[[np.ndarray], np.ndarray] | None = None  # how other stamps of this clock become seconds; None = they cannot
    warnings: list[str] = field(default_factory=list)
    shifts: tuple[float, ...] = ()  # [s] added to each of the sessions that were joined


def read_clock(
    raw: np.ndarray | None, n: int, *, what: str, order: str = "", fps: float | None = None, shifts: tuple[float, ...] = ()
) -> Clock:
    """Turn the stamps of a stream into seconds.

    raw : (n,) as written, None = there are none; what, order : the stream and the order of its images, for warnings; fps : rate [Hz] where stamps are no clock;
    shifts : those of another stream of the same clock
    Sound stamps in seconds come out as they are, bit for bit.
    """
    if n == 0:
        return Clock(np.empty(0), np.empty(0, dtype=np.int64), is_clock=False)
    if raw is None:
        return _assumed(n, fps, f"{what}: has no time stamps", order)
    finite = np.isfinite(raw)
    if finite.sum() < max(1, n / 2):
        return _assumed(n, fps, f"{what}: most time stamps are no numbers", order)
    rows, values = np.flatnonzero(finite), np.asarray(raw, dtype=np.float64)[finite]
    warnings = [f"{what}: {n - len(rows)} frames without a time stamp left out"] if len(rows) < n else []
    found = _judge(values, what, order, fps, shifts)
    return replace(found, row=rows[found.row], warnings=warnings + found.warnings)


def _judge(raw: np.ndarray, what: str, order: str, fps: float | None, shifts: tuple[float, ...]) -> Clock:
    """Decide what finite stamps are."""
    n, step = len(raw), np.diff(raw)
    if n == 1:
        per_second = UNITS[_unit_of_epoch(raw) or "s"]
        return Clock(raw / per_second, np.zeros(1, dtype=np.int64), True, lambda other: other / per_second)
    if (step == 0).mean() > MANY_REPEATED:
        return _repeated(raw, what, order, fps)
    if _are_frame_numbers(raw):
        return _numbers(raw, what, fps)
    unit, is_plausible = _unit(raw)
    per_second = UNITS[unit]
    seconds = raw / per_second
    told = [f"{what}: stamps are in {unit}; read as such"] if unit != "s" else []
    back = int((step < 0).sum())
    if back == 0:
        return _ordered(seconds, per_second, what, told) if is_plausible else _assumed(n, fps, _hasty(what, seconds), order)
    unrolled = _unrolled(raw)
    if unrolled is not None:
        kept = np.flatnonzero(np.concatenate([[True], np.diff(unrolled) > 0]))
        return Clock(
            unrolled[kept] / per_second, kept, True, None, [*told, f"{what}: the counter of the stamps rolled over {back} times; unrolled"]
        )
    stretches = _sessions(seconds)
    if stretches is not None:
        return _joined(seconds, stretches, what, told, shifts)
    is_regular = _is_regular(raw)
    if (back > MANY_BACK * (n - 1) and n >= ENOUGH and not is_regular) or not is_plausible:
        return _assumed(
            n, fps, f"{what}: stamps go back {back} times and show no even pace, so they are no clock (processing times?)", order
        )
    return _ordered(seconds, per_second, what, told)


def _ordered(seconds: np.ndarray, per_second: float, what: str, told: list[str]) -> Clock:
    """Sort stamps, and of those repeated keep the first."""
    back = int((np.diff(seconds) < 0).sum())
    if back:
        told = [*told, f"{what}: not sorted by time ({back} steps back); sorted"]
    order = np.argsort(seconds, kind="stable")
    is_first = np.concatenate([[True], np.diff(seconds[order]) > 0])
    if not is_first.all():
        told = [*told, f"{what}: {int((~is_first).sum())} repeated stamps; the first image of each is kept"]
    order = order[is_first]
    return Clock(seconds[order], order, True, lambda other: other / per_second, told)


def _assumed(n: int, fps: float | None, why: str, order: str) -> Clock:
    """Keep the order of the images at a rate."""
    rate = fps or ASSUMED_RATE
    return Clock(np.arange(n) / rate, np.arange(n), False, None, [f"{why}; {_rate_told(rate, fps)}, {order}"])


def _rate_told(rate: float, fps: float | None) -> str:
    option = hint().option("recording.fps")
    return f"{rate:g} Hz as {option} says" if fps else f"{rate:g} Hz assumed ({option} gives another rate)"


def _numbers(raw: np.ndarray, what: str, fps: float | None) -> Clock:
    rate = fps or ASSUMED_RATE
    found = _ordered(raw / rate, 1.0, what, [])
    warnings = [*found.warnings, f"{what}: stamps are frame numbers; {_rate_told(rate, fps)}"]
    return Clock(found.stamp, found.row, False, lambda other: np.asarray(other) / rate, warnings)


def _repeated(raw: np.ndarray, what: str, order: str, fps: float | None) -> Clock:
    """Read stamps of which many are equal: whole seconds tell the rate, anything else does not."""
    values, counts = np.unique(raw, return_counts=True)
    is_counting = len(values) >= 4 and (np.diff(raw) >= 0).all() and (np.diff(values) == 1).mean() > MOSTLY_ONE
    rate = float(counts[1:-1].mean()) if is_counting else 0.0
    if fps is None and RATES[0] <= rate <= RATES[1]:
        message = f"{what}: stamps are whole seconds; {rate:.1f} Hz taken from how many frames share one, {order}"
        return Clock(raw[0] + np.arange(len(raw)) / rate, np.arange(len(raw)), False, None, [message])
    repeated = int((np.diff(raw) == 0).sum())
    return _assumed(len(raw), fps, f"{what}: {repeated} of {len(raw)} stamps repeat the one before, so they are no clock", order)


def _unit_of_epoch(raw: np.ndarray) -> str | None:
    """Return the unit under which stamps are dates of our time, and their steps those of a camera."""
    middle, step = float(np.median(raw)), np.diff(np.unique(raw))
    typical = float(np.median(step)) if len(step) else 0.0
    return next(
        (unit for unit, per_second in UNITS.items() if EPOCH[0] <= middle / per_second <= EPOCH[1] and typical / per_second < SLOWEST), None
    )


def _unit(raw: np.ndarray) -> tuple[str, bool]:
    """Return the unit of stamps, and whether their pace is a camera's then."""
    step = np.diff(np.unique(raw))
    typical = float(np.median(step))
    unit = _unit_of_epoch(raw)
    if unit is None:
        unit = (
            "s"
            if typical < SLOWEST_STEP
            else "ms"
            if typical < UNITS["ms"] * SLOWEST_STEP
            else "us"
            if typical < UNITS["us"] * SLOWEST_STEP
            else "ns"
        )
    return unit, typical / UNITS[unit] >= FASTEST


def _hasty(what: str, seconds: np.ndarray) -> str:
    return f"{what}: stamps advance by {np.median(np.diff(seconds)):.2g} s, faster than any camera"


def _are_frame_numbers(raw: np.ndarray) -> bool:
    """Say whether stamps are whole numbers in even, small steps that are no dates."""
    if (raw != np.floor(raw)).any() or _unit_of_epoch(raw) == "s":
        return False
    step = np.diff(np.unique(raw))
    typical = float(np.median(step))
    return (
        1.0 <= typical <= LARGEST_NUMBER_STEP and bool((step % typical == 0).mean() > MULTIPLES) and float((step == typical).mean()) > ALIKE
    )


def _is_regular(raw: np.ndarray) -> bool:
    step = np.diff(np.unique(raw))
    if len(step) < ENOUGH:
        return True
    short, long = np.percentile(step, [10, 90])
    return bool(long < IRREGULAR * short)


def _unrolled(raw: np.ndarray) -> np.ndarray | None:
    """Undo the roll-over of a counter; None where steps back are of another kind."""
    step = np.diff(raw)
    forward, back = step[step > 0], np.flatnonzero(step < 0)
    if len(forward) < ENOUGH:
        return None
    near = NEAR_ROLL_OVER * float(np.median(forward))
    for modulus in (period * unit for period in ROLL_OVERS for unit in (1.0, 1e-3, 1e-6, 1e-9)):
        at_top, at_bottom = raw[back] >= modulus - near, raw[back + 1] < near
        if at_top.all() and at_bottom.all() and (raw < modulus).all() and modulus > 10 * near:
            turns = np.zeros(len(raw))
            turns[back + 1] = 1.0
            return raw + modulus * np.cumsum(turns)
    return None


def _sessions(seconds: np.ndarray) -> list[slice] | None:
    """Find the stretches of a list in which sessions with clocks of their own were joined; None where sorting would mix up nothing."""
    cuts = np.flatnonzero(np.diff(seconds) < 0) + 1
    bounds = [0, *cuts.tolist(), len(seconds)]
    stretches = [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    if any(s.stop - s.start < SESSION for s in stretches):
        return None
    for k, one in enumerate(stretches):
        for other in stretches[k + 1 :]:
            inside = (seconds[other] > seconds[one][0]) & (seconds[other] < seconds[one][-1])
            if inside.sum() >= INTERLEAVED or (seconds[other][0] <= seconds[one][0] <= seconds[other][-1]):
                return stretches
    return None


def _joined(seconds: np.ndarray, stretches: list[slice], what: str, told: list[str], shifts: tuple[float, ...]) -> Clock:
    """Lay sessions one after another, or as another list's were laid."""
    out, end, made = seconds.copy(), -np.inf, []
    for k, stretch in enumerate(stretches):
        shift = end + SESSION_PAUSE - seconds[stretch][0] if seconds[stretch][0] <= end else 0.0
        made.append(shifts[k] if len(shifts) == len(stretches) else float(shift))
        out[stretch] += made[-1]
        end = float(out[stretch][-1])
    message = f"{what}: the clock goes back {len(stretches) - 1} times: sessions that were joined; each is kept whole, one after another"
    kept = np.flatnonzero(np.concatenate([[True], np.diff(out) > 0]))
    return Clock(out[kept], kept, True, None, [*told, message], tuple(made))
