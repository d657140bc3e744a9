"""Voxel keys in Morton order, and a hash from keys to rows of growing arrays.

A Morton key interleaves the bits of three non-negative cell numbers, x lowest: sorting by it keeps neighbours together, and eight
consecutive keys are the children of one octree node. Keys are kept in int64, as 3 * 21 bits fit and mixing uint64 with int64 gives floats.
"""

from typing import NamedTuple

import numpy as np
from numba import i4, i8

from slamcli import mapped_memory
from slamcli.errors import SlamError
from slamcli.jit.kernel import kernel

AXIS_BITS = 21  # per axis in a Morton key
GOLDEN = -7046029254386353131  # 2^64 / golden ratio as int64: Fibonacci hashing, Knuth, TAOCP 3, section 6.4


def _spread(x):
    """Put two zero bits between the lowest 21 bits of an int64."""
    x = x & 0x1FFFFF
    x = (x | (x << 32)) & 0x1F00000000FFFF
    x = (x | (x << 16)) & 0x1F0000FF0000FF
    x = (x | (x << 8)) & 0x100F00F00F00F00F
    x = (x | (x << 4)) & 0x10C30C30C30C30C3
    return (x | (x << 2)) & 0x1249249249249249


def _gather(x):
    """Undo `spread`: collect every third bit."""
    x = x & 0x1249249249249249
    x = (x ^ (x >> 2)) & 0x10C30C30C30C30C3
    x = (x ^ (x >> 4)) & 0x100F00F00F00F00F
    x = (x ^ (x >> 8)) & 0x1F0000FF0000FF
    x = (x ^ (x >> 16)) & 0x1F00000000FFFF
    return (x ^ (x >> 32)) & 0x1FFFFF


spread = kernel(_spread)
gather = kernel(_gather)


def morton(cell: np.ndarray) -> np.ndarray:
    """Return the Morton keys (N,) int64 of cells (N, 3), each number in [0, 2^21)."""
    cell = np.asarray(cell, dtype=np.int64)
    return _spread(cell[..., 0]) | _spread(cell[..., 1]) << 1 | _spread(cell[..., 2]) << 2


def unmorton(key: np.ndarray) -> np.ndarray:
    """Return the cells (N, 3) int64 of Morton keys (N,)."""
    key = np.asarray(key, dtype=np.int64)
    return np.stack([_gather(key), _gather(key >> 1), _gather(key >> 2)], axis=-1)


class Index(NamedTuple):
    """The row of each key: open addressing with linear probing."""

    slot_row: i4[::1]  # (C,) row whose key is in a slot, -1 = empty; C a power of two
    row_key: i8[::1]  # (R,)


@kernel
def first_slot(key, mask):
    """Return the slot a key's search starts at; the eight children of a node share a cache line."""
    return (((key >> 3) * GOLDEN >> 32) + (key & 7)) & mask


@kernel
def find_row(index, key):
    """Return the row of a key, -1 where it has none."""
    slot_row, row_key = index
    mask = slot_row.size - 1
    slot = first_slot(key, mask)
    while slot_row[slot] >= 0:
        if row_key[slot_row[slot]] == key:
            return slot_row[slot]
        slot = (slot + 1) & mask
    return -1


@kernel
def find_or_add(index, n_rows, key):
    """Return the row of a key; a new key gets row `n_rows`, and it is the caller who counts on. The table must have room."""
    slot_row, row_key = index
    mask = slot_row.size - 1
    slot = first_slot(key, mask)
    while slot_row[slot] >= 0:
        if row_key[slot_row[slot]] == key:
            return slot_row[slot]
        slot = (slot + 1) & mask
    slot_row[slot] = n_rows
    row_key[n_rows] = key
    return n_rows


@kernel
def _fill_slots(index: Index, n_rows: i8):
    slot_row, row_key = index
    mask = slot_row.size - 1
    for row in range(n_rows):
        slot = first_slot(row_key[row], mask)
        while slot_row[slot] >= 0:
            slot = (slot + 1) & mask
        slot_row[slot] = row


class VoxelRows:
    """Rows by key, found by an index that is at most half full, and the row columns that grow with it.

    Attributes: `index`; `n` rows in use; `columns`, each (R, ...).
    """

    def __init__(self, **columns: tuple[tuple[int, ...], type[np.generic], float]) -> None:
        """Declare columns as name=(shape of a row, dtype, value of a new row)."""
        self._new = columns
        self.n = 0
        self.index = Index(np.full(2048, -1, dtype=np.int32), np.zeros(1024, dtype=np.int64))
        self.columns = {name: np.full((1024, *shape), fill, dtype=dtype) for name, (shape, dtype, fill) in columns.items()}

    @property
    def key(self) -> np.ndarray:
        """The keys (n,) int64 of the rows in use."""
        return self.index.row_key[: self.n]

    def reserve(self, n_more: int) -> None:
        """Make room for `n_more` further rows."""
        need, have = self.n + n_more, len(self.index.row_key)
        if need <= have:
            return
        if need > 1 << 29:
            raise SlamError(f"the map would need {need} voxels; choose larger ones")
        # A factor of 1.5 keeps the room of both copies at 2.5 times the rows in use; 2 would make it 3.
        size = max(need, have + have // 2)
        self.index = self.index._replace(row_key=_grown(self.index.row_key, size, 0))
        for name, (_, _, fill) in self._new.items():
            self.columns[name] = _grown(self.columns[name], size, fill)
        if 2 * size > len(self.index.slot_row):
            self.index = self.index._replace(slot_row=np.full(1 << int(2 * size - 1).bit_length(), -1, dtype=np.int32))
            _fill_slots(self.index, self.n)


def _grown(column: np.ndarray, size: int, fill: float) -> np.ndarray:
    """Copy a column into a longer one; zeros that nobody has written to take no memory."""
    out = mapped_memory.zeros((size, *column.shape[1:]), column.dtype)
    for rows in mapped_memory.blocks(column):
        out[rows] = column[rows]
        mapped_memory.release_beyond(mapped_memory.MOST_RESIDENT)
    if fill != 0.0:
        out[len(column) :] = fill
    return out
