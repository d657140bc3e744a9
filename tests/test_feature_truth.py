"""How repeatability is counted: each point once, the nearest pairs first."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from feature_truth import pairs_within


def greedy(a: np.ndarray, b: np.ndarray, radius: float, octave_a: np.ndarray, octave_b: np.ndarray, octaves: float) -> int:
    """Take the nearest pair that is left, until none is near enough."""
    left_a, left_b, n = set(range(len(a))), set(range(len(b))), 0
    while True:
        near = [(float(np.linalg.norm(a[i] - b[j])), i, j) for i in left_a for j in left_b if abs(octave_a[i] - octave_b[j]) <= octaves]
        if not near or min(near)[0] > radius:
            return n
        _, i, j = min(near)
        left_a.remove(i)
        left_b.remove(j)
        n += 1


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 14), st.integers(0, 14), st.sampled_from([0, 1, np.inf]))
def test_pairs_are_those_of_the_twin_and_no_more_than_there_are_points(seed: int, n: int, m: int, octaves: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, 12, (n, 2)).astype(float), rng.integers(0, 12, (m, 2)).astype(float)  # many distances equal
    octave_a, octave_b = rng.integers(0, 4, n).astype(np.uint8), rng.integers(0, 4, m).astype(np.uint8)
    found = pairs_within(a, b, 3.0, octave_a, octave_b, octaves=octaves)
    assert found == greedy(a, b, 3.0, octave_a.astype(int), octave_b.astype(int), octaves)
    assert found <= min(n, m)


@pytest.mark.parametrize("copies", [1, 5])
def test_a_bunch_around_one_place_counts_once_for_one_partner(copies: int) -> None:
    bunch, lone = np.zeros((copies, 2)), np.array([[1.0, 0.0]])
    assert pairs_within(bunch, lone, 3.0, np.zeros(copies, np.uint8), np.zeros(1, np.uint8), octaves=1) == 1
