"""Which frames are asked about places where key frames contradict each other."""

import numpy as np
import pytest

from slamcli.dense import change_detection
from slamcli.dense.occupancy import OccupancyMap
from slamcli.geometry.camera import Camera

MODEL = {"hit": 0.7, "miss": 0.4, "clamp_min": 0.1192, "clamp_max": 0.971}
CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
ORIGIN = np.zeros(3)
LAST_SEEN = 40  # frame


def wall(z: float) -> np.ndarray:
    """End points on a plane before the camera, half a cell apart at 2 m; inside a block of cells along x and y."""
    x, y = np.meshgrid(np.arange(0.0, 0.4, 0.02), np.arange(0.0, 0.4, 0.02))
    return np.column_stack([x.ravel() * z / 2.0 + 0.01, y.ravel() * z / 2.0 + 0.01, np.full(x.size, z)])


def facing(turn: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = [[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]]
    return T


def box_taken_away(misses: int) -> OccupancyMap:
    """A map in which something stood 2 m away in frames 10 to 40, and then `misses` scans saw the wall behind."""
    grid = OccupancyMap(0.05, **MODEL)
    for frame in (10, 20, 30, LAST_SEEN):
        grid.insert(wall(2.02), ORIGIN, max_range=0.0, frame=frame)
    for k in range(misses):
        grid.insert(wall(2.82), ORIGIN, max_range=0.0, frame=LAST_SEEN + 10 * (k + 1))
    return grid


@pytest.mark.parametrize(
    ("misses", "is_doubted"), [(0, False), (change_detection.MISSES - 1, False), (change_detection.MISSES, True), (20, False)]
)
def test_cells_are_doubted_from_the_second_miss_until_they_are_free(misses: int, is_doubted: bool) -> None:
    grid = box_taken_away(misses)
    cell, last_hit = grid.doubted(change_detection.MISSES)
    centre = grid.centre(cell)
    assert (len(centre) > 30) == is_doubted
    assert len(centre) == len(last_hit)
    assert (last_hit == LAST_SEEN).all()
    assert (np.abs(centre[:, 2] - 2.025) < 1e-6).all()


def test_frames_are_asked_that_look_there_after_the_last_hit_and_no_more_than_can_turn_it() -> None:
    grid = box_taken_away(3)
    poses = [(frame, facing(np.pi if frame % 3 == 0 else 0.0)) for frame in range(100)]
    chosen = [frame for frame, _ in change_detection.witnesses(grid, poses, CAMERA, max_range=3.2, most=50)]
    assert chosen == [frame for frame in range(LAST_SEEN + 1, 100) if frame % 3][: grid.looks]
    assert grid.looks == 9  # ln(0.971 / 0.029) / ln(0.6 / 0.4) = 8.66
    for frame in chosen:
        grid.insert(wall(2.82), ORIGIN, max_range=0.0, frame=frame)
    assert len(grid.doubted(1)[0]) == 0


def test_nobody_is_asked_without_need_or_where_nobody_can_see() -> None:
    poses = [(frame, facing()) for frame in range(41, 60)]
    assert change_detection.witnesses(box_taken_away(0), poses, CAMERA, max_range=3.2, most=50) == []
    grid = box_taken_away(3)
    assert len(change_detection.witnesses(grid, poses, CAMERA, max_range=3.2, most=50)) == grid.looks
    assert change_detection.witnesses(grid, poses, CAMERA, max_range=1.0, most=50) == []
    assert change_detection.witnesses(grid, [(frame, facing(np.pi)) for frame, _ in poses], CAMERA, max_range=0.0, most=50) == []
    assert change_detection.witnesses(grid, [], CAMERA, max_range=0.0, most=50) == []


def test_the_more_there_would_be_the_sparser_they_are_asked() -> None:
    grid, poses = box_taken_away(3), [(frame, facing()) for frame in range(41, 60)]
    chosen = [frame for frame, _ in change_detection.witnesses(grid, poses, CAMERA, max_range=3.2, most=50)]
    for most, step in ((len(chosen), 1), (len(chosen) - 1, 2), (3, 3), (1, len(chosen))):
        fewer = change_detection.witnesses(grid, poses, CAMERA, max_range=3.2, most=most)
        assert [frame for frame, _ in fewer] == chosen[::step] and len(fewer) <= most


def test_groups_are_those_of_a_graph_library() -> None:
    from scipy.ndimage import label

    rng = np.random.default_rng(0)
    for density in (0.02, 0.1, 0.3):
        volume = rng.random((20, 25, 30)) < density
        expected, n = label(volume, structure=np.ones((3, 3, 3)))
        group = change_detection._components(np.argwhere(volume) + 1000)
        assert len(np.unique(group)) == n
        for k in range(1, n + 1):
            assert len(np.unique(group[expected[volume] == k])) == 1
    assert len(change_detection._components(np.empty((0, 3), dtype=np.int64))) == 0
