"""Maps made by hand: key frames where a test puts them, that share as many landmarks as it says."""

import numpy as np

from slamcli.schema import Features, Words
from slamcli.sparse_map.sparse_map import SparseMap

ROWS = 400  # features of each key frame


def plain_map(T_wk: np.ndarray, *, segment: list[int] | None = None) -> SparseMap:
    """Return a map of key frames (K, 4, 4) without landmarks."""
    n, rows = len(T_wk), ROWS * len(T_wk)
    stamp = 10.0 + np.arange(n)
    sparse_map = SparseMap(
        Features(
            stamp=stamp,
            depth_stamp=stamp.copy(),
            offset=ROWS * np.arange(n + 1),
            xy=np.zeros((rows, 2), np.float32),
            depth=np.ones(rows, np.float32),
            slope=np.zeros((rows, 2), np.float32),
            octave=np.zeros(rows, np.uint8),
            angle=np.zeros(rows, np.float32),
            desc=np.zeros((rows, 32), np.uint8),
            octave_scale=np.array(1.2),
        )
    )
    for k, T in enumerate(T_wk):
        sparse_map.add_key_frame(k, T, 0 if segment is None else segment[k])
    return sparse_map


def share(sparse_map: SparseMap, kfs: tuple[int, ...], n: int) -> np.ndarray:
    """Add `n` landmarks that all of the key frames see; returns their ids."""
    first, *others = kfs
    free = [np.flatnonzero(sparse_map.lm_of_row[sparse_map.rows_of(kf)] < 0)[:n] + ROWS * kf for kf in kfs]
    ids = sparse_map.add_landmarks(first, free[0], sparse_map.kf.T_wk[first, :3, 3] + [0.0, 0.0, 3.0] + np.zeros((n, 1)))
    for kf, rows in zip(others, free[1:], strict=True):
        sparse_map.observe(kf, ids, rows)
    return ids


def words_in(frames: list[list[int]]) -> Words:
    """Return words, all of equal weight, that the frames hold: with ten each, every one that two share makes them a tenth alike."""
    offset = np.cumsum([0, *map(len, frames)])
    word = np.concatenate([np.array(f, np.int32) for f in frames])
    n = word.max() + 1
    return Words(np.ones(n, np.float32), offset.astype(np.int64), word, np.arange(n, dtype=np.int32), np.full(len(word), -1, np.int32))
