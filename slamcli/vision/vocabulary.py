"""Visual words: a tree of binary descriptors; [Z] 1.1.

D. Galvez-Lopez, J. D. Tardos, Bags of binary words for fast place recognition in image sequences, T-RO 2012, doi:10.1109/TRO.2012.2197158
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import i4, i8, u8

from slamcli.errors import SlamError
from slamcli.geometry.bits import hamming
from slamcli.jit.kernel import kernel

MAX_NODES = 4_000_000  # ORB-SLAM's vocabulary has 1.1 million
MAX_DEPTH = 64  # levels below the root: a descriptor takes them all, one by one


@dataclass(frozen=True)
class Vocabulary:
    """A tree whose nodes stand level by level, the children of a node together; node 0 is the root, the leaves are the words."""

    centre: np.ndarray  # (V, 32) uint8, descriptor a node stands for; the root's is 0
    first_child: np.ndarray  # (V + 1,) int32: children of node v are first_child[v] .. first_child[v + 1] - 1; none: v is a word
    idf: np.ndarray  # (W,) float32, inverse document frequency ln(images / images with the word); words in the order of their nodes
    origin: str = ""  # what it was trained on

    @property
    def n_words(self) -> int:
        """Return the number of words."""
        return len(self.idf)

    @cached_property
    def word_of_node(self) -> np.ndarray:
        """Return the word of each node, -1 for inner nodes, (V,) int32."""
        is_leaf = np.diff(self.first_child) == 0
        return np.where(is_leaf, np.cumsum(is_leaf) - 1, -1).astype(np.int32)

    @cached_property
    def level(self) -> np.ndarray:
        """Return each node's distance from the root, (V,) int32."""
        level = np.zeros(len(self.centre), dtype=np.int32)
        start, stop = 0, 1
        while stop > start:
            start, stop = int(self.first_child[start]), int(self.first_child[stop])
            level[start:stop] = level[start - 1] + 1 if start < stop else 0
        return level

    def node_of_word(self, level: int) -> np.ndarray:
        """Return the node `level` levels below the root above each word, or the word's own where that comes sooner, (W,) int32."""
        node, parent = np.flatnonzero(np.diff(self.first_child) == 0).astype(np.int32), np.append(np.int32(0), self.parent)
        while (is_deeper := self.level[node] > level).any():
            node[is_deeper] = parent[node[is_deeper]]
        return node

    @property
    def parent(self) -> np.ndarray:
        """Return the parent of each node but the root, (V - 1,) int32."""
        return np.repeat(np.arange(len(self.centre), dtype=np.int32), np.diff(self.first_child))

    @property
    def node_weight(self) -> np.ndarray:
        """Return the weight of each node but the root, 0 for inner ones, (V - 1,) float32."""
        word = self.word_of_node[1:]
        return np.where(word >= 0, self.idf[word], np.float32(0))

    @property
    def branching(self) -> int:
        """Return the largest number of children."""
        return int(np.diff(self.first_child).max())

    @property
    def depth(self) -> int:
        """Return the number of levels below the root."""
        return int(self.level.max())


def from_parents(parent: np.ndarray, centre: np.ndarray, weight: np.ndarray, *, origin: str, source: str) -> Vocabulary:
    """Build a vocabulary from any tree whose parents stand before their children.

    parent : (N,) int32 of nodes 1 .. N, 0 = the root; centre : (N, 32) uint8; weight : (N,), read at the leaves
    """
    n = len(parent)
    by_parent = np.argsort(parent, kind="stable") + 1
    first = np.searchsorted(parent[by_parent - 1], np.arange(n + 2))  # children of old node v are by_parent[first[v]:first[v + 1]]
    order, level = [np.zeros(1, dtype=np.int64)], np.zeros(1, dtype=np.int64)
    while len(level := np.concatenate([by_parent[first[v] : first[v + 1]] for v in level] or [level])):
        order.append(level)
    old = np.concatenate(order)  # old ids level by level
    n_children = np.diff(first)[old]
    tree = np.concatenate([np.zeros((1, 32), np.uint8), centre])[old]
    idf = np.concatenate([[0.0], weight])[old][n_children == 0].astype(np.float32)
    first_child = np.concatenate([[1], 1 + np.cumsum(n_children)]).astype(np.int32)
    return check(Vocabulary(tree, first_child, idf, origin), source=source)


def check(vocabulary: Vocabulary, *, source: str) -> Vocabulary:
    """Return the vocabulary if its tree is sound; SlamError names `source` and the fault otherwise."""
    first, n = vocabulary.first_child, len(vocabulary.centre)
    if not 2 <= n <= MAX_NODES:
        raise SlamError(f"{source}: a vocabulary of {n} nodes; 2 to {MAX_NODES} are allowed")
    is_tree = len(first) == n + 1 and first[0] == 1 and first[-1] == n and (np.diff(first) >= 0).all()
    if not is_tree or not (first[1:-1] > np.arange(1, n)).all():
        raise SlamError(f"{source}: the nodes of this vocabulary are no tree")
    if _depth(first) > MAX_DEPTH:
        raise SlamError(f"{source}: the tree of this vocabulary has more than {MAX_DEPTH} levels")
    n_words = int((np.diff(first) == 0).sum())
    if len(vocabulary.idf) != n_words:
        raise SlamError(f"{source}: {len(vocabulary.idf)} weights for {n_words} words")
    if not (np.isfinite(vocabulary.idf).all() and (vocabulary.idf >= 0).all()):
        raise SlamError(f"{source}: a word's weight is negative or not a number")
    return vocabulary


def _depth(first_child: np.ndarray) -> int:
    """Count the levels below the root, up to one more than are allowed."""
    start, stop, depth = 0, 1, -1
    while stop > start and depth <= MAX_DEPTH:
        start, stop, depth = int(first_child[start]), int(first_child[stop]), depth + 1
    return depth


@kernel
def _descend(
    centre: u8[:, ::1],
    first_child: i4[::1],
    word_of_node: i4[::1],
    desc: u8[:, ::1],
    node_level: i8,
    margin: i8,
    word: i4[::1],
    node: i4[:, ::1],
):
    """Walk each descriptor from the root to its word, at every step to the nearest child, of equals the first.

    node : (N, 2); the second is the next nearest child at `node_level`, -1 where it is more than `margin` bits farther.
    """
    for k in range(len(desc)):
        here, level = 0, 0
        node[k, 0], node[k, 1] = 0, -1
        while first_child[here] < first_child[here + 1]:
            nearest, least, following, second = -1, 257, -1, 257
            for child in range(first_child[here], first_child[here + 1]):
                d = int(hamming(desc, k, centre, child))
                if d < least:
                    following, second = nearest, least
                    nearest, least = child, d
                elif d < second:
                    following, second = child, d
            here = nearest
            level += 1
            if level <= node_level:
                node[k, 0] = here
                node[k, 1] = following if level == node_level and second - least <= margin else -1
        word[k] = word_of_node[here]


def quantize(vocabulary: Vocabulary, desc: np.ndarray, *, node_level: int = 1, margin: int = -1) -> tuple[np.ndarray, np.ndarray]:
    """Return the word and the nodes `node_level` levels below the root (or the word's, where that comes sooner) of descriptors (N, 32) uint8.

    margin [bits] : a second node is given where it is at most this much farther; negative: never
    Returns word (N,) int32 and node (N, 2) int32: the nearest node and the second, -1 for none.
    """
    rows = np.ascontiguousarray(desc, dtype=np.uint8).reshape(-1, 32).view(np.uint64)
    word, node = np.empty(len(rows), dtype=np.int32), np.empty((len(rows), 2), dtype=np.int32)
    _descend(vocabulary.centre.view(np.uint64), vocabulary.first_child, vocabulary.word_of_node, rows, node_level, margin, word, node)
    return word, node
