"""Decoding of single images: exact values, and BadFrame for whatever is wrong with a file."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import SIZE, colour, depth, png

from slamcli.datasets import images
from slamcli.errors import BadFrame
from slamcli.formats.image_header import image_size


def grey(path: Path) -> np.ndarray:
    return images.decode_grey(images.read_bytes(path), SIZE, name=str(path))


def rgb(path: Path) -> np.ndarray:
    return images.decode_rgb(images.read_bytes(path), SIZE, name=str(path))


def raw_depth(path: Path) -> np.ndarray:
    return images.decode_depth(images.read_bytes(path), SIZE, name=str(path))


def written(folder: Path, data: bytes, name: str = "image.png") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def test_grey_of_png_is_the_integer_luma_formula(tmp_path: Path) -> None:
    bgr = colour()
    b, g, r = (bgr[..., k].astype(np.int64) for k in range(3))
    expected = (9798 * r + 19235 * g + 3735 * b + (1 << 14)) >> 15
    assert np.array_equal(grey(written(tmp_path, png(bgr))), expected)


def test_grey_of_jpeg_is_its_stored_luma(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(colour(), (0, 0), 4)
    path = written(tmp_path, png(smooth, ".jpg"), "image.jpg")
    assert np.abs(grey(path).astype(int) - cv2.cvtColor(smooth, cv2.COLOR_BGR2GRAY)).mean() < 2.0


def test_gamma_chunk_of_a_png_changes_nothing(tmp_path: Path) -> None:
    data = png(colour())
    gamma = bytes.fromhex("0000000467414d41000186a031e8965f")  # gAMA 1.0 with its checksum
    path = written(tmp_path, data[:33] + gamma + data[33:])
    assert np.array_equal(grey(path), grey(written(tmp_path, data, "plain.png")))


def test_rgb_has_red_first_and_depth_is_raw(tmp_path: Path) -> None:
    bgr, raw = colour(), depth()
    assert np.array_equal(rgb(written(tmp_path, png(bgr))), bgr[..., ::-1])
    assert np.array_equal(raw_depth(written(tmp_path, png(raw))), raw)


def test_grey_picture_serves_as_colour(tmp_path: Path) -> None:
    luma = colour()[..., 0]
    path = written(tmp_path, png(luma))
    assert np.array_equal(grey(path), luma)
    assert np.array_equal(rgb(path)[..., 1], luma)


SUFFIXES = (".png", ".jpg", ".bmp", ".tiff", ".ppm", ".pgm", ".webp")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_size_is_read_from_the_header(suffix: str) -> None:
    picture = colour() if suffix != ".pgm" else colour()[..., 0]
    assert image_size(png(picture, suffix)) == (64, 48)


def test_size_of_kinds_that_opencv_does_not_write() -> None:
    assert image_size(b"P5 # a remark\n640\n# another\n480 255\n") == (640, 480)
    assert image_size(b"Pf\n640 480\n-1.0\n") == (640, 480)
    entries = [(256, 3, 1, 640 << 16), (257, 4, 1, 480)]  # a short stands in the first two bytes
    assert image_size(b"MM\0*" + struct.pack(">IH", 8, 2) + b"".join(struct.pack(">HHII", *entry) for entry in entries)) == (640, 480)
    assert image_size(b"BM" + bytes(12) + struct.pack("<IHH", 12, 640, 480)) == (640, 480)
    assert image_size(b"BM" + bytes(12) + struct.pack("<Iii", 40, 640, -480)) == (640, 480)  # rows from the top
    assert image_size(b"RIFF" + bytes(4) + b"WEBPVP8X" + bytes(8) + (639).to_bytes(3, "little") + (479).to_bytes(3, "little")) == (640, 480)
    assert image_size(b"RIFF" + bytes(4) + b"WEBPVP8L" + bytes(4) + b"/" + struct.pack("<I", 639 | 479 << 14)) == (640, 480)


@pytest.mark.parametrize("length", [0, 3, 8, 20, 100])
def test_size_of_a_broken_header_is_unknown_or_right(length: int) -> None:
    for suffix in SUFFIXES:
        picture = colour() if suffix != ".pgm" else colour()[..., 0]
        assert image_size(png(picture, suffix)[:length]) in (None, SIZE)


@pytest.mark.parametrize(
    "claim",
    [
        b"GIF89a" + struct.pack("<HH", 30000, 30000) + bytes(30),
        b"II*\0" + struct.pack("<IHHHIIHHII", 8, 2, 256, 4, 1, 30000, 257, 4, 1, 30000),
        b"II*\0" + struct.pack("<IHHHIIHHIIHHII", 8, 3, 256, 4, 1, 64, 257, 4, 1, 48, 256, 4, 1, 30000),
        b"BM" + bytes(12) + struct.pack("<Iii", 40, 30000, 30000),
        b"P5 30000 30000 255\n",
        b"RIFF" + bytes(4) + b"WEBPVP8X" + bytes(8) + b"\xff" * 6,
        b"\x00\x00\x00\x0cjP  \r\n\x87\n" + bytes(40),
    ],
    ids=["gif", "tiff", "tiff of two widths", "bmp", "pgm", "webp", "jpeg 2000"],
)
def test_no_decoder_is_asked_for_what_is_too_large_or_of_no_known_kind(claim: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    asked = (
        lambda: images.decode_grey(claim, SIZE, name="x"),
        lambda: images.decode_rgb(claim, SIZE, name="x"),
        lambda: images.decode_depth(claim, SIZE, name="x"),
        lambda: images.decode_depth(claim, name="x"),
        lambda: images.decode_as_it_is(claim, name="x"),
        lambda: images.picture_size(claim, "x"),
    )
    for decode in asked:
        with pytest.raises(BadFrame, match=r"^x: (is |\d+ x \d+ px is too large)"):
            decode()


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_truncated_files_are_bad_frames(tmp_path: Path, suffix: str, share: float) -> None:
    data = png(colour(), suffix)
    path = written(tmp_path, data[: int(share * len(data))], f"image{suffix}")
    with pytest.raises(BadFrame, match="image"):
        grey(path)


def damaged(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes(50) + data[middle + 50 :]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "empty"),
        (b"no image at all", "not an image"),
        (png(depth().astype(np.uint8)), "8 bits"),
        (png(colour()), "3 channels"),
        (png(depth()[:40]), "64 x 40"),
        (damaged(png(depth())), "damaged"),
        (png(depth().astype(np.uint8)[..., None].repeat(4, axis=2)), "4 channels"),
    ],
)
def test_unusable_depth_is_told(tmp_path: Path, data: bytes, said: str) -> None:
    with pytest.raises(BadFrame, match=said):
        raw_depth(written(tmp_path, data, "depth.png"))


def test_huge_header_is_refused_before_memory_is_reserved(tmp_path: Path) -> None:
    data = bytearray(png(depth()))
    data[16:24] = (2**30).to_bytes(4, "big") * 2
    with pytest.raises(BadFrame, match="1073741824 x 1073741824"):
        raw_depth(written(tmp_path, bytes(data)))


def test_missing_file_and_folder_are_bad_frames(tmp_path: Path) -> None:
    for path in (tmp_path / "none.png", tmp_path):
        with pytest.raises(BadFrame, match="cannot be read"):
            grey(path)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("reduction", [1, 2, 3, 5, 8, 9])
def test_large_pictures_are_averaged_without_a_shift(suffix: str, reduction: int) -> None:
    """A ramp keeps its place: pixel u of the small picture lies at (u + 0.5) * reduction - 0.5 of the large one."""
    size = (720, 360)
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    ramp = (20 + 0.2 * u + 0.15 * v).astype(np.uint8)
    data = png(np.repeat(ramp[..., None], 3, axis=2), suffix)
    small = images.decode_grey(data, size, name="ramp", reduction=reduction)
    assert small.shape == (size[1] // reduction, size[0] // reduction)
    x, y = np.meshgrid(np.arange(small.shape[1]), np.arange(small.shape[0]))
    expected = 20 + 0.2 * ((x + 0.5) * reduction - 0.5) + 0.15 * ((y + 0.5) * reduction - 0.5) - 0.5  # the ramp is rounded down
    assert abs(float((small - expected).mean())) < 0.35 and np.abs(small - expected)[2:-2, 2:-2].max() < 3.0
    rgb = images.decode_rgb(data, size, name="ramp", reduction=reduction)
    assert rgb.shape == (*small.shape, 3) and np.abs(rgb[..., 1].astype(int) - small).max() <= 2


def test_a_picture_without_a_pixel_is_a_bad_frame() -> None:
    data = bytearray(cv2.imencode(".png", np.zeros((4, 5), np.uint8))[1].tobytes())
    assert images.picture_size(bytes(data), "p.png") == (5, 4)
    data[16:24] = bytes(8)
    with pytest.raises(BadFrame, match=r"p\.png: has no pixel"):
        images.picture_size(bytes(data), "p.png")
