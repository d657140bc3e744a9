import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.errors import SlamError
from slamcli.geometry import voxel

number = st.integers(0, 2**21 - 1)


@settings(deadline=None)
@given(number, number, number)
def test_a_morton_key_interleaves_the_bits_and_comes_apart_again(x: int, y: int, z: int) -> None:
    key = voxel.morton(np.array([[x, y, z]]))
    assert key[0] == naive.interleaved(x, y, z)
    assert voxel.unmorton(key).tolist() == [[x, y, z]]
    assert voxel.spread(x) | voxel.spread(y) << 1 | voxel.spread(z) << 2 == key[0]
    assert (voxel.gather(key[0]), voxel.gather(key[0] >> 1), voxel.gather(key[0] >> 2)) == (x, y, z)


def test_eight_consecutive_keys_are_the_children_of_one_node() -> None:
    cells = voxel.unmorton(np.arange(8 * 77, 8 * 78))
    assert len(np.unique(cells >> 1, axis=0)) == 1
    assert (cells & 1).tolist() == [[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)]


@settings(deadline=None)
@given(st.lists(st.integers(0, 2**62), max_size=300), st.integers(0, 2**62))
def test_rows_are_those_of_a_dictionary(keys: list[int], absent: int) -> None:
    rows, expected = voxel.VoxelRows(), {}
    rows.reserve(len(keys))
    for key in keys:
        row = voxel.find_or_add(rows.index, rows.n, key)
        assert row == expected.setdefault(key, len(expected))
        rows.n = max(rows.n, row + 1)
    assert rows.key.tolist() == list(expected)
    assert voxel.find_row(rows.index, absent) == expected.get(absent, -1)


def test_rows_keep_their_numbers_and_columns_while_the_table_grows() -> None:
    rows = voxel.VoxelRows(value=((2,), np.float32, np.nan))
    keys = np.random.default_rng(0).integers(0, 2**62, 20_000)
    for start in range(0, len(keys), 500):
        rows.reserve(500)
        for key in keys[start : start + 500]:
            rows.columns["value"][rows.n] = rows.n
            rows.n += voxel.find_or_add(rows.index, rows.n, key) == rows.n
    found = [voxel.find_row(rows.index, key) for key in keys]
    assert found == list(range(len(keys)))
    assert (rows.columns["value"][: rows.n, 0] == np.arange(rows.n)).all()
    assert np.isnan(rows.columns["value"][rows.n :]).all()
    assert len(rows.index.slot_row) >= 2 * len(rows.index.row_key)


def test_a_map_beyond_all_memory_is_refused() -> None:
    with pytest.raises(SlamError, match="larger"):
        voxel.VoxelRows().reserve(1 << 30)
