"""Record3D's own file: a zip of JPEG pictures, LZFSE-packed depth in metres and confidence."""

import importlib
import json
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.datasets.images import check_whole
from slamcli.datasets.readers.record3d import METRES, intrinsics, stamps
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.errors import BadFrame, SlamError

MAX_MEMBER = 64 << 20  # bytes of one member, packed or unpacked
MAX_MEMBERS = 1_000_000
PICTURE = re.compile(r"rgbd/([0-9]{1,18})\.jpg")
LEAST_CONFIDENCE = 2  # of 0 1 2


def recognises(path: Path) -> bool:
    """Look for the suffix."""
    return path.is_file() and path.suffix.lower() == ".r3d"


def read(path: Path) -> Recorded:
    """Read the description and list the frames."""
    try:
        archive = zipfile.ZipFile(path)
        names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise SlamError(f"{path}: is no Record3D file, or is cut off ({error})") from error
    if len(names) > MAX_MEMBERS:
        raise SlamError(f"{path}: {len(names)} members are too many for a recording")
    about = _metadata(archive, path)
    numbers = sorted(int(found.group(1)) for name in names if (found := PICTURE.fullmatch(name)))
    if not numbers:
        raise SlamError(f"{path}: holds no picture rgbd/N.jpg")
    calibration, there = intrinsics(about, path), set(names)
    size = _depth_size(about, path)
    depth = PackedDepth(archive, path, [f"rgbd/{n}.depth" if f"rgbd/{n}.depth" in there else "" for n in numbers], size)
    return Recorded(
        reader="r3d",
        root=path,
        colour=Stream(Members(archive, path, [f"rgbd/{n}.jpg" for n in numbers]), stamps(about, numbers), str(path)),
        depth=Stream(depth, None, str(path)),
        calibration=calibration,
        is_paired=True,
        depth_scale=METRES,
    )


class Members:
    """Files in a zip."""

    def __init__(self, archive: zipfile.ZipFile, path: Path, names: Sequence[str]) -> None:
        self.archive, self.path, self.names = archive, path, names

    def where(self, i: int) -> str:
        """Name the archive and the member."""
        return f"{self.path}:{self.names[i]}"

    def n_bytes(self, i: int) -> int:
        """Return the member's size."""
        try:
            return self.archive.getinfo(self.names[i]).file_size
        except KeyError:
            return -1

    def read(self, i: int) -> bytes | np.ndarray:
        """Unpack one picture."""
        data = self._member(self.names[i], self.where(i))
        check_whole(data, self.where(i))
        return data

    def _member(self, name: str, where: str) -> bytes:
        try:
            info = self.archive.getinfo(name)
            if info.file_size > MAX_MEMBER:
                raise BadFrame(f"{where}: {info.file_size >> 20} MB is too large for an image")
            with self.archive.open(info) as member:
                return member.read(MAX_MEMBER)
        except KeyError:
            raise BadFrame(f"{where}: is not in the archive") from None
        except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError, ValueError, zlib.error) as error:
            raise BadFrame(f"{where}: is damaged ({error})") from error


class PackedDepth(Members):
    """Depth of a Record3D file, with readings of low confidence set to none."""

    def __init__(self, archive: zipfile.ZipFile, path: Path, names: Sequence[str], size: tuple[int, int]) -> None:
        super().__init__(archive, path, names)
        self._size = size
        self._has = set(archive.namelist())
        self._lzfse = _load_lzfse(path)

    def read(self, i: int) -> np.ndarray:
        """Unpack depth, (h, w) float32 [m]."""
        where, name = self.where(i), self.names[i]
        depth = self._array(name, where, np.float32)
        confidence = name.replace(".depth", ".conf")
        if confidence in self._has:
            depth = np.where(self._array(confidence, where, np.uint8) >= LEAST_CONFIDENCE, depth, np.float32(0))
        return depth

    def _array(self, name: str, where: str, dtype: type) -> np.ndarray:
        width, height = self._size
        try:
            data = self._lzfse.decompress(self._member(name, where))
        except (self._lzfse.error, MemoryError, ValueError) as error:
            raise BadFrame(f"{where}: is damaged ({error})") from error
        if len(data) != width * height * np.dtype(dtype).itemsize:
            raise BadFrame(f"{where}: {len(data)} bytes are no image of {width} x {height} px")
        return np.frombuffer(data, dtype=dtype).reshape(height, width)


def _metadata(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    try:
        if archive.getinfo("metadata").file_size > MAX_MEMBER:
            raise SlamError(f"{path}: its metadata are too large")
        about = json.loads(archive.read("metadata"))
    except KeyError:
        raise SlamError(f"{path}: holds no metadata; is it of Record3D?") from None
    except (ValueError, RecursionError, zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise SlamError(f"{path}: its metadata cannot be parsed") from error
    if not isinstance(about, dict):
        raise SlamError(f"{path}: its metadata are no table")
    return about


def _depth_size(about: dict[str, Any], path: Path) -> tuple[int, int]:
    try:
        width, height = int(about["dw"]), int(about["dh"])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise SlamError(f"{path}: its metadata do not say the size of depth, dw and dh") from None
    if not (0 < width <= 4096 and 0 < height <= 4096):
        raise SlamError(f"{path}: depth of {width} x {height} px cannot be right")
    return width, height


def _load_lzfse(path: Path) -> Any:
    try:
        return importlib.import_module("liblzfse")
    except ImportError:
        raise SlamError(f"{path}: Record3D's depth needs a library; pip install 'slamcli[phone]'") from None
