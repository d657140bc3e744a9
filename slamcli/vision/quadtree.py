"""The quadtree that spreads key points over the image; [Z] 1.1, steps 4 to 7."""

import numpy as np
from numba import b1, f4, i4, i8

from slamcli.kernels import kernel


@kernel
def spread(xy: i4[:, ::1], response: f4[::1], root: i4[::1], wanted: i8, is_chosen: b1[::1]):
    """Choose at most `wanted` points, evenly spread: one for each leaf of a quadtree.

    xy : (N, 2) int32 [px], no point twice; root : (4,) int32, x0, y0, x1, y1 of the first node, the end excluded; response : (N,) float32; is_chosen : (N,) bool, all false

    Rounds: every node with more than one point splits in four, the fullest nodes first; the end is when there are as many nodes as
    wanted or nothing can split. Each node gives its strongest point, of equals the first. The last split may give up
    to three nodes too many: then the weakest points go.
    """
    n = len(xy)
    if n == 0 or wanted <= 0:
        return
    capacity = wanted + 3
    box = np.empty((capacity, 4), dtype=np.int32)
    start, stop, rank = np.empty(capacity, dtype=np.int32), np.empty(capacity, dtype=np.int32), np.empty(capacity, dtype=np.int32)
    order, buffer = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)  # rows of xy, those of a node together
    for k in range(n):
        order[k] = k
    box[0, 0], box[0, 1], box[0, 2], box[0, 3] = root[0], root[1], root[2], root[3]
    start[0], stop[0] = 0, n
    n_nodes = 1
    while n_nodes < wanted:
        n_before = n_nodes
        _fullest_first(start, stop, n_before, rank)
        if stop[rank[0]] - start[rank[0]] < 2:
            break
        for node in rank[:n_before]:
            if stop[node] - start[node] < 2 or n_nodes >= wanted:
                break
            n_nodes = _split(xy, order, buffer, box, start, stop, node, n_nodes)
    for node in range(n_nodes):
        best = order[start[node]]
        for k in range(start[node] + 1, stop[node]):
            if response[order[k]] > response[best]:
                best = order[k]
        is_chosen[best] = True
        rank[node] = best
    while n_nodes > wanted:
        weakest = 0
        for node in range(1, n_nodes):
            if response[rank[node]] < response[rank[weakest]]:
                weakest = node
        n_nodes -= 1
        is_chosen[rank[weakest]] = False
        rank[weakest] = rank[n_nodes]


@kernel
def _fullest_first(start, stop, n_nodes, rank):
    """Sort nodes by falling number of points, equal ones by number, into rank: insertion, as there are a few hundred at most."""
    for node in range(n_nodes):
        count = stop[node] - start[node]
        place = node
        while place > 0 and stop[rank[place - 1]] - start[rank[place - 1]] < count:
            rank[place] = rank[place - 1]
            place -= 1
        rank[place] = node


@kernel
def _split(xy, order, buffer, box, start, stop, node, n_nodes):
    """Split a node in four in place; the first child that has points takes its row, the others are appended. Returns the number of nodes."""
    x0, y0, x1, y1 = box[node, 0], box[node, 1], box[node, 2], box[node, 3]
    x_mid, y_mid = (x0 + x1) // 2, (y0 + y1) // 2
    begin, end = start[node], stop[node]
    size = np.zeros(4, dtype=np.int32)
    for k in range(begin, end):
        size[_child(xy, order[k], x_mid, y_mid)] += 1
    place = np.empty(4, dtype=np.int32)
    place[0] = begin
    for child in range(1, 4):
        place[child] = place[child - 1] + size[child - 1]
    for k in range(begin, end):
        child = _child(xy, order[k], x_mid, y_mid)
        buffer[place[child]] = order[k]
        place[child] += 1
    for k in range(begin, end):
        order[k] = buffer[k]
    target = node
    for child in range(4):
        if size[child] > 0:
            box[target, 0], box[target, 2] = (x_mid, x1) if child & 1 else (x0, x_mid)
            box[target, 1], box[target, 3] = (y_mid, y1) if child & 2 else (y0, y_mid)
            start[target], stop[target] = place[child] - size[child], place[child]
            target = n_nodes
            n_nodes += 1
    return n_nodes - 1  # the last target was not used


@kernel
def _child(xy, row, x_mid, y_mid):
    return (xy[row, 0] >= x_mid) + 2 * (xy[row, 1] >= y_mid)


def choose(xy: np.ndarray, response: np.ndarray, root: tuple[int, int, int, int], wanted: int) -> np.ndarray:
    """Give the increasing rows of at most `wanted` evenly spread points; root : x0, y0, x1, y1 of the first node [px]; see `spread`."""
    is_chosen = np.zeros(len(xy), dtype=np.bool_)
    spread(xy, response, np.array(root, dtype=np.int32), wanted, is_chosen)
    return np.flatnonzero(is_chosen)
