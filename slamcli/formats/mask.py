"""Masks drawn by hand: a picture that is not black where something is to be left out, or from black to white by how much it counts."""

from pathlib import Path

import numpy as np

from slamcli.formats.picture import read_grey

MAX_PIXELS = 1 << 26


def read_mask(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read a mask (H, W) bool from a PNG or BMP; SlamError for what is no picture and for one of another size."""
    return read_shades(path, shape) > 0


def read_shades(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read a mask (H, W) uint8, 0 = black and 255 = white, as `read_mask` does."""
    return read_grey(path, max_pixels=MAX_PIXELS, shape=shape)
