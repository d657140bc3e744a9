"""Which colour and which depth image belong together."""

import numpy as np

MAX_DIFFERENCE = 0.02  # [s] between a colour and a depth image that belong together, strictly below


def associate(stamp_a: np.ndarray, stamp_b: np.ndarray, *, offset: float = 0.0, max_difference: float = MAX_DIFFERENCE) -> np.ndarray:
    """Pair stamps one to one, nearest pairs first, as the data set's own associate.py does.

    stamp_a, stamp_b : (A,), (B,) [s], increasing; `offset` is added to b
    Returns (P, 2) indices into a and b, sorted by a.
    """
    shifted = stamp_b + offset
    # A margin wider than rounding: whether a pair counts is decided below, by the very expression of the rule.
    first = np.searchsorted(shifted, stamp_a - 1.001 * max_difference)
    last = np.searchsorted(shifted, stamp_a + 1.001 * max_difference, side="right")
    a = np.repeat(np.arange(len(stamp_a)), last - first)
    b = np.arange(len(a)) - np.repeat(np.cumsum(last - first) - last, last - first)
    difference = np.abs(stamp_a[a] - shifted[b])
    near = difference < max_difference
    a, b, difference = a[near], b[near], difference[near]
    free_a, free_b = np.ones(len(stamp_a), dtype=bool), np.ones(len(stamp_b), dtype=bool)
    pairs = []
    for k in np.lexsort((b, a, difference)):
        if free_a[a[k]] and free_b[b[k]]:
            free_a[a[k]] = free_b[b[k]] = False
            pairs.append((a[k], b[k]))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
