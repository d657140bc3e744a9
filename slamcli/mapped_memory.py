"""Arrays that lie in files and are mapped into memory: what was read of them is let go before a long recording fills the memory with it.

A page that a file holds as well can be dropped at any time; who reads it again gets it from the file, as a rule from the system's cache.
So a stage may read and make arrays with a row for each feature as if all memory were its own.
"""

import mmap
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO
from weakref import WeakSet

import numpy as np

from slamcli import files

MOST_RESIDENT = 384 << 20  # bytes of mapped files in memory, a third of which are the libraries
LEAST_FILE = 64 << 20  # bytes of an array that is worth a file
AT_ONCE = 2 << 20  # bytes made or copied at once: what goes into them takes several times as many
LOOK = 0.02  # [s] between looks at the resident memory

_CAN_RELEASE = hasattr(mmap, "MADV_DONTNEED")
_maps: WeakSet[mmap.mmap] = WeakSet()  # whose pages may be dropped
_lock = threading.Lock()  # of _maps
_room: list[Path] = []  # folders for the files of large arrays, the latest block's last


@contextmanager
def bounded(folder: Path) -> Iterator[None]:
    """Hold what is mapped and `adopt`ed within the block to MOST_RESIDENT bytes; what `empty` makes of large arrays lies in `folder`."""
    done = threading.Event()
    watch = threading.Thread(target=_watch, args=(done,), name="slamcli-mapped", daemon=True)
    _room.append(folder)
    watch.start()
    try:
        yield
    finally:
        _room.remove(folder)
        done.set()
        watch.join()
        if not _room:
            with _lock:
                _maps.clear()


def adopt(array: np.ndarray) -> None:
    """Let the memory of an array that is read alone be dropped until the block ends; nothing happens to one that no file holds.

    What was written to a private map would be forgotten. Other threads may read it meanwhile.
    """
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    if _room and isinstance(base, mmap.mmap):
        _add(base)


def empty(shape: tuple[int, ...], dtype: np.typing.DTypeLike) -> np.ndarray:
    """Make an array, of any content; a large one within `bounded` in a file without a name. SlamError where the disk is too full for it."""
    return zeros(shape, dtype) if _has_file(shape, dtype) else np.empty(shape, dtype)


def zeros(shape: tuple[int, ...], dtype: np.typing.DTypeLike) -> np.ndarray:
    """Make an array of zeros where `empty` would make it."""
    if not _has_file(shape, dtype):
        return np.zeros(shape, dtype)
    size = _bytes(shape, dtype)
    with files.written(_room[-1]), tempfile.TemporaryFile(dir=_room[-1]) as file:
        _reserve(file, size)
        mapped = mmap.mmap(file.fileno(), size)
    _add(mapped)
    return np.frombuffer(mapped, dtype=dtype).reshape(shape)


def copy(array: np.ndarray) -> np.ndarray:
    """Copy an array into one that `empty` makes."""
    return by_blocks(lambda rows: array[rows], len(array), array.shape[1:], array.dtype)


def by_blocks(values: Callable[[slice], np.ndarray], n: int, tail: tuple[int, ...], dtype: np.typing.DTypeLike) -> np.ndarray:
    """Make an array (n, *tail) as `empty` does, a block of rows at a time, of what `values` gives, or gives each row, for a slice of them."""
    out = empty((n, *tail), dtype)
    for rows in blocks(out):
        out[rows] = values(rows)
        release_beyond(MOST_RESIDENT)
    return out


def blocks(array: np.ndarray) -> Iterator[slice]:
    """Divide the rows of an array into slices of AT_ONCE bytes."""
    step = max(1, AT_ONCE // max(1, array.nbytes // max(1, len(array))))
    return (slice(first, min(first + step, len(array))) for first in range(0, len(array), step))


def release_beyond(most: int) -> None:
    """Drop the pages of all adopted maps where more than `most` bytes of mapped files are in memory."""
    if _CAN_RELEASE and _maps and _resident() > most:
        with _lock:
            for mapped in _maps:
                mapped.madvise(mmap.MADV_DONTNEED)


def _bytes(shape: tuple[int, ...], dtype: np.typing.DTypeLike) -> int:
    return int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize


def _has_file(shape: tuple[int, ...], dtype: np.typing.DTypeLike) -> bool:
    return bool(_room) and _bytes(shape, dtype) >= LEAST_FILE


def _add(mapped: mmap.mmap) -> None:
    with _lock:
        _maps.add(mapped)


def _reserve(file: BinaryIO, size: int) -> None:
    """Take room on the disk: where it lacked, writing to the mapped file would end the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
        return
    for first in range(0, size, AT_ONCE):
        file.write(bytes(min(AT_ONCE, size - first)))
    file.flush()


def _watch(done: threading.Event) -> None:
    while not done.wait(LOOK):
        release_beyond(MOST_RESIDENT)


def _resident() -> int:
    """Return how many bytes of mapped files are in memory; 0 where the system does not tell."""
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[2]) * mmap.PAGESIZE
    except OSError:
        return 0
