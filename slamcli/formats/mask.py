"""Masks drawn by hand: a picture that is not black where something is to be left out."""

from pathlib import Path

import numpy as np

from slamcli.errors import SlamError
from slamcli.formats.picture import read_grey

MAX_PIXELS = 1 << 26


def read_mask(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read a mask (H, W) bool from a PNG or BMP; SlamError for what is no picture and for one of another size."""
    picture = read_grey(path, max_pixels=MAX_PIXELS)
    if picture.shape != shape:
        raise SlamError(f"{path}: is {picture.shape[1]} x {picture.shape[0]} px; a mask of this must have {shape[1]} x {shape[0]} px")
    return picture > 0
