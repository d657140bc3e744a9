"""Which colour and which depth image belong together."""

import heapq

import numpy as np

MAX_DIFFERENCE = 0.02  # [s] between a colour and a depth image that belong together, strictly below


def associate(stamp_a: np.ndarray, stamp_b: np.ndarray, *, offset: float = 0.0, max_difference: float = MAX_DIFFERENCE) -> np.ndarray:
    """Pair stamps one to one, nearest pairs first, as the data set's own associate.py does.

    stamp_a, stamp_b : (A,), (B,) [s], increasing; `offset` is added to b
    Returns (P, 2) indices into a and b, sorted by a.

    Of all that is free, the two that are nearest lie side by side in the order of time, as whatever lies between is nearer to one of them.
    So only neighbours are looked at, and those who become neighbours when a pair is taken out: memory grows with A + B, however dense
    the stamps are.
    """
    stamp = np.concatenate([stamp_a, stamp_b + offset])
    order = np.argsort(stamp, kind="stable")
    is_b = order >= len(stamp_a)
    apart = np.diff(stamp[order])
    is_pair = (is_b[1:] != is_b[:-1]) & (apart < max_difference)

    time, row, of_b = stamp[order].tolist(), (order - len(stamp_a) * is_b).tolist(), is_b.tolist()
    n = len(time)
    before, after, free = list(range(-1, n - 1)), list(range(1, n + 1)), [True] * n
    nearest = [_pair(i, i + 1, row, of_b) for i in np.flatnonzero(is_pair).tolist()]
    heap = [(difference, *pair) for difference, pair in zip(apart[is_pair].tolist(), nearest, strict=True)]
    heapq.heapify(heap)
    pairs = []
    while heap:
        _, a, b, i, j = heapq.heappop(heap)
        if not (free[i] and free[j]):
            continue
        free[i] = free[j] = False
        pairs.append((a, b))
        left, right = before[i], after[j]
        if left >= 0:
            after[left] = right
        if right < n:
            before[right] = left
        if left >= 0 and right < n and of_b[left] != of_b[right] and time[right] - time[left] < max_difference:
            heapq.heappush(heap, (time[right] - time[left], *_pair(left, right, row, of_b)))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _pair(i: int, j: int, row: list[int], of_b: list[bool]) -> tuple[int, int, int, int]:
    """Return rows of a and of b that lie at places i < j in the order of time, and the places: of equally near pairs the first rows win."""
    return (row[j], row[i], i, j) if of_b[i] else (row[i], row[j], i, j)
