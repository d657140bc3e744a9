"""Grey pictures that people draw or programs write: PNG and BMP, their size checked before they are decoded."""

from pathlib import Path

import cv2
import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.formats.image_header import PNG_MAGIC, image_size, is_whole

MAX_BYTES = 64 << 20
BMP_MAGIC = b"BM"


def read_grey(path: Path, *, max_pixels: int, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Read a picture as (H, W) uint8, row 0 at the top; SlamError for what is none, and for one too large to be meant or not of `shape`."""
    try:
        data = files.read_bytes(path, limit=MAX_BYTES)
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror or error})") from error
    is_there = is_whole(data) if data.startswith(PNG_MAGIC) else data.startswith(BMP_MAGIC)
    columns, rows = (image_size(data) if data.startswith((PNG_MAGIC, BMP_MAGIC)) else None) or (0, 0)
    if columns * rows > max_pixels:
        raise SlamError(f"{path}: {columns} x {rows} pixels are too many")
    if columns * rows:
        _check_shape((rows, columns), shape, path)
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE) if is_there and columns * rows else None
    except cv2.error as error:
        raise SlamError(f"{path}: cannot be decoded ({error.err})") from error
    if picture is None:
        raise SlamError(f"{path}: not a picture in PNG or BMP")
    _check_shape(picture.shape, shape, path)  # a PNG may say that it is to be turned
    return picture


def _check_shape(found: tuple[int, ...], shape: tuple[int, int] | None, path: Path) -> None:
    if shape is not None and found != shape:
        raise SlamError(f"{path}: is {found[1]} x {found[0]} px; it must have {shape[1]} x {shape[0]} px")


def encoded(picture: np.ndarray, ending: str) -> bytes:
    """Encode a grey picture (H, W) uint8 as `.png` or `.bmp`."""
    return cv2.imencode(ending, picture)[1].tobytes()
