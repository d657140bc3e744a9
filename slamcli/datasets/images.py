"""Decode colour and depth images; whatever is wrong with one becomes a BadFrame that names it.

Colour is decoded without honouring EXIF orientation: turning the picture would break its calibration. Grey is the luma of ITU-R BT.601 in
integer arithmetic, hence the same on every machine: a JPEG stores it, a PNG's is computed by the fixed-point formula of
``cv2.cvtColor`` (libpng's own reduction would honour gamma chunks and differ by a grey level in half of all pixels).
"""

import tokenize
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slamcli import files
from slamcli.datasets import png
from slamcli.errors import BadFrame, SlamError
from slamcli.formats.image_header import JPEG_MAGIC, KINDS, image_size, is_whole

MAX_BYTES = 256 << 20  # of one image file
MAX_PIXELS = 100_000_000  # of one image
EXR_MAGIC = b"\x76\x2f\x31\x01"
NPY_MAGIC = b"\x93NUMPY"
REDUCED = {2: cv2.IMREAD_REDUCED_GRAYSCALE_2, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4, 8: cv2.IMREAD_REDUCED_GRAYSCALE_8}
REDUCED_COLOUR = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}

# How pixels that come without a file format become (grey, RGB): OpenCV's conversion, None = none needed, "" = drop nothing.
# The names are those of ROS (sensor_msgs/image_encodings) and FFmpeg. A Bayer pattern is named by OpenCV one pixel farther along.
TO_GREY_AND_RGB: dict[str, tuple[int | None, int | None]] = {
    "rgb8": (cv2.COLOR_RGB2GRAY, None),
    "bgr8": (cv2.COLOR_BGR2GRAY, cv2.COLOR_BGR2RGB),
    "rgba8": (cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2RGB),
    "bgra8": (cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2RGB),
    "mono8": (None, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2RGB),
    "yuv422": (cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (cv2.COLOR_YUV2GRAY_YUY2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (cv2.COLOR_YUV2GRAY_YUY2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv420p": (cv2.COLOR_YUV2GRAY_I420, cv2.COLOR_YUV2RGB_I420),
    "nv12": (cv2.COLOR_YUV2GRAY_NV12, cv2.COLOR_YUV2RGB_NV12),
}
PLANAR = ("yuv420p", "nv12")  # rows of luma, then half as many of chroma
LIMITED = ("yuv420p", "nv12", "yuv422", "uyvy", "yuv422_yuy2", "yuyv")  # luma from 16, black, to 235, white: ITU-R BT.601
FULL_RANGE = np.clip(np.rint((np.arange(256) - 16.0) * (255.0 / 219.0)), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Pixels:
    """Pixels that come without a file format, as messages and videos carry them."""

    data: np.ndarray  # (H, W, C) or (H, W) uint8; PLANAR: (3 H / 2, W)
    encoding: str  # a row of TO_GREY_AND_RGB

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) [px]."""
        height, width = self.data.shape[:2]
        return (width, height * 2 // 3) if self.encoding in PLANAR else (width, height)


Picture = bytes | Pixels


def read_bytes(path: Path) -> bytes:
    """Read a whole image file; BadFrame where it is missing, empty, cut off or absurdly large."""
    try:
        data = files.read_bytes(path, limit=MAX_BYTES)
    except OSError as error:
        raise BadFrame(f"{path}: cannot be read ({error.strerror})") from error
    except SlamError as error:
        raise BadFrame(str(error)) from error
    check_whole(data, str(path))
    return data


def check_whole(data: bytes, name: str) -> None:
    """Raise BadFrame for an encoded image that is empty or cut off."""
    if not data:
        raise BadFrame(f"{name}: is empty (0 bytes)")
    if data.startswith(png.MAGIC) and b"IEND" not in data[-64:]:
        raise BadFrame(f"{name}: PNG is cut off")
    # Decoders fill the missing part of a JPEG with grey and go on; trailing bytes after the end marker are common and harmless.
    if data.startswith(JPEG_MAGIC) and b"\xff\xd9" not in data[-4096:]:
        raise BadFrame(f"{name}: JPEG is cut off")


def picture_size(picture: Picture, name: str) -> tuple[int, int]:
    """Return (width, height) of a picture, from its header where that says it; BadFrame where it is no picture."""
    if isinstance(picture, Pixels):
        found = picture.size
    else:
        found = _claimed_size(picture, name)
    if 0 in found:
        raise BadFrame(f"{name}: has no pixel ({found[0]} x {found[1]} px)")
    return found


def decode_grey(picture: Picture, size: tuple[int, int], *, name: str, reduction: int = 1) -> np.ndarray:
    """Return the grey image, (height // reduction, width // reduction) uint8; `size` is the (width, height) it must have before."""
    if isinstance(picture, Pixels):
        return _reduced(_converted(picture, 0, size, name), size, reduction)
    _check_size(picture, size, name)
    if picture.startswith(JPEG_MAGIC):
        flags = REDUCED.get(_power(reduction), cv2.IMREAD_GRAYSCALE)
        return _reduced(_decode(picture, flags, name, None if flags in REDUCED.values() else size), size, reduction)
    rgb = png.rgb(picture, size)
    if rgb is not None:
        return _reduced(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, reduction)
    return _reduced(cv2.cvtColor(_decode(picture, cv2.IMREAD_COLOR, name, size), cv2.COLOR_BGR2GRAY), size, reduction)


def decode_rgb(picture: Picture, size: tuple[int, int], *, name: str, reduction: int = 1) -> np.ndarray:
    """Return the colour image, (height // reduction, width // reduction, 3) uint8, red first."""
    if isinstance(picture, Pixels):
        return _reduced(_converted(picture, 1, size, name), size, reduction)
    _check_size(picture, size, name)
    rgb = png.rgb(picture, size)
    if rgb is not None:
        return _reduced(rgb, size, reduction)
    flags = REDUCED_COLOUR.get(_power(reduction), cv2.IMREAD_COLOR) if picture.startswith(JPEG_MAGIC) else cv2.IMREAD_COLOR
    image = _decode(picture, flags, name, size if flags == cv2.IMREAD_COLOR else None)
    return cv2.cvtColor(_reduced(image, size, reduction), cv2.COLOR_BGR2RGB)


def decode_depth(data: bytes, size: tuple[int, int] | None = None, *, name: str) -> np.ndarray:
    """Return the raw depth image, (height, width) uint16 or float32; BadFrame for any other pixel type, 8 bits above all.

    PNG, TIFF and PNM of 16 bits or of floats, EXR, and numpy's .npy without objects.
    """
    if data.startswith(EXR_MAGIC):
        from slamcli.datasets import exr

        raw = exr.decode(data, name=name)
    elif data.startswith(NPY_MAGIC):
        raw = decode_npy(data, name)
    else:
        _check_size(data, size, name)
        grey = png.grey_16(data, size or image_size(data) or (0, 0))
        raw = _decode(data, cv2.IMREAD_UNCHANGED, name) if grey is None else grey
    return checked_depth(raw, size, name=name)


def checked_depth(raw: np.ndarray, size: tuple[int, int] | None = None, *, name: str) -> np.ndarray:
    """Return depth pixels as (height, width) uint16 or float32; BadFrame where they are of another kind."""
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    if raw.ndim != 2:
        channels = raw.shape[2] if raw.ndim == 3 else raw.ndim
        raise BadFrame(f"{name}: has {channels} channels; depth must be a one-channel image of 16 bits")
    if raw.dtype == np.uint8:
        raise BadFrame(f"{name}: has 8 bits a pixel; depth must have 16 (was it saved as a picture for viewing?)")
    if raw.dtype.kind == "f" and raw.itemsize in (2, 4, 8):
        raw = np.ascontiguousarray(raw, dtype=np.float32)
    elif raw.dtype.kind in "ui" and raw.itemsize > 2:
        raw = np.where((raw > 0) & (raw < 65535), raw, 0).astype(np.uint16)
    elif raw.dtype.kind == "i":
        raw = np.maximum(raw, 0).astype(np.uint16)
    elif raw.dtype != np.uint16:
        raise BadFrame(f"{name}: has pixels of type {raw.dtype}; depth must be 16-bit whole numbers or floating-point metres")
    if size is not None and raw.shape[::-1] != size:
        raise _size_error(name, (raw.shape[1], raw.shape[0]), size)
    return raw


def decode_npy(data: bytes, name: str) -> np.ndarray:
    """Read an array of numbers in numpy's own format; nothing is unpickled, and the header's size is believed only up to the file's."""
    import io

    try:
        stream = io.BytesIO(data)
        version = np.lib.format.read_magic(stream)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
        if dtype.hasobject or dtype.kind not in "uif" or int(np.prod(shape, dtype=np.float64)) * dtype.itemsize > len(data):
            raise BadFrame(f"{name}: is no array of numbers, or is cut off")
        return np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OverflowError, SyntaxError, TypeError, tokenize.TokenError) as error:  # all that numpy's header may raise
        raise BadFrame(f"{name}: is damaged ({error})") from error


def _converted(picture: Pixels, which: int, size: tuple[int, int], name: str) -> np.ndarray:
    if picture.encoding not in TO_GREY_AND_RGB:
        raise BadFrame(f"{name}: pixels of kind {picture.encoding!r} are not known; known are {', '.join(TO_GREY_AND_RGB)}")
    if picture.size != size:
        raise _size_error(name, picture.size, size)
    code = TO_GREY_AND_RGB[picture.encoding][which]
    image = picture.data if code is None else cv2.cvtColor(picture.data, code)
    return cv2.LUT(image, FULL_RANGE) if which == 0 and picture.encoding in LIMITED else image


def _power(reduction: int) -> int:
    """Return the largest reduction that JPEG's decoder offers up to this one."""
    return max((power for power in REDUCED if power <= reduction), default=1)


def _reduced(image: np.ndarray, size: tuple[int, int], reduction: int) -> np.ndarray:
    """Average an image, which may have been reduced in part already, to its final size."""
    wanted = (size[0] // reduction, size[1] // reduction)
    return image if image.shape[1::-1] == wanted else cv2.resize(image, wanted, interpolation=cv2.INTER_AREA)


def _check_size(data: bytes, size: tuple[int, int] | None, name: str) -> None:
    """Compare the header's size before any memory is reserved for pixels."""
    found = _claimed_size(data, name)
    if size is not None and found != size:
        raise _size_error(name, found, size)


def _claimed_size(data: bytes, name: str) -> tuple[int, int]:
    """Read the size from the header; BadFrame for what is no image of a known kind, and for one too large to be meant."""
    found = image_size(data)
    if found is None:
        raise BadFrame(f"{name}: is damaged, or not an image ({KINDS})")
    if found[0] * found[1] > MAX_PIXELS:
        raise BadFrame(f"{name}: {found[0]} x {found[1]} px is too large for an image")
    return found


def decode_as_it_is(data: bytes, *, name: str) -> np.ndarray:
    """Decode an image whose size and kind of pixels are not known before, as (H, W) or (H, W, C) of its own type."""
    _check_size(data, None, name)
    return _decode(data, cv2.IMREAD_UNCHANGED, name)


def _decode(data: bytes, flags: int, name: str, size: tuple[int, int] | None = None) -> np.ndarray:
    if data.startswith(png.MAGIC) and not is_whole(data):
        raise BadFrame(f"{name}: PNG is cut off")
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise BadFrame(f"{name}: cannot be decoded ({error.err})") from error
    if image is None:
        raise BadFrame(f"{name}: is damaged, or not an image")
    if size is not None and image.shape[1::-1] != size:
        raise _size_error(name, image.shape[1::-1], size)
    return image


def _size_error(name: str, found: tuple[int, ...], size: tuple[int, int]) -> BadFrame:
    return BadFrame(f"{name}: is {found[0]} x {found[1]} px, the others are {size[0]} x {size[1]}; all images of a recording have one size")
