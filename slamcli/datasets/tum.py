"""Reader of the TUM RGB-D layout: a folder with rgb.txt, depth.txt and, where known, groundtruth.txt."""

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from slamcli.datasets import images
from slamcli.datasets.calibration import find_camera
from slamcli.datasets.recording import Dataset, spread
from slamcli.errors import BadFrame, SlamError
from slamcli.formats.trajectory import read_tum

MAX_DIFFERENCE = 0.02  # [s] between a colour and a depth image that belong together, strictly below
MAX_LIST_BYTES = 256 << 20
PROBED = 5  # images looked at when a recording is opened
NEAREST_READING = 0.4  # [m] such cameras give no nearer depth
FARTHEST_MEDIAN = 8.0  # [m]


@dataclass(frozen=True)
class ImageList:
    """One of the lists: stamps [s], strictly increasing, and file names."""

    path: Path
    stamp: np.ndarray
    name: list[str]
    warnings: list[str]


def recognises(folder: Path) -> bool:
    """Say whether the folder looks like this layout."""
    return (folder / "rgb.txt").is_file()


def read(folder: Path, *, name: str, camera: dict[str, Any] | None = None) -> Dataset:
    """Open a recording; SlamError where a run would make no sense, `warnings` for what could be put right."""
    colour, depth = read_list(folder / "rgb.txt"), read_list(folder / "depth.txt")
    pairs = associate(colour.stamp, depth.stamp)
    if len(pairs) == 0:
        raise SlamError(_no_association(folder, colour, depth))
    depth_of = np.full(len(colour.stamp), -1)
    depth_of[pairs[:, 0]] = pairs[:, 1]
    size = _probe_size(folder, colour.name)
    dataset = Dataset(
        reader="tum",
        name=name,
        root=folder,
        camera=find_camera(folder, camera, size),
        stamp=colour.stamp,
        depth_stamp=np.where(depth_of >= 0, depth.stamp[depth_of], np.nan),
        colour_path=colour.name,
        depth_path=[depth.name[j] if j >= 0 else "" for j in depth_of],
        warnings=colour.warnings + depth.warnings,
        read_ground_truth=lambda: read_tum(folder / "groundtruth.txt") if (folder / "groundtruth.txt").is_file() else None,
    )
    _check_sizes(dataset, size)
    dataset.warnings.extend(_doubts_about_depth(dataset))
    return dataset


def read_list(path: Path) -> ImageList:
    """Read a list of images: lines ``stamp file``, `#` comments; commas and tabs may separate.

    Lines that cannot be used and repeated stamps are dropped, unsorted stamps are sorted, each with a warning. A list without any
    usable line, stamps that are not seconds, and file names that lead out of the folder are errors.
    """
    entries: list[tuple[float, str]] = []
    bad_lines: list[int] = []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        tokens = line.replace(",", " ").split(maxsplit=1)
        if not tokens or tokens[0].startswith("#"):
            continue
        stamp = _to_float(tokens[0])
        if len(tokens) < 2 or not math.isfinite(stamp):
            bad_lines.append(number)
            continue
        file_name = tokens[1].split("\t")[0].strip()
        _check_inside(path, number, file_name)
        entries.append((stamp, file_name))
    if not entries:
        raise SlamError(f"{path}: lists no image; expected lines 'stamp file'")
    warnings = []
    if bad_lines:
        warnings.append(f"{path}: {len(bad_lines)} unusable lines left out, the first is line {bad_lines[0]}")
    return _ordered(path, entries, warnings)


def associate(stamp_a: np.ndarray, stamp_b: np.ndarray, *, offset: float = 0.0, max_difference: float = MAX_DIFFERENCE) -> np.ndarray:
    """Pair stamps one to one, nearest pairs first, as the data set's own associate.py does.

    stamp_a, stamp_b : (A,), (B,) [s], increasing; `offset` is added to b
    Returns (P, 2) indices into a and b, sorted by a.
    """
    shifted = stamp_b + offset
    # A margin wider than rounding: whether a pair counts is decided below, by the very expression of the rule.
    first = np.searchsorted(shifted, stamp_a - 1.001 * max_difference)
    last = np.searchsorted(shifted, stamp_a + 1.001 * max_difference, side="right")
    a = np.repeat(np.arange(len(stamp_a)), last - first)
    b = np.arange(len(a)) - np.repeat(np.cumsum(last - first) - last, last - first)
    difference = np.abs(stamp_a[a] - shifted[b])
    near = difference < max_difference
    a, b, difference = a[near], b[near], difference[near]
    free_a, free_b = np.ones(len(stamp_a), dtype=bool), np.ones(len(stamp_b), dtype=bool)
    pairs = []
    for k in np.lexsort((b, a, difference)):
        if free_a[a[k]] and free_b[b[k]]:
            free_a[a[k]] = free_b[b[k]] = False
            pairs.append((a[k], b[k]))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_LIST_BYTES:
            raise SlamError(f"{path}: {path.stat().st_size >> 20} MB is too large for a list of images")
        return path.read_text(encoding="utf-8", errors="replace").replace("\ufeff", "")
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror}); a recording has rgb.txt and depth.txt") from error


def _to_float(token: str) -> float:
    try:
        return float(token)
    except ValueError:
        return math.nan


def _check_inside(path: Path, number: int, name: str) -> None:
    """Refuse names that lead out of the folder; a list is data from elsewhere."""
    for kind in (PurePosixPath, PureWindowsPath):
        if kind(name).is_absolute() or ".." in kind(name).parts or PureWindowsPath(name).drive:
            raise SlamError(f"{path}:{number}: {name!r} leads out of the recording's folder")


def _ordered(path: Path, entries: list[tuple[float, str]], warnings: list[str]) -> ImageList:
    stamp = np.array([entry[0] for entry in entries])
    if np.abs(stamp).max() > 1e11:  # seconds since 1970 have ten digits before the point
        raise SlamError(f"{path}: stamps such as {entries[0][0]:.0f} are no seconds (nanoseconds?); divide them, so that 1 means 1 s")
    backwards = int((np.diff(stamp) < 0).sum())
    if backwards:
        warnings.append(f"{path}: not sorted by time ({backwards} steps back); sorted")
    order = np.argsort(stamp, kind="stable")
    is_first = np.concatenate([[True], np.diff(stamp[order]) > 0])
    if not is_first.all():
        warnings.append(f"{path}: {int((~is_first).sum())} repeated stamps; the first image of each is kept")
    order = order[is_first]
    return ImageList(path=path, stamp=stamp[order], name=[entries[i][1] for i in order], warnings=warnings)


def _no_association(folder: Path, colour: ImageList, depth: ImageList) -> str:
    after = np.searchsorted(depth.stamp, colour.stamp).clip(0, len(depth.stamp) - 1)
    gap = np.abs(colour.stamp[:, None] - depth.stamp[np.stack([after, (after - 1).clip(0)], axis=1)])
    return (
        f"{folder}: no depth image lies within {MAX_DIFFERENCE} s of a colour image (the nearest is {gap.min():.3f} s away); "
        "check that both lists use one clock and one unit"
    )


def _probe_size(folder: Path, names: list[str]) -> tuple[int, int] | None:
    """Find (width, height) of the first colour image that can be read, among a few."""
    for i in spread(len(names), PROBED):
        try:
            size = images.image_size(images.read_bytes(folder / names[i]))
        except BadFrame:
            continue
        if size is not None:
            return size
    return None


def _check_sizes(dataset: Dataset, size: tuple[int, int] | None) -> None:
    camera = dataset.camera
    if size is not None and size != (camera.width, camera.height):
        raise SlamError(
            f"{dataset.root}: colour images are {size[0]} x {size[1]} px but the calibration is for {camera.width} x {camera.height}; "
            "give the calibration of these images"
        )


def _doubts_about_depth(dataset: Dataset) -> list[str]:
    """Look at a few depth images: refuse what no frame of such a recording could give, warn of a doubtful unit."""
    with_depth = [i for i, path in enumerate(dataset.depth_path) if path]
    readings, errors = [], []
    for i in (with_depth[k] for k in spread(len(with_depth), PROBED)):
        try:
            depth = dataset.depth(i)
        except BadFrame as error:
            errors.append(error)
            continue
        if depth is not None:
            readings.append(depth[np.isfinite(depth)][::7])
    if errors and not readings:
        raise SlamError(str(errors[0]))
    values = np.concatenate(readings) if readings else np.empty(0)
    if len(values) == 0:
        return [f"{dataset.root}: the depth images looked at hold no reading"]
    return _doubtful_scale(dataset, values)


def _doubtful_scale(dataset: Dataset, values: np.ndarray) -> list[str]:
    scale = dataset.camera.depth_scale
    near, far = np.percentile(values, [25.0, 50.0])
    if near < NEAREST_READING and scale > 1000.0:
        likely, what = "1000 (millimetres)", f"a quarter of all readings is nearer than {near:.2f} m, where such cameras are blind"
    elif far > FARTHEST_MEDIAN and scale < 5000.0:
        likely, what = "5000", f"half of all readings is farther than {far:.1f} m, which no room is"
    else:
        return []
    return [f"{dataset.root}: with depth_scale {scale:g} {what}; is camera.depth_scale = {likely} right?"]
