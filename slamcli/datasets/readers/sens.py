"""ScanNet's .sens: one binary file of JPEG pictures and zlib-packed depth."""

import mmap
import struct
import zlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import BinaryIO

import numpy as np

from slamcli.datasets.images import Picture, Pixels, check_whole
from slamcli.datasets.readers.scannet import of_two
from slamcli.datasets.recorded import Recorded, Stream, truth_of_rows
from slamcli.errors import BadFrame, SlamError

VERSION = 4
RAW, PNG, JPEG = 0, 1, 2  # of colour
RAW_DEPTH, ZLIB_DEPTH = 0, 1
FRAME = struct.Struct("<16f4Q")  # camera to world, stamps of colour and depth [us], their sizes
SIZES = struct.Struct("<2i4IfQ")  # kinds, widths and heights, depth scale, frames


def recognises(path: Path) -> bool:
    """Look for the suffix."""
    return path.is_file() and path.suffix.lower() == ".sens"


def read(path: Path) -> Recorded:
    """Read the head and find every frame without reading its images."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        try:
            version, length = struct.unpack("<IQ", file.read(12))
            if version != VERSION or length > 4096:
                raise SlamError(f"{path}: is no .sens file of version {VERSION}")
            file.seek(length, 1)
            matrices = np.frombuffer(file.read(4 * 64), dtype="<f4").astype(np.float64).reshape(4, 4, 4)
            colour_kind, depth_kind, *sizes, scale, n = SIZES.unpack(file.read(SIZES.size))
        except (struct.error, ValueError) as error:
            raise SlamError(f"{path}: is no .sens file, or is cut off") from error
        if colour_kind not in (RAW, PNG, JPEG) or depth_kind not in (RAW_DEPTH, ZLIB_DEPTH):
            raise SlamError(f"{path}: its images are packed in a way that is not known (colour {colour_kind}, depth {depth_kind})")
        frames = _frames(file, size, n)
    if not frames:
        raise SlamError(f"{path}: holds no whole frame")
    file_map = _Map(path)
    colour_size, depth_size = (sizes[0], sizes[1]), (sizes[2], sizes[3])
    stamps = np.array([frame[1] for frame in frames], dtype=np.float64)
    depth_stamps = np.array([frame[2] for frame in frames], dtype=np.float64)
    has_stamps = len(np.unique(stamps)) == len(stamps)
    k_colour, T_bc, k_depth, T_bd = matrices
    calibration = of_two(_intrinsics(k_colour, colour_size), _intrinsics(k_depth, depth_size), T_bc, T_bd, f"{path}: its head")
    return Recorded(
        reader="sens",
        root=path,
        colour=Stream(SensColour(file_map, [f[3] for f in frames], colour_kind, colour_size), stamps if has_stamps else None, str(path)),
        depth=Stream(SensDepth(file_map, [f[4] for f in frames], depth_kind, depth_size), depth_stamps if has_stamps else None, str(path)),
        calibration=calibration,
        is_paired=True,
        depth_scale=float(scale) if scale >= 1.0 else None,
        truth=truth_of_rows(np.array([frame[0] for frame in frames])),
        warnings=[f"{path}: is cut off; {len(frames)} of {n} frames are there"] if len(frames) < n else [],
    )


def _frames(file: BinaryIO, size: int, n: int) -> list[tuple[np.ndarray, int, int, tuple[int, int], tuple[int, int]]]:
    """Find (pose, stamps of colour and depth, place and size of colour, of depth) of every frame that is there as a whole."""
    found: list[tuple[np.ndarray, int, int, tuple[int, int], tuple[int, int]]] = []
    while len(found) < n:
        head = file.read(FRAME.size)
        if len(head) < FRAME.size:
            break
        *pose, colour_stamp, depth_stamp, colour_size, depth_size = FRAME.unpack(head)
        at = file.tell()
        if at + colour_size + depth_size > size:
            break
        T_wc = np.array(pose, dtype=np.float64).reshape(4, 4)
        found.append((T_wc, colour_stamp, depth_stamp, (at, colour_size), (at + colour_size, depth_size)))
        file.seek(at + colour_size + depth_size)
    return found


def _intrinsics(k: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    return {"width": size[0], "height": size[1], "fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}


class _Map:
    """The file as memory; pages are read when they are needed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with open(path, "rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def part(self, place: tuple[int, int]) -> bytes:
        return self._map[place[0] : place[0] + place[1]]


class SensColour:
    """Pictures of a .sens file."""

    label = "colour"

    def __init__(self, file: _Map, places: Sequence[tuple[int, int]], kind: int, size: tuple[int, int]) -> None:
        self._file, self._places, self._kind, self._size = file, places, kind, size

    @cached_property
    def names(self) -> list[str]:
        """Name images by number."""
        return [f"{self.label}#{i}" for i in range(len(self._places))]

    def where(self, i: int) -> str:
        """Name the file and the frame."""
        return f"{self._file.path}:{self.names[i]}"

    def n_bytes(self, i: int) -> int:
        """Return the size as stored."""
        return self._places[i][1]

    def read(self, i: int) -> Picture | np.ndarray:
        """Read one picture."""
        data = self._file.part(self._places[i])
        if self._kind != RAW:
            check_whole(data, self.where(i))
            return data
        width, height = self._size
        if len(data) != 3 * width * height:
            raise BadFrame(f"{self.where(i)}: {len(data)} bytes are no picture of {width} x {height} px")
        return Pixels(np.frombuffer(data, np.uint8).reshape(height, width, 3), "rgb8")


class SensDepth(SensColour):
    """Depth images of a .sens file."""

    label = "depth"

    def read(self, i: int) -> np.ndarray:
        """Unpack one depth image, (h, w) uint16."""
        data, (width, height) = self._file.part(self._places[i]), self._size
        wanted = 2 * width * height
        if self._kind == ZLIB_DEPTH:
            try:
                data = zlib.decompressobj().decompress(data, wanted + 1)
            except zlib.error as error:
                raise BadFrame(f"{self.where(i)}: is damaged ({error})") from error
        if len(data) != wanted:
            raise BadFrame(f"{self.where(i)}: {len(data)} bytes are no depth image of {width} x {height} px")
        return np.frombuffer(data, "<u2").reshape(height, width)
