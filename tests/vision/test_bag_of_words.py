"""Word vectors and the inverted index."""

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.vision import bag_of_words
from slamcli.vision.bag_of_words import InvertedIndex

seeds = st.integers(0, 2**32 - 1)


def test_a_word_vector_sums_to_one_and_leaves_out_words_of_no_weight() -> None:
    idf = np.array([0.0, 1.0, 2.0, 3.0], dtype=np.float32)
    word, weight = bag_of_words.word_vector(np.array([3, 1, 1, 0]), idf)
    assert word.tolist() == [1, 3] and word.dtype == np.int32
    np.testing.assert_allclose(weight, [2 / 5, 3 / 5])
    for empty in (np.zeros(0, np.int32), np.zeros(4, np.int32)):
        word, weight = bag_of_words.word_vector(empty, idf)
        assert len(word) == len(weight) == 0 and weight.dtype == np.float32


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(1, 12))
def test_the_index_scores_as_the_papers_formula(seed: int, n_frames: int) -> None:
    rng = np.random.default_rng(seed)
    vectors = [
        bag_of_words.word_vector(rng.integers(0, 30, rng.integers(0, 15)), np.linspace(0.0, 3, 30, dtype=np.float32))
        for _ in range(n_frames)
    ]
    index = InvertedIndex(30)
    for frame in rng.permutation(n_frames):
        index.add(int(frame), *vectors[frame])
    query = vectors[int(rng.integers(n_frames))]
    frames, scores = index.query(*query)
    expected = [naive.similarity(dict(zip(*query, strict=True)), dict(zip(*vector, strict=True))) for vector in vectors]
    assert frames.tolist() == [f for f in range(n_frames) if expected[f] > 0]
    np.testing.assert_allclose(scores, [expected[f] for f in frames], atol=1e-6)
    assert (scores <= 1 + 1e-6).all()


def test_a_frame_is_most_like_itself_and_the_index_grows_past_its_first_size() -> None:
    rng = np.random.default_rng(1)
    vectors = [bag_of_words.word_vector(rng.integers(0, 5000, 400), np.ones(5000, np.float32)) for _ in range(12)]
    index = InvertedIndex(5000)
    for frame, vector in enumerate(vectors):
        index.add(frame, *vector)
    for frame, vector in enumerate(vectors):
        frames, scores = index.query(*vector)
        assert frames[scores.argmax()] == frame and scores.max() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("word, weight", [([30], [1.0]), ([-1], [1.0]), ([1, 2], [1.0])])
def test_words_that_the_index_does_not_have_are_refused(word: list, weight: list) -> None:
    index = InvertedIndex(30)
    for use in (lambda *vector: index.add(0, *vector), index.query):
        with pytest.raises(ValueError, match="does not fit an index of 30 words"):
            use(np.array(word), np.array(weight))
