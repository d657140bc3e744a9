"""Matching kernels against their twin, and what the checks are worth."""

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.vision import hamming
from slamcli.vision.hamming import Described

seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(0, 25)


def descriptors(rng: np.random.Generator, n: int) -> np.ndarray:
    """Few bits set apart, so that distances are often equal."""
    base = rng.integers(0, 256, (1, 32)).astype(np.uint8)
    return base ^ np.packbits(rng.random((n, 256)) < 0.05, axis=1).reshape(n, 32)


def as_list(found: hamming.Match) -> list[tuple[int, int, int]]:
    rows, distance = found
    assert rows.dtype == np.int32 and distance.dtype == np.uint8 and rows.shape == (len(distance), 2)
    return [(int(i), int(j), int(d)) for (i, j), d in zip(rows, distance, strict=True)]


@settings(max_examples=80, deadline=None)
@given(seeds, sizes, sizes, st.sampled_from([0, 20, 256]), st.sampled_from([0.7, 0.95, 1.0]))
def test_brute_force_is_its_twin(seed: int, n_i: int, n_j: int, max_distance: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = descriptors(rng, n_i), descriptors(rng, n_j)
    found = hamming.match_brute(Described(a, np.zeros(n_i)), Described(b, np.zeros(n_j)), max_distance=max_distance, ratio=ratio)
    expected = naive.matches(a, b, np.ones((n_i, n_j), bool), max_distance, ratio) if n_i and n_j else []
    assert as_list(found) == expected


@settings(max_examples=80, deadline=None)
@given(seeds, sizes, sizes, st.booleans())
def test_under_nodes_only_features_with_one_in_common_are_compared(seed: int, n_i: int, n_j: int, has_second: bool) -> None:
    rng = np.random.default_rng(seed)
    a, b = descriptors(rng, n_i), descriptors(rng, n_j)
    node_i, node_j = (rng.integers(0, 4, (n, 2)).astype(np.int32) for n in (n_i, n_j))
    for node in (node_i, node_j):
        node[(node[:, 0] == node[:, 1]) | (not has_second), 1] = -1
    first = node_i[:, :1] == node_j[:, 0]
    crossed = (node_i[:, 1:] == node_j[:, 0]) | (node_i[:, :1] == node_j[:, 1])
    found = hamming.match_nodes(Described(a, np.zeros(n_i), node_i), Described(b, np.zeros(n_j), node_j), max_distance=256, ratio=1.0)
    expected = naive.matches(a, b, first | crossed, 256, hamming.NODE_RATIO) if n_i and n_j else []
    assert as_list(found) == expected


EXTREMES = {
    "all alike": (np.zeros((9, 32), np.uint8), np.zeros((7, 32), np.uint8)),
    "as far apart as can be": (np.zeros((4, 32), np.uint8), np.full((5, 32), 255, np.uint8)),
    "one and one": (np.full((1, 32), 7, np.uint8), np.full((1, 32), 6, np.uint8)),
    "one among its copies": (np.full((1, 32), 7, np.uint8), np.full((6, 32), 7, np.uint8)),
    "each twice": tuple(np.repeat(np.arange(8, dtype=np.uint8)[:, None] * np.ones(32, np.uint8), 2, axis=0) for _ in range(2)),
}


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("ratio", [0.8, 1.0])
def test_ties_and_extremes_are_matched_as_by_the_twin(name: str, ratio: float) -> None:
    a, b = EXTREMES[name]
    every = np.ones((len(a), len(b)), bool)
    found = hamming.match_brute(Described(a, np.zeros(len(a))), Described(b, np.zeros(len(b))), max_distance=256, ratio=ratio)
    assert as_list(found) == naive.matches(a, b, every, 256, ratio)
    i, j = (Described(one, np.zeros(len(one)), np.zeros((len(one), 2), np.int32) - [0, 1]) for one in (a, b))
    found = hamming.match_nodes(i, j, max_distance=256, ratio=ratio)
    assert as_list(found) == naive.matches(a, b, every, 256, ratio * hamming.NODE_RATIO)


def test_one_column_of_nodes_means_no_second_node() -> None:
    rng = np.random.default_rng(3)
    a, b = descriptors(rng, 40), descriptors(rng, 50)
    node_i, node_j = rng.integers(0, 5, 40), rng.integers(0, 5, 50)
    one = hamming.match_nodes(Described(a, np.zeros(40), node_i), Described(b, np.zeros(50), node_j))
    two = hamming.match_nodes(
        Described(a, np.zeros(40), np.stack([node_i, 0 * node_i - 1], 1)), Described(b, np.zeros(50), np.stack([node_j, 0 * node_j - 1], 1))
    )
    assert as_list(one) == as_list(two)


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(1, 60))
def test_the_turn_check_keeps_the_fullest_bins(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    desc = rng.integers(0, 256, (n, 32)).astype(np.uint8)
    angle_i = (rng.choice([0.0, 0.3, 2.0, 6.0], n) + rng.uniform(-4, 4, n)).astype(np.float32)
    angle_j = rng.uniform(-4, 4, n).astype(np.float32)
    rows, _ = hamming.match_brute(Described(desc, angle_i), Described(desc, angle_j), ratio=1.0)
    every, _ = hamming.match_brute(Described(desc, angle_i), Described(desc, angle_j), ratio=1.0, check_rotation=False)
    assert len(every) == n
    is_kept = naive.agreeing([float(angle_i[k]) - float(angle_j[k]) for k in range(n)])
    assert rows[:, 0].tolist() == np.flatnonzero(is_kept).tolist()


def test_one_wrong_turn_among_many_right_ones_goes() -> None:
    desc = np.random.default_rng(0).integers(0, 256, (40, 32)).astype(np.uint8)
    turn = np.full(40, 0.2)
    turn[7] = 2.5
    rows, _ = hamming.match_brute(Described(desc, turn), Described(desc, np.zeros(40)))
    assert rows[:, 0].tolist() == [k for k in range(40) if k != 7]


@pytest.mark.parametrize("n_i, n_j", [(0, 0), (0, 5), (5, 0)])
def test_nothing_matches_nothing(n_i: int, n_j: int) -> None:
    desc = np.zeros((5, 32), np.uint8)
    node = np.zeros((5, 2), np.int32)
    i, j = (Described(desc[:n], np.zeros(n), node[:n]) for n in (n_i, n_j))
    assert as_list(hamming.match_brute(i, j)) == []
    assert as_list(hamming.match_nodes(i, j)) == []


def test_columns_of_different_length_are_refused() -> None:
    desc, node, angle = np.zeros((5, 32), np.uint8), np.zeros((5, 2), np.int32), np.zeros(5)
    for columns in (
        (node[:4], node, angle, angle),
        (node, node[:4], angle[:4], angle),
        (node, np.zeros((6, 2)), angle, angle),
        (node - 1, node, angle, angle),
        (None, node, angle, angle),
    ):
        with pytest.raises(ValueError, match="each descriptor needs"):
            hamming.match_nodes(Described(desc, columns[2], columns[0]), Described(desc, columns[3], columns[1]))
