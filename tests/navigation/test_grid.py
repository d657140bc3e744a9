"""The navigation grid: the paper's equations, the kernels against slow twins, and rooms whose truth is known."""

from dataclasses import replace

import naive
import numpy as np
import pytest
from boxroom import CUPBOARD, FURNITURE, HANGING, KINECT, LOW, READING, TABLE, kinect_noise, look_along, render, round_trip

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.navigation import grid, grid_evidence
from slamcli.navigation.grid import FREE, OCCUPIED, UNKNOWN, build_grid, decide, fuse, view_probability
from slamcli.navigation.grid_evidence import Sight, View

SETTINGS = GridConfig(stride=1, min_range=0.5, n_low=3, n_high=8)  # of images a quarter as wide as a Kinect's
SENSOR = SensorConfig()


def build(T_lc, *, boxes=FURNITURE, seed=0, settings=SETTINGS, clean=False):
    rng = np.random.default_rng(seed)
    depth = (render(T, boxes=boxes) for T in T_lc)
    frames = [(z if clean else kinect_noise(z, rng), T) for z, T in zip(depth, T_lc, strict=True)]
    return build_grid(frames, KINECT, settings=settings, sensor=SENSOR)


@pytest.fixture(scope="module")
def room():
    return build(round_trip())


def cells(made, box, *, margin=0.0):
    """The states of the cells whose centres lie within a box's outline, grown by a margin [m]."""
    rows, columns = made.state.shape
    y = made.origin[1] + (np.arange(rows) + 0.5) * float(made.resolution)
    x = made.origin[0] + (np.arange(columns) + 0.5) * float(made.resolution)
    (x0, y0, _), (x1, y1, _) = box
    return made.state[np.ix_((y > y0 - margin) & (y < y1 + margin), (x > x0 - margin) & (x < x1 + margin))]


def state_at(made, x, y):
    column, row = np.floor((np.array([x, y]) - made.origin) / float(made.resolution)).astype(int)
    return made.state[row, column]


def test_walls_and_furniture_are_occupied_and_the_floor_between_is_free(room):
    for x in np.arange(0.3, 1.8, 0.1):
        assert state_at(room, x, 0.02) == OCCUPIED
        assert state_at(room, x, 0.5) == FREE
    assert (cells(room, TABLE) == OCCUPIED).sum() > 30
    assert (cells(room, CUPBOARD) == OCCUPIED).sum() > 15
    assert (room.state == FREE).sum() * 0.05**2 > 28.0  # of 40 m2, 3 of them furniture and 4 hidden


def test_low_and_hanging_boxes_are_occupied(room):
    low = cells(room, LOW)
    assert (low == OCCUPIED).mean() > 0.9
    assert (cells(room, HANGING, margin=0.05) == OCCUPIED).sum() > 12


def test_the_floor_seen_under_a_hanging_box_is_not_free(room):
    inside = cells(room, HANGING, margin=-0.05)
    assert (inside == FREE).sum() <= 0.1 * inside.size
    # and it is the line of sight that tells: without the box the same place is free
    empty = build(round_trip(), boxes=(TABLE, CUPBOARD, LOW))
    assert (cells(empty, HANGING, margin=-0.05) == FREE).mean() > 0.9


def test_free_cells_are_free_and_floor_is_not_called_occupied(room):
    rows, columns = room.state.shape
    y = room.origin[1] + (np.arange(rows) + 0.5) * 0.05
    x = room.origin[0] + (np.arange(columns) + 0.5) * 0.05
    inside = np.zeros((rows, columns), bool)
    near = np.ones((rows, columns), bool)
    near[np.ix_((y > 0.1) & (y < 4.9), (x > 0.1) & (x < 7.9))] = False
    for (x0, y0, _), (x1, y1, _) in FURNITURE:
        inside |= np.outer((y > y0 + 0.05) & (y < y1 - 0.05), (x > x0 + 0.05) & (x < x1 - 0.05))
        near |= np.outer((y > y0 - 0.1) & (y < y1 + 0.1), (x > x0 - 0.1) & (x < x1 + 0.1))
    outside = np.ones((rows, columns), bool)
    outside[np.ix_((y > -0.05) & (y < 5.05), (x > -0.05) & (x < 8.05))] = False
    free = room.state == FREE
    assert (free & (inside | outside)).sum() <= 0.005 * free.sum()
    assert (room.state[~near] == OCCUPIED).sum() <= 0.005 * (~near).sum()


def test_what_was_never_seen_is_unknown(room):
    assert (np.isnan(room.p_occupied) == (room.n_seen == 0)).all()
    assert (room.state[room.n_seen == 0] == UNKNOWN).all()
    assert (cells(room, TABLE, margin=-0.15) == UNKNOWN).all()  # inside the table, where no camera looks


def test_probabilities_and_counts_stay_in_range(room):
    seen = room.n_seen > 0
    assert ((room.p_occupied[seen] >= 0.0) & (room.p_occupied[seen] <= 1.0)).all()
    assert room.n_seen.max() <= len(round_trip())


def test_moving_the_world_by_whole_cells_moves_the_grid(room):
    T = round_trip()
    shift = np.eye(4)
    shift[:2, 3] = [-40 * 0.05, 13 * 0.05]
    moved = build(shift @ T[:12], clean=False)  # images of another place: rendered again from there, so compare geometry only
    assert moved.origin == pytest.approx(np.round(moved.origin / 0.05) * 0.05)
    rng = np.random.default_rng(0)
    frames = [(kinect_noise(render(t), rng), t) for t in T[:12]]
    a = build_grid(frames, KINECT, settings=SETTINGS, sensor=SENSOR)
    b = build_grid([(depth, shift @ t) for depth, t in frames], KINECT, settings=SETTINGS, sensor=SENSOR)
    np.testing.assert_allclose(b.origin - a.origin, shift[:2, 3], atol=1e-9)
    assert (a.state == b.state).mean() > 0.999  # a point on a cell's border may fall on either side


def test_the_same_input_gives_the_same_grid():
    a, b = (build(round_trip(step=0.6)) for _ in range(2))
    assert a.p_occupied.tobytes() == b.p_occupied.tobytes()


@pytest.mark.shows("grid2d.extend_down")
def test_an_upright_surface_that_leaves_the_picture_downwards_reaches_the_floor():
    pillar = ((3.0, 2.0, 0.0), (3.6, 2.6, 2.0))
    T = [look_along([2.0 + 0.02 * i, 2.3, 1.4], 0.0, 0.1) for i in range(6)]  # the picture ends at a height of 0.87 m on its face
    seen = build(T, boxes=(pillar,))
    assert state_at(seen, 3.01, 2.3) == OCCUPIED
    ignored = build(T, boxes=(pillar,), settings=replace(SETTINGS, extend_down=False))
    assert (cells(ignored, pillar) == UNKNOWN).all()
    shelf = ((3.0, 2.0, 1.0), (3.6, 2.6, 1.04))  # a table top that leaves the picture is no wall
    T = [look_along([2.3 + 0.02 * i, 2.3, 1.4], 0.0, 0.2) for i in range(6)]
    assert (cells(build(T, boxes=(shelf,)), shelf) != OCCUPIED).all()


def rolling(side):
    """A floor that rises and falls by 0.1 m."""
    i, j = np.mgrid[:side, :side]
    return (0.1 * np.sin(0.08 * i) * np.cos(0.05 * j)).astype(np.float32)


def test_band_points_floor_holes_and_tops_match_their_slow_twin():
    rng = np.random.default_rng(3)
    # From below a level frame that is too high, the floor is a hole and the table reaches just above the band.
    for height, lift in ((0.6, 0.0), (0.7, 0.0), (1.1, -0.2)):
        T = look_along([3.9, 0.9, height], 0.7, 0.3)
        depth = kinect_noise(render(T), rng)
        corner, side = np.floor(T[:2, 3] / 0.05) - 85, 171
        T[2, 3] += lift
        sight, noise = Sight(corner, cell=0.05, near=0.5, far=4.0, low=0.05, high=0.5, drop=0.08), READING
        seen, ground = grid_evidence.blank_cells(side), rolling(side) if height == 0.6 else np.zeros((side, side), np.float32)
        image = grid_evidence.DepthImage(depth, KINECT.rays, T)
        grid_evidence._sort_points(image, sight, noise, 3, 4, ground, seen)
        expected = naive.sorted_points(image, sight, noise, 3, 4, ground, side)
        assert seen.n_band.sum() > 100 and (seen.floor.sum() > 100 if lift == 0.0 else min(seen.hole.sum(), seen.top.sum()) > 50)
        for found, twin in zip((*seen[:4], seen.top > 0), expected, strict=True):
            np.testing.assert_array_equal(found, twin)


def test_crossed_slices_match_their_slow_twin():
    T = look_along([1.0, 0.9, 0.6], 0.7, 0.3)
    depth = kinect_noise(render(T), np.random.default_rng(3), far=6.0)
    corner, side = np.floor(T[:2, 3] / 0.05) - 85, 171
    sight, noise = Sight(corner, cell=0.05, near=0.5, far=4.0, low=0.05, high=0.5, drop=0.08), READING
    crossed = np.zeros((side, side), np.uint16)
    ground = rolling(side)
    image = grid_evidence.DepthImage(depth, KINECT.rays, T)
    grid_evidence._cross(image, sight, noise, 5, ground, crossed)
    expected = np.zeros((side, side), np.uint16)
    for i, j, k in naive.crossed_slices(image, sight, noise, 5, ground, side):
        expected[i, j] |= np.uint16(1 << k)
    assert (crossed > 0).sum() > 300
    np.testing.assert_array_equal(crossed, expected)


def test_lines_of_sight_match_their_slow_twin():
    rng = np.random.default_rng(5)
    standing = (rng.integers(0, 1 << 16, (40, 50)) * (rng.random((40, 50)) < 0.06)).astype(np.uint16)
    standing[rng.random((40, 50)) < 0.03] = 0b1111111100000000
    rows, columns = (index.ravel() for index in np.mgrid[0:40, 0:50])
    is_open = rng.integers(0, 1 << 16, (40, 50)).astype(np.uint16) | np.where(rng.random((40, 50)) < 0.5, 0xFFFF, 0).astype(np.uint16)
    face, around = (rng.integers(0, 3, (40, 50)).astype(np.int32) * (rng.random((40, 50)) < 0.3) for _ in range(2))
    level = np.zeros((40, 50), np.float32)
    for camera, ground in (((10.3, 20.7, 0.6), level), ((-5.0, 60.0, 1.4), rolling(50)[:40]), ((25.5, 20.5, 0.3), rolling(50)[:40])):
        ground = np.ascontiguousarray(ground)
        got, hangs = np.arange(len(rows)) % 7 > 0, np.zeros((40, 50), np.uint16)
        was_hidden = ~got
        sight = grid.CellSights(rows, columns, *camera, 0.05, 0.5, 20.0)
        grid._drop_hidden(got, standing, is_open, hangs, face, around, ground, sight)
        expected = np.array([naive.is_clear(standing, is_open, face, around, ground, n, sight) for n in range(len(rows))])
        np.testing.assert_array_equal(got, expected & ~was_hidden)
        assert 0.15 < np.mean(~got) < 0.98
        assert (hangs > 0).any() and not (hangs & ~standing).any()


def test_equation_20():
    n = np.array([0, 2, 3, 5, 8, 9, 20])
    expected = [1.0, 1.0, 1 - 3 / 20, 1 - 5 / 20, 1 - 8 / 20, 0.0, 0.0]
    np.testing.assert_allclose(view_probability(n, n_low=3, n_high=8), expected)
    np.testing.assert_allclose(view_probability(np.array([4]), n_low=3, n_high=8), [0.0])
    assert view_probability(np.zeros(0, int), n_low=3, n_high=8).shape == (0,)


def test_equations_22_and_23():
    settings = GridConfig(update="paper", p_floor=0.01)
    for before in (0.05, 0.3, 0.5, 0.95):
        for n, seen in ((0, 1.0), (4, 0.6), (20, 0.0)):
            p, count = np.full((1, 2), before, np.float32), np.array([[1, 1]], np.int32)
            n_view = np.array([n, 10])  # n_max is 10, or n
            if n == 20:
                n_view = np.array([20, 20])
            grid.paper_update(p, count, np.array([0, 0]), np.array([0, 1]), n_view, settings)
            expected = 0.5 * (0.9 * seen / before) + 0.5 * (0.1 * seen / (1.0 - before))
            assert p[0, 0] == pytest.approx(min(expected, 1.0), abs=1e-6)
            assert count[0, 0] == 2


def test_equation_23_as_printed_forgets_and_evidence_does_not():
    """Ten full views, then an empty one: the printed update calls the cell empty, log-odds still full."""
    for update, is_full in ((grid.paper_update, False), (grid.evidence_update, True)):
        p, count = np.full((1, 1), np.nan, np.float32), np.zeros((1, 1), np.int32)
        for n in [20] * 10 + [0]:
            update(p, count, np.array([0]), np.array([0]), np.array([n]), GridConfig(n_low=3, n_high=8, p_floor=0.01))
        assert (1.0 - p[0, 0] > 0.6) == is_full


def test_evidence_is_bayes_rule_and_its_order_does_not_matter():
    settings = GridConfig(n_low=3, n_high=8, p_floor=1e-6)
    counts = [9, 0, 0, 9, 9, 0, 4]
    results = []
    for order in (counts, counts[::-1], sorted(counts)):
        p, seen = np.full((1, 1), np.nan), np.zeros((1, 1), np.int32)
        for n in order:
            grid.evidence_update(p, seen, np.array([0]), np.array([0]), np.array([n]), settings)
        results.append(p[0, 0])
    assert results == pytest.approx([results[0]] * 3)
    p, seen = np.full((1, 1), np.nan), np.zeros((1, 1), np.int32)
    grid.evidence_update(p, seen, np.array([0]), np.array([0]), np.array([0]), settings)
    assert p[0, 0] == pytest.approx(0.9)  # P(E1|E2) from even odds


def test_equation_24():
    p = np.array([[0.0, 0.19, 0.2, 0.5, 0.7, 0.71, 1.0, np.nan]], np.float32)
    assert decide(p, low=0.2, high=0.7).tolist() == [[0, 0, -1, -1, -1, 1, 1, -1]]


def test_the_papers_update_is_selectable():
    made = build(round_trip(step=0.4), settings=replace(SETTINGS, update="paper"))
    assert (made.state == FREE).sum() > 8000
    assert (cells(made, LOW) == OCCUPIED).sum() > 10


def view(cell, n, camera=None, is_floor=False, layers=0xFFFF):
    cell = np.atleast_2d(np.array(cell, np.int32))
    k = len(cell)
    camera = camera or (*(cell[0] + 0.5) * 0.05, 0.6)
    no_cell = np.zeros((0, 2), np.int32), np.zeros(0, np.uint16)
    return View(
        cell, np.full(k, n, np.int32), np.full(k, layers, np.uint16), np.full(k, 2 * is_floor, np.uint8), np.zeros(k, bool), np.zeros(k, bool), np.array(camera), *no_cell
    )  # fmt: skip


def test_a_grid_of_one_row_and_one_of_one_cell():
    made = fuse([view([[-2, 5], [3, 5]], 20)] * 2, settings=SETTINGS)
    assert made.state.tolist() == [[1, -1, -1, -1, -1, 1]]
    np.testing.assert_allclose(made.origin, [-0.1, 0.25])
    assert fuse([view([7, 7], 0, is_floor=True)] * 3, settings=SETTINGS).state.tolist() == [[0]]


def test_a_line_of_sight_does_not_slip_through_a_gap_of_one_cell_under_what_hangs():
    camera = (30.5 * 0.05, 4.5 * 0.05, 0.6)
    for gap, expected in (([4], UNKNOWN), ([3, 4, 5], FREE)):
        face = view([[10, y] for y in range(9) if y not in gap], 20, camera=camera, layers=0xF000)
        floor = view([8, 4], 0, camera=camera, is_floor=True)
        made = fuse([face, floor] * 3, settings=SETTINGS)
        assert made.state[4, 0] == expected
        assert made.state[0, 2] == OCCUPIED


def test_the_grid_holds_the_camera():
    made = fuse([view([3, 1], 20, camera=(-0.12, 0.26, 0.6))] * 2, settings=SETTINGS)
    assert made.state.shape == (5, 7)
    np.testing.assert_allclose(made.origin, [-0.15, 0.05])


def test_one_look_at_the_floor_is_not_enough():
    assert fuse([view([7, 7], 0, is_floor=True)], settings=SETTINGS).state.tolist() == [[-1]]


def test_nothing_seen_gives_one_unknown_cell():
    for frames in ([], [(np.full((120, 160), np.nan, np.float32), np.eye(4))]):
        made = build_grid(frames, KINECT, settings=SETTINGS, sensor=SENSOR)
        assert made.state.tolist() == [[-1]]
        assert made.n_seen.tolist() == [[0]]


def test_an_empty_band_leaves_only_floor():
    made = build(round_trip(step=0.6), boxes=(), settings=replace(SETTINGS, band_low=2.6, band_high=2.7))
    assert not (made.state == OCCUPIED).any()


def test_a_room_of_200_by_200_metres():
    corners = [view([x, y], 20) for x in (-2000, 1999) for y in (-2000, 1999)]
    made = fuse(corners * 2, settings=SETTINGS)
    assert made.state.shape == (4000, 4000)
    assert (made.state == OCCUPIED).sum() == 4
    assert made.state[0, 0] == made.state[-1, -1] == OCCUPIED
    np.testing.assert_allclose(made.origin, [-100.0, -100.0])


@pytest.mark.parametrize("far", [2e3, 1e7, 1e300])
def test_absurd_poses_are_an_error_before_memory_is_reserved(far):
    T = np.stack([look_along([1.0, 1.0, 0.6], 0.0, 0.3)] * 2)
    T[1, :2, 3] += far
    with pytest.raises(SlamError, match="grid2d"):
        build_grid([(render(look_along([1.0, 1.0, 0.6], 0.0, 0.3)), t) for t in T], KINECT, settings=SETTINGS, sensor=SENSOR)


def test_a_pose_that_is_no_number_is_an_error():
    with pytest.raises(SlamError, match="grid2d"):
        build_grid([(np.ones((120, 160), np.float32), np.full((4, 4), np.nan))], KINECT, settings=SETTINGS, sensor=SENSOR)


def test_too_fine_a_grid_is_an_error_before_memory_is_reserved():
    with pytest.raises(SlamError, match=r"resolution = 0\.0001: too fine"):
        build_grid([], KINECT, settings=replace(SETTINGS, resolution=1e-4), sensor=SENSOR)


def test_frames_are_chosen_by_how_far_they_moved_or_turned():
    T = np.tile(np.eye(4), (60, 1, 1))
    T[:30, 0, 3] = 0.02 * np.arange(30)  # 0.02 m a frame
    T[30:] = T[29] @ se3.exp(np.outer(np.arange(30), [0, 0, 0, 0, np.radians(3.0), 0]))  # then 3 degrees a frame
    T[10:12] = np.nan
    chosen = grid.spaced(T, metres=0.15, degrees=10.0)
    assert chosen.tolist() == [0, 8, 16, 24, 34, 38, 42, 46, 50, 54, 58]
    assert grid.spaced(T[:0], metres=0.15, degrees=10.0).tolist() == []
    assert grid.spaced(T[10:12], metres=0.15, degrees=10.0).tolist() == []


@pytest.mark.parametrize("change", [{"band_low": 0.5}, {"max_range": 0.2}, {"n_low": 9}, {"m_low": 0.6}])
def test_settings_that_contradict_each_other_are_an_error(change):
    with pytest.raises(SlamError, match="must be below grid2d"):
        build_grid([], KINECT, settings=replace(SETTINGS, **change), sensor=SENSOR)
