"""Colour and depth images with equal numbers in their names, or with time stamps for names; in two folders, or in one."""

import contextlib
import re
from pathlib import Path

import numpy as np

from slamcli.datasets import images
from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import (
    COLOUR_FOLDERS,
    DEPTH_FOLDERS,
    DEPTH_SUFFIXES,
    IMAGE_SUFFIXES,
    Folder,
    in_step,
    number_of,
    numbered,
    subfolder,
)
from slamcli.datasets.recorded import BY_NAME, BY_NUMBER, Recorded, Stream
from slamcli.datasets.sources import ConfidentDepth, ImageFiles
from slamcli.errors import BadFrame, SlamError

CONFIDENCE = "confidence"
LEAST_CONFIDENCE = {2: 2, 100: 100, 255: 255}  # by the largest value of an image: ARKit's levels and what programs make of them


FLAT_COLOUR, FLAT_DEPTH = ("color", "colour", "rgb", "image", "frame"), ("depth",)  # beginnings of names in one folder
STAMP = re.compile(r"\d+\.\d+|\d{13,19}")  # seconds with a fraction, or milliseconds and finer since 1970


def recognises(path: Path) -> bool:
    """Look for the two folders, or for both kinds of names in one."""
    has_folders = subfolder(path, COLOUR_FOLDERS) is not None and subfolder(path, DEPTH_FOLDERS) is not None
    return has_folders or (path.is_dir() and bool(_flat(path, FLAT_COLOUR)) and bool(_flat(path, FLAT_DEPTH)))


def read(path: Path) -> Recorded:
    """Pair what has equal numbers; a folder `confidence` of such numbers says which readings count."""
    if subfolder(path, COLOUR_FOLDERS) is None or subfolder(path, DEPTH_FOLDERS) is None:
        colour, depth = _flat(path, FLAT_COLOUR), _flat(path, FLAT_DEPTH)
        names = sorted(file.name for file in path.glob("intrinsics*.*"))[:1]
        return _paired(path, "numbered", find_calibration(path, tuple(names)), colour, depth)
    return of_folders(path, reader="numbered", calibration=find_calibration(path))


def _flat(path: Path, beginnings: tuple[str, ...]) -> dict[int, str]:
    """List the images of a folder whose names begin so, by number."""
    names = [name for name in Folder(path).files() if name.lower().startswith(beginnings) and Path(name).suffix.lower() in DEPTH_SUFFIXES]
    found = {number: name for name in names if (number := number_of(name)) is not None}
    return dict(sorted(found.items()))


def of_folders(
    path: Path,
    *,
    reader: str,
    calibration: Calibration,
    colour: str | None = None,
    depth: str | None = None,
    depth_scale: float | None = None,
) -> Recorded:
    """Return the images of two folders, found by their usual names where not given, by number."""
    colour, depth = colour or subfolder(path, COLOUR_FOLDERS), depth or subfolder(path, DEPTH_FOLDERS)
    folder = Folder(path)
    stamped = _stamped(path, folder, colour or "", depth or "", reader, calibration, depth_scale)
    if stamped is not None:
        return stamped
    pictures = numbered(folder, colour or "", IMAGE_SUFFIXES)
    depths = numbered(folder, depth or "", DEPTH_SUFFIXES)
    return _paired(path, reader, calibration, pictures, depths, depth_scale)


def _paired(
    path: Path, reader: str, calibration: Calibration, pictures: dict[int, str], depths: dict[int, str], depth_scale: float | None = None
) -> Recorded:
    """Pair images by number."""
    depths, shifted = in_step(list(pictures), depths, path)
    if not any(number in depths for number in pictures):
        raise SlamError(
            f"{path}: none of {_told(pictures, 'colour')} has the number of one of {_told(depths, 'depth')}; "
            "write an associations.txt with lines 'stamp colour stamp depth'"
        )
    numbers = list(pictures)
    depth_images = ImageFiles(path, [depths.get(number, "") for number in numbers])
    source, said = with_confidence(path, Folder(path), depth_images, numbers)
    return Recorded(
        reader=reader,
        root=path,
        colour=Stream(ImageFiles(path, list(pictures.values())), None, str(path), BY_NUMBER),
        depth=Stream(source, None, str(path), BY_NUMBER),
        calibration=calibration,
        is_paired=True,
        depth_scale=depth_scale,
        warnings=shifted + said,
    )


def _told(images: dict[int, str], kind: str) -> str:
    first = next(iter(images.values()), "")
    return f"{len(images)} {kind} images" + (f" (the first: {first})" if first else "")


def _stamped(
    path: Path, folder: Folder, colour: str, depth: str, reader: str, calibration: Calibration, depth_scale: float | None
) -> Recorded | None:
    """Read folders whose files are named by their time stamps; None where they are not."""
    streams = []
    for below, suffixes in ((colour, IMAGE_SUFFIXES), (depth, DEPTH_SUFFIXES)):
        files = [name for name in folder.files(below) if Path(name).suffix.lower() in suffixes]
        if not files or not all(STAMP.fullmatch(Path(name).stem) for name in files):
            return None
        stamp = np.array([float(Path(name).stem) for name in files])
        order = np.argsort(stamp, kind="stable")
        streams.append(Stream(ImageFiles(path, [f"{below}/{files[i]}" for i in order]), stamp[order], str(path / below), BY_NAME))
    return Recorded(reader=reader, root=path, colour=streams[0], depth=streams[1], calibration=calibration, depth_scale=depth_scale)


def with_confidence(path: Path, folder: Folder, depth: ImageFiles, numbers: list[int]) -> tuple[ImageFiles | ConfidentDepth, list[str]]:
    """Lay a folder of confidence images over depth, where there is one: only the highest level counts."""
    confidence = numbered(folder, CONFIDENCE, IMAGE_SUFFIXES)
    names = [confidence.get(number, "") for number in numbers]
    if not any(names):
        return depth, []
    highest = 0
    for name in [name for name in names if name][:: max(1, len(names) // 4)]:
        with contextlib.suppress(BadFrame):  # it is told when its frame is read
            image = images.decode_as_it_is(images.read_bytes(path / name), name=name)
            highest = max(highest, int(image.max()))
    least = LEAST_CONFIDENCE.get(highest, highest)
    if least <= 0:
        return depth, []
    return ConfidentDepth(depth, ImageFiles(path, names), least), [f"{path}: depth of low confidence counts as none"]
