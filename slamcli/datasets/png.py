"""Decode the PNG files of recordings faster than libpng: 16-bit grey and 8-bit RGB, not interlaced, pixel for pixel what OpenCV gives.

Intel's ISA-L inflates in less than half the time of zlib, and most of a PNG's decoding is inflating. Everything else - palettes, alpha,
interlacing, animation, damage of any kind - is left to OpenCV, by returning None: so there is one judge of what is damaged.

PNG: ISO/IEC 15948, section 9 for the filters.
"""

import struct
import zlib
from types import ModuleType
from typing import Any

import numpy as np
from numba import int32, types, u1, u8, uint8, uint16, uintp

from slamcli.jit.kernel import kernel

MAGIC = b"\x89PNG\r\n\x1a\n"
HEADER = struct.Struct(
    ">4x4sIIBBBBB"
)  # of the chunk IHDR: its length, name, width, height, bits, colour type, compression, filter, interlacing
CHUNK, CHECKSUM = struct.Struct(">I4s"), struct.Struct(">I")  # the length and name before a chunk, and what follows it
GREY_16, RGB_8 = (16, 0), (8, 2)  # (bits, colour type)
BYTES_PER_PIXEL = {GREY_16: 2, RGB_8: 3}
# Chunks that say nothing about what OpenCV makes of the pixels. All others, transparency and animation among them, are for OpenCV.
HARMLESS = frozenset({b"pHYs", b"tEXt", b"zTXt", b"iTXt", b"tIME", b"gAMA", b"cHRM", b"sRGB", b"sBIT"})
PLAIN, SUB, UP, AVERAGE, PAETH = range(5)  # how a row is filtered
ZERO, ONE, TWO, THREE = (np.uintp(n) for n in range(4))  # unsigned: an index that may be negative is tested for and wrapped

_Bytes: Any = types.Array(types.uint8, 1, "C", readonly=True)


def _inflater() -> ModuleType:
    """Choose the fastest library there is; wheels of ISA-L exist for x86-64 and ARM, elsewhere zlib does."""
    try:
        from isal import isal_zlib
    except ImportError:
        return zlib
    return isal_zlib


_zlib = _inflater()


def rgb(data: bytes, size: tuple[int, int]) -> np.ndarray | None:
    """Decode an 8-bit RGB file of size (width, height) to (height, width, 3) uint8; None where OpenCV has to."""
    image = _decode(data, size, RGB_8)
    return None if image is None else image.reshape(size[1], size[0], 3)


def grey_16(data: bytes, size: tuple[int, int]) -> np.ndarray | None:
    """Decode a 16-bit grey file of size (width, height) to (height, width) uint16; None where OpenCV has to."""
    image = _decode(data, size, GREY_16)
    return None if image is None else image.view(">u2").astype(np.uint16)


def _decode(data: bytes, size: tuple[int, int], kind: tuple[int, int]) -> np.ndarray | None:
    """Decode a sound file of this kind and size to the bytes of its rows; None for anything else."""
    rows = _rows(data, size, kind)
    if rows is None:
        return None
    image = np.empty((size[1], size[0] * BYTES_PER_PIXEL[kind]), dtype=np.uint8)
    is_sound = _unfilter(
        np.frombuffer(rows, dtype=np.uint8), np.uint64(BYTES_PER_PIXEL[kind]), np.zeros(image.shape[1], dtype=np.uint8), image
    )
    return image if is_sound else None


def _rows(data: bytes, size: tuple[int, int], kind: tuple[int, int]) -> bytes | None:
    """Inflate a file's filtered rows; None where it is not a sound one of this kind and size."""
    parts = _parts(data, size, kind)
    if parts is None:
        return None
    n_bytes = size[1] * (1 + size[0] * BYTES_PER_PIXEL[kind])
    stream = _zlib.decompressobj()
    try:
        rows = stream.decompress(b"".join(parts), n_bytes + 1)  # however much a hostile file would inflate to
    except _zlib.error:
        return None
    return rows if len(rows) == n_bytes and stream.eof and not stream.unused_data else None


def _parts(data: bytes, size: tuple[int, int], kind: tuple[int, int]) -> list[memoryview] | None:
    """List the compressed parts of a sound file, None where anything else than this kind and size is found in it."""
    if not data.startswith(MAGIC) or len(data) < len(MAGIC) + HEADER.size:
        return None
    name, width, height, bits, colour, *methods = HEADER.unpack_from(data, len(MAGIC))
    if (name, width, height, bits, colour, *methods) != (b"IHDR", *size, *kind, 0, 0, 0):
        return None
    parts: list[memoryview] = []
    view, at, last = memoryview(data), len(MAGIC), b""
    while at + 12 <= len(data):
        n, name = CHUNK.unpack_from(data, at)
        end = at + 8 + n
        if end + 4 > len(data) or _zlib.crc32(view[at + 4 : end]) != CHECKSUM.unpack_from(data, end)[0]:
            return None
        if name == b"IDAT":
            if parts and last != b"IDAT":  # they must follow on one another
                return None
            parts.append(view[at + 8 : end])
        elif name == b"IEND":
            return parts
        elif name not in HARMLESS and not (name == b"IHDR" and at == len(MAGIC)):
            return None
        at, last = end + 4, name
    return None


@kernel
def _nearest(left, up, corner):
    """Return that of the three neighbours of a byte which is nearest to left + up - corner; the first of equal ones."""
    to_left, to_up = up - corner, left - corner
    to_left, to_up, to_corner = abs(to_left), abs(to_up), abs(to_left + to_up)
    nearest = up if to_up <= to_corner else corner
    return left if (to_left <= to_up) & (to_left <= to_corner) else nearest


@kernel
def _unfilter(rows: _Bytes, step: u8, above: u1[::1], image: u1[:, ::1]):
    """Undo the filter of each row; returns False where a row names a filter that does not exist.

    rows : (H (1 + N),) uint8, the filter before each row; step : bytes of a pixel, 2 or 3; above : (N,) uint8, 0; image : (H, N) uint8, filled
    Bytes are sums modulo 256. SUB, what OpenCV uses, and PAETH, most of the TUM recordings' depth, keep the pixel to the left in registers:
    each waits for the one before, and to read it back from memory would take longer than all else.
    """
    n = uintp(image.shape[1])
    at = uintp(1)
    for y in range(uintp(image.shape[0])):
        kind, row = rows[at - ONE], image[y]
        if kind == PLAIN:
            for k in range(n):
                row[k] = rows[at + k]
        elif kind == SUB:
            a = b = c = uint8(0)
            if step == TWO:
                for k in range(ZERO, n, TWO):
                    a, b = uint8(a + rows[at + k]), uint8(b + rows[at + k + ONE])
                    row[k], row[k + ONE] = a, b
            else:
                for k in range(ZERO, n, THREE):
                    a, b, c = uint8(a + rows[at + k]), uint8(b + rows[at + k + ONE]), uint8(c + rows[at + k + TWO])
                    row[k], row[k + ONE], row[k + TWO] = a, b, c
        elif kind == UP:
            for k in range(n):
                row[k] = uint8(above[k] + rows[at + k])
        elif kind == AVERAGE:
            for k in range(step):
                row[k] = uint8(rows[at + k] + (above[k] >> 1))
            for k in range(step, n):
                row[k] = uint8(rows[at + k] + ((uint16(row[k - step]) + uint16(above[k])) >> 1))
        elif kind == PAETH:
            a = b = c = upper_a = upper_b = upper_c = int32(0)
            if step == TWO:
                for k in range(ZERO, n, TWO):
                    here_a, here_b = int32(above[k]), int32(above[k + ONE])
                    a = (int32(rows[at + k]) + _nearest(a, here_a, upper_a)) & int32(255)
                    b = (int32(rows[at + k + ONE]) + _nearest(b, here_b, upper_b)) & int32(255)
                    row[k], row[k + ONE] = uint8(a), uint8(b)
                    upper_a, upper_b = here_a, here_b
            else:
                for k in range(ZERO, n, THREE):
                    here_a, here_b, here_c = int32(above[k]), int32(above[k + ONE]), int32(above[k + TWO])
                    a = (int32(rows[at + k]) + _nearest(a, here_a, upper_a)) & int32(255)
                    b = (int32(rows[at + k + ONE]) + _nearest(b, here_b, upper_b)) & int32(255)
                    c = (int32(rows[at + k + TWO]) + _nearest(c, here_c, upper_c)) & int32(255)
                    row[k], row[k + ONE], row[k + TWO] = uint8(a), uint8(b), uint8(c)
                    upper_a, upper_b, upper_c = here_a, here_b, here_c
        else:
            return False
        above = row
        at += ONE + n
    return True
