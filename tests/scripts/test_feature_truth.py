"""How repeatability is counted: each point once, the nearest pairs first; and where the points truly are."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

from feature_truth import Recording, pairs_within, pixel_grid

from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate
from slamcli.geometry import se3


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


def test_the_images_put_a_true_trajectory_right_whose_direction_is_noisy(tmp_path: Path) -> None:
    """0.4 degrees are 3 px; after that the way of pixels from image to image is known to half of one."""
    folder = simulate(tmp_path / "room", progress=silent, seed=1, frames=4, laps=0.02, width=320, height=240)
    recording = Recording(str(folder))
    raw = pixel_grid(recording.camera, 8)
    true = recording.carry(raw, 0, 3)
    assert recording.is_exact and np.isfinite(true[:, 0]).mean() > 0.5

    recording.T_wc[3] = recording.T_wc[3] @ se3.exp(np.radians([0.0, 0.0, 0.0, 0.4, -0.4, 0.3]))
    noisy = recording.seen_from(raw, 0, 3, se3.inverse(recording.T_wc[3]) @ recording.T_wc[0])
    recording.is_exact = False
    there, back = (recording.seen_from(raw, *pair, recording.motion(*pair)) for pair in ((0, 3), (3, 0)))
    assert np.nanmedian(np.linalg.norm(noisy - true, axis=1)) > 1.5
    assert np.nanmedian(np.linalg.norm(there - true, axis=1)) < 0.4
    assert np.isfinite(back[:, 0]).mean() > 0.5


def test_where_too_little_is_seen_the_true_trajectory_has_the_last_word(tmp_path: Path) -> None:
    folder = simulate(tmp_path / "room", progress=silent, seed=1, frames=2, laps=0.02, width=160, height=120)
    recording = Recording(str(folder))
    recording.is_exact, recording.grey = False, lambda _: np.zeros((120, 160), np.uint8)
    np.testing.assert_array_equal(recording.motion(0, 1), se3.inverse(recording.T_wc[1]) @ recording.T_wc[0])
