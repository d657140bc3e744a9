"""The heap of A* gives its entries in order of key, and of arrival where keys are equal."""

import heapq

import numpy as np
import pytest

from slamcli.geometry.heap import doubled, pop, push


@pytest.mark.parametrize("n_keys", [1, 4, 10**6])
def test_entries_come_out_as_from_a_list_kept_sorted(n_keys: int) -> None:
    rng = np.random.default_rng(n_keys)
    key, order, cell = np.empty(2), np.empty(2, np.int64), np.empty(2, np.int64)
    expected: list[tuple[float, int, int]] = []
    for n, is_push in enumerate(rng.random(3000) < 0.6):
        if is_push:
            if len(expected) == len(key):
                key, order, cell = doubled(key), doubled(order), doubled(cell)
            entry = float(rng.integers(n_keys)), n, int(rng.integers(100))
            push(key, order, cell, len(expected), *entry)
            heapq.heappush(expected, entry)
        elif expected:
            pop(key, order, cell, len(expected))
            assert cell[len(expected) - 1] == heapq.heappop(expected)[2]
    assert len(expected) > 300


def test_room_is_doubled_and_what_it_holds_stays() -> None:
    values = np.arange(5.0)
    np.testing.assert_array_equal(doubled(values)[:5], values)
    assert doubled(values).shape == (10,)
