"""A small vocabulary, and the groups of descriptors that it was trained on."""

from functools import cache

import numpy as np

from slamcli.vision import kmeans
from slamcli.vision.vocabulary import Vocabulary


def groups(rng: np.random.Generator, n_groups: int, per_group: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors strewn around random centres: (centres, descriptors group by group)."""
    centre = rng.integers(0, 256, (n_groups, 32)).astype(np.uint8)
    noise_bits = np.packbits(rng.random((n_groups, per_group, 256)) < noise, axis=2)
    return centre, (centre[:, None] ^ noise_bits).reshape(-1, 32)


@cache
def tree() -> Vocabulary:
    """Train a tree of 5 children and 3 levels on 60 groups."""
    rng = np.random.default_rng(4)
    _, desc = groups(rng, 60, 20, 0.08)
    return kmeans.train(np.array_split(rng.permutation(desc), 12), branching=5, depth=3, rng=rng, origin="groups")
