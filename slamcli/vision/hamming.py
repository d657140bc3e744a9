"""Matching of binary descriptors by Hamming distance: all with all, or only those under one vocabulary node."""

from typing import NamedTuple

import numpy as np
from numba import f4, f8, i4, i8, u4, u8, uint32, uintp

from slamcli.geometry.bits import popcount
from slamcli.jit.kernel import kernel

BINS = 30  # of the histogram of turns between matched points
KEPT_BINS = 3
FAR = 257  # [bits] more than two descriptors can differ by
INDEX_BITS = 22  # of a number that holds a distance above an index
NODE_RATIO = (
    0.96  # among the few under a node the second nearest is farther than among all; this makes up for it: precision as of brute force
)

Match = tuple[np.ndarray, np.ndarray]


class Compared(NamedTuple):
    """Which descriptors of frame j each of frame i is compared with."""

    block: i4[:, :, ::1]  # (N, B, 2) start and stop of the entries each row of i is compared with
    entries: u8[:, ::1]  # (4, E) descriptors of j, those of a node side by side
    row_of_entry: i4[::1]  # (E,) a row of j may have several


class Nearest(NamedTuple):
    """What comparing found, of N rows of i and of E entries."""

    best: i4[::1]  # (N,) [bits] smallest distance
    following: i4[::1]  # (N,) [bits] smallest distance to another row of j
    choice: i4[::1]  # (N,) row of j, -1 = none
    back: u4[::1]  # (E,) smallest distance << INDEX_BITS | row of i


@kernel
def _compare(desc_i: u8[:, ::1], compared: Compared, nearest: Nearest):
    """Find each row's best and second-best match, and the best distance of each column; desc_i (N, 4).

    A distance and an index in one number have their minimum at the smallest distance, of equals the first; so no loop has a branch, and several
    descriptors go in one instruction.
    """
    block, desc_j, row_of_entry = compared
    best, following, choice, back = nearest
    b0, b1, b2, b3 = desc_j[0], desc_j[1], desc_j[2], desc_j[3]
    distance = np.empty(len(row_of_entry), dtype=np.uint32)
    shift = uint32(INDEX_BITS)
    for i in range(len(desc_i)):
        a0, a1, a2, a3 = desc_i[i, 0], desc_i[i, 1], desc_i[i, 2], desc_i[i, 3]
        least = uint32(0xFFFFFFFF)
        for b in range(block.shape[1]):
            for e in range(uintp(block[i, b, 0]), uintp(block[i, b, 1])):
                bits = uint32(popcount(a0 ^ b0[e]) + popcount(a1 ^ b1[e]) + popcount(a2 ^ b2[e]) + popcount(a3 ^ b3[e]))
                distance[e] = bits
                back[e] = min(back[e], uint32(uint32(bits << shift) | uint32(i)))
                least = min(least, uint32(uint32(bits << shift) | uint32(e)))
        if least == uint32(0xFFFFFFFF):
            best[i], following[i], choice[i] = FAR, FAR, -1
            continue
        row, second = row_of_entry[least & uint32((1 << INDEX_BITS) - 1)], uint32(FAR)
        for b in range(block.shape[1]):
            for e in range(uintp(block[i, b, 0]), uintp(block[i, b, 1])):
                second = min(second, distance[e] if row_of_entry[e] != row else uint32(FAR))
        best[i], following[i], choice[i] = least >> shift, second, row


@kernel
def _accept(nearest: Nearest, row_of_entry: i4[::1], back_of_row: u4[::1], max_distance: i8, ratio: f8, rows: i4[:, ::1]):
    """List the matches that pass distance and ratio and are each other's nearest.

    back_of_row : (M,) uint32 of the largest number, becomes `back` of the rows of j; rows : (N, 2) int32. Returns the number of matches.
    """
    best, following, choice, back = nearest
    for e in range(len(back)):
        j = row_of_entry[e]
        back_of_row[j] = min(back_of_row[j], back[e])
    n = 0
    for i in range(len(best)):
        is_near = best[i] <= max_distance and best[i] < ratio * following[i]
        if is_near and back_of_row[choice[i]] & uint32((1 << INDEX_BITS) - 1) == i:
            rows[n, 0], rows[n, 1] = i, choice[i]
            n += 1
    return n


@kernel
def _group(
    node_i: i4[:, ::1],
    node_j: i4[:, ::1],
    desc_j: u8[:, ::1],
    start: i4[::1],
    block: i4[:, :, ::1],
    row_of_entry: i4[::1],
    entries: u8[:, ::1],
):
    """Sort the rows of j by node, those whose first node it is before those whose second it is, and find each row of i its blocks.

    node_i, node_j : (N, 2), (M, 2) int32; desc_j : (M, 4) uint64; start : (2 n_nodes + 2,) int32 of zeros; block : (N, 2, 2) int32 of zeros
    entries : (4, E) uint64, descriptors in the new order. A counting sort; returns the number of entries.
    """
    for j in range(len(node_j)):
        for c in range(2):
            if node_j[j, c] >= 0:
                start[2 * node_j[j, c] + c + 2] += 1
    for k in range(1, len(start)):
        start[k] += start[k - 1]
    for j in range(len(node_j)):
        for c in range(2):
            if node_j[j, c] >= 0:
                k = 2 * node_j[j, c] + c + 1
                e = start[k]  # becomes the end of these entries, where the next begin
                start[k] += 1
                row_of_entry[e] = j
                for w in range(4):
                    entries[w, e] = desc_j[j, w]
    for i in range(len(node_i)):
        first, second = 2 * node_i[i, 0], 2 * node_i[i, 1]
        block[i, 0, 0], block[i, 0, 1] = start[first], start[first + 2]
        if second >= 0:
            block[i, 1, 0], block[i, 1, 1] = start[second], start[second + 1]
    return start[-1]


def as_words(desc: np.ndarray) -> np.ndarray:
    """View descriptors (N, 32) uint8 as (N, 4) uint64, the form the kernels compare."""
    return np.ascontiguousarray(desc, dtype=np.uint8).reshape(-1, 32).view(np.uint64)


class Described(NamedTuple):
    """The features of one frame, as matching takes them."""

    desc: np.ndarray  # (N, 32) uint8
    angle: np.ndarray  # (N,) [rad]
    node: np.ndarray | None = None  # (N,), or (N, 2) where the second is the node a descriptor nearly fell under, -1 = none


def match_brute(i: Described, j: Described, *, max_distance: int = 64, ratio: float = 0.8, check_rotation: bool = True) -> Match:
    """Match two sets of descriptors by comparing all with all.

    max_distance [bits]; ratio : the nearest must be closer than this share of the second nearest's distance
    check_rotation : keep only matches whose turn agrees with most, see `_keep_agreeing`
    Returns rows (Q, 2) int32, increasing in the first column, and distances (Q,) uint8. Each is the other's nearest.
    """
    block = np.empty((len(i.desc), 1, 2), dtype=np.int32)
    block[:] = 0, len(j.desc)
    compared = Compared(block, np.ascontiguousarray(as_words(j.desc).T), np.arange(len(j.desc), dtype=np.int32))
    return _match(i, j, compared, max_distance, ratio, check_rotation)


def match_nodes(i: Described, j: Described, *, max_distance: int = 64, ratio: float = 0.8, check_rotation: bool = True) -> Match:
    """Match as `match_brute` does, comparing only descriptors with a vocabulary node in common.

    Two are compared where one's first node is the other's first or second. The ratio is tightened by NODE_RATIO.
    """
    node_i, node_j = _two_nodes(i), _two_nodes(j)
    n_nodes = 1 + max(int(node_i.max(initial=0)), int(node_j.max(initial=0)))
    block = np.zeros((len(node_i), 2, 2), dtype=np.int32)
    row_of_entry, entries = np.empty(node_j.size, dtype=np.int32), np.empty((4, node_j.size), dtype=np.uint64)
    n = _group(node_i, node_j, as_words(j.desc), np.zeros(2 * n_nodes + 2, dtype=np.int32), block, row_of_entry, entries)
    return _match(i, j, Compared(block, entries, row_of_entry[:n]), max_distance, ratio * NODE_RATIO, check_rotation)


def _two_nodes(features: Described) -> np.ndarray:
    """Return nodes (N, 2) int32; -1 stands for no second."""
    if features.node is None or len(features.node) != len(features.desc):
        raise ValueError("each descriptor needs a node")
    node = np.ascontiguousarray(features.node, dtype=np.int32)
    node = node if node.ndim == 2 else np.stack([node, np.full_like(node, -1)], axis=1)
    if node[:, 0].min(initial=0) < 0:
        raise ValueError("each descriptor needs a node")
    return node


@kernel
def _keep_agreeing(rows: i4[:, ::1], angle_i: f4[::1], angle_j: f4[::1]):
    """Keep in place the matches whose turn falls in the three fullest of thirty bins of a full circle; returns their number.

    A bin that holds less than a tenth of the fullest is left out; of equally full ones the first counts.
    """
    count = np.zeros(BINS, dtype=np.int32)
    bin_of = np.empty(len(rows), dtype=np.int32)
    for k in range(len(rows)):
        turn = (np.float64(angle_i[rows[k, 0]]) - np.float64(angle_j[rows[k, 1]])) * (BINS / (2.0 * np.pi))
        bin_of[k] = int(np.floor(turn + 0.5)) % BINS
        count[bin_of[k]] += 1
    is_kept = np.zeros(BINS, dtype=np.bool_)
    fullest = -1
    for _ in range(KEPT_BINS):
        best = 0
        for b in range(1, BINS):
            if count[b] > count[best]:
                best = b
        fullest = max(fullest, count[best])
        is_kept[best] = 10 * count[best] >= fullest
        count[best] = -1
    n = 0
    for k in range(len(rows)):
        if is_kept[bin_of[k]]:
            rows[n, 0], rows[n, 1] = rows[k, 0], rows[k, 1]
            n += 1
    return n


def _match(i: Described, j: Described, compared: Compared, max_distance: int, ratio: float, check_rotation: bool) -> Match:
    row_of_entry = compared.row_of_entry
    words_i, n_i, n_j = as_words(i.desc), len(i.angle), len(j.angle)
    if len(words_i) != n_i or row_of_entry.max(initial=-1) >= n_j:
        raise ValueError("each descriptor needs an angle")
    if max(n_i, len(row_of_entry)) >> INDEX_BITS:
        raise ValueError(f"more than {1 << INDEX_BITS} descriptors in a frame")
    best, following, choice = (np.empty(n_i, dtype=np.int32) for _ in range(3))
    back, back_of_row = (np.full(n, 0xFFFFFFFF, dtype=np.uint32) for n in (len(row_of_entry), n_j))
    nearest = Nearest(best, following, choice, back)
    _compare(words_i, compared, nearest)
    rows = np.empty((n_i, 2), dtype=np.int32)
    rows = rows[: _accept(nearest, row_of_entry, back_of_row, min(int(max_distance), FAR - 1), float(ratio), rows)]
    if check_rotation:
        rows = rows[
            : _keep_agreeing(rows, np.ascontiguousarray(i.angle, dtype=np.float32), np.ascontiguousarray(j.angle, dtype=np.float32))
        ]
    return rows, best[rows[:, 0]].astype(np.uint8)
