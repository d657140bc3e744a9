"""The size of an encoded image from its first bytes, so that no decoder reserves memory for what a few bytes merely claim.

What has no row here is not decoded: OpenCV knows further kinds, of which no recording holds any, and a GIF of a few bytes takes gigabytes.
"""

import re
import struct
from collections.abc import Callable

Size = tuple[int, int]  # width, height

PNG_MAGIC, JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
KINDS = "PNG, JPEG, TIFF, BMP, PNM, PFM, WebP"
JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0..15 without DHT, JPG, DAC
JPEG_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD9)})  # carry no length
TIFF_SIDES, TIFF_NUMBERS = {256: 0, 257: 1}, {3: "H", 4: "I"}  # tags of width and length; kinds of number that they may be
PNM_HEADER = re.compile(rb"P[1-6Ff](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
PNM_LONGEST = 4096  # bytes of a header with its comments
PNG_CHUNK = 12  # bytes around a chunk's data: length, kind, checksum
OLD_BMP = 12  # bytes of the header of OS/2, with shorter numbers


def image_size(data: bytes) -> Size | None:
    """Read (width, height) from an image's header; None for other kinds and for broken headers."""
    for magic, read in READERS.items():
        if data.startswith(magic):
            try:
                return read(data)
            except (struct.error, IndexError):  # cut off
                return None
    return None


def is_whole(png: bytes) -> bool:
    """Say whether all chunks lie within a PNG file; OpenCV reserves and clears whatever length a chunk claims, up to 2 GB."""
    at, name = len(PNG_MAGIC), b""
    while name != b"IEND" and at + PNG_CHUNK <= len(png):
        length, name = struct.unpack_from(">I4s", png, at)
        at += PNG_CHUNK + length
    return name == b"IEND" and at <= len(png)


def _png(data: bytes) -> Size | None:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg(data: bytes) -> Size | None:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in JPEG_SIZE_MARKERS:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker == 0xFF:  # fill byte
            at += 1
        elif marker in JPEG_BARE_MARKERS:
            at += 2
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _tiff(data: bytes) -> Size | None:
    order = "<" if data.startswith(b"II") else ">"
    (directory,) = struct.unpack_from(f"{order}I", data, 4)
    (n_entries,) = struct.unpack_from(f"{order}H", data, directory)
    sides: dict[int, int] = {}
    for at in range(directory + 2, directory + 2 + 12 * n_entries, 12):
        tag, kind = struct.unpack_from(f"{order}HH", data, at)
        if tag in TIFF_SIDES:
            if TIFF_SIDES[tag] in sides or kind not in TIFF_NUMBERS:
                return None
            (sides[TIFF_SIDES[tag]],) = struct.unpack_from(f"{order}{TIFF_NUMBERS[kind]}", data, at + 8)
    return (sides[0], sides[1]) if len(sides) == len(TIFF_SIDES) else None


def _bmp(data: bytes) -> Size | None:
    (length,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if length == OLD_BMP else "<ii", data, 18)
    return abs(width), abs(height)


def _pnm(data: bytes) -> Size | None:
    found = PNM_HEADER.match(data[:PNM_LONGEST])
    return (int(found[1]), int(found[2])) if found else None


def _webp(data: bytes) -> Size | None:
    kind = data[8:16]
    if kind == b"WEBPVP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"WEBPVP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"WEBPVP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    return None


READERS: dict[bytes, Callable[[bytes], Size | None]] = {
    PNG_MAGIC: _png,
    JPEG_MAGIC: _jpeg,
    b"II*\x00": _tiff,
    b"MM\x00*": _tiff,
    b"BM": _bmp,
    b"P": _pnm,
    b"RIFF": _webp,
}
