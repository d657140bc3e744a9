"""Grey pictures that people draw or programs write: PNG and BMP, their size checked before they are decoded."""

import struct
from pathlib import Path

import cv2
import numpy as np

from slamcli import files
from slamcli.errors import SlamError

MAX_BYTES = 64 << 20
PNG_MAGIC, BMP_MAGIC = b"\x89PNG\r\n\x1a\n", b"BM"


def read_grey(path: Path, *, max_pixels: int) -> np.ndarray:
    """Read a picture as (H, W) uint8, row 0 at the top; SlamError for what is none, and for one too large to be meant."""
    try:
        data = files.read_bytes(path, limit=MAX_BYTES)
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror or error})") from error
    columns, rows = _size(data)
    if columns * rows > max_pixels:
        raise SlamError(f"{path}: {columns} x {rows} pixels are too many")
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE) if columns * rows else None
    except cv2.error as error:
        raise SlamError(f"{path}: cannot be decoded ({error.err})") from error
    if picture is None:
        raise SlamError(f"{path}: not a picture in PNG or BMP")
    return picture


def _size(data: bytes) -> tuple[int, int]:
    """Read width and height from the header of a PNG or BMP file; 0 by 0 for anything else."""
    if data.startswith(PNG_MAGIC) and len(data) >= 24:
        return struct.unpack(">II", data[16:24])
    if data.startswith(BMP_MAGIC) and len(data) >= 26:
        columns, rows = struct.unpack("<ii", data[18:26])
        return abs(columns), abs(rows)
    return 0, 0


def encoded(picture: np.ndarray, ending: str) -> bytes:
    """Encode a grey picture (H, W) uint8 as `.png` or `.bmp`."""
    return cv2.imencode(ending, picture)[1].tobytes()
