"""Training of a vocabulary: hierarchical k-means++ of binary descriptors, majority vote as mean; [Z] 1.1.

D. Arthur, S. Vassilvitskii, k-means++: the advantages of careful seeding, SODA 2007; D. Galvez-Lopez, J. D. Tardos, T-RO 2012.
"""

from collections.abc import Callable

import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry import elementary
from slamcli.geometry.bits import hamming
from slamcli.jit.kernel import kernel
from slamcli.vision.vocabulary import MAX_NODES, Vocabulary, check, quantize


@kernel
def _distances(desc, rows, centre, nearest_squared):
    """Lower each row's squared distance to the nearest centre by a new centre; returns the sum."""
    total = 0.0
    for k in range(len(rows)):
        d = np.float64(hamming(desc, rows[k], centre, 0))
        nearest_squared[k] = min(nearest_squared[k], d * d)
        total += nearest_squared[k]
    return total


@kernel
def _assign(desc, rows, centres, label):
    """Label each row with its nearest centre, of equals the first; returns the number of labels that changed."""
    changed = 0
    for k in range(len(rows)):
        nearest, least = 0, 257
        for c in range(len(centres)):
            d = int(hamming(desc, rows[k], centres, c))
            if d < least:
                nearest, least = c, d
        changed += label[k] != nearest
        label[k] = nearest
    return changed


@kernel
def _vote(desc, rows, label, centres):
    """Set each bit of each centre to the majority of its rows, an even vote to 1. A centre without rows stays."""
    votes = np.zeros((len(centres), 256), dtype=np.int32)
    size = np.zeros(len(centres), dtype=np.int32)
    for k in range(len(rows)):
        c = label[k]
        size[c] += 1
        for w in range(4):
            bits = desc[rows[k], w]
            for b in range(64):
                votes[c, 64 * w + b] += np.int32((bits >> np.uint64(b)) & np.uint64(1))
    for c in range(len(centres)):
        if size[c] == 0:
            continue
        for w in range(4):
            word = np.uint64(0)
            for b in range(64):
                if 2 * votes[c, 64 * w + b] >= size[c]:
                    word |= np.uint64(1) << np.uint64(b)
            centres[c, w] = word


def _seed(desc: np.ndarray, rows: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Choose up to k different descriptors: the first at random, each further one with probability by its squared distance to the chosen."""
    centres = desc[rows[rng.integers(len(rows))]][None]
    squared = np.full(len(rows), np.inf)
    while len(centres) < k and (total := _distances(desc, rows, centres[-1:], squared)) > 0:
        pick = min(int(np.searchsorted(np.cumsum(squared), rng.random() * total, side="right")), len(rows) - 1)
        centres = np.concatenate([centres, desc[rows[pick]][None]])
    return centres


def cluster(
    desc: np.ndarray, rows: np.ndarray, k: int, *, rng: np.random.Generator, iterations: int
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Cluster rows of desc (N, 4) uint64. Returns centres (C, 4) uint64, C <= k, and the rows of each; no cluster is empty."""
    centres = _seed(desc, rows, k, rng)
    label = np.full(len(rows), -1, dtype=np.int32)
    for _ in range(iterations):
        if _assign(desc, rows, centres, label) == 0:
            break
        _vote(desc, rows, label, centres)
    _assign(desc, rows, centres, label)
    members = [rows[label == c] for c in range(len(centres))]
    kept = [c for c, group in enumerate(members) if len(group)]
    return centres[kept], [members[c] for c in kept]


def train(
    descriptors: list[np.ndarray],
    *,
    branching: int = 10,
    depth: int = 5,
    min_size: int = 1,
    iterations: int = 10,
    rng: np.random.Generator,
    origin: str = "",
    progress: Callable = lambda items, label, total=None: items,
) -> Vocabulary:
    """Train a vocabulary on the descriptors (N_i, 32) uint8 of each of a set of images.

    branching, depth : of the tree; min_size : a cluster of fewer descriptors than 2 min_size is a word, however high it stands.
    origin : a sentence that says what the images are. Same input and generator state: same vocabulary.
    """
    desc = np.ascontiguousarray(np.concatenate([np.zeros((0, 32), np.uint8), *descriptors]), dtype=np.uint8).view(np.uint64)
    if len(np.unique(desc, axis=0)) < 2:
        raise SlamError("a vocabulary needs images with at least two different descriptors")
    centres, n_children = [np.zeros((1, 4), dtype=np.uint64)], []
    groups = [np.arange(len(desc), dtype=np.int32)]
    for level in range(depth):
        below = []
        for rows in progress(groups, f"level {level + 1} of {depth}", len(groups)):
            if len(rows) < max(2, 2 * min_size):
                n_children.append(0)
                continue
            found, members = cluster(desc, rows, branching, rng=rng, iterations=iterations)
            if len(members) == 1 and level > 0:  # all alike: already a word
                n_children.append(0)
                continue
            n_children.append(len(members))
            centres.append(found)
            below += members
        groups = below
        if sum(map(len, centres)) > MAX_NODES:
            raise SlamError(f"a vocabulary of more than {MAX_NODES} nodes: lower the depth or the branching")
    n_children += [0] * len(groups)
    first_child = np.concatenate([[1], 1 + np.cumsum(n_children)]).astype(np.int32)
    tree = np.ascontiguousarray(np.concatenate(centres)).view(np.uint8).reshape(-1, 32)
    n_words = n_children.count(0)
    bare = Vocabulary(tree, first_child, np.ones(n_words, dtype=np.float32), origin)
    return check(Vocabulary(tree, first_child, document_frequency(bare, descriptors), origin), source="training")


def document_frequency(vocabulary: Vocabulary, descriptors: list[np.ndarray]) -> np.ndarray:
    """Return each word's weight (W,) float32: ln(images / images that hold it); a word of every image weighs nothing."""
    n_images = np.zeros(vocabulary.n_words, dtype=np.int64)
    for desc in descriptors:
        n_images[np.unique(quantize(vocabulary, desc)[0])] += 1
    return elementary.log(len(descriptors) / np.maximum(n_images, 1)).astype(np.float32)
