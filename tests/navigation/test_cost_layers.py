"""Inflation costs, keep-out polygons and reachability, on grids drawn by hand."""

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.navigation import cost_layers, planner
from slamcli.schema import Grid

R = 0.05


def grid(state, origin=(-1.0, -0.5)):
    state = np.asarray(state, np.int8)
    p = np.where(state < 0, np.nan, state).astype(np.float32)
    return Grid(p, (state >= 0).astype(np.int32), state, np.array(origin), np.array(R))


def two_rooms(door=0):
    """3 m x 1.5 m, a wall across with a door of so many cells, and a corner that was never seen."""
    state = np.zeros((30, 60), np.int8)
    state[[0, -1]], state[:, [0, -1]], state[:, 30] = 1, 1, 1
    state[10 : 10 + door, 30] = 0
    state[20:28, 50:58] = -1
    return grid(state)


def test_costs_are_those_of_nav2s_inflation_layer():
    state = np.zeros((41, 41), np.int8)
    state[20, 20] = 1
    cost = cost_layers.inflated(grid(state), radius=0.2, reach=0.6, falloff=5.0)
    assert cost[20, 20] == cost_layers.LETHAL
    distance = R * (np.hypot(*np.mgrid[-20:21, -20:21]) - 0.5**0.5)  # from a cell's centre to the obstacle's edge
    assert (cost[(distance < 0.2) & (state == 0)] == cost_layers.INSCRIBED).all()
    between = (distance >= 0.2) & (distance <= 0.6)
    np.testing.assert_allclose(cost[between], 98 * np.exp(-5.0 * (distance[between] - 0.2)), atol=0.6)
    assert (cost[distance > 0.61] == 0).all()


def test_costs_fall_with_distance_and_unknown_stays_unknown():
    made = two_rooms()
    cost = cost_layers.inflated(made, radius=0.1, reach=0.5, falloff=3.0)
    assert (cost[made.state < 0] == cost_layers.UNKNOWN).all() and (cost[made.state == 1] == 100).all()
    free = made.state == 0
    near = planner.obstacle_distance(made, allow_unknown=True)
    order = np.argsort(near[free])
    assert (np.diff(cost[free][order].astype(int)) <= 0).all()
    with pytest.raises(SlamError, match="radius = -1"):
        cost_layers.inflated(made, radius=-1.0, reach=0.5, falloff=3.0)


def test_polygons_hold_the_cells_whose_centres_they_hold():
    made = grid(np.zeros((20, 30), np.int8), origin=(0.0, 0.0))
    inside = cost_layers.inside_polygons(made, [[[0.2, 0.2], [0.7, 0.2], [0.7, 0.5], [0.2, 0.5]]])
    assert inside.sum() == 10 * 6 and inside[4:10, 4:14].all()
    triangle = cost_layers.inside_polygons(made, [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    assert triangle.sum() * R**2 == pytest.approx(0.5, rel=0.1)
    both = cost_layers.inside_polygons(made, [[[0.2, 0.2], [0.7, 0.2], [0.7, 0.5], [0.2, 0.5]], [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    assert (both == (inside | triangle)).all()
    for bad in ([[[0, 0], [1, 1]]], [[[0, 0], [1, 1], [2, float("nan")]]], [[1, 2, 3]]):
        with pytest.raises(SlamError, match="three corners"):
            cost_layers.inside_polygons(made, bad)


def test_the_slowest_area_counts_and_black_has_no_limit():
    made = grid(np.zeros((20, 30), np.int8), origin=(0.0, 0.0))
    square = [[0.2, 0.2], [0.7, 0.2], [0.7, 0.5], [0.2, 0.5]]
    limits = cost_layers.speed_limits(made, [(30, square), (60, [[0.0, 0.0], [1.5, 0.0], [1.5, 1.0], [0.0, 1.0]]), (90, square)])
    assert (limits[4:10, 4:14] == 30).all() and (limits == 60).sum() == limits.size - 60
    assert (cost_layers.speed_limits(made, [(100, square)]) == np.where(limits == 30, 100, cost_layers.NO_LIMIT)).all()
    assert (cost_layers.speed_limits(made, []) == cost_layers.NO_LIMIT).all()
    for bad in (0, 101, -5, 50.5, float("nan"), True):
        with pytest.raises(SlamError, match="whole percentage"):
            cost_layers.speed_limits(made, [(bad, square)])
    shades = np.array([[0, 1, 2, 128, 254, 255]], np.uint8)
    assert cost_layers.speeds_of_shades(shades).tolist() == [[0, 1, 1, 50, 100, 100]]


@pytest.mark.parametrize(("door", "radius", "goes_through"), [(0, 0.05, False), (4, 0.05, True), (4, 0.3, False)])
def test_a_robot_gets_to_the_other_room_where_the_planner_finds_a_way(door, radius, goes_through):
    made = two_rooms(door)
    cells = cost_layers.reachable(made, (-0.3, 0.1), radius=radius)
    other = (1.0, 0.05)
    column, row = np.floor((np.array(other) - made.origin) / R).astype(int)
    assert cells[row, column] == goes_through
    assert (made.state[cells] == 0).all()
    if goes_through:
        assert planner.plan(made, (-0.3, 0.1), other, radius=radius).length > 1.0
    else:
        with pytest.raises(SlamError, match="no way leads"):
            planner.plan(made, (-0.3, 0.1), other, radius=radius)


def test_the_swept_floor_is_the_reach_grown_by_the_radius():
    made = two_rooms()
    cells = cost_layers.reachable(made, (-0.3, 0.1), radius=0.2)
    swept = cost_layers.swept(made, cells, radius=0.2)
    assert (swept & cells == cells).all() and swept.sum() > cells.sum() and not swept[:, 31:].any()
    with pytest.raises(SlamError, match="inside an obstacle"):
        cost_layers.reachable(made, (-0.99, 0.0), radius=0.2)
