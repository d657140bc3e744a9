"""Which depth image belongs to which colour image, and which part of a recording is used."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slamcli.config.options import RecordingConfig
from slamcli.datasets.association import MAX_DIFFERENCE, associate
from slamcli.datasets.clock import ENOUGH, MANY_REPEATED, Clock, read_clock
from slamcli.datasets.folder import number_of
from slamcli.datasets.images import Pixels
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.recording import spread
from slamcli.datasets.sources import Images
from slamcli.errors import BadFrame, SlamError
from slamcli.hints import hint

LOOKED_AT = 5  # images that are compared with the one before


@dataclass(frozen=True)
class Pairs:
    """Frames: rows of colour in the order of time, and the rows of depth that belong to them."""

    clock: Clock
    depth_row: np.ndarray  # (K,) int64, -1 = none
    depth_stamp: np.ndarray  # (K,) s, NaN = none
    warnings: list[str]


def pair(found: Recorded, fps: float | None) -> Pairs:
    """Pair colour and depth, by row where the reader did so, else by time; SlamError where nothing fits."""
    colour, depth = found.colour, found.depth
    clock = _clock(colour, str(found.root), fps, is_paired=found.is_paired)
    warnings = list(clock.warnings)
    if fps and clock.is_clock:
        warnings.append(f"{found.root}: {hint().option('recording.fps')} {fps:g} is not used, as the recording has time stamps")
    if len(colour) == 0:
        raise SlamError(f"{found.root}: holds no colour image")
    if found.is_paired:
        return _by_row(found, clock, warnings)
    depth_clock = _clock(depth, str(found.root), fps, shifts=clock.shifts)
    warnings += [w for w in depth_clock.warnings if w not in warnings]
    if not (clock.is_clock and depth_clock.is_clock) and not (clock.seconds and depth_clock.seconds):
        return _by_list(found, clock, warnings)
    pairs = associate(clock.stamp, depth_clock.stamp)
    if len(pairs) == 0:
        raise SlamError(_no_association(found, clock.stamp, depth_clock.stamp))
    of_frame = np.full(len(clock.stamp), -1)
    of_frame[pairs[:, 0]] = pairs[:, 1]
    return Pairs(
        clock=clock,
        depth_row=np.where(of_frame >= 0, depth_clock.row[of_frame], -1),
        depth_stamp=np.where(of_frame >= 0, depth_clock.stamp[of_frame], np.nan),
        warnings=warnings,
    )


def _clock(stream: Stream, root: str, fps: float | None, *, is_paired: bool = False, shifts: tuple[float, ...] = ()) -> Clock:
    """Judge a stream's stamps, images written twice left out."""
    what = stream.where or root
    if stream.stamp is None or is_paired or not (is_copy := _copies(stream)).any():
        return read_clock(stream.stamp, len(stream), what=what, order=stream.order, fps=fps, shifts=shifts)
    rows = np.flatnonzero(~is_copy)
    clock = read_clock(np.asarray(stream.stamp)[rows], len(rows), what=what, order=stream.order, fps=fps, shifts=shifts)
    said = f"{what}: {int(is_copy.sum())} images repeat the one before, stamp and content; left out"
    return replace(clock, row=rows[clock.row], warnings=[said, *clock.warnings])


def _copies(stream: Stream) -> np.ndarray:
    """Find the images (N,) bool that repeat the one before, where so many stamps are repeated that they would be no clock.

    A recorder that writes images twice is told from stamps that are too coarse by what a few of the images hold.
    """
    stamp = np.asarray(stream.stamp, dtype=np.float64)
    is_copy, source = np.concatenate([[False], np.diff(stamp) == 0.0]), stream.images
    if (~is_copy).sum() < ENOUGH or is_copy[1:].mean() <= MANY_REPEATED:
        return np.zeros_like(is_copy)
    is_copy[is_copy] = [source.n_bytes(int(i)) == source.n_bytes(int(i) - 1) for i in np.flatnonzero(is_copy)]
    rows = np.flatnonzero(is_copy)
    if not all(_are_equal(source, int(rows[k])) for k in spread(len(rows), LOOKED_AT)):
        return np.zeros_like(is_copy)
    return is_copy


def _are_equal(source: Images, i: int) -> bool:
    """Compare an image with the one before."""
    try:
        before, after = (source.read(row) for row in (i - 1, i))
    except BadFrame:
        return False
    if isinstance(before, bytes) or isinstance(after, bytes):
        return isinstance(before, bytes) and isinstance(after, bytes) and before == after
    a, b = (image.data if isinstance(image, Pixels) else image for image in (before, after))
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def _by_row(found: Recorded, clock: Clock, warnings: list[str]) -> Pairs:
    """Take row i of depth for row i of colour; its own stamps count where they are of the same clock."""
    names = found.depth.images.names
    row = np.array([int(r) if names[r] else -1 for r in clock.row], dtype=np.int64)
    stamp = clock.stamp
    raw = found.depth.stamp
    if raw is not None and clock.seconds is not None:
        own = clock.seconds(np.asarray(raw, dtype=np.float64)[clock.row])
        stamp = np.where(np.isfinite(own) & (np.abs(own - clock.stamp) < 1.0), own, clock.stamp)
    if not (row >= 0).any():
        raise SlamError(f"{found.root}: no colour image has a depth image")
    return Pairs(clock, row, np.where(row >= 0, stamp, np.nan), warnings)


def _by_list(found: Recorded, clock: Clock, warnings: list[str]) -> Pairs:
    """Pair lists without a common clock: by equal stamps, else by the numbers in the names, else line by line."""
    colour, depth = found.colour, found.depth
    ways: tuple[tuple[str, list[Any], list[Any]], ...] = (
        ("equal stamps", _raw_keys(colour.stamp), _raw_keys(depth.stamp)),
        ("the numbers in their names", [number_of(n) for n in colour.images.names], [number_of(n) for n in depth.images.names]),
    )
    for way, a, b in ways:
        row_of = {key: j for j, key in enumerate(b) if key is not None}
        if len(row_of) == len(depth) and len(set(a)) == len(colour) and sum(key in row_of for key in a) > len(colour) / 2:
            how, row = way, np.array([row_of.get(a[r], -1) for r in clock.row], dtype=np.int64)
            break
    else:
        if len(colour) != len(depth):
            raise SlamError(
                f"{found.root}: the stamps are no clock, and {len(colour)} colour and {len(depth)} depth images cannot be paired line by "
                "line; write an associations.txt with lines 'stamp colour stamp depth'"
            )
        how, row = "their order", clock.row.copy()
    warnings.append(f"{found.root}: colour and depth are paired by {how}")
    return Pairs(clock, row, np.where(row >= 0, clock.stamp, np.nan), warnings)


def _raw_keys(stamp: np.ndarray | None) -> list[float | None]:
    return [] if stamp is None else [float(value) for value in stamp]


def _no_association(found: Recorded, stamp: np.ndarray, depth_stamp: np.ndarray) -> str:
    after = np.searchsorted(depth_stamp, stamp).clip(0, len(depth_stamp) - 1)
    gap = np.abs(stamp[:, None] - depth_stamp[np.stack([after, (after - 1).clip(0)], axis=1)])
    return (
        f"{found.root}: no depth image lies within {MAX_DIFFERENCE} s of a colour image (the nearest is {gap.min():.3f} s away); "
        "check that both have one clock and one unit"
    )


def select(pairs: Pairs, options: RecordingConfig, found: Recorded) -> Pairs:
    """Keep the part of the recording that is asked for."""
    stamp = pairs.clock.stamp
    since = stamp - stamp[0]
    keep = since >= options.start
    if options.end > 0:
        keep &= since <= options.end
    rows = np.flatnonzero(keep)[:: options.every]
    if len(rows) == len(stamp):
        return pairs
    if len(rows) == 0:
        raise SlamError(f"{found.root}: lasts {since[-1]:.2f} s; nothing is left of it from {options.start:g} s to {options.end:g} s")
    clock = replace(pairs.clock, stamp=stamp[rows], row=pairs.clock.row[rows])
    return replace(pairs, clock=clock, depth_row=pairs.depth_row[rows], depth_stamp=pairs.depth_stamp[rows])
