"""How the views of a grid are added up: floor, holes, faces and crossings at the limits where a count begins to tell."""

from dataclasses import replace

import numpy as np
import pytest

from slamcli.config.options import GridConfig
from slamcli.errors import SlamError
from slamcli.navigation import grid
from slamcli.navigation.grid import FREE, OCCUPIED, UNKNOWN, fuse
from slamcli.navigation.grid_evidence import NOT_SEEN, PASSED, SEEN, View

SETTINGS = GridConfig(n_low=3, n_high=8)
NONE = np.zeros((0, 2), np.int32), np.zeros(0, np.uint16)


def view(cells, *, n=0, floor=NOT_SEEN, hole=False, top=False, slices=0xFFFF, camera=None, crossed=NONE) -> View:
    """Return a view that saw the same in each of its cells (column, row)."""
    cell = np.atleast_2d(np.array(cells, np.int32))
    k = len(cell)
    camera = (*(cell[0] + 0.5) * 0.05, 0.6) if camera is None else camera
    return View(
        cell, np.full(k, n, np.int32), np.full(k, slices, np.uint16), np.full(k, floor, np.uint8), np.full(k, hole), np.full(k, top),
        np.array(camera), *crossed,
    )  # fmt: skip


def state(views: list[View], **settings) -> list[list[int]]:
    return fuse(views, settings=replace(SETTINGS, **settings)).state.tolist()


@pytest.mark.parametrize("n_high", [3, 8])
def test_points_tell_from_the_least_number_on_and_no_more_beyond_the_largest(n_high):
    settings = replace(SETTINGS, n_high=n_high)
    p = []
    for n in (0, 2, 3, 5, n_high, n_high + 1, 99):
        p_empty, n_seen = np.full((1, 1), np.nan), np.zeros((1, 1), np.int32)
        grid.evidence_update(p_empty, n_seen, np.array([0]), np.array([0]), np.array([n]), settings)
        p.append(float(p_empty[0, 0]))
    assert p[:2] == pytest.approx([0.9, 0.9]) and p[-3:] == pytest.approx([0.1, 0.1, 0.1])
    assert (p[2:4] == pytest.approx([0.1, 0.1])) if n_high == 3 else (0.1 < p[3] < p[2] < 0.5)


@pytest.mark.parametrize(("n", "expected"), [(2, UNKNOWN), (3, OCCUPIED)])
def test_a_cell_with_fewer_points_than_the_least_number_is_not_told_of(n, expected):
    assert state([view([4, 4], n=n)] * 8) == [[expected]]


@pytest.mark.parametrize(("floor", "expected"), [(NOT_SEEN, UNKNOWN), (PASSED, FREE), (SEEN, FREE)])
def test_floor_that_was_seen_or_passed_close_above_is_free(floor, expected):
    assert state([view([4, 4], floor=floor)] * 3) == [[expected]]


@pytest.mark.parametrize("update", ["evidence", "paper"])
def test_each_view_that_tells_of_a_cell_counts_once(update):
    made = fuse([view([4, 4], floor=SEEN)] * 3 + [view([4, 4], n=9), view([4, 4])], settings=replace(SETTINGS, update=update))
    assert made.n_seen.tolist() == [[4]]


@pytest.mark.parametrize(
    ("n_hole", "n_floor", "is_hole"),
    [(1, 0, False), (2, 0, True), (1, 2, False), (2, 4, True), (2, 5, False), (3, 6, True), (3, 7, False)],
)
def test_a_hole_is_seen_through_twice_and_half_as_often_as_a_floor(n_hole, n_floor, is_hole):
    views = [view([4, 4], hole=True)] * n_hole + [view([4, 4], floor=SEEN)] * n_floor
    found = grid._holes(views, np.array([4, 4]), (1, 1), 0.05)
    assert found.tolist() == [[is_hole]]
    assert n_floor < 4 or state(views) == [[UNKNOWN if is_hole else FREE]]


def test_round_a_hole_a_line_that_passes_is_no_floor_and_one_that_ends_there_is():
    """FAR_EDGE is six cells."""
    holes = view([[10, 0]], hole=True, camera=(0.525, 0.025, 0.6))
    passed = view([[3, 0], [4, 0], [16, 0], [17, 0]], floor=PASSED, camera=(0.525, 0.025, 0.6))
    made = fuse([holes, holes] + [passed] * 3 + [view([[5, 0]], floor=SEEN)] * 3, settings=SETTINGS)
    assert made.origin[0] == pytest.approx(3 * 0.05)
    assert {x + 3: s for x, s in enumerate(made.state[0]) if s == FREE} == {3: FREE, 5: FREE, 17: FREE}


def test_crossings_count_from_the_second_view_on_wherever_the_grid_grows():
    rng = np.random.default_rng(0)
    crossings, once, twice = grid.Crossings(0.05), {}, {}
    for k in range(40):
        middle = np.array([60 * np.cos(0.5 * k), 60 * np.sin(0.5 * k)]) * (k / 40)
        cell = np.unique(np.floor(middle + rng.normal(0, 6, (80, 2))).astype(np.int32), axis=0)
        slices = rng.integers(0, 1 << 16, len(cell)).astype(np.uint16)
        crossings.add(cell, slices)
        for at, bits in zip(map(tuple, cell.tolist()), slices.tolist(), strict=True):
            twice[at] = twice.get(at, 0) | (once.get(at, 0) & bits)
            once[at] = once.get(at, 0) | bits
    crossings.add(*NONE)
    assert sum(bits > 0 for bits in twice.values()) > 250
    for low, shape in ((np.array([-90, -80]), (170, 190)), (np.array([-5, 3]), (20, 30)), (np.array([500, 0]), (3, 4))):
        found = crossings.open_slices(low, shape)
        expected = [[twice.get((low[0] + c, low[1] + r), 0) for c in range(shape[1])] for r in range(shape[0])]
        np.testing.assert_array_equal(found, expected)
    assert not grid.Crossings(0.05).open_slices(np.zeros(2, np.int64), (2, 3)).any()


def test_a_crossing_far_away_is_an_error_before_memory_is_reserved():
    crossings = grid.Crossings(0.05)
    crossings.add(np.array([[0, 0]], np.int32), np.array([1], np.uint16))
    with pytest.raises(SlamError, match="grid2d: the grid would have"):
        crossings.add(np.array([[30_000, 30_000]], np.int32), np.array([1], np.uint16))


def test_the_largest_grid_has_thirty_three_million_cells():
    grid.check_size(1 << 12, 1 << 13, 0.05)
    with pytest.raises(SlamError, match=r"33554433 x 1 cells \(1677722 m x 0 m\)"):
        grid.check_size(1, (1 << 25) + 1, 0.05)


def test_only_the_two_counts_of_points_may_be_equal():
    grid.check(replace(SETTINGS, n_low=5, n_high=5))
    for change in ({"band_low": 0.3, "band_high": 0.3}, {"min_range": 2.0, "max_range": 2.0}, {"m_low": 0.5, "m_high": 0.5}):
        with pytest.raises(SlamError, match=r"must be below"):
            grid.check(replace(SETTINGS, **change))


def test_within_reach_of_a_view_are_four_thousand_cells_at_most():
    grid.check(replace(SETTINGS, max_range=4.0, resolution=0.00201))
    with pytest.raises(SlamError, match="too fine for grid2d.max_range = 4"):
        grid.check(replace(SETTINGS, max_range=4.0, resolution=0.00199))


CAMERA = (30.5 * 0.05, 4.5 * 0.05, 0.6)
FACE = view([[10, y] for y in range(9)], n=20, camera=CAMERA, slices=0xF000)  # hangs in the upper quarter of the band
UNDER = view([[8, 4]], floor=SEEN, camera=CAMERA)


def crossed(n_views: int, slices: int) -> list[View]:
    """Views whose lines of sight cross the cell under what hangs."""
    return [view([[20, 8]], camera=CAMERA, crossed=(np.array([[8, 4]], np.int32), np.array([slices], np.uint16)))] * n_views


@pytest.mark.parametrize(
    ("n_views", "slices", "expected"),
    [(0, 0xFFFF, UNKNOWN), (1, 0xFFFF, UNKNOWN), (2, 0xFFFF, FREE), (2, 0x0FFF, UNKNOWN), (2, 0xF000, FREE)],
)
def test_floor_under_what_hangs_is_free_where_two_views_looked_through_at_its_height(n_views, slices, expected):
    made = fuse([FACE, UNDER] * 3 + crossed(n_views, slices), settings=SETTINGS)
    assert made.state[4, 0] == expected and made.state[0, 2] == OCCUPIED


@pytest.mark.parametrize(
    ("n_under", "top", "expected"), [(3, True, OCCUPIED), (2, True, OCCUPIED), (1, True, UNKNOWN), (3, False, UNKNOWN)]
)
def test_under_a_table_top_near_its_edge_a_cell_whose_floor_two_views_saw_is_occupied(n_under, top, expected):
    below, table = view([[10, 3], [10, 4], [10, 5]], floor=SEEN, camera=CAMERA), view([[8, 4]], top=top, camera=CAMERA)
    made = fuse([FACE, below] * 3 + [UNDER] * n_under + [table], settings=SETTINGS)
    assert made.state[4, 0] == expected
    if expected == OCCUPIED:
        assert made.p_occupied[4, 0] == pytest.approx(grid.INSIDE) and made.n_seen[4, 0] == n_under


@pytest.mark.parametrize("to", [(1, 0), (-1, 0), (0, 1), (0, -1)])
@pytest.mark.parametrize(("behind", "expected"), [(20, UNKNOWN), (22, FREE)])
def test_what_hangs_may_go_on_for_a_metre_behind_its_face_in_every_direction(to, behind, expected):
    """DEEPEST is twenty cells; the outline of a face is one cell wider on either side."""
    along, middle = np.array(to), np.array([100, 100])
    camera = (*((middle - 40 * along + 0.5) * 0.05), 0.6)
    face = view([middle + k * along[::-1] for k in range(-4, 5)], n=20, camera=camera, slices=0xF000)
    under = middle + behind * along
    made = fuse([face, view([under], floor=SEEN, camera=camera)] * 3, settings=SETTINGS)
    column, row = under - np.round(made.origin / 0.05).astype(int)
    assert made.state[row, column] == expected


def test_an_outline_is_closed_by_the_four_cells_beside_each_and_no_others():
    standing = np.zeros((5, 6), np.uint16)
    standing[2, 3], standing[0, 0], standing[4, 5] = 0b0110, 0b1000, 0b0001
    expected = standing.copy()
    for i, j in zip(*np.nonzero(standing), strict=True):
        for r, c in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if 0 <= r < 5 and 0 <= c < 6:
                expected[r, c] |= standing[i, j]
    np.testing.assert_array_equal(grid._with_neighbours(standing), expected)


@pytest.mark.parametrize(
    ("x", "n_views", "slices", "expected"),
    [(8, 0, 0, UNKNOWN), (8, 1, 0x4000, UNKNOWN), (8, 2, 0x4000, FREE), (8, 2, 0x0FFF, UNKNOWN), (7, 0, 0, UNKNOWN), (6, 0, 0, FREE)],
)
def test_floor_close_beside_what_hangs_is_free_only_where_lines_of_sight_crossed_its_heights(x, n_views, slices, expected):
    """BESIDE is three cells. A side seen at too flat an angle shows nothing, while the floor under the thing is seen past its front."""
    aside = ((x + 0.5) * 0.05, 40.5 * 0.05, 0.6)  # from here no line passes under the face
    below = view([[10, 3], [10, 4], [10, 5]], floor=SEEN, camera=CAMERA)
    beside = view([[x, 4]], floor=SEEN, camera=aside)
    crossing = view([[20, 8]], camera=CAMERA, crossed=(np.array([[x, 4]], np.int32), np.array([slices], np.uint16)))
    made = fuse([FACE, below, beside] * 3 + [crossing] * n_views, settings=SETTINGS)
    assert made.state[4, x - round(float(made.origin[0]) / 0.05)] == expected


def test_frames_stand_as_far_apart_or_as_much_turned_as_asked_for():
    T = np.tile(np.eye(4), (4, 1, 1))
    T[1, 0, 3], T[2, :2, 3], T[3, :3, 3] = 0.14, [0.12, 0.12], [0.12, 0.12, 0.14]
    assert grid.spaced(T, metres=0.15, degrees=10.0).tolist() == [0, 2]
    for degrees, is_chosen in ((9.9, False), (10.1, True)):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        T[1] = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        assert grid.spaced(T[:2], metres=0.15, degrees=10.0).tolist() == ([0, 1] if is_chosen else [0])
