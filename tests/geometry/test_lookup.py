"""A table looked up by 16-bit index."""

import numpy as np

from slamcli.geometry.lookup import look_up


def test_it_is_what_indexing_gives():
    rng = np.random.default_rng(0)
    table = rng.normal(size=1 << 16).astype(np.float32)
    table[0] = np.nan
    index = rng.integers(0, 1 << 16, size=(31, 17)).astype(np.uint16)
    index[0, :3] = 0, 1, (1 << 16) - 1
    assert np.array_equal(look_up(table, index), table[index], equal_nan=True)
    assert np.array_equal(look_up(table, index.T), table[index.T], equal_nan=True)
