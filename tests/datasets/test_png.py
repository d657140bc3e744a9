"""Our PNG decoder gives the pixels that OpenCV gives, or leaves the file to it; row filters are written here from the standard."""

import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.datasets import images, png
from slamcli.errors import BadFrame
from slamcli.formats.image_header import is_whole

FILTERS = range(5)


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def predicted(kind: int, left: int, up: int, corner: int) -> int:
    if kind == 4:
        return min((left, up, corner), key=lambda value: abs(left + up - corner - value))  # min keeps the first of equals
    return (0, left, up, (left + up) // 2)[kind]


def filtered(pixels: np.ndarray, kinds: list[int]) -> bytes:
    """Filter the rows of (H, N, step) uint8, each its own way: the slow twin of what the decoder undoes."""
    height, n, step = pixels.shape
    padded = np.zeros((height + 1, n + 1, step), dtype=int)
    padded[1:, 1:] = pixels
    out = bytearray()
    for y in range(height):
        out.append(kinds[y])
        for x in range(n):
            for c in range(step):
                value, left, up, corner = padded[y + 1, x + 1, c], padded[y + 1, x, c], padded[y, x + 1, c], padded[y, x, c]
                out.append((value - predicted(kinds[y], left, up, corner)) % 256)
    return bytes(out)


def encoded(
    image: np.ndarray,
    kinds: list[int],
    *,
    rows: Callable[[bytes], bytes] = lambda raw: raw,
    before: bytes = b"",
    piece: int = 1 << 20,
    interlaced: int = 0,
) -> bytes:
    """Write (H, W, 3) uint8 or (H, W) uint16 as PNG. rows : what becomes of the filtered rows; before : chunks before the image's own."""
    height, width = image.shape[:2]
    pixels = image if image.ndim == 3 else image.astype(">u2").view(np.uint8).reshape(height, width, 2)
    head = struct.pack(">IIBBBBB", width, height, *((8, 2) if image.ndim == 3 else (16, 0)), 0, 0, interlaced)
    body = zlib.compress(rows(filtered(pixels, kinds)))
    parts = b"".join(chunk(b"IDAT", body[k : k + piece]) for k in range(0, len(body), piece))
    return png.MAGIC + chunk(b"IHDR", head) + before + parts + chunk(b"IEND", b"")


def colour(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Colours that predictions come near, with bytes that wrap."""
    rng = np.random.default_rng(seed)
    return (np.cumsum(rng.integers(-9, 10, size=(height, width, 3)), axis=1) + rng.integers(0, 256, 3)).astype(np.uint8)


def depth(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 1 << 16, size=(height, width)).astype(np.uint16)


def by_opencv(data: bytes, flags: int) -> np.ndarray | None:
    return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)


@pytest.mark.parametrize("make", [colour, depth])
@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (31, 7), (64, 5)])
def test_every_filter_and_width_gives_the_pixels_that_were_written(make: Callable, kind: int, size: tuple[int, int]) -> None:
    image = make(size[1], size[0], seed=kind)
    found = (png.rgb if make is colour else png.grey_16)(encoded(image, [kind] * size[1]), size)
    assert found is not None
    assert found.dtype == image.dtype
    assert np.array_equal(found, image)


@given(seed=st.integers(0, 1000), kinds=st.lists(st.sampled_from(FILTERS), min_size=1, max_size=6), width=st.integers(1, 40))
def test_mixed_filters_give_what_opencv_gives(seed: int, kinds: list[int], width: int) -> None:
    size = (width, len(kinds))
    data = encoded(colour(len(kinds), width, seed), kinds, piece=17)
    assert np.array_equal(png.rgb(data, size), by_opencv(data, cv2.IMREAD_COLOR)[..., ::-1])
    data = encoded(depth(len(kinds), width, seed), kinds, piece=17)
    assert np.array_equal(png.grey_16(data, size), by_opencv(data, cv2.IMREAD_UNCHANGED))


@pytest.mark.parametrize("kind", FILTERS)
def test_a_whole_file_is_grey_as_by_opencv(kind: int) -> None:
    image = colour(48, 64, seed=kind)
    data = encoded(image, [kind] * 48)
    assert np.array_equal(images.decode_grey(data, (64, 48), name="image.png"), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def test_chunks_that_change_no_pixel_are_passed_over() -> None:
    image = colour(4, 5)
    told = chunk(b"gAMA", struct.pack(">I", 45455)) + chunk(b"tEXt", b"Software\0camera") + chunk(b"pHYs", bytes(9))
    assert np.array_equal(png.rgb(encoded(image, [1] * 4, before=told), (5, 4)), image)


OTHERS = {
    "transparency": lambda image: encoded(image, [0] * 4, before=chunk(b"tRNS", bytes(6))),
    "an unknown chunk": lambda image: encoded(image, [0] * 4, before=chunk(b"abCD", b"")),
    "an animation": lambda image: encoded(image, [0] * 4, before=chunk(b"acTL", bytes(8))),
    "a header twice": lambda image: encoded(image, [0] * 4, before=encoded(image, [0] * 4)[8:33]),
    "interlacing": lambda image: encoded(image, [0] * 4, interlaced=1),
    "a filter that does not exist": lambda image: encoded(image, [0] * 4, rows=lambda raw: b"\5" + raw[1:]),
    "rows too few": lambda image: encoded(image, [0] * 4, rows=lambda raw: raw[:-1]),
    "rows too many": lambda image: encoded(image, [0] * 4, rows=lambda raw: raw + b"\0"),
    "no image": lambda image: png.MAGIC + encoded(image, [0] * 4)[8:33] + chunk(b"IEND", b""),
    "a checksum that is wrong": lambda image: encoded(image, [0] * 4)[:-16] + b"\0\0\0\1" + encoded(image, [0] * 4)[-12:],
    "no end": lambda image: encoded(image, [0] * 4)[:-12],
    "an end cut off": lambda image: encoded(image, [0] * 4)[:-1],
    "another format": lambda image: cv2.imencode(".jpg", image)[1].tobytes(),
    "four channels": lambda image: cv2.imencode(".png", np.dstack([image, image[..., :1]]))[1].tobytes(),
    "one channel": lambda image: cv2.imencode(".png", image[..., 0])[1].tobytes(),
    "a data stream that goes on": lambda image: split_by(encoded(image, [0] * 4), chunk(b"IDAT", b"more")),
    "image data in two places": lambda image: split_by(encoded(image, [0] * 4), chunk(b"tEXt", b"a\0b") + chunk(b"IDAT", b"")),
    "nothing": lambda image: b"",
}


def split_by(data: bytes, more: bytes) -> bytes:
    """Put chunks before the last one."""
    return data[:-12] + more + data[-12:]


@pytest.mark.parametrize("what", OTHERS)
def test_whatever_is_not_plain_and_sound_is_left_to_opencv(what: str) -> None:
    data = OTHERS[what](colour(4, 5))
    assert png.rgb(data, (5, 4)) is None
    assert png.grey_16(data, (5, 4)) is None


def test_a_chunk_that_claims_more_than_the_file_has_is_refused_before_room_is_made_for_it() -> None:
    image = encoded(colour(4, 5), [0] * 4)
    assert is_whole(image)
    at = image.index(b"IDAT") - 4
    for length in (len(image), 1 << 30, (1 << 32) - 1):
        claimed = image[:at] + struct.pack(">I", length) + image[at + 4 :]
        assert not is_whole(claimed)
        with pytest.raises(BadFrame, match="cut off"):
            images.decode_grey(claimed, (5, 4), name="image.png")
    assert not is_whole(image[:-1])


def test_another_size_than_asked_for_is_left_to_opencv() -> None:
    data = encoded(colour(4, 5), [0] * 4)
    assert png.rgb(data, (4, 5)) is None
    assert png.rgb(data, (5, 4)) is not None


@given(seed=st.integers(0, 10_000))
def test_a_damaged_file_is_decoded_as_by_opencv_or_is_a_bad_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(encoded(colour(6, 9, seed), list(rng.integers(0, 5, 6))))
    for at in rng.integers(8, len(data), size=rng.integers(1, 4)):
        data[at] = rng.integers(0, 256)
    found = png.rgb(bytes(data), (9, 6))
    assert found is None or np.array_equal(found, by_opencv(bytes(data), cv2.IMREAD_COLOR)[..., ::-1])


def test_what_inflates_to_gigabytes_takes_no_more_memory_than_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    class Stream:
        eof, unused_data = False, b""

        def decompress(self, data: bytes, most: int) -> bytes:
            asked.append(most)
            return bytes(most)

    bomb = encoded(colour(4, 5), [0] * 4, rows=lambda raw: raw + bytes(1 << 20))
    with monkeypatch.context() as patch:
        patch.setattr(png._zlib, "decompressobj", Stream)
        assert png.rgb(bomb, (5, 4)) is None
    assert asked == [4 * (1 + 3 * 5) + 1]
    with pytest.raises(BadFrame, match=r"bomb\.png"):
        images.decode_grey(bomb[: len(bomb) // 2], (5, 4), name="bomb.png")
