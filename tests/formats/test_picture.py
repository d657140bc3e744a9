"""Grey pictures: back as written, and one line, within bounds, for what is none."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.formats import picture


@pytest.mark.parametrize("ending", [".png", ".bmp"])
def test_a_picture_is_read_back(tmp_path: Path, ending: str) -> None:
    grey = np.random.default_rng(0).integers(0, 256, (7, 13)).astype(np.uint8)
    (tmp_path / f"p{ending}").write_bytes(picture.encoded(grey, ending))
    np.testing.assert_array_equal(picture.read_grey(tmp_path / f"p{ending}", max_pixels=91), grey)
    with pytest.raises(SlamError, match="13 x 7 pixels are too many"):
        picture.read_grey(tmp_path / f"p{ending}", max_pixels=90)


def png_of(width: int, height: int) -> bytes:
    """The header of a picture of this size, and little more."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return picture.PNG_MAGIC + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)) + b"IDAT"


def wide_png(width: int) -> bytes:
    """A picture of one row, whole, with a size other than that of its data."""
    good = picture.encoded(np.zeros((1, 9), np.uint8), ".png")
    header = b"IHDR" + struct.pack(">I", width) + good[20:29]
    return good[:12] + header + struct.pack(">I", zlib.crc32(header)) + good[33:]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "not a picture"),
        (b"hello", "not a picture"),
        (picture.PNG_MAGIC, "not a picture"),
        (picture.BMP_MAGIC + bytes(40), "not a picture"),
        (png_of(100_000, 100_000), "100000 x 100000 pixels are too many"),
        (picture.BMP_MAGIC + bytes(16) + struct.pack("<ii", -100_000, 2**31 - 1) + bytes(30), "too many"),
        (
            picture.BMP_MAGIC + bytes(12) + struct.pack("<IHH", 12, 20_000, 20_000) + bytes(30),
            "20000 x 20000 pixels are too many",
        ),  # of OS/2
        (picture.encoded(np.zeros((9, 9), np.uint8), ".png")[:40], "not a picture"),
        (picture.BMP_MAGIC + bytes(16) + struct.pack("<ii", 1 << 21, 1) + bytes(30), "not a picture"),
        (wide_png(1 << 21), "not a picture|cannot be decoded"),  # wider than OpenCV allows: some versions raise, some return nothing
    ],
)
def test_what_is_no_picture_gives_one_line(tmp_path: Path, data: bytes, says: str) -> None:
    (tmp_path / "p.png").write_bytes(data)
    with pytest.raises(SlamError, match=says) as caught:
        picture.read_grey(tmp_path / "p.png", max_pixels=1 << 24)
    assert "p.png" in str(caught.value) and "\n" not in str(caught.value)


def test_a_picture_of_another_size_is_refused_before_it_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "p.png").write_bytes(picture.encoded(np.zeros((7, 13), np.uint8), ".png"))
    monkeypatch.setattr(picture.cv2, "imdecode", None)
    with pytest.raises(SlamError, match="is 13 x 7 px; it must have 7 x 13 px"):
        picture.read_grey(tmp_path / "p.png", max_pixels=1 << 24, shape=(13, 7))


def test_a_chunk_that_claims_more_than_there_is_reserves_no_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = picture.encoded(np.zeros((7, 13), np.uint8), ".png")
    at = good.index(b"IDAT") - 4
    (tmp_path / "p.png").write_bytes(good[:at] + struct.pack(">I", 1 << 30) + good[at + 4 :])
    monkeypatch.setattr(picture.cv2, "imdecode", None)
    with pytest.raises(SlamError, match="not a picture"):
        picture.read_grey(tmp_path / "p.png", max_pixels=1 << 24)


def test_a_missing_picture_is_named(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="none.png"):
        picture.read_grey(tmp_path / "none.png", max_pixels=10)
