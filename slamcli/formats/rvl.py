"""RVL, lossless coding of 16-bit depth images: runs of zeros, and differences in variable-length code.

A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017, doi:10.1145/3132272.3134144. Numbers are written in groups of three bits,
the lowest first, each in a nibble whose top bit says that another follows; nibbles fill 32-bit little-endian words from the top.
"""

import numpy as np
from numba import i8, u1, u2, u4

from slamcli.errors import SlamError
from slamcli.jit.kernel import kernel

MOST_PIXELS_PER_BYTE = 500_000  # a run of zeros takes a few nibbles whatever its length; this bounds a hostile size
MAX_PIXELS = 100_000_000
MOST_NIBBLES = 7  # a pixel: 6 for a difference of 17 bits with its sign, and the lengths of runs


def decode(data: bytes, width: int, height: int) -> np.ndarray:
    """Decode an image, (height, width) uint16; SlamError where the code does not fill it exactly."""
    n = width * height
    if not 0 < n <= min(MAX_PIXELS, len(data) * MOST_PIXELS_PER_BYTE):
        raise SlamError(f"RVL image of {width} x {height} px cannot be right")
    padded = np.frombuffer(bytearray(data) + bytes(-len(data) % 4), dtype=np.uint8)  # writable, as `unpack` is compiled for
    out = np.zeros(n, dtype=np.uint16)
    if unpack(padded, out) != n:
        raise SlamError("RVL image is damaged or cut off")
    return out.reshape(height, width)


def encode(image: np.ndarray) -> bytes:
    """Encode an image (H, W) uint16; `decode` inverts it."""
    values = np.ascontiguousarray(image, dtype=np.uint16).ravel()
    words = np.zeros(MOST_NIBBLES * len(values) // 8 + 3, dtype=np.uint32)
    return words[: pack(values, words)].astype("<u4", copy=False).tobytes()


@kernel
def pack(values: u2[::1], words: u4[::1]) -> i8:
    """Encode into `words`, zeros before; returns how many the code takes."""
    n, at, start, previous = len(values), 0, 0, 0
    while start < n:
        first = start
        while first < n and values[first] == 0:
            first += 1
        stop = first
        while stop < n and values[stop] != 0:
            stop += 1
        at = put(words, at, first - start)
        at = put(words, at, stop - first)
        for k in range(first, stop):
            delta = i8(values[k]) - previous
            at = put(words, at, (delta << 1) ^ (delta >> 63))
            previous = i8(values[k])
        start = stop
    return (at + 7) >> 3


@kernel
def put(words, at, value):
    """Write one number at nibble `at`; returns the next nibble."""
    while True:
        nibble, value = value & 7, value >> 3
        nibble |= 8 if value else 0
        words[at >> 3] |= u4(nibble << (4 * (7 - (at & 7))))
        at += 1
        if value == 0:
            return at


@kernel
def unpack(data: u1[::1], out: u2[::1]) -> i8:
    """Decode into `out`; returns how many pixels the code gave, or -1 where it goes beyond them."""
    n, at, nibbles, pixel, previous = len(out), 0, 2 * len(data), 0, 0
    while pixel < n:
        for is_run_of_values in (False, True):
            count, at = number(data, at, nibbles)
            if at < 0 or count > n - pixel:
                return -1
            if not is_run_of_values:
                pixel += count
                continue
            for _ in range(count):
                code, at = number(data, at, nibbles)
                if at < 0:
                    return -1
                previous = (previous + ((code >> 1) ^ -(code & 1))) & 0xFFFF
                out[pixel] = previous
                pixel += 1
    return pixel


@kernel
def number(data, at, nibbles):
    """Read one number from nibble `at` on: (number, next nibble), next = -1 where the data end before it."""
    value, shift = 0, 0
    while at < nibbles:
        word, place = at >> 3, at & 7
        byte = i8(data[4 * word + 3 - (place >> 1)])
        nibble = (byte >> 4) if place & 1 == 0 else (byte & 15)
        at += 1
        value |= (nibble & 7) << shift
        if nibble < 8:
            return value, at
        shift += 3
        if shift > 33:
            return value, -1
    return value, -1
