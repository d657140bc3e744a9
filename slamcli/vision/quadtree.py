"""The quadtree that spreads key points over each level of a pyramid; [Z] 1.1, steps 4 to 7."""

from typing import NamedTuple

import numpy as np
from numba import f4, i4, i8, u1

from slamcli.jit.kernel import kernel

X0, Y0, X1, Y1, FIRST, COUNT = range(6)  # columns of a node: its box [px], the end excluded; the first of its points; how many they are
NODE_COLUMNS = 6
NONE = -1  # there is no further point


class _Trees(NamedTuple):
    """The leaves of the quadtrees of all levels, and the points in each."""

    # (sum of wanted + 3 for each level, NODE_COLUMNS); a level's begin where those of the levels before would all find room
    node: i4[:, ::1]
    n_nodes: i8[::1]  # (levels,)
    following: i4[::1]  # (N,) the next point in the same node


class _Room(NamedTuple):
    """Room to work in."""

    child: i4[:, ::1]  # (4, 2)
    rank: i4[::1]  # (rows of `node`,)


@kernel
def _grow(xy: i4[:, ::1], first: i8[::1], root: i4[:, ::1], wanted: i8[::1], trees: _Trees, room: _Room):
    """Split the nodes of each level until there are as many as wanted or nothing can split; a split may give up to three too many.

    xy : (N, 2) int32 [px]; first, root, wanted : as of `choose`; trees : to be filled

    Rounds: every node with more than one point splits in four, the fullest first, of equals the one with the lower row. The first child
    that has points takes its parent's row, the others are appended. One kernel, without calls: each would be compiled and optimized again.
    """
    node, n_nodes, following = trees
    child, rank = room
    base = 0
    for level in range(len(wanted)):
        start, end, n = first[level], first[level + 1], base
        if start < end and wanted[level] > 0:
            n += 1
            for side in range(4):
                node[base, side] = root[level, side]
            node[base, FIRST], node[base, COUNT] = start, end - start
            for k in range(start, end):
                following[k] = k + 1
            following[end - 1] = NONE
        while base < n < base + wanted[level]:
            n_before = n
            for v in range(base, n_before):  # insertion sort, as there are a few hundred at most
                place = v
                while place > base and node[rank[place - 1], COUNT] < node[v, COUNT]:
                    rank[place] = rank[place - 1]
                    place -= 1
                rank[place] = v
            if node[rank[base], COUNT] < 2:
                break
            for r in range(base, n_before):
                v = rank[r]
                if node[v, COUNT] < 2 or n >= base + wanted[level]:
                    break
                x0, y0, x1, y1 = node[v, X0], node[v, Y0], node[v, X1], node[v, Y1]
                x_mid, y_mid = (x0 + x1) >> 1, (y0 + y1) >> 1
                for c in range(4):
                    child[c, 0], child[c, 1] = NONE, 0
                k = node[v, FIRST]
                while k != NONE:
                    c = (xy[k, 0] >= x_mid) + 2 * (xy[k, 1] >= y_mid)
                    after = following[k]
                    following[k], child[c, 0] = child[c, 0], k
                    child[c, 1] += 1
                    k = after
                for c in range(4):
                    if child[c, 1] > 0:
                        node[v, X0], node[v, X1] = (x_mid, x1) if c & 1 else (x0, x_mid)
                        node[v, Y0], node[v, Y1] = (y_mid, y1) if c & 2 else (y0, y_mid)
                        node[v, FIRST], node[v, COUNT] = child[c, 0], child[c, 1]
                        v = n
                        n += 1
                n -= 1  # the last row made ready was not used
        n_nodes[level] = n - base
        base += wanted[level] + 3


@kernel
def _strongest(response: f4[::1], wanted: i8[::1], trees: _Trees, is_chosen: u1[::1]):
    """Choose the strongest point of each leaf, of equals the first; where the last split gave leaves too many, the weakest go.

    response : (N,) float32; is_chosen : (N,) uint8, 0, becomes 1
    """
    node, n_nodes, following = trees
    base = 0
    for level in range(len(wanted)):
        for v in range(base, base + n_nodes[level]):
            best = node[v, FIRST]
            k = following[best]
            while k != NONE:
                if response[k] > response[best] or (response[k] == response[best] and k < best):
                    best = k
                k = following[k]
            node[v, FIRST] = best
            is_chosen[best] = 1
        end = base + n_nodes[level]
        while end > base + wanted[level]:
            weakest, end = base, end - 1
            for v in range(base, end + 1):
                if response[node[v, FIRST]] < response[node[weakest, FIRST]]:
                    weakest = v
            is_chosen[node[weakest, FIRST]] = 0
            node[weakest, FIRST] = node[end, FIRST]
        base += wanted[level] + 3


def choose(xy: np.ndarray, response: np.ndarray, first: np.ndarray, root: np.ndarray, wanted: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Choose of each level at most `wanted` points, evenly spread: one for each leaf of a quadtree, its strongest, of equals the first.

    xy : (N, 2) int32 [px], no point twice; response : (N,) float32; first : (levels + 1,) int64, row of each level's first point
    root : (levels, 4) int32, x0, y0, x1, y1 of the first nodes [px], the end excluded
    Returns increasing rows (M,) int64 of xy and their levels (M,) uint8. Where the last split gave nodes too many, the weakest points go.
    """
    goal, most = np.array(wanted, dtype=np.int64), sum(wanted) + 3 * len(wanted)
    trees = _Trees(np.empty((most, NODE_COLUMNS), np.int32), np.empty(len(wanted), np.int64), np.empty(len(xy), np.int32))
    _grow(xy, first, root, goal, trees, _Room(np.empty((4, 2), np.int32), np.empty(most, np.int32)))
    is_chosen = np.zeros(len(xy), np.uint8)
    _strongest(response, goal, trees, is_chosen)
    rows = np.flatnonzero(is_chosen)
    return rows, (np.searchsorted(first, rows, side="right") - 1).astype(np.uint8)
