"""Bags of visual words: the word vector of a frame, and the inverted index that finds frames with words in common; [Z] 1.1 and (10).

D. Galvez-Lopez, J. D. Tardos, Bags of binary words for fast place recognition in image sequences, T-RO 2012, doi:10.1109/TRO.2012.2197158
"""

import numpy as np
from numba import f4, f8, i4, i8

from slamcli.jit.kernel import kernel


def word_vector(word: np.ndarray, idf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the word vector of one frame: words (B,) int32 in increasing order and their tf-idf weights (B,) float32, which sum to 1.

    Words of no weight are left out; a frame without features, or without any word of weight, has an empty vector.
    """
    present, count = np.unique(word, return_counts=True)
    weight = count * idf[present].astype(np.float64)
    present, weight = present[weight > 0], weight[weight > 0]
    return present.astype(np.int32), (weight / weight.sum()).astype(np.float32) if len(weight) else weight.astype(np.float32)


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
