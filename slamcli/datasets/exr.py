"""OpenEXR depth images; OpenCV's wheel is built without them."""

import importlib
import os
import tempfile

import numpy as np

from slamcli.errors import BadFrame, SlamError

MAX_PIXELS = 100_000_000


def decode(data: bytes, *, name: str) -> np.ndarray:
    """Decode the one channel of an EXR file, or the first of R, Z, Y, (H, W) float32; SlamError where no library is there for it."""
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise BadFrame(f"{name}: is no EXR file")
    try:
        library = importlib.import_module("OpenEXR")
    except ImportError:
        raise SlamError(f"{name}: EXR images need a library; pip install 'slamcli[phone]'") from None
    _check_window(data, name)
    with tempfile.NamedTemporaryFile(suffix=".exr", dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as file:
        file.write(data)
        file.flush()
        try:
            with library.File(file.name, separate_channels=True) as image:
                channels = image.channels()
                chosen = next((key for key in ("R", "Z", "Y", "depth", *channels) if key in channels), None)
                if chosen is None:
                    raise BadFrame(f"{name}: has no channel")
                return np.array(channels[chosen].pixels, dtype=np.float32)
        except BadFrame:
            raise
        except Exception as error:  # the library raises RuntimeError, ValueError and its own
            raise BadFrame(f"{name}: cannot be decoded ({error})") from error


def _check_window(data: bytes, name: str) -> None:
    """Refuse an absurd size before memory is reserved: the attribute dataWindow holds four 32-bit corners."""
    at = data.find(b"dataWindow\0box2i\0")
    if at < 0 or at + 37 > len(data):
        raise BadFrame(f"{name}: EXR header is damaged")
    left, top, right, bottom = np.frombuffer(data[at + 21 : at + 37], "<i4").astype(np.int64)
    if not 0 < (right - left + 1) * (bottom - top + 1) <= MAX_PIXELS or right < left:
        raise BadFrame(f"{name}: EXR size {right - left + 1} x {bottom - top + 1} cannot be right")
