import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.dense import occupancy
from slamcli.dense.occupancy import OccupancyMap, Scan
from slamcli.dense.ray_casting import FREE, OCCUPIED, mark_scan
from slamcli.errors import SlamError
from slamcli.formats import octomap
from slamcli.geometry import voxel
from slamcli.geometry.octree import DEPTH, Octree, prune

MODEL = {"hit": 0.7, "miss": 0.4, "clamp_min": 0.1192, "clamp_max": 0.971}


def room_scan(rng: np.random.Generator, origin: np.ndarray, n: int = 3000) -> np.ndarray:
    """End points on the walls of a box of 5 x 4 x 2.5 m, seen from inside, with 1 cm of noise."""
    direction = rng.normal(size=(n, 3))
    with np.errstate(divide="ignore"):
        t = np.where(direction > 0, np.array([3.0, 2.5, 1.5]) - origin, np.array([-2.0, -1.5, -1.0]) - origin) / direction
    return (origin + direction * t.min(axis=1, keepdims=True) + rng.normal(0, 0.01, (n, 3))).astype(np.float32)


def marked_cells(points: np.ndarray, origin: np.ndarray, max_range: float, resolution: float) -> dict[tuple, bool]:
    found = mark_scan(points, origin, max_range=max_range, resolution=resolution)
    if found is None:
        return {}
    marks, lower = found
    z, y, x = np.nonzero(marks)
    cells = np.column_stack([x, y, z]) + lower
    return {tuple(int(c) for c in cell): bool(mark == OCCUPIED) for cell, mark in zip(cells, marks[z, y, x], strict=True)}


coordinate = st.one_of(
    st.floats(-2, 2, width=32),
    st.integers(-40, 40).map(lambda n: float(np.float32(0.05 * n))),  # on a face between cells
    st.integers(-40, 40).map(lambda n: float(np.float32(0.05 * n + 0.025))),  # in a cell's middle: ties along diagonals
)
point = st.tuples(coordinate, coordinate, coordinate)


@settings(deadline=None, max_examples=300)
@given(point, st.lists(point, min_size=1, max_size=12), st.sampled_from([0.7, 1.5, np.inf]))
def test_the_cells_of_a_scan_are_those_of_octomap_whatever_rounding_does(origin: tuple, ends: list, max_range: float) -> None:
    points = np.array(ends, dtype=np.float32)
    expected = naive.scan_marks(points, np.array(origin), max_range, 0.05)
    assert marked_cells(points, np.array(origin), max_range, 0.05) == expected


@pytest.mark.parametrize("max_range", [0.002, np.inf])
@pytest.mark.parametrize("n", [1, 5])
def test_rays_that_end_in_the_cell_of_their_origin_pass_none(n: int, max_range: float) -> None:
    origin, points = np.array([0.02, 0.02, 0.02]), np.full((n, 3), 0.03, dtype=np.float32)
    found = marked_cells(points, origin, max_range, 0.05)
    assert found == naive.scan_marks(points, origin, max_range, 0.05)
    assert list(found.values()) == ([True] if max_range == np.inf else [])


def test_a_room_full_of_rays_gives_the_cells_of_octomap() -> None:
    rng = np.random.default_rng(0)
    origin = np.array([0.31, -0.22, 0.13])
    points = room_scan(rng, origin, 400)
    assert marked_cells(points, origin, 2.0, 0.05) == naive.scan_marks(points, origin, 2.0, 0.05)


def test_a_cell_hit_and_passed_in_one_scan_is_hit_once() -> None:
    grid = OccupancyMap(0.1, **MODEL)
    points = np.array([[1.05, 0.01, 0.01], [1.06, 0.01, 0.01], [2.05, 0.02, 0.02]])  # the third ray passes the first one's end
    grid.insert(points, np.array([0.05, 0.0, 0.0]), max_range=0.0)
    tree = grid.leaves()
    value = tree.log_odds[tree.find(tree.cells(points))]
    np.testing.assert_array_equal(value, occupancy.log_odds(0.7))
    passed = tree.log_odds[tree.find(tree.cells(np.array([[0.55, 0.0, 0.0], [0.05, 0.0, 0.0], [1.55, 0.01, 0.01]])))]
    np.testing.assert_array_equal(passed, occupancy.log_odds(0.4))


def test_beyond_the_range_space_is_freed_but_nothing_is_hit() -> None:
    grid = OccupancyMap(0.1, **MODEL)
    grid.insert(np.array([[5.0, 0.05, 0.05]]), np.array([0.05, 0.05, 0.05]), max_range=2.0)
    tree = grid.leaves()
    assert not tree.is_occupied().any()
    assert len(tree) == 20
    assert tree.centre[:, 0].max() == pytest.approx(1.95)


def test_the_order_of_scans_does_not_matter_as_long_as_nothing_is_clamped() -> None:
    rng = np.random.default_rng(1)
    origins = [np.array([0.2 * i, 0.1 * i, 0.0]) for i in range(3)]
    scans = [(room_scan(rng, origin, 800), origin) for origin in origins]
    trees = []
    for order in ((0, 1, 2), (2, 0, 1)):
        grid = OccupancyMap(0.05, hit=0.7, miss=0.4, clamp_min=1e-4, clamp_max=1 - 1e-4)
        for i in order:
            grid.insert(*scans[i], max_range=4.0)
        trees.append(grid.leaves())
    assert np.array_equal(trees[0].key, trees[1].key)
    np.testing.assert_allclose(trees[0].log_odds, trees[1].log_odds, atol=1e-6)


def test_probabilities_stay_clamped_and_an_object_taken_away_fades() -> None:
    grid, origin = OccupancyMap(0.05, **MODEL), np.zeros(3)
    near, far = np.array([[1.02, 0.02, 0.02]]), np.array([[2.02, 0.04, 0.04]])
    for _ in range(100):
        grid.insert(near, origin, max_range=0.0)
    tree = grid.leaves()
    assert tree.log_odds.max() == pytest.approx(occupancy.log_odds(0.971))
    assert tree.log_odds.min() == pytest.approx(occupancy.log_odds(0.1192))
    scans_until_free = 0
    while True:
        tree = grid.leaves()
        if not tree.is_occupied()[tree.find(tree.cells(near))[0]]:
            break
        grid.insert(far, origin, max_range=0.0)
        scans_until_free += 1
    assert scans_until_free == 9  # ln(0.971 / 0.029) / ln(0.6 / 0.4) = 8.66, however long it had stood there


def test_a_map_that_would_outgrow_memory_is_refused_before_room_is_made_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    near = np.stack([np.full(200, 2.0), np.linspace(-1, 1, 200), np.linspace(-1, 1, 200)], axis=1)
    aside, grid = np.array([0.0, 4.0, 0.0]), OccupancyMap(0.05, **MODEL)
    grid.insert(near, np.zeros(3), max_range=5.0)
    known = grid._blocks.n
    monkeypatch.setattr(occupancy, "MAX_BLOCKS", 3 * known // 2)
    grid.insert(near + aside, aside, max_range=5.0)
    assert grid._blocks.n > 3 * known // 2, "a scan is small beside the bound, and is not cut"
    with pytest.raises(SlamError, match=r"0\.05 m cells would fill .* raise octree\.resolution"):
        grid.insert(near, np.zeros(3), max_range=5.0)
    monkeypatch.setattr(occupancy, "MAX_BLOCKS", known // 2)
    with pytest.raises(SlamError, match=r"raise octree\.resolution"):
        OccupancyMap(0.05, **MODEL).insert(near, np.zeros(3), max_range=5.0)  # one scan alone


def test_leaves_are_sorted_and_unique() -> None:
    grid = OccupancyMap(0.05, **MODEL)
    grid.insert(room_scan(np.random.default_rng(2), np.zeros(3)), np.zeros(3), max_range=4.0)
    assert (np.diff(grid.leaves().key) > 0).all()
    assert len(OccupancyMap(0.05, **MODEL).leaves()) == 0


def test_points_that_cannot_be_are_skipped() -> None:
    grid = OccupancyMap(0.05, **MODEL)
    grid.insert(np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0]]), np.zeros(3), max_range=0.0)
    grid.insert(np.zeros((0, 3)), np.zeros(3), max_range=1.0)
    grid.insert(np.ones((5, 3)), np.full(3, 1e9), max_range=1.0)
    grid.insert(np.ones((5, 3)), np.full(3, np.nan), max_range=1.0)
    assert len(grid.leaves()) == 0
    grid.insert(np.array([[0.5, 0.5, 0.5]]), np.full(3, 0.5), max_range=1.0)
    assert len(grid.leaves()) == 1


def test_a_scan_too_large_for_memory_is_refused() -> None:
    with pytest.raises(SlamError, match=r"octree\.max_range"):
        OccupancyMap(0.01, **MODEL).insert(np.array([[300.0, 300.0, 300.0]]), np.zeros(3), max_range=0.0)


def test_discretized_scans_cast_one_ray_to_each_end_cell() -> None:
    points = np.array([[1.01, 0.51, 0.26], [1.02, 0.52, 0.27], [1.03, 0.53, 0.28]])
    both = [OccupancyMap(0.05, **MODEL) for _ in range(2)]
    both[0].insert(points, np.zeros(3), max_range=3.0, discretize=True)
    both[1].insert(np.array([[1.025, 0.525, 0.275]]), np.zeros(3), max_range=3.0)
    assert np.array_equal(both[0].leaves().key, both[1].leaves().key)


def test_a_map_agrees_with_the_scan_it_was_made_from_and_not_with_its_opposite() -> None:
    origin = np.array([0.1, 0.2, 0.0])
    scan = (room_scan(np.random.default_rng(3), origin), origin)
    grid = OccupancyMap(0.05, **MODEL)
    grid.insert(*scan, max_range=4.0)
    tree = prune(grid.leaves())
    right = occupancy.accuracy(tree, [Scan(*scan)], max_range=4.0)
    assert (right.share, right.unknown) == (1.0, 0)
    assert right.correct == len(grid.leaves())
    wrong = occupancy.accuracy(Octree(tree.resolution, tree.key, tree.depth, -tree.log_odds), [Scan(*scan)], max_range=4.0)
    assert wrong.share == 0.0
    nothing = occupancy.accuracy(Octree(0.05, tree.key[:0], tree.depth[:0], tree.log_odds[:0]), [Scan(*scan)], max_range=4.0)
    assert nothing.unknown == right.correct and np.isnan(nothing.share)


@pytest.mark.parametrize("max_range", [-1.0, 1.6])
@pytest.mark.parametrize("discretize", [False, True])
def test_maps_are_those_of_the_octomap_library(max_range: float, discretize: bool, tmp_path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", reason="the C++ library, in the extra 'test', is not installed")
    rng = np.random.default_rng(4)
    theirs, ours = pyoctomap.OcTree(0.05), OccupancyMap(0.05, **MODEL)
    for i in range(12):
        origin = np.array([0.11 * i, 0.03 * i, 0.02 * i])
        points = room_scan(rng, origin)
        ours.insert(points, origin, max_range=max_range, discretize=discretize)
        theirs.insertPointCloud(points.astype(np.float64), origin, max_range=max_range, discretize=discretize)
    theirs.updateInnerOccupancy()
    theirs.write(str(tmp_path / "theirs.ot"))
    octomap.write_ot(tmp_path / "ours.ot", prune(ours.leaves()))
    assert (tmp_path / "ours.ot").read_bytes() == (tmp_path / "theirs.ot").read_bytes()


def test_marks_tell_free_from_occupied() -> None:
    marks, lower = mark_scan(np.array([[0.31, 0.01, 0.01]]), np.array([0.01, 0.01, 0.01]), max_range=1.0, resolution=0.1)
    line = marks[32768 - lower[2], 32768 - lower[1], 32768 - lower[0] :]
    assert line[:5].tolist() == [FREE, FREE, FREE, OCCUPIED, 0]
    assert np.count_nonzero(marks) == 4
    assert voxel.morton(lower[None])[0] % 512 == 0
    assert DEPTH == 16
