"""Visual words: a tree of binary descriptors, word vectors and the inverted index; [Z] 1.1 and (10).

D. Galvez-Lopez, J. D. Tardos, Bags of binary words for fast place recognition in image sequences, T-RO 2012, doi:10.1109/TRO.2012.2197158
"""

import zipfile
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numba import f4, f8, i4, i8, u8

from slamcli import files
from slamcli.errors import SlamError
from slamcli.files import open_regular
from slamcli.geometry.bits import hamming
from slamcli.jit.kernel import kernel

FORMAT = 1
MAX_NODES = 4_000_000  # ORB-SLAM's vocabulary has 1.1 million
MAX_DEPTH = 64  # levels below the root: a descriptor takes them all, one by one
SHIPPED = Path(__file__).resolve().parent.parent / "data" / "vocabulary.npz"
_FILE_ARRAYS = {"format": ("i4", 0), "centre": ("u1", 2), "first_child": ("i4", 1), "idf": ("f4", 1), "origin": ("u1", 1)}


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
        raise SlamError(f"{source}: the nodes of this vocabulary are no tree; make it anew with: slamcli vocab train")
    if _depth(first) > MAX_DEPTH:
        raise SlamError(f"{source}: the tree of this vocabulary has more than {MAX_DEPTH} levels")
    n_words = int((np.diff(first) == 0).sum())
    if len(vocabulary.idf) != n_words:
        raise SlamError(f"{source}: {len(vocabulary.idf)} weights for {n_words} words; make it anew with: slamcli vocab train")
    if not (np.isfinite(vocabulary.idf).all() and (vocabulary.idf >= 0).all()):
        raise SlamError(f"{source}: a word's weight is negative or not a number; make it anew with: slamcli vocab train")
    return vocabulary


def _depth(first_child: np.ndarray) -> int:
    """Count the levels below the root, up to one more than are allowed."""
    start, stop, depth = 0, 1, -1
    while stop > start and depth <= MAX_DEPTH:
        start, stop, depth = int(first_child[start]), int(first_child[stop]), depth + 1
    return depth


def save(path: str | Path, vocabulary: Vocabulary) -> None:
    """Write a vocabulary file (.npz)."""
    origin = np.frombuffer(vocabulary.origin.encode(), dtype=np.uint8)
    with files.whole(path) as file:
        np.savez(
            file, format=np.int32(FORMAT), centre=vocabulary.centre, first_child=vocabulary.first_child, idf=vocabulary.idf, origin=origin
        )


def load(path: str | Path = "") -> Vocabulary:
    """Read a vocabulary file, the shipped one without a path; SlamError names the file and its fault."""
    path = Path(path) if str(path) else SHIPPED
    try:
        found = path.stat()
    except OSError as error:
        raise SlamError(f"{path}: the vocabulary cannot be read ({error.strerror}); make one with: slamcli vocab train") from error
    return _load(path, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=2)
def _load(path: Path, _mtime_ns: int, _size: int) -> Vocabulary:
    """Read the file, once as long as it stays the same."""
    try:
        columns = _read_arrays(path)
    except OSError as error:
        raise SlamError(f"{path}: the vocabulary cannot be read ({error.strerror or error}); make one with: slamcli vocab train") from error
    except SlamError:
        raise
    except Exception as error:  # what zipfile, its decompressors and numpy's header raise is not declared anywhere
        raise SlamError(f"{path}: not a vocabulary of slamcli ({error}); text files of DBoW2 come in by: slamcli vocab import") from error
    vocabulary = Vocabulary(columns["centre"], columns["first_child"], columns["idf"], columns["origin"].tobytes().decode(errors="replace"))
    return check(vocabulary, source=str(path))


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of the file, each checked for type and size before memory is reserved."""
    columns = {}
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        for name, (dtype, n_axes) in _FILE_ARRAYS.items():
            try:
                member = archive.open(name + ".npy")
            except KeyError:
                raise ValueError(f"{name} is missing") from None
            with member:
                version = np.lib.format.read_magic(member)
                if version != (1, 0):
                    raise ValueError(f"{name} is of an unknown kind")
                shape, fortran_order, kind = np.lib.format.read_array_header_1_0(member)
                row_bytes = 32 if name == "centre" else 1
                if kind != np.dtype(dtype) or len(shape) != n_axes or fortran_order or (n_axes == 2 and shape[1] != row_bytes):
                    raise ValueError(f"{name} has type {kind} and shape {shape}")
                if n_axes and not 0 <= shape[0] <= MAX_NODES + 1:
                    raise ValueError(f"{name} has {shape[0]} rows")
                n_bytes = int(np.prod(shape)) * kind.itemsize
                content = member.read(n_bytes + 1)
                if len(content) != n_bytes:
                    raise ValueError(f"{name} is cut short")
                columns[name] = np.frombuffer(bytearray(content), dtype=kind).reshape(shape)
    if columns["format"] != FORMAT:
        raise ValueError(f"format {int(columns['format'])}, this version reads {FORMAT}")
    return columns


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


def word_vector(word: np.ndarray, idf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the word vector of one frame: words (B,) int32 in increasing order and their tf-idf weights (B,) float32, which sum to 1.

    Words of no weight are left out; a frame without features, or without any word of weight, has an empty vector.
    """
    present, count = np.unique(word, return_counts=True)
    weight = count * idf[present].astype(np.float64)
    present, weight = present[weight > 0], weight[weight > 0]
    return present.astype(np.int32), (weight / weight.sum()).astype(np.float32) if len(weight) else weight.astype(np.float32)


def word_vectors(word: np.ndarray, offset: np.ndarray, idf: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the word vectors of all frames: offset (F + 1,) int64, word (B,) int32, weight (B,) float32; `offset` delimits the frames' features."""
    vectors = [word_vector(word[start:stop], idf) for start, stop in zip(offset[:-1], offset[1:], strict=True)]
    bow_offset = np.cumsum([0] + [len(words) for words, _ in vectors], dtype=np.int64)
    if not vectors:
        return bow_offset, np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.float32)
    return bow_offset, np.concatenate([words for words, _ in vectors]), np.concatenate([weights for _, weights in vectors])


@kernel
def _link(
    word: i4[::1], weight: f4[::1], frame: i8, head: i4[::1], following: i4[::1], posting_frame: i4[::1], posting_weight: f4[::1], n: i8
):
    for k in range(len(word)):
        posting_frame[n], posting_weight[n], following[n] = frame, weight[k], head[word[k]]
        head[word[k]] = n
        n += 1
    return n


@kernel
def _score(
    word: i4[::1], weight: f4[::1], head: i4[::1], following: i4[::1], posting_frame: i4[::1], posting_weight: f4[::1], score: f8[::1]
):
    for k in range(len(word)):
        posting = head[word[k]]
        while posting >= 0:
            score[posting_frame[posting]] += min(weight[k], posting_weight[posting])
            posting = following[posting]


class InvertedIndex:
    """For each word the frames that hold it, so that a query touches only frames it shares words with. Grows by `add`."""

    def __init__(self, n_words: int) -> None:
        self._head = np.full(n_words, -1, dtype=np.int32)  # last posting of each word
        self._following = np.empty(1024, dtype=np.int32)
        self._frame, self._weight = np.empty(1024, dtype=np.int32), np.empty(1024, dtype=np.float32)
        self._n, self._n_frames = 0, 0

    def add(self, frame: int, word: np.ndarray, weight: np.ndarray) -> None:
        """Add a frame (>= 0, any order, each once) by its word vector."""
        while self._n + len(word) > len(self._frame):
            self._following, self._frame, self._weight = (
                np.concatenate([column, np.empty_like(column)]) for column in (self._following, self._frame, self._weight)
            )
        self._n = _link(*self._vector(word, weight), frame, self._head, self._following, self._frame, self._weight, self._n)
        self._n_frames = max(self._n_frames, frame + 1)

    def query(self, word: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the frames that share a word with this vector, increasing (C,) int64, and their similarities (C,) float64 in (0, 1]; [Z] (10).

        1/2 sum(|a| + |b| - |a - b|) is the sum of min(a, b), as weights are never negative.
        """
        score = np.zeros(self._n_frames)
        _score(*self._vector(word, weight), self._head, self._following, self._frame, self._weight, score)
        frames = np.flatnonzero(score > 0)
        return frames, score[frames]

    def _vector(self, word: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        word, weight = np.array(word, dtype=np.int32), np.array(weight, dtype=np.float32)
        if len(word) != len(weight) or (len(word) and not 0 <= word.min() <= word.max() < len(self._head)):
            raise ValueError(
                f"a word vector of {len(word)} words and {len(weight)} weights does not fit an index of {len(self._head)} words"
            )
        return word, weight
