"""The tree of words: training and quantizing."""

import naive
import numpy as np
import pytest
import word_groups
from hypothesis import given, settings
from hypothesis import strategies as st
from word_groups import groups

from slamcli.errors import SlamError
from slamcli.vision import kmeans, vocabulary
from slamcli.vision.vocabulary import Vocabulary

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture
def small() -> Vocabulary:
    return word_groups.tree()


def distance(a: np.ndarray, b: np.ndarray) -> int:
    return int(np.unpackbits(a ^ b).sum())


def test_training_recovers_well_separated_groups() -> None:
    rng = np.random.default_rng(0)
    centre, desc = groups(rng, 8, 50, 0.05)
    trained = kmeans.train([desc], branching=8, depth=1, rng=np.random.default_rng(1))
    assert trained.n_words == 8
    nearest = [min(distance(c, w) for w in trained.centre[1:]) for c in centre]
    assert max(nearest) <= 3, "a majority of 50 votes with 5 % noise is all but exact"
    word = vocabulary.quantize(trained, desc)[0].reshape(8, 50)
    assert (word == word[:, :1]).all() and len(np.unique(word)) == 8


def test_a_centre_is_the_majority_of_its_members(small: Vocabulary) -> None:
    _, desc = groups(np.random.default_rng(4), 60, 20, 0.08)
    rows = desc.view(np.uint64)
    centres, members = kmeans.cluster(rows, np.arange(len(rows), dtype=np.int32), 5, rng=np.random.default_rng(0), iterations=100)
    assert sum(map(len, members)) == len(rows)
    for centre, group in zip(centres, members, strict=True):
        votes = np.unpackbits(desc[group], axis=1).sum(axis=0)
        np.testing.assert_array_equal(np.unpackbits(centre.view(np.uint8)), 2 * votes >= len(group))
        for row in group[:5]:
            own = distance(desc[row], centre.view(np.uint8))
            assert own == min(distance(desc[row], other.view(np.uint8)) for other in centres)


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(1, 30), st.integers(1, 6))
def test_a_round_of_k_means_is_its_twin(seed: int, n: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    desc = (
        rng.integers(0, 256, (n, 32)).astype(np.uint8) if seed % 2 else np.repeat(rng.integers(0, 256, (1, 32)), n, axis=0).astype(np.uint8)
    )
    centres = rng.integers(0, 256, (k, 32)).astype(np.uint8)
    rows, label = rng.permutation(n).astype(np.int32), np.full(n, -1, np.int32)
    nearest = [min(range(k), key=lambda c: distance(centres[c], desc[row])) for row in rows]
    assert kmeans._assign(desc.view(np.uint64), rows, centres.view(np.uint64), label) == n
    assert label.tolist() == nearest
    voted = centres.copy()
    kmeans._vote(desc.view(np.uint64), rows, label, voted.view(np.uint64))
    for c in range(k):
        members = np.unpackbits(desc[rows[label == c]], axis=1)
        expected = np.packbits(2 * members.sum(axis=0) >= len(members)) if len(members) else centres[c]
        np.testing.assert_array_equal(voted[c], expected)


def test_centres_start_far_apart_by_the_squared_distance_and_never_twice_alike() -> None:
    """Three descriptors 0, 8 and 16 bits from the first: the second centre is the farther one in 4 of 5 cases, if the first is first."""
    desc = np.zeros((3, 32), np.uint8)
    desc[1, :1], desc[2, 1:3] = 255, 255
    picked = []
    for seed in range(600):
        centres = kmeans._seed(desc.view(np.uint64), np.arange(3, dtype=np.int32), 2, np.random.default_rng(seed)).view(np.uint8)
        if not centres[0].any():
            picked.append(int(np.unpackbits(centres[1]).sum()))
    assert set(picked) == {8, 16} and len(picked) > 150
    assert 0.7 < np.mean(np.array(picked) == 16) < 0.9
    alike = np.concatenate([desc, desc])
    centres = kmeans._seed(alike.view(np.uint64), np.arange(6, dtype=np.int32), 6, np.random.default_rng(0))
    assert len(centres) == len(np.unique(centres, axis=0)) == 3


def test_same_descriptors_and_seed_give_the_same_tree() -> None:
    _, desc = groups(np.random.default_rng(2), 30, 10, 0.1)
    a, b = (kmeans.train([desc], branching=4, depth=3, rng=np.random.default_rng(7)) for _ in range(2))
    for name in ("centre", "first_child", "idf"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("desc", [np.zeros((0, 32)), np.zeros((1, 32)), np.zeros((50, 32))], ids=["none", "one", "all alike"])
def test_too_little_to_train_on_is_a_clear_error(desc: np.ndarray) -> None:
    with pytest.raises(SlamError, match="two different descriptors"):
        kmeans.train([desc.astype(np.uint8)], rng=np.random.default_rng(0))


def test_few_descriptors_become_a_word_each() -> None:
    desc = np.random.default_rng(0).integers(0, 256, (3, 32)).astype(np.uint8)
    trained = kmeans.train([desc, desc], branching=10, depth=4, rng=np.random.default_rng(0))
    assert trained.n_words == 3
    assert {bytes(c) for c in trained.centre[1:]} >= {bytes(d) for d in desc}
    np.testing.assert_array_equal(trained.idf, 0.0)  # every word is in every image


def test_the_tree_is_well_formed(small: Vocabulary) -> None:
    assert small.first_child[0] == 1 and small.first_child[-1] == len(small.centre)
    assert small.n_words == (np.diff(small.first_child) == 0).sum() and 30 < small.n_words <= 125
    assert small.depth == 3 and small.branching == 5
    np.testing.assert_array_equal(small.level[1:], small.level[small.parent] + 1)
    assert (small.parent < np.arange(1, len(small.centre))).all()


def test_quantizing_goes_down_as_its_twin(small: Vocabulary) -> None:
    desc = np.random.default_rng(9).integers(0, 256, (60, 32)).astype(np.uint8)
    word, node = vocabulary.quantize(small, desc, node_level=1, margin=10)
    children = {v: list(range(small.first_child[v], small.first_child[v + 1])) for v in range(len(small.centre))}
    expected = [naive.word_of(children, small.centre, d) for d in desc]
    np.testing.assert_array_equal(word, small.word_of_node[expected])
    for d, (first, second) in zip(desc, node, strict=True):
        order = sorted(children[0], key=lambda child: (distance(small.centre[child], d), child))
        far = distance(small.centre[order[1]], d) - distance(small.centre[order[0]], d)
        assert (first, second) == (order[0], order[1] if far <= 10 else -1)


@pytest.mark.parametrize("node_level", [0, 1, 2, 3, 9])
def test_the_node_is_the_words_ancestor(small: Vocabulary, node_level: int) -> None:
    desc = np.random.default_rng(5).integers(0, 256, (40, 32)).astype(np.uint8)
    word, node = vocabulary.quantize(small, desc, node_level=node_level)
    leaf = np.flatnonzero(small.word_of_node >= 0)[word]
    assert (node[:, 1] == -1).all()
    np.testing.assert_array_equal(small.node_of_word(node_level)[word], node[:, 0])
    for v, ancestor in zip(leaf, node[:, 0], strict=True):
        while v != ancestor:
            assert small.level[v] > node_level
            v = small.parent[v - 1]
        assert small.level[ancestor] <= node_level


def test_no_descriptor_has_no_word(small: Vocabulary) -> None:
    word, node = vocabulary.quantize(small, np.zeros((0, 32), np.uint8))
    assert word.shape == (0,) and node.shape == (0, 2)


def test_children_of_any_tree_are_put_side_by_side(small: Vocabulary) -> None:
    """Nodes renamed at random, parents still first: the rebuilt tree gives every descriptor the same centre as word."""
    rng = np.random.default_rng(3)
    key = np.zeros(len(small.centre))
    for v in range(1, len(key)):
        key[v] = key[small.parent[v - 1]] + rng.random()
    order = np.argsort(key, kind="stable")
    new = np.argsort(order)
    parent = new[np.concatenate([[0], small.parent])][order][1:].astype(np.int32)
    weight = np.concatenate([[0], small.node_weight])[order][1:]
    rebuilt = vocabulary.from_parents(parent, small.centre[order][1:], weight, origin="", source="test")
    desc = groups(np.random.default_rng(4), 60, 20, 0.08)[1]
    centre = [v.centre[v.word_of_node >= 0][vocabulary.quantize(v, desc)[0]] for v in (small, rebuilt)]
    assert np.mean((centre[0] == centre[1]).all(axis=1)) > 0.9  # ties may go the other way
    np.testing.assert_allclose(np.sort(rebuilt.idf), np.sort(small.idf))
