"""The grid from the octree: against a brute-force look at every leaf's cells, and what hangs."""

import numpy as np
import pytest
from octrees import box, hanging_box, tree_of

from slamcli.config.options import GridConfig
from slamcli.errors import SlamError
from slamcli.geometry.octree import DEPTH
from slamcli.navigation.grid import FREE, OCCUPIED, UNKNOWN
from slamcli.navigation.grid_from_octree import grid_from_octree

SETTINGS = GridConfig(source="octree")


def state_at(grid, cell):
    column, row = np.array(cell) - np.round(grid.origin / float(grid.resolution)).astype(int)
    return int(grid.state[row, column])


def test_every_column_matches_a_look_at_its_cells():
    rng = np.random.default_rng(0)
    cells = {tuple(c): bool(rng.random() < 0.2) for c in rng.integers([-8, -8, -3], [8, 8, 14], (900, 3)).tolist()}
    cells |= box((-8, 0), (0, 8), (2, 8), False)  # prunes to large leaves
    tree = tree_of(cells)
    assert (tree.depth < DEPTH).any()
    grid = grid_from_octree(tree, settings=SETTINGS)
    for i in range(-8, 8):
        for j in range(-8, 8):
            band = [cells[i, j, k] for k in range(1, 10) if (i, j, k) in cells]  # 0.05 to 0.5 m
            known = band or [(i, j, k) for k in (-1, 0) if (i, j, k) in cells]
            state = state_at(grid, (i, j))
            assert (state == OCCUPIED) == any(band)
            if not any(band):
                assert state in ((FREE, UNKNOWN) if known else (UNKNOWN,))


def test_floor_and_band_make_free_and_nothing_makes_unknown():
    cells = box((0, 4), (0, 4), (-1, 0), True) | box((6, 8), (0, 4), (3, 5), False)
    grid = grid_from_octree(tree_of(cells), settings=SETTINGS)
    assert state_at(grid, (1, 1)) == FREE  # a floor
    assert state_at(grid, (7, 1)) == FREE  # air
    assert state_at(grid, (5, 1)) == UNKNOWN
    assert np.isnan(grid.p_occupied[grid.state == UNKNOWN]).all()


def test_what_lies_above_or_below_the_band_does_not_matter():
    cells = box((0, 3), (0, 3), (-1, 0), True) | box((0, 3), (0, 3), (10, 30), True)
    assert state_at(grid_from_octree(tree_of(cells), settings=SETTINGS), (1, 1)) == FREE
    assert state_at(grid_from_octree(tree_of(cells | {(1, 1, 9): True}), settings=SETTINGS), (1, 1)) == OCCUPIED


def test_the_inside_of_something_that_hangs_is_not_free_though_the_floor_below_is_seen():
    grid = grid_from_octree(tree_of(hanging_box(hollow=False)), settings=SETTINGS)
    inside = [(i, j) for i in range(-3, 4) for j in range(-3, 4)]
    assert all(state_at(grid, c) == UNKNOWN for c in inside)
    assert state_at(grid, (4, 0)) == OCCUPIED
    assert state_at(grid, (6, 0)) == state_at(grid, (-10, 7)) == FREE
    seen_into = grid_from_octree(tree_of(hanging_box(hollow=True)), settings=SETTINGS)
    assert all(state_at(seen_into, c) == FREE for c in inside)


def test_unknown_air_elsewhere_does_not_spoil_the_floor():
    cells = box((0, 40), (0, 40), (-1, 0), True) | box((0, 3), (0, 40), (0, 12), True)  # a wall stands, it does not hang
    grid = grid_from_octree(tree_of(cells), settings=SETTINGS)
    assert all(state_at(grid, (i, 20)) == FREE for i in range(3, 40))


@pytest.mark.parametrize("resolution", [0.02, 0.05, 0.1])
def test_leaves_and_cells_may_differ_in_size(resolution):
    tree = tree_of(box((0, 20), (0, 20), (-1, 0), True) | box((4, 8), (4, 8), (2, 6), True))  # 0.2 to 0.4 m in x and y
    grid = grid_from_octree(tree, settings=GridConfig(resolution=resolution))
    x = grid.origin[0] + (np.arange(grid.state.shape[1]) + 0.5) * resolution
    y = grid.origin[1] + (np.arange(grid.state.shape[0]) + 0.5) * resolution
    inside = np.outer((y > 0.2) & (y < 0.4), (x > 0.2) & (x < 0.4))
    np.testing.assert_array_equal(grid.state, np.where(inside, OCCUPIED, FREE))


def test_an_empty_octree_gives_one_unknown_cell():
    assert grid_from_octree(tree_of({}), settings=SETTINGS).state.tolist() == [[UNKNOWN]]
    assert grid_from_octree(tree_of(box((0, 4), (0, 4), (40, 44), True)), settings=SETTINGS).state.tolist() == [[UNKNOWN]]


def test_a_tree_too_wide_is_an_error():
    with pytest.raises(SlamError, match=r"raise grid2d\.resolution"):
        grid_from_octree(tree_of({(-30000, -30000, 2): True, (30000, 30000, 2): True}), settings=SETTINGS)
