"""What was driven over is free, and nothing else changes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.config.options import GridConfig
from slamcli.errors import SlamError
from slamcli.navigation.driven import mark_driven
from slamcli.schema import Grid

SETTINGS = GridConfig(driven=0.3)


def a_grid(seed: int = 0, shape: tuple[int, int] = (40, 50)) -> Grid:
    state = np.random.default_rng(seed).integers(-1, 2, shape).astype(np.int8)
    p = np.where(state < 0, np.nan, np.where(state == 1, 0.9, 0.02)).astype(np.float32)
    return Grid(p, (state >= 0).astype(np.int32), state, origin=np.array([-1.0, -0.5]), resolution=np.array(0.05))


def centres(grid: Grid) -> np.ndarray:
    rows, columns = grid.state.shape
    y, x = np.mgrid[0:rows, 0:columns]
    return np.stack([x, y], axis=-1) * 0.05 + 0.025 + grid.origin


def test_off_by_default_since_nobody_drives_where_a_hand_goes() -> None:
    grid = a_grid()
    assert mark_driven(grid, np.array([[0.0, 0.0]]), settings=GridConfig()) is grid
    assert mark_driven(grid, np.full((3, 2), np.nan), settings=SETTINGS) is grid


@given(st.lists(st.tuples(st.floats(-0.6, 1.1), st.floats(-0.1, 1.1)), min_size=1, max_size=5), st.integers(0, 5))
def test_unknown_cells_within_the_radius_become_free_and_no_others_change(places: list, seed: int) -> None:
    before = a_grid(seed)
    after = mark_driven(before, np.array(places), settings=replace(SETTINGS, driven=0.15))
    assert after.state.shape == before.state.shape  # the path lies well inside
    near = np.min([np.linalg.norm(centres(before) - place, axis=-1) for place in places], axis=0) <= 0.15 - 1e-9
    assert (after.state[near & (before.state == -1)] == 0).all()
    np.testing.assert_array_equal(after.state[before.state >= 0], before.state[before.state >= 0])
    assert np.isfinite(after.p_occupied[after.state == 0]).all()
    np.testing.assert_array_equal(after.n_seen, before.n_seen)


def test_the_way_between_two_frames_is_driven_too_unless_it_is_a_leap() -> None:
    empty = replace(a_grid(), state=np.full((40, 50), -1, np.int8))
    path = np.array([[-0.5, 0.0], [-0.1, 0.0], [1.0, 1.0]])
    after = mark_driven(empty, path, settings=replace(SETTINGS, driven=0.1))
    free = centres(after)[after.state == 0]
    assert np.linalg.norm(free - [-0.3, 0.0], axis=1).min() < 0.04
    assert np.linalg.norm(free - [0.5, 0.55], axis=1).min() > 0.3


def test_the_grid_grows_to_hold_the_whole_footprint() -> None:
    before = a_grid()
    after = mark_driven(before, np.array([[-1.2, 0.0], [1.6, 1.7]]), settings=SETTINGS)
    assert (after.origin <= [-1.5, -0.5]).all()
    assert after.state.shape > before.state.shape
    offset = np.rint((before.origin - after.origin) / 0.05).astype(int)
    inner = after.state[offset[1] : offset[1] + 40, offset[0] : offset[0] + 50]
    np.testing.assert_array_equal(inner[before.state >= 0], before.state[before.state >= 0])
    area = (after.state == 0).sum() - (before.state == 0).sum()
    assert 0.5 * 2 * np.pi * 6**2 < area < 2 * np.pi * 6.5**2  # cells: less where something was known


def test_a_path_far_away_is_refused_before_memory_is_reserved() -> None:
    with pytest.raises(SlamError, match="the grid would have"):
        mark_driven(a_grid(), np.array([[0.0, 0.0], [1e5, 1e5]]), settings=SETTINGS)
