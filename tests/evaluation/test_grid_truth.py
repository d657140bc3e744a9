"""The judge of grids is judged: its rays against the analytic room, its shares on grids with known faults."""

import json

import numpy as np
import pytest
from boxroom import FURNITURE, HANGING, KINECT, LOW, ROOM, look_along, render, round_trip

from slamcli.errors import SlamError
from slamcli.evaluation import grid_truth
from slamcli.evaluation.grid_truth import TrueRoom
from slamcli.geometry import se3
from slamcli.schema import Grid

BAND = (0.05, 0.5)
NAMES = ("table", "cupboard", "hanging_box", "low_box")


def scene():
    solids = [
        {
            "name": name,
            "type": "box",
            "centre": [(a + b) / 2 for a, b in zip(*box, strict=True)],
            "size": [b - a for a, b in zip(*box, strict=True)],
            "yaw": 0.0,
        }
        for name, box in zip(NAMES, FURNITURE, strict=True)
    ]
    return TrueRoom(*(np.array(corner) for corner in ROOM), solids)


def perfect(T_sl, points, *, resolution=0.05):
    """The grid of one who knows everything: occupied where anything is, be it only on the cell's border, free elsewhere."""
    shape = (110, 170)
    blank = Grid(
        np.zeros(shape, np.float32), np.ones(shape, np.int32), np.zeros(shape, np.int8), np.array([-0.25, -0.25]), np.array(resolution)
    )
    outline = grid_truth.seen(blank, T_sl, points, band=BAND)[1]
    state = (grid_truth.sample(blank, scene(), T_sl, BAND).any(axis=-1) | outline).astype(np.int8)
    return Grid(state.astype(np.float32), blank.n_seen, state, blank.origin, blank.resolution)


@pytest.fixture(scope="module")
def points():
    T = round_trip(step=0.6, turn=0.4)
    return [grid_truth.exact_points(scene(), render(t), t, KINECT, max_range=4.0, stride=1) for t in T]


def test_rays_meet_what_the_analytic_room_shows():
    T = look_along([1.0, 1.0, 0.6], 0.5, 0.25)
    depth = render(T)
    points = grid_truth.exact_points(scene(), depth, T, KINECT, max_range=9.0, stride=3)
    xyz_c = se3.transform(se3.inverse(T), points)
    np.testing.assert_allclose(xyz_c[:, 2], depth[::3, ::3].ravel(), rtol=1e-5)


def test_rays_meet_a_turned_box_and_a_cylinder():
    solids = [
        {"name": "a", "type": "box", "centre": [2.0, 0.0, 0.5], "size": [1.0, 1.0, 1.0], "yaw": np.pi / 4},
        {"name": "b", "type": "cylinder", "centre": [0.0, 3.0, 0.5], "radius": 0.5, "height": 1.0},
    ]
    room = TrueRoom(np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 3.0]), solids)
    rays = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, -1.0], [0, 0.5, 0.1], [-1e-9, 1.0, 0.5]])
    expected = [2.0 - np.sqrt(0.5), 2.5, 5.0, 0.5, 5.0, 5.0]
    np.testing.assert_allclose(grid_truth.cast(room, np.array([0.0, 0.0, 0.5]), rays), expected, atol=1e-6)


def test_outlines_of_solids_reach_only_into_their_heights():
    xy = np.array([[3.4 + 0.8, 1.7], [1.5, 2.2], [5.0, 4.0]])
    for (low, high), expected in (
        ((0.05, 0.5), [True, True, False]),
        ((0.05, 0.29), [False, True, False]),
        ((0.15, 0.5), [True, False, False]),
    ):
        assert scene().occupied(xy, low, high).tolist() == expected


@pytest.mark.parametrize("T_sl", [np.eye(4), se3.exp(np.array([0.3, 0.2, 0.0, 0.0, 0.0, 0.4]))])
def test_a_perfect_grid_has_full_marks(points, T_sl):
    score = grid_truth.score(perfect(T_sl, points), scene(), T_sl, points, band=BAND)
    assert score.free_is_free == score.free_is_free_exact == score.floor_is_free == 1.0
    assert score.outline_is_occupied == score.outline_is_occupied_exact == 1.0
    assert score.floor_is_occupied == 0.0
    for box in score.special.values():
        assert box["occupied"] == box["cells"] > 0
        assert box["outline_occupied"] == box["outline"] > 0
    assert score.n_floor > 5000 and score.n_outline > 300


def test_faults_are_counted(points):
    grid = perfect(np.eye(4), points)
    state = grid.state.copy()

    def cells(box, margin=0.0):
        (x0, y0, _), (x1, y1, _) = box
        rows = np.arange(int((y0 + margin + 0.25) / 0.05 + 0.5), int((y1 - margin + 0.25) / 0.05 + 0.5))
        columns = np.arange(int((x0 + margin + 0.25) / 0.05 + 0.5), int((x1 - margin + 0.25) / 0.05 + 0.5))
        return np.ix_(rows, columns)

    state[cells(HANGING)] = 0  # called free: all but its rim is wrong even with a cell's tolerance
    state[cells(LOW)] = -1
    state[60:64, 60:70] = 1  # 40 cells of open floor
    score = grid_truth.score(Grid(grid.p_occupied, grid.n_seen, state, grid.origin, grid.resolution), scene(), np.eye(4), points, band=BAND)
    wrong = (10 - 2) * (7 - 2)
    assert score.free_is_free == pytest.approx(1.0 - wrong / score.n_free)
    assert score.free_is_free_exact == pytest.approx(1.0 - 70 / score.n_free)
    assert 0.0 < score.floor_is_occupied <= 40 / score.n_floor
    assert score.outline_is_occupied < 0.98
    box = {"cells": 70, "occupied": 0, "free": 70, "unknown": 0, "outline": 16, "outline_occupied": 0}
    assert score.special["hanging_box"] == box
    assert score.special["low_box"]["unknown"] == 60


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"room": 3, "obstacles": []}', "\xff"])
def test_a_file_that_is_no_scene(tmp_path, text):
    path = tmp_path / "scene.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(SlamError, match=r"scene\.json: not the scene"):
        grid_truth.read_scene(path)
    with pytest.raises(SlamError, match="only simulated recordings"):
        grid_truth.read_scene(tmp_path / "none.json")


BOX = {"type": "box", "name": "b", "centre": [1, 1, 1], "size": [1, 1, 1], "yaw": 0.0}


@pytest.mark.parametrize("solid", [
    3, {}, {**BOX, "type": "cone"}, {**BOX, "centre": [1, 1]}, {**BOX, "size": [1, 1, 1, 1]}, {**BOX, "size": "111"}, {**BOX, "yaw": "x"},
    {**BOX, "centre": [1e300, 0, 0]}, {**BOX, "centre": [10**400, 0, 0]}, {**BOX, "type": "cylinder"}, {**BOX, "type": ["box"]},
    {name: value for name, value in BOX.items() if name != "name"},
])  # fmt: skip
def test_an_obstacle_that_is_none_is_told_when_the_scene_is_read(tmp_path, solid):
    room = {"min": [0, 0, 0], "max": [8, 5, 2.5]}
    (tmp_path / "scene.json").write_text(json.dumps({"room": room, "obstacles": [BOX]}))
    grid_truth.read_scene(tmp_path / "scene.json")
    (tmp_path / "scene.json").write_text(json.dumps({"room": room, "obstacles": [BOX, solid]}))
    with pytest.raises(SlamError, match="not the scene"):
        grid_truth.read_scene(tmp_path / "scene.json")


def test_a_scene_is_read(tmp_path):
    about = {"room": {"min": [0, 0, 0], "max": [8, 5, 2.5]}, "obstacles": scene().solids}
    (tmp_path / "scene.json").write_text(json.dumps(about))
    read = grid_truth.read_scene(tmp_path / "scene.json")
    assert read.solids == scene().solids
    assert read.high.tolist() == [8.0, 5.0, 2.5]
