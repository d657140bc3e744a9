"""What is too narrow for a robot: the widest of several ways, where it is narrowest, and what bounds it there."""

import numpy as np
import pytest

from slamcli.navigation import planner, reach
from slamcli.schema import Grid

RESOLUTION = 0.05
START, BEYOND = (1.0, 1.0), np.s_[60:, 5:75]


def two_rooms(*doors: tuple[int, int], wall: int = 1) -> Grid:
    """Two rooms of 4 m x 2.5 m, one above the other, with a wall between that is open at columns of cells (first, last + 1)."""
    state = np.zeros((100, 80), np.int8)
    state[[0, -1]], state[:, [0, -1]] = 1, 1
    state[50] = wall
    for first, end in doors:
        state[50, first:end] = 0
    return Grid(np.abs(state).astype(np.float32), (state >= 0).astype(np.int32), state, np.zeros(2), np.array(RESOLUTION))


def gap_of(grid: Grid, radius: float = 0.5, *, allow_unknown: bool = False) -> reach.Gap | None:
    beyond = np.zeros(grid.state.shape, dtype=bool)
    beyond[BEYOND] = True
    return reach.widest_gap(grid, START, beyond, radius=radius, allow_unknown=allow_unknown)


@pytest.mark.parametrize("cells", [3, 6, 11, 16])
def test_a_door_that_is_too_narrow_is_found_with_its_width(cells: int) -> None:
    gap = gap_of(two_rooms((30, 30 + cells)))
    assert np.hypot(gap.xy[0] - (30 + cells / 2) * RESOLUTION, gap.xy[1] - 2.525) < 1.5 * RESOLUTION
    assert (cells - 2.5) * RESOLUTION < gap.width <= cells * RESOLUTION  # never promised wider than it is
    assert not gap.is_unseen


def test_of_two_doors_the_wider_one_counts() -> None:
    gap = gap_of(two_rooms((20, 24), (60, 69)))
    assert 3.0 < gap.xy[0] < 3.45


def test_an_obstacle_that_the_way_passes_as_closely_is_not_taken_for_the_gap() -> None:
    grid = two_rooms((66, 72))
    state = np.array(grid.state)
    state[22:26, 24:60] = 1  # between the start and the door: the shortest way cuts its corners
    gap = gap_of(Grid(grid.p_occupied, grid.n_seen, state, grid.origin, grid.resolution))
    assert np.hypot(gap.xy[0] - 69 * RESOLUTION, gap.xy[1] - 2.525) < 2 * RESOLUTION


def test_a_robot_of_that_width_gets_through() -> None:
    grid = two_rooms((30, 40))
    gap = gap_of(grid)
    assert planner.plan(grid, START, (1.0, 4.0), radius=0.5 * gap.width).length > 3.0
    with pytest.raises(planner.NoWay):
        planner.plan(grid, START, (1.0, 4.0), radius=0.5 * gap.width + RESOLUTION)


def test_what_bounds_a_gap_is_told_from_what_was_never_seen() -> None:
    assert gap_of(two_rooms((30, 36), wall=-1)).is_unseen
    assert not gap_of(two_rooms((30, 36), wall=1)).is_unseen


def test_beyond_the_rim_of_the_grid_nothing_was_seen() -> None:
    """A passage of 0.3 m between an obstacle and the rim, of which only the obstacle is known to end it."""
    state = np.zeros((100, 80), np.int8)
    state[50, 6:] = 1
    gap = gap_of(Grid(np.abs(state).astype(np.float32), np.ones((100, 80), np.int32), state, np.zeros(2), np.array(RESOLUTION)))
    assert gap.is_unseen and gap.xy[0] < 0.2 and gap.width < 0.3


def test_behind_a_closed_wall_there_is_no_way_of_any_width() -> None:
    assert gap_of(two_rooms()) is None


def test_reach_names_the_gap_before_the_largest_piece_left_out() -> None:
    found = reach.reach(two_rooms((30, 36)), START, radius=0.3, allow_unknown=False, walls=[])
    assert found.area_beyond == pytest.approx(4.0 * 2.5, rel=0.1)
    assert found.to_dict()["gap"]["beside"] == "occupied" and found.to_dict()["gap"]["beyond_m2"] == pytest.approx(
        found.area_beyond, abs=1e-3
    )
    open_ = reach.reach(two_rooms((10, 70)), START, radius=0.3, allow_unknown=False, walls=[])
    assert open_.gap is None and open_.reached_area > 0.9 * open_.free_area
