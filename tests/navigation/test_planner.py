"""Paths: cheapest against a slow twin, never through what is blocked, and clear about what cannot be."""

import itertools

import naive
import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import csgraph

from slamcli.errors import SlamError
from slamcli.navigation import planner, tight_path
from slamcli.schema import Grid

RESOLUTION = 0.05


def grid_of(state, origin=(0.0, 0.0)):
    state = np.array(state, np.int8)
    p = np.where(state < 0, np.nan, state).astype(np.float32)
    return Grid(p, (state >= 0).astype(np.int32), state, np.array(origin), np.array(RESOLUTION))


def room_with_wall(gap=(60, 80)):
    """4 m x 5 m with a wall across at y = 2.5 m that leaves a gap of 1 m at the right."""
    state = np.zeros((100, 80), np.int8)
    state[[0, -1]], state[:, [0, -1]] = 1, 1
    state[50, : gap[0]] = 1
    return grid_of(state)


def test_the_path_goes_round_a_wall_and_keeps_its_distance():
    grid = room_with_wall()
    route = planner.plan(grid, (1.0, 1.0), (1.0, 4.0))
    np.testing.assert_allclose(route.xy[[0, -1]], [(1.0, 1.0), (1.0, 4.0)])
    assert 2 * np.hypot(2.0, 1.5) < route.length < 6.5  # the straight ways past the wall's end, and not much more
    assert np.linalg.norm(np.diff(route.xy, axis=0), axis=1).max() <= RESOLUTION + 1e-9
    rows, columns = np.nonzero(grid.state == 1)
    for x, y in route.xy:  # distance to every occupied square, exactly
        dx = np.maximum(np.abs(x - (columns + 0.5) * RESOLUTION) - 0.5 * RESOLUTION, 0.0)
        dy = np.maximum(np.abs(y - (rows + 0.5) * RESOLUTION) - 0.5 * RESOLUTION, 0.0)
        assert np.hypot(dx, dy).min() > 0.2 - 0.5 * RESOLUTION
    assert route.clearance.min() >= 0.0


def steps_cost(cost, cells):
    """Add up what the steps from cell to cell cost."""
    return sum(np.hypot(*(np.array(b) - a)) * 0.5 * (cost[tuple(a)] + cost[tuple(b)]) for a, b in itertools.pairwise(cells.tolist()))


def test_the_cells_are_the_cheapest_there_are():
    rng = np.random.default_rng(1)
    for _ in range(12):
        cost = 1.0 + 3.0 * rng.random((9, 11))
        cost[rng.random(cost.shape) < 0.25] = np.inf
        start, goal = (0, 0), (8, 10)
        cost[start], cost[goal] = 1.0, 1.0
        cells = planner.cheapest(cost, start, goal)
        expected = naive.cheapest_cost(cost, start, goal)
        if cells is None:
            assert expected == np.inf
            continue
        assert steps_cost(cost, cells) == pytest.approx(expected)
        assert np.abs(np.diff(cells, axis=0)).max() == 1


def test_among_many_open_cells_the_path_is_the_cheapest_too():
    """Far more cells wait at once than the first room of the list of open cells holds."""
    rng = np.random.default_rng(4)
    shape, cost = (200, 200), 1.0 + 200.0 * rng.random((200, 200)) ** 8
    cells = planner.cheapest(cost, (100, 100), (199, 0))
    number = np.arange(cost.size).reshape(shape)
    ends, length = [], []
    for a, b, step in (
        (np.s_[:, :-1], np.s_[:, 1:], 1.0), (np.s_[:-1], np.s_[1:], 1.0),
        (np.s_[:-1, :-1], np.s_[1:, 1:], 2**0.5), (np.s_[:-1, 1:], np.s_[1:, :-1], 2**0.5),
    ):  # fmt: skip
        ends.append((number[a].ravel(), number[b].ravel()))
        length.append(step * 0.5 * (cost[a] + cost[b]).ravel())
    graph = sparse.coo_array((np.concatenate(length), np.concatenate(ends, axis=1)), shape=(cost.size,) * 2)
    expected = csgraph.dijkstra(graph, directed=False, indices=number[100, 100])[number[199, 0]]
    assert steps_cost(cost, cells) == pytest.approx(expected)


def test_pulled_tight_the_path_costs_no_more():
    rng = np.random.default_rng(2)
    cost = 1.0 + rng.random((40, 40)) ** 4
    cost[20, 5:35] = np.inf
    cells = planner.cheapest(cost, (2, 20), (38, 20))
    corners = tight_path.pull_tight(cost, cells)
    total = sum(tight_path.line_cost(cost, a, b) for a, b in itertools.pairwise(corners))
    steps = sum(tight_path.line_cost(cost, a, b) for a, b in itertools.pairwise(cells))
    assert total <= tight_path.SLACK * steps + 1e-9
    assert len(corners) < len(cells) / 2
    np.testing.assert_array_equal(corners[[0, -1]], cells[[0, -1]])


def test_an_open_floor_is_crossed_straight():
    route = planner.plan(grid_of(np.zeros((100, 100))), (0.7, 0.9), (4.2, 3.1), allow_unknown=True)
    assert route.length == pytest.approx(np.hypot(3.5, 2.2), rel=0.02)


def test_there_and_back_cost_the_same():
    grid = room_with_wall()
    a = planner.plan(grid, (1.0, 1.0), (1.0, 4.0))
    b = planner.plan(grid, (1.0, 4.0), (1.0, 1.0))
    assert a.length == pytest.approx(b.length, rel=0.03)


def test_clearance_is_bought_with_length():
    grid = room_with_wall()
    close = planner.plan(grid, (1.0, 1.0), (1.0, 4.0), weight=0.0)
    wide = planner.plan(grid, (1.0, 1.0), (1.0, 4.0), weight=10.0)
    assert close.length < wide.length < 1.3 * close.length
    assert wide.clearance[20:-20].min() > close.clearance[20:-20].min()


def test_start_is_goal():
    route = planner.plan(room_with_wall(), (1.0, 1.0), (1.0, 1.0))
    assert route.length == 0.0
    np.testing.assert_allclose(route.xy, [(1.0, 1.0)])


def test_origin_shifts_the_path():
    at_zero = planner.plan(room_with_wall(), (1.0, 1.0), (1.0, 4.0))
    moved = planner.plan(grid_of(room_with_wall().state, (-3.0, 7.0)), (-2.0, 8.0), (-2.0, 11.0))
    np.testing.assert_allclose(moved.xy, at_zero.xy + [-3.0, 7.0], atol=1e-9)


def test_unknown_is_blocked_unless_allowed():
    state = room_with_wall(gap=(80, 80)).state.copy()
    state[50, 40:60] = -1
    with pytest.raises(SlamError, match="no way leads"):
        planner.plan(grid_of(state), (1.0, 1.0), (1.0, 4.0))
    route = planner.plan(grid_of(state), (1.0, 1.0), (1.0, 4.0), allow_unknown=True)
    crossing = route.xy[np.argmin(np.abs(route.xy[:, 1] - 2.5)), 0]
    assert 2.2 <= crossing <= 2.8


def test_outside_the_grid_is_unknown():
    open_floor = grid_of(np.zeros((20, 20)))
    with pytest.raises(SlamError, match=r"start 0\.1,0\.5: nearer than"):
        planner.plan(open_floor, (0.1, 0.5), (0.5, 0.5))


@pytest.mark.parametrize(
    ("start", "goal", "says"),
    [
        ((9.0, 1.0), (1.0, 1.0), r"start 9,1: outside the grid, which covers x 0\.00 to 4\.00 m, y 0\.00 to 5\.00 m"),
        ((4.5, 1.0), (1.0, 1.0), r"start 4\.5,1: outside"),  # beyond in x, though not in y, which goes further
        ((1.0, 1.0), (1.0, -0.1), r"goal 1,-0\.1: outside"),
        ((1.0, 2.52), (1.0, 1.0), r"start 1,2\.52: inside an obstacle; the nearest place with room for the robot is "),
        ((1.0, 1.0), (1.0, 2.4), r"goal 1,2\.4: nearer than the robot's radius of 0\.2 m"),
        ((float("nan"), 1.0), (1.0, 1.0), "outside"),
        ((1.0, 1.0), (float("inf"), 1.0), "outside"),
    ],
)
def test_places_that_cannot_be_are_named(start, goal, says):
    with pytest.raises(SlamError, match=says):
        planner.plan(room_with_wall(), start, goal)


def test_the_place_that_is_proposed_works():
    with pytest.raises(SlamError) as caught:
        planner.plan(room_with_wall(), (1.0, 2.52), (1.0, 1.0))
    x, y = (float(v) for v in str(caught.value).rsplit(" ", 1)[1].split(","))
    assert 0.1 < np.hypot(x - 1.0, y - 2.52) < 0.4  # beside the wall
    route = planner.plan(room_with_wall(), (x, y), (1.0, 1.0))
    assert np.hypot(x - 1.0, y - 1.0) - 0.1 < route.length < 2.0
    np.testing.assert_allclose(route.xy[0], (x, y), atol=0.05)


def test_unreachable_says_how_much_is_reachable():
    with pytest.raises(SlamError, match=r"gets to 7\.\d m2 from the start, 7\.\d m2 from the goal; try a smaller radius"):
        planner.plan(room_with_wall(gap=(80, 80)), (1.0, 1.0), (1.0, 4.0))


def pockets() -> Grid:
    """A room of 60 x 100 cells, a nook of 7 x 7 that nothing leads to, and one of 31 x 31 that touches the room's corner."""
    state = np.ones((110, 110), dtype=np.int8)
    state[45:105, 5:105] = 0
    state[5:12, 5:12] = 0
    state[14:45, 74:105] = 0
    state[44, 74:105] = 1
    state[44, 73] = 0
    return grid_of(state)


def test_the_nearest_room_is_no_pocket():
    grid = pockets()
    camera = (0.3, 0.3)  # above the nook
    (place,) = planner.nearest_room(grid, [camera], radius=0.1, allow_unknown=False)
    assert place[1] > 2.25
    near = [(x, y) for x in np.arange(0.3, 5.2, 0.05) for y in np.arange(2.4, 5.0, 0.05)]
    assert np.hypot(*np.subtract(place, camera)) <= min(np.hypot(*np.subtract(xy, camera)) for xy in near) + 0.05
    (large,) = planner.nearest_room(grid, [(4.0, 1.0)], radius=0.1, allow_unknown=False)
    assert large[1] < 2.2  # a sixth of the floor is no pocket


def test_places_of_one_region_have_a_way_between_them():
    """A corner at which free cells only touch joins nothing: A* needs both cells beside a diagonal step."""
    state = np.zeros((60, 60), dtype=np.int8)
    state[:30, 30:] = state[30:, :30] = 1
    grid = grid_of(state)
    start, goal = planner.nearest_room(grid, [(0.5, 0.5), (2.5, 2.5)], radius=0.0, allow_unknown=False)
    assert planner.plan(grid, start, goal, radius=0.0).length > 0.0
    with pytest.raises(planner.NoWay):
        planner.plan(grid, (0.5, 0.5), (2.5, 2.5), radius=0.0)


def test_a_point_does_not_pass_through_walls():
    with pytest.raises(planner.NoWay):
        planner.plan(room_with_wall(gap=(80, 80)), (1.0, 1.0), (1.0, 4.0), radius=0.0)
    with pytest.raises(SlamError, match="inside an obstacle"):
        planner.plan(room_with_wall(), (1.0, 2.52), (1.0, 1.0), radius=0.0)


def test_a_robot_too_large_for_the_grid():
    with pytest.raises(SlamError, match="fits nowhere"):
        planner.plan(room_with_wall(), (1.0, 1.0), (1.0, 4.0), radius=3.0)


@pytest.mark.parametrize("bad", [{"radius": -0.1}, {"radius": float("nan")}, {"clearance": -1.0}, {"weight": float("inf")}])
def test_settings_out_of_range(bad):
    with pytest.raises(SlamError, match="must be from"):
        planner.plan(room_with_wall(), (1.0, 1.0), (1.0, 4.0), **bad)


def test_distance_to_obstacles_is_never_overstated():
    rng = np.random.default_rng(3)
    state = (rng.random((30, 40)) < 0.03).astype(np.int8)
    distance = planner.obstacle_distance(grid_of(state), allow_unknown=True)
    rows, columns = np.nonzero(state)
    for i, j in rng.integers(0, 30, (50, 2)):
        dx, dy = np.maximum(np.abs(columns - j) - 0.5, 0.0), np.maximum(np.abs(rows - i) - 0.5, 0.0)
        exact = np.hypot(dx, dy).min() * RESOLUTION
        assert distance[i, j] <= exact + 1e-6
        assert distance[i, j] >= exact - 0.5 * RESOLUTION


def islands() -> Grid:
    """Two free regions, 2 m x 2 m and 1 m x 1 m, in the unknown."""
    state = np.full((60, 100), -1, np.int8)
    state[10:50, 10:50] = 0
    state[20:40, 70:90] = 0
    return Grid(np.zeros(state.shape, np.float32), np.ones(state.shape, np.int32), state, origin=np.zeros(2), resolution=np.array(0.05))


def test_a_place_without_room_is_moved_to_the_nearest_that_has_it() -> None:
    grid = islands()
    ((x, y),) = planner.nearest_room(grid, [(0.1, 1.5)], radius=0.2, allow_unknown=False)
    margin = planner.obstacle_distance(grid, allow_unknown=False)
    assert margin[int(y / 0.05), int(x / 0.05)] >= 0.2
    assert y == pytest.approx(1.5, abs=0.05)
    assert 0.5 + 0.2 <= x < 0.5 + 0.3


def test_both_ends_come_to_lie_in_one_region() -> None:
    places = [(0.1, 1.5), (3.4, 1.5)]
    found = planner.nearest_room(islands(), places, radius=0.2, allow_unknown=False)
    assert planner.plan(islands(), *found, radius=0.2).length > 0.5
    assert all(x < 2.5 for x, _ in found)


def test_a_robot_too_large_for_every_region() -> None:
    with pytest.raises(SlamError, match="fits nowhere"):
        planner.nearest_room(islands(), [(1.0, 1.0)], radius=1.5, allow_unknown=False)
