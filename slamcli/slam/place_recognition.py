"""Place recognition: which key frames look like an image, by the similarity of their bags of words; [Z] (10)."""

import numpy as np

from slamcli.parallel import LastUsed
from slamcli.schema import Words
from slamcli.vision.bag_of_words import InvertedIndex, word_vector

KEPT_SCORES = 1 << 23  # numbers, 64 MiB: every round of loop closing asks for the same


def bow_vector(words: Words, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the bag-of-words vector of one frame: words (B,) and their weights (B,)."""
    rows = slice(int(words.word_offset[frame]), int(words.word_offset[frame + 1]))
    return word_vector(words.word[rows], words.idf)


class PlaceIndex:
    """An inverted index over the bags of words of key frames."""

    def __init__(self, words: Words, kf_frame: np.ndarray) -> None:
        """Index the key frames whose frames are `kf_frame` (K,); `words` are of the recording that they belong to."""
        self.words = words
        self._scores: LastUsed[np.ndarray] = LastUsed(1)
        self._index = InvertedIndex(len(words.idf))
        self._vectors: list[tuple[np.ndarray, np.ndarray]] = []
        for frame in kf_frame:
            self.add(int(frame))

    def add(self, frame: int) -> None:
        """Add the next key frame, which is frame `frame` of the recording."""
        vector = bow_vector(self.words, frame)
        self._index.add(len(self._vectors), *vector)
        self._vectors.append(vector)
        self._scores = LastUsed(max(1, KEPT_SCORES // len(self._vectors)))  # of fewer key frames than there are now

    def query(self, vector: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Find the key frames that share words with a bag-of-words vector, and the similarity of each."""
        return self._index.query(*vector)

    def scores(self, kf: int) -> np.ndarray:
        """Compute the similarity (K,) of key frame `kf` to every key frame."""
        return self._scores.get(kf, self._compute_scores).copy()

    def _compute_scores(self, kf: int) -> np.ndarray:
        scores = np.zeros(len(self._vectors))
        found, values = self.query(self._vectors[kf])
        scores[found] = values
        return scores
