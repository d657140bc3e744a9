"""Where the images of a recording are: files, or what a reader of one big file offers in their stead."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from slamcli.datasets import images
from slamcli.datasets.images import Picture
from slamcli.errors import BadFrame, SlamError


class Images(Protocol):
    """Images by index, readable from several threads at once."""

    @property
    def names(self) -> Sequence[str]:
        """Name each within its recording."""

    def where(self, i: int) -> str:
        """Name image i for a message, with its folder or file."""

    def n_bytes(self, i: int) -> int:
        """Return the size of image i as stored, -1 where it is missing."""

    def read(self, i: int) -> Picture | np.ndarray:
        """Read image i: a picture, or depth pixels (h, w); BadFrame where it cannot be read."""


class ImageFiles:
    """Image files of one folder."""

    def __init__(self, root: Path, names: Sequence[str]) -> None:
        self.root, self.names = root, names
        self._sizes: dict[int, int] = {}

    def where(self, i: int) -> str:
        """Return the path."""
        return str(self.root / self.names[i])

    def n_bytes(self, i: int) -> int:
        """Ask the file system, of each file once: that all are there, and what identifies the recording, is asked of a hundred thousand."""
        if i not in self._sizes:
            try:
                self._sizes[i] = os.stat(os.path.join(self.root, self.names[i])).st_size  # no Path of each
            except (OSError, ValueError):  # ValueError: a NUL byte in the name
                self._sizes[i] = -1
        return self._sizes[i]

    def read(self, i: int) -> bytes:
        """Read the whole file."""
        return images.read_bytes(self.root / self.names[i])


class ConfidentDepth:
    """Depth images whose readings count only where a second image, of confidence, is high enough."""

    def __init__(self, depth: Images, confidence: Images, least: int) -> None:
        self.names, self._depth, self._confidence, self._least = depth.names, depth, confidence, least

    def where(self, i: int) -> str:
        """Name the depth image."""
        return self._depth.where(i)

    def n_bytes(self, i: int) -> int:
        """Return the size of the depth image."""
        return self._depth.n_bytes(i)

    def read(self, i: int) -> np.ndarray:
        """Decode depth, and set readings of low confidence to 0, none."""
        raw = depth_pixels(self._depth, i)
        if not self._confidence.names[i] or self._confidence.n_bytes(i) < 0:
            return raw
        confidence = _grey_values(self._confidence, i)
        if confidence.shape != raw.shape:
            raise BadFrame(f"{self._confidence.where(i)}: has another size than {self._depth.where(i)}")
        return np.where(confidence >= self._least, raw, raw.dtype.type(0))


def depth_pixels(source: Images, i: int, size: tuple[int, int] | None = None) -> np.ndarray:
    """Decode depth image i, (h, w) uint16 or float32 as stored; `size` is the (width, height) it must have."""
    found = source.read(i)
    if isinstance(found, np.ndarray):
        return images.checked_depth(found, size, name=source.where(i))
    if isinstance(found, images.Pixels):
        raise BadFrame(f"{source.where(i)}: is a colour picture ({found.encoding}), not depth")
    return images.decode_depth(found, size, name=source.where(i))


def picture(source: Images, i: int) -> Picture:
    """Read picture i."""
    found = source.read(i)
    if isinstance(found, np.ndarray):
        raise BadFrame(f"{source.where(i)}: is depth, not a picture")
    return found


def _grey_values(source: Images, i: int) -> np.ndarray:
    found = source.read(i)
    if isinstance(found, np.ndarray):
        return found
    name = source.where(i)
    return images.decode_grey(found, images.picture_size(found, name), name=name)


def count_missing(source: Images, rows: np.ndarray, *, what: str) -> list[str]:
    """Warn of images that are named but not there; SlamError where most are missing."""
    missing = [int(i) for i in rows if i >= 0 and source.n_bytes(int(i)) < 0]
    n = int((rows >= 0).sum())
    if not missing:
        return []
    text = f"{len(missing)} of {n} {what} images are not there, the first is {source.where(missing[0])}"
    if len(missing) > n / 2:
        raise SlamError(f"{text}; copy or unpack the recording again, or shorten its list")
    return [text]
