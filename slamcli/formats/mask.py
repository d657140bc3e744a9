"""Masks drawn by hand: a picture that is not black where something is to be left out."""

from pathlib import Path

import cv2
import numpy as np

from slamcli.errors import SlamError

MAX_BYTES = 64 << 20


def read_mask(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read a mask (H, W) bool; SlamError for what is no picture and for one of another size."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SlamError(f"{path}: too large to be a mask")
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror})") from error
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if picture is None:
        raise SlamError(f"{path}: not a picture; a mask is a PNG that is not black where something is to be left out")
    if picture.shape != shape:
        raise SlamError(f"{path}: is {picture.shape[1]} x {picture.shape[0]} px; a mask of this must have {shape[1]} x {shape[0]} px")
    return picture > 0
