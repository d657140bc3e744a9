"""Arrays in files: what was read of them can be let go at any time and comes back as it was."""

import errno
import mmap
import os
from pathlib import Path

import numpy as np
import pytest

from slamcli import mapped_memory
from slamcli.errors import SlamError

on_linux = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not tell")


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[2]) * mmap.PAGESIZE


def stored(path: Path, megabytes: int) -> np.ndarray:
    """Map an array as a stage reads it."""
    np.save(path, np.arange(megabytes << 17, dtype=np.int64))
    return np.asarray(np.lib.format.open_memmap(path, mode="c"))


@on_linux
def test_an_adopted_array_takes_no_memory_once_too_much_is_mapped(tmp_path: Path) -> None:
    array = stored(tmp_path / "a.npy", 32)
    with mapped_memory.bounded(tmp_path):
        mapped_memory.adopt(array[5:])
        before, total = resident(), int(array.sum())
        assert resident() - before > 0.9 * array.nbytes
        mapped_memory.release_beyond(1 << 60)
        assert resident() - before > 0.9 * array.nbytes
        mapped_memory.release_beyond(0)
        assert resident() - before < 0.1 * array.nbytes
        assert int(array.sum()) == total


@on_linux
def test_the_bound_is_kept_while_a_block_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    array = stored(tmp_path / "a.npy", 32)
    before = resident()
    monkeypatch.setattr(mapped_memory, "MOST_RESIDENT", before + (4 << 20))
    with mapped_memory.bounded(tmp_path):
        mapped_memory.adopt(array)
        array.sum()
        for _ in range(500):
            mapped_memory.threading.Event().wait(0.01)
            if resident() - before < 8 << 20:
                break
        assert resident() - before < 8 << 20


@on_linux
def test_nothing_is_dropped_outside_a_block_nor_after_it(tmp_path: Path) -> None:
    before_it, within = stored(tmp_path / "a.npy", 1), stored(tmp_path / "b.npy", 1)
    mapped_memory.adopt(before_it)
    with mapped_memory.bounded(tmp_path):
        mapped_memory.adopt(within)
    for array in (before_it, within):
        array[:] = -1  # as a user may: the map is the user's own
    mapped_memory.release_beyond(0)
    assert (before_it == -1).all() and (within == -1).all()


def test_an_array_of_no_file_is_kept(tmp_path: Path) -> None:
    array = np.arange(1 << 17)
    with mapped_memory.bounded(tmp_path):
        mapped_memory.adopt(array[1:])
        mapped_memory.release_beyond(0)
    np.testing.assert_array_equal(array, np.arange(1 << 17))


def test_a_large_array_lies_in_a_file_without_a_name_and_keeps_what_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapped_memory, "LEAST_FILE", 1 << 20)
    with mapped_memory.bounded(tmp_path):
        large, small = mapped_memory.empty((1 << 16, 4), np.float32), mapped_memory.empty((10, 2), np.float32)
        assert isinstance(large.base, np.ndarray) and small.base is None
        assert large.shape == (1 << 16, 4) and large.dtype == np.float32 and large.flags.c_contiguous and large.flags.writeable
        large[:] = np.arange(1 << 18, dtype=np.float32).reshape(-1, 4)
        mapped_memory.release_beyond(0)
        np.testing.assert_array_equal(large.ravel(), np.arange(1 << 18, dtype=np.float32))
        assert not list(tmp_path.iterdir())
    assert mapped_memory.empty((1 << 16, 4), np.float32).base is None


@pytest.mark.parametrize("shape", [(0,), (0, 2), (7,), (5, 2), (1 << 21, 3)])
def test_a_copy_is_equal_whatever_its_size(tmp_path: Path, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    with mapped_memory.bounded(tmp_path):
        copied = mapped_memory.copy(array)
        np.testing.assert_array_equal(copied, array)
        assert not np.shares_memory(copied, array)


def test_room_is_taken_on_the_disk_where_the_system_reserves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(mapped_memory.os, "posix_fallocate")
    monkeypatch.setattr(mapped_memory, "LEAST_FILE", 1)
    with mapped_memory.bounded(tmp_path):
        array = mapped_memory.empty((mapped_memory.AT_ONCE // 8 + 3,), np.int64)
        array[:] = 7
        assert int(array.sum()) == 7 * len(array)


def test_a_disk_too_full_for_an_array_is_told_before_anything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(mapped_memory, "LEAST_FILE", 1)
    monkeypatch.setattr(mapped_memory, "_reserve", full)
    with mapped_memory.bounded(tmp_path), pytest.raises(SlamError, match="No space left on device"):
        mapped_memory.empty((1000,), np.float32)
