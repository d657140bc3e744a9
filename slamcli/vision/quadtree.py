"""The quadtree that spreads key points over the image; [Z] 1.1, steps 4 to 7."""

import numpy as np
from numba import f4, i4, i8

from slamcli.kernels import kernel

X0, Y0, X1, Y1, FIRST, COUNT = range(6)  # columns of a node: its box [px], the end excluded; the first of its points; how many they are
NODE_COLUMNS = 6
NONE = -1  # there is no further point


@kernel
def _grow(xy: i4[:, ::1], wanted: i8, node: i4[:, ::1], following: i4[::1], child: i4[:, ::1], rank: i4[::1]):
    """Split nodes until there are as many as wanted or nothing can split; a split may give up to three too many. Returns their number.

    xy : (N, 2) int32 [px]; following : (N,) int32, the next point in the same node
    node : (wanted + 3, NODE_COLUMNS) int32, row 0 the root with all points; child : (4, 2) int32 and rank : (wanted + 3,) int32, scratch

    Rounds: every node with more than one point splits in four, the fullest first, of equals the one with the lower row. The first child
    that has points takes its parent's row, the others are appended. One kernel, without calls: each would be compiled and optimised again.
    """
    n_nodes = 1
    while n_nodes < wanted:
        n_before = n_nodes
        for v in range(n_before):  # insertion sort, as there are a few hundred at most
            place = v
            while place > 0 and node[rank[place - 1], COUNT] < node[v, COUNT]:
                rank[place] = rank[place - 1]
                place -= 1
            rank[place] = v
        if node[rank[0], COUNT] < 2:
            break
        for r in range(n_before):
            v = rank[r]
            if node[v, COUNT] < 2 or n_nodes >= wanted:
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
                    v = n_nodes
                    n_nodes += 1
            n_nodes -= 1  # the last row made ready was not used
    return n_nodes


@kernel
def _strongest(node: i4[:, ::1], following: i4[::1], response: f4[::1], chosen: i4[::1]):
    """Write the point of each node with the largest response, of equals the lowest row. response : (N,) float32, chosen : (nodes,) int32."""
    for v in range(len(chosen)):
        best = node[v, FIRST]
        k = following[best]
        while k != NONE:
            if response[k] > response[best] or (response[k] == response[best] and k < best):
                best = k
            k = following[k]
        chosen[v] = best


def choose(xy: np.ndarray, response: np.ndarray, root: tuple[int, int, int, int], wanted: int) -> np.ndarray:
    """Choose at most `wanted` points, evenly spread: one for each leaf of a quadtree, its strongest, of equals the first.

    xy : (N, 2) int32 [px], no point twice; response : (N,) float32; root : x0, y0, x1, y1 of the first node [px], the end excluded
    Returns increasing rows of xy. Where the last split gave nodes too many, the weakest points go.
    """
    n = len(xy)
    if n == 0 or wanted <= 0:
        return np.zeros(0, dtype=np.int32)
    node = np.empty((wanted + 3, NODE_COLUMNS), dtype=np.int32)
    node[0] = *root, 0, n
    following = np.arange(1, n + 1, dtype=np.int32)
    following[-1] = NONE
    n_nodes = _grow(xy, wanted, node, following, np.empty((4, 2), dtype=np.int32), np.empty(len(node), dtype=np.int32))
    chosen = np.empty(n_nodes, dtype=np.int32)
    _strongest(node, following, response, chosen)
    for last in range(n_nodes - 1, wanted - 1, -1):
        chosen[response[chosen[: last + 1]].argmin()] = chosen[last]
    return np.sort(chosen[:wanted])
