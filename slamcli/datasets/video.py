"""Frames of a video file by number, decoded as they are asked for."""

import importlib
import threading
from collections import OrderedDict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.datasets.images import Pixels
from slamcli.errors import BadFrame, SlamError

KEPT = 12  # decoded frames: as many as threads may ask for out of order
AHEAD = 90  # frames that are rather decoded in passing than sought
MAX_FRAMES = 10_000_000
FORMATS = {"yuv420p": "yuv420p", "rgb8": "rgb24", "mono16": "gray16le"}  # FFmpeg's names of ours


def load_av(path: Path) -> Any:
    """Import PyAV; SlamError says how to install it."""
    try:
        return importlib.import_module("av")
    except ImportError:
        raise SlamError(f"{path}: video needs a library; pip install 'slamcli[video]'") from None


class VideoFrames:
    """The frames of one video track in the order in which they are shown."""

    def __init__(self, path: Path, *, track: int = 0, encoding: str = "yuv420p") -> None:
        self.path, self._track, self._encoding = path, track, encoding
        self._av = load_av(path)
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, Pixels] = OrderedDict()
        self._container: Any = None
        self._decoder: Any = None
        self._next = 0
        self.pts, self._sizes, self.time_base = self._index()
        self._row = {int(pts): row for row, pts in enumerate(self.pts)}

    @cached_property
    def names(self) -> list[str]:
        """Name frames by number."""
        return [f"{self.path.name}#{i}" for i in range(len(self.pts))]

    @property
    def seconds(self) -> np.ndarray:
        """Return the time of each frame since the beginning of the file, (N,) [s]."""
        return np.array([float(pts * self.time_base) for pts in self.pts])

    def where(self, i: int) -> str:
        """Name the file and the frame."""
        return f"{self.path}#{i}"

    def n_bytes(self, i: int) -> int:
        """Return the size of the frame's packet."""
        return int(self._sizes[i]) if 0 <= i < len(self._sizes) else -1

    def read(self, i: int) -> Pixels | np.ndarray:
        """Decode frame i, and on the way those between it and the last one asked for."""
        return self._frame(i)

    def _frame(self, i: int) -> Pixels:
        with self._lock:
            if i in self._kept:
                return self._kept[i]
            try:
                return self._decode_to(i)
            except (self._av.error.FFmpegError, ValueError, StopIteration) as error:
                self._decoder = None
                raise BadFrame(f"{self.where(i)}: cannot be decoded ({error or 'the video ends before it'})") from error

    def _decode_to(self, i: int) -> Pixels:
        if self._decoder is None or not self._next <= i < self._next + AHEAD:
            self._seek(i)
        while True:
            frame = next(self._decoder)
            row = self._row.get(int(frame.pts)) if frame.pts is not None else None
            if row is None:
                continue
            self._next = row + 1
            if row < i - KEPT:
                continue
            self._kept[row] = self._pixels(frame)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            if row >= i:
                if row > i:
                    raise ValueError("it is missing in the video")
                return self._kept[i]

    def _pixels(self, frame: Any) -> Pixels:
        return Pixels(frame.to_ndarray(format=FORMATS[self._encoding]), self._encoding)

    def _seek(self, i: int) -> None:
        if self._container is None:
            self._container = self._open()
        stream = self._container.streams.video[self._track]
        self._container.seek(int(self.pts[i]), stream=stream, backward=True)
        self._decoder = self._container.decode(stream)
        self._next = i

    def _open(self) -> Any:
        try:
            container = self._av.open(str(self.path))
        except (self._av.error.FFmpegError, OSError) as error:
            raise SlamError(f"{self.path}: is no video that can be read ({error})") from error
        if len(container.streams.video) <= self._track:
            raise SlamError(f"{self.path}: has {len(container.streams.video)} video tracks; number {self._track + 1} is needed")
        return container

    def _index(self) -> tuple[np.ndarray, np.ndarray, Any]:
        """Find the time and size of every frame without decoding any."""
        with self._open() as container:
            stream = container.streams.video[self._track]
            found: list[tuple[int, int]] = []
            try:
                for packet in container.demux(stream):
                    if packet.pts is not None and packet.size and len(found) < MAX_FRAMES:
                        found.append((int(packet.pts), int(packet.size)))
            except self._av.error.FFmpegError as error:
                if not found:
                    raise SlamError(f"{self.path}: is no video that can be read ({error})") from error
            if not found:
                raise SlamError(f"{self.path}: holds no video frame")
            table = np.array(sorted(found), dtype=np.int64)
            return table[:, 0], table[:, 1], stream.time_base


class VideoDepth(VideoFrames):
    """The frames of a track of 16-bit grey, as depth."""

    def __init__(self, path: Path, *, track: int) -> None:
        super().__init__(path, track=track, encoding="mono16")

    def read(self, i: int) -> np.ndarray:
        """Decode frame i, (h, w) uint16."""
        return self._frame(i).data
