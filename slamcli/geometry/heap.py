"""A binary heap of cells in three arrays, for A* in kernels: key, order of arrival, cell."""

import numpy as np

from slamcli.jit.kernel import kernel


@kernel
def pop(key, order, cell, size):
    """Take the first entry off a binary heap of `size` entries; its cell is left at cell[size - 1]."""
    size -= 1
    first, k, o, c = cell[0], key[size], order[size], cell[size]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        other = child + 1
        if other < size and (key[other] < key[child] or (key[other] == key[child] and order[other] < order[child])):
            child = other
        if k < key[child] or (k == key[child] and o < order[child]):
            break
        key[i], order[i], cell[i] = key[child], order[child], cell[child]
        i = child
    key[i], order[i], cell[i] = k, o, c
    cell[size] = first


@kernel
def push(key, order, cell, size, k, o, c):
    """Add an entry to a binary heap of `size` entries; `o` counts the pushes, so that among equal keys the oldest comes first."""
    i = size
    while i > 0:
        parent = (i - 1) // 2
        if key[parent] <= k:
            break
        key[i], order[i], cell[i] = key[parent], order[parent], cell[parent]
        i = parent
    key[i], order[i], cell[i] = k, o, c


@kernel
def doubled(values):
    """Return an array twice as long that begins with the values."""
    out = np.empty(2 * len(values), dtype=values.dtype)
    for i in range(len(values)):
        out[i] = values[i]
    return out
