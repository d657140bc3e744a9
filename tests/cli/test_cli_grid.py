"""export-grid and plan from the command line, and the stage itself, on runs put together without any SLAM."""

import json

import cv2
import finished
import numpy as np
import pytest
from boxroom import HANGING, KINECT, kinect_noise, look_along, render, round_trip

from slamcli import artifacts
from slamcli.config.options import Config, GridConfig, RobotConfig
from slamcli.depth import icp
from slamcli.depth.coarse_images import encode
from slamcli.errors import BadFrame
from slamcli.formats import grid_map, octomap
from slamcli.geometry import se3
from slamcli.navigation.robot_pose import OPTICAL_IN_BODY
from slamcli.runs import pipeline, placement
from slamcli.runs.run_directory import RunDir
from slamcli.schema import CoarseDepth, FrameTimes, Grid, Ground, Map, Moving, Timing, Tracks
from slamcli.stages import grid2d, stage_named


def room_grid():
    """5 m x 4 m with a wall across that leaves a gap; origin (-1, -0.5)."""
    state = np.zeros((80, 100), np.int8)
    state[[0, -1]], state[:, [0, -1]] = 1, 1
    state[:50, 50] = 1
    state[70:, 80:] = -1
    p = np.where(state < 0, np.nan, state).astype(np.float32)
    return Grid(p, (state >= 0).astype(np.int32), state, np.array([-1.0, -0.5]), np.array(0.05))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose grid is known."""
    made = finished.make(tmp_path_factory.mktemp("runs"), frames=60, until="octree")
    folder = RunDir(made.run)
    with folder.writing("grid2d") as out:
        artifacts.save(room_grid(), out)
        folder.commit("grid2d", out, finished._record(folder, stage_named("grid2d"), out, 60))
    return made.run


def test_export_grid_writes_map_page_and_picture(run, here, slamcli):
    result = slamcli("export-grid", "map.pgm", "--png", "map.png", "-r", run)
    assert result.exit_code == 0
    assert "map.pgm" in result.stderr and "100 x 80 cells of 0.05 m" in result.stderr
    read = grid_map.read(here / "map.yaml")
    np.testing.assert_array_equal(read.state, room_grid().state)
    assert read.origin == (-1.0, -0.5)
    picture = cv2.imread(str(here / "map.png"))
    assert min(picture.shape[:2]) > 300
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 5  # cells, trajectory, legend


def test_the_page_tells_where_the_recording_began_and_with_a_mount_where_the_base_did(run, here, slamcli):
    about = json.loads(slamcli("export-grid", "map.pgm", "-r", run, "--json").stdout)
    folder = RunDir(run)
    T_lc = folder.load(Ground, "densify").T_lw @ placement.camera_poses(folder)[0]
    assert [about["start"]["x"], about["start"]["y"]] == pytest.approx(T_lc[:2, 3])
    first = (here / "map.yaml").read_text().splitlines()[0]
    assert first.startswith(f"# start: x {T_lc[0, 3]:.4f}")
    assert grid_map.read(here / "map.yaml").origin == (-1.0, -0.5)  # a comment, no more
    moved = json.loads(slamcli("export-grid", "map.pgm", "-r", run, "--json", "--mount", "0,0,0.2,0,0,0").stdout)["start"]
    assert moved != about["start"]
    assert slamcli("export-grid", "map.pgm", "-r", run, "--mount", "1,2,3").exit_code == 2


def test_a_mount_that_does_not_stand_on_the_floor_is_told(run, here, slamcli):
    """The recording shows how high its camera was, and how it was tilted."""
    folder = RunDir(run)
    T_lc = folder.load(Ground, "densify").T_lw @ placement.camera_poses(folder)[0]
    R = T_lc[:3, :3] @ OPTICAL_IN_BODY[:3, :3].T  # of the camera's body on a base that stands upright
    z, roll, pitch = T_lc[2, 3], np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0])
    for mount, is_right in (
        ((0.1, 0.0, z, roll, pitch, 0.0), True),
        ((0.1, 0.0, z - 0.1, roll, pitch + 0.05, 0.5), True),
        ((0.1, 0.0, z - 0.5, roll, pitch, 0.0), False),
        ((100.0, 0.0, 1000.0 * z, roll, pitch, 0.0), False),
        ((0.0, 0.0, z, roll, pitch + 0.5, 0.0), False),
        ((0.0, 0.0, z, roll + 0.3, pitch, 0.0), False),
    ):
        said = slamcli("export-grid", "map.pgm", "-r", run, "--mount", ",".join(f"{value:.6f}" for value in mount)).stderr
        assert ("it stands upright on the floor with --mount" not in said) == is_right, (mount, said)


@pytest.mark.parametrize("name", ["map.tif", "map", "map.PGM.txt"])
def test_export_grid_wants_a_picture_that_map_server_reads(run, here, slamcli, name):
    result = slamcli("export-grid", name, "-r", run)
    assert result.exit_code == 1
    assert "ends in .pgm" in result.stderr


def test_export_grid_into_no_folder(run, here, slamcli):
    result = slamcli("export-grid", "nowhere/map.pgm", "-r", run)
    assert result.exit_code == 1
    assert "nowhere/map.pgm: cannot be written" in result.stderr


def test_plan_prints_csv_and_draws(run, here, slamcli):
    result = slamcli("plan", "--start", "0,0.5", "--goal", "2.5,0.5", "-r", run, "--png", "plan.png")
    assert result.exit_code == 0
    rows = [line.split(",") for line in result.stdout.splitlines()]
    assert rows[0] == ["x", "y", "clearance"]
    xy = np.array(rows[1:], float)
    np.testing.assert_allclose(xy[[0, -1], :2], [(0.0, 0.5), (2.5, 0.5)])
    assert xy[:, 1].max() > 2.2  # round the wall's end at y = 2.0
    assert (xy[:, 2] >= 0.0).all()
    assert cv2.imread("plan.png") is not None


def test_plan_as_json_and_into_files(run, here, slamcli):
    arguments = ("plan", "--start", "0,0.5", "--goal", "2.5,0.5", "-r", run, "--png", "p.png")
    about = json.loads(slamcli(*arguments, "--json", "-o", "path.csv").stdout)
    assert about["frame"] == "level"
    assert about["points"][0] == [0.0, 0.5]
    assert len(about["points"]) == len(about["clearance"])
    assert about["length"] == pytest.approx(np.linalg.norm(np.diff(about["points"], axis=0), axis=1).sum(), abs=0.01)
    csv = (here / "path.csv").read_text().splitlines()
    assert len(csv) == 1 + len(about["points"])
    assert slamcli(*arguments, "-o", "path.txt").exit_code == 1


def test_plan_draws_into_the_run_by_default(run, here, slamcli):
    assert slamcli("plan", "--start", "0,0.5", "--goal", "1,0.5", "-r", run).exit_code == 0
    assert (run / "plan.png").stat().st_size > 1000


def test_plan_between_where_the_camera_began_and_ended(run, here, slamcli):
    result = slamcli("plan", "--start", "first", "--goal", "last", "-r", run, "--png", "p.png", "--json")
    assert result.exit_code == 0, result.stderr
    about = json.loads(result.stdout)
    assert about["start"] == pytest.approx(about["points"][0], abs=1e-3)
    assert about["length"] > 0.0


def test_a_map_file_does_not_tell_where_the_camera_was(run, here, slamcli):
    slamcli("export-grid", "map.pgm", "-r", run)
    result = slamcli("plan", "--map", "map.yaml", "--start", "first", "--goal", "1,1")
    assert result.exit_code == 1
    assert "does not tell where a camera was" in result.stderr


def test_plan_on_a_map_of_someone_else(run, here, slamcli):
    slamcli("export-grid", "map.pgm", "-r", run)
    result = slamcli("plan", "--map", "map.yaml", "--start", "0,0.5", "--goal", "2.5,0.5")
    assert result.exit_code == 0
    assert result.stdout == slamcli("plan", "--start", "0,0.5", "--goal", "2.5,0.5", "-r", run, "--png", "p.png").stdout


@pytest.mark.parametrize(
    ("start", "goal", "more", "code", "says"),
    [
        ("0,0.5", "9,9", (), 1, "goal 9,9: outside the grid, which covers x -1.00 to 4.00 m"),
        ("0,0.5", "1.52,0.5", (), 1, "goal 1.52,0.5: inside an obstacle; the nearest place"),
        ("0,0.5", "3.5,3.2", (), 1, "in unknown space"),
        ("0,0.5", "2.5,0.5", ("--radius", "1.2"), 1, "robot"),
        ("0,0.5", "2.5,0.5", ("--radius", "-1"), 1, "radius = -1"),
        ("0", "2.5,0.5", (), 2, "'0' is not a place such as 0.5,1.0"),
        ("a,b", "2.5,0.5", (), 2, "is not a place"),
    ],
)
def test_plan_says_what_is_wrong(run, here, slamcli, start, goal, more, code, says):
    result = slamcli("plan", "--start", start, "--goal", goal, "-r", run, *more)
    assert result.exit_code == code
    assert says in result.stderr
    assert result.stdout == ""


def test_plan_through_unknown_space_when_allowed(run, here, slamcli):
    assert slamcli("plan", "--start", "0,0.5", "--goal", "3.5,3.2", "-r", run, "--allow-unknown", "--png", "p.png").exit_code == 0


def test_a_run_without_a_grid_says_how_to_make_one(tmp_path, slamcli):
    made = finished.make(tmp_path, frames=60, until="octree")
    result = slamcli("export-grid", tmp_path / "map.pgm", "-r", made.run)
    assert result.exit_code == 1
    assert "grid2d has not been run; try: slamcli run --until grid2d" in result.stderr


class Recording:
    """Depth of the analytic room, one image of which is broken and one missing."""

    def __init__(self, T_lc):
        rng = np.random.default_rng(0)
        self._depth = [kinect_noise(render(T), rng) for T in T_lc]

    def depth(self, i, camera):
        if i == 3:
            raise BadFrame("depth/3.png: cannot be decoded")
        return None if i == 4 else self._depth[i]

    def __len__(self):
        return len(self._depth)


class Inputs:
    def __init__(self, folder, T_lc, is_found=True):
        n = len(T_lc)
        T_wl = se3.exp(np.array([1.0, 2.0, 3.0, 0.3, 0.2, 0.1]))
        T_lw = se3.inverse(T_wl)
        plane = np.append(T_lw[2, :3], T_lw[2, 3])
        lost = np.arange(n) == 7
        T_kc = np.tile(np.eye(4), (n, 1, 1))
        T_kc[lost] = np.nan
        stamp = 0.2 * np.arange(n)
        self._values = {
            FrameTimes: FrameTimes(stamp, stamp),
            CoarseDepth: encode(np.zeros((n, 0, 0), np.uint16), (0, 0)),
            Moving: Moving(),
            Ground: Ground(T_lw, plane, np.array(0.01), np.array(0.9), np.array(is_found)),
            Timing: Timing(np.array(0.0), np.array(0.0), np.array(0.0), np.zeros((n, 6))),
            Tracks: Tracks(np.where(lost, -1, np.arange(n)).astype(np.int32), T_kc, np.ones(n, np.uint8), np.full(n, 99, np.int32)),
            Map: Map(
                np.arange(n, dtype=np.int32),
                np.zeros(n, np.int32),
                T_wl @ T_lc,
                np.empty((0, 3)),
                *(np.empty(0, t) for t in (np.int32, np.int32, np.int64)),
            ),
        }
        self.dataset, self._folder = Recording(T_lc), folder

    def load(self, cls, stage):
        return self._values[cls]

    def camera(self, stage="extract"):
        return KINECT

    def path(self, stage, *names):
        return self._folder.joinpath(stage, *names)


def run_stage(tmp_path, inputs, **changes):
    config = Config(grid2d=GridConfig(**{"stride": 1, "min_range": 0.5, **changes}))
    out = tmp_path / "out"
    out.mkdir(exist_ok=True)
    tools = pipeline.Tools("grid2d", config)
    summary = grid2d.run(inputs, out, pipeline.Settings(stage_named("grid2d"), config), tools)
    return summary, out, tools


def test_the_stage_writes_grid_and_map_alike(tmp_path):
    summary, out, tools = run_stage(tmp_path, Inputs(tmp_path, round_trip(step=0.4, turn=0.3)))
    made = artifacts.load(Grid, out)
    read = grid_map.read(out / "map.yaml")
    np.testing.assert_array_equal(read.state, made.state)
    assert read.origin == tuple(made.origin)
    assert summary["free"] == (made.state == 0).sum() > 8000
    assert summary["occupied"] == (made.state == 1).sum() > 500
    assert tools.warnings == ["depth/3.png: cannot be decoded"]
    row, column = np.floor((np.array(HANGING)[:, 1::-1].mean(axis=0) - made.origin[::-1]) / 0.05).astype(int)
    assert made.state[row, column] != 0


def test_the_stage_leaves_out_the_robots_own_body_and_says_so(tmp_path):
    T = round_trip(step=0.4, turn=0.3)
    inputs = Inputs(tmp_path, T)
    coarse = np.zeros((len(T), 15, 20), np.uint16)
    coarse[:, 13:, 6:14] = round(0.6 / icp.UNIT)
    inputs._values[CoarseDepth] = encode(coarse, (15, 20))
    _, _, tools = run_stage(tmp_path, inputs)
    assert any("own body" in warning for warning in tools.warnings)
    (tmp_path / "again").mkdir()
    _, _, tools = run_stage(tmp_path / "again", inputs, own_body=False)
    assert not any("own body" in warning for warning in tools.warnings)


def test_the_stage_leaves_out_what_a_mask_says(tmp_path):
    inputs = Inputs(tmp_path, round_trip(step=0.4, turn=0.3))
    cv2.imwrite(str(tmp_path / "all.png"), np.full((120, 160), 255, np.uint8))
    summary, _, _ = run_stage(tmp_path, inputs, mask=str(tmp_path / "all.png"))
    assert summary["free"] == summary["occupied"] == 0


def test_the_stage_warns_when_no_floor_was_found_or_seen(tmp_path):
    T = np.stack([look_along([4.0, 2.5, 0.8], a, -0.5) for a in np.arange(0.0, 6.0, 0.5)])
    summary, _, tools = run_stage(tmp_path, Inputs(tmp_path, T, is_found=False))
    assert not summary["floor"]
    assert any("no floor was found" in warning for warning in tools.warnings)
    assert any("no free cell" in warning for warning in tools.warnings)


def test_the_stage_reads_the_octree(tmp_path):
    from octrees import hanging_box, tree_of

    (tmp_path / "octree").mkdir()
    octomap.write_ot(tmp_path / "octree" / "map.ot", tree_of(hanging_box(hollow=False)))
    summary, out, _ = run_stage(tmp_path, Inputs(tmp_path, round_trip(step=2.0, turn=2.0)), source="octree")
    assert summary["columns"] == summary["rows"] == 40
    assert artifacts.load(Grid, out).state[20, 24] == 1


def test_costs_and_keep_out_layers_lie_on_the_grid(slamcli, run, tmp_path):
    (tmp_path / "no.json").write_text("[[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]]")
    result = slamcli("export-grid", tmp_path / "m.pgm", "-r", run, "--costs", tmp_path / "c.pgm", "--keep-out", tmp_path / "no.json")
    assert result.exit_code == 0
    mask = grid_map.read_pgm(tmp_path / "m_keepout.pgm")[::-1]
    assert (mask == 0).sum() == 400 and (mask[10:30, 20:40] == 0).all() and set(np.unique(mask)) == {0, 255}
    costs = grid_map.read_pgm(tmp_path / "c.pgm")[::-1]
    assert (costs[room_grid().state != 0] == 0).all() and costs.max() == 255
    drawn = np.zeros((80, 100), np.uint8)
    drawn[-30:-10, 20:40] = 255  # row 0 is the largest y
    cv2.imwrite(str(tmp_path / "no.png"), drawn)
    assert slamcli("export-grid", tmp_path / "n.pgm", "-r", run, "--keep-out", tmp_path / "no.png").exit_code == 0
    assert (tmp_path / "n_keepout.pgm").read_bytes() == (tmp_path / "m_keepout.pgm").read_bytes()
    for content in ("{", "[[1, 2]]", "5", f"[[[1{'0' * 400}, 0], [1, 1], [0, 1]]]", "[" * 10_000):
        (tmp_path / "no.json").write_text(content)
        result = slamcli("export-grid", tmp_path / "x.pgm", "-r", run, "--keep-out", tmp_path / "no.json")
        assert result.exit_code == 1 and "no.json" in result.stderr


def test_a_speed_layer_says_how_fast_a_robot_may_go_where(slamcli, run, tmp_path):
    """As nav2's speed filter of type 1 reads it with base 0 and multiplier 1: percent of full speed, 0 = no limit."""
    (tmp_path / "slow.json").write_text("[[40, [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]]]")
    result = slamcli("export-grid", tmp_path / "m.pgm", "-r", run, "--speed", tmp_path / "slow.json")
    assert result.exit_code == 0 and "m_speed.pgm" in result.stderr and "mode: scale" in (tmp_path / "m_speed.yaml").read_text()
    percent = np.rint((255.0 - grid_map.read_pgm(tmp_path / "m_speed.pgm")[::-1]) / 255.0 * 100.0)
    assert (percent == 40).sum() == 400 and (percent[10:30, 20:40] == 40).all() and set(np.unique(percent)) == {0, 40}
    drawn = np.zeros((80, 100), np.uint8)
    drawn[-30:-10, 20:40] = 102  # row 0 is the largest y
    cv2.imwrite(str(tmp_path / "slow.png"), drawn)
    assert slamcli("export-grid", tmp_path / "n.pgm", "-r", run, "--speed", tmp_path / "slow.png").exit_code == 0
    assert (tmp_path / "n_speed.pgm").read_bytes() == (tmp_path / "m_speed.pgm").read_bytes()
    for content in ("{", "[[1, 2]]", "5", "[[0, [[0, 0], [1, 1], [0, 1]]]]", f"[[1{'0' * 400}, [[0, 0], [1, 1], [0, 1]]]]", "[" * 10_000):
        (tmp_path / "slow.json").write_text(content)
        result = slamcli("export-grid", tmp_path / "x.pgm", "-r", run, "--speed", tmp_path / "slow.json")
        assert result.exit_code == 1 and "slow.json" in result.stderr
    assert not (tmp_path / "x_speed.pgm").exists()


def test_plan_tells_what_a_robot_can_reach(slamcli, run, tmp_path):
    wide = json.loads(slamcli("plan", "--start", "0,1", "--reachable", "-r", run, "--json", "--radius", 0.2).stdout)
    assert 0.9 * wide["free_m2"] < wide["reachable_m2"] < wide["free_m2"]
    fat = slamcli("plan", "--start", "0,1", "--reachable", "-r", run, "--radius", 0.8, "--png", tmp_path / "reach.png")
    robot = "a robot of 0.8 m radius, up to 0.5 m high (grid2d.band_high)"
    assert fat.exit_code == 0 and f"are within reach of {robot}; drawn" in fat.stdout and (tmp_path / "reach.png").stat().st_size > 5000
    assert (
        json.loads(slamcli("plan", "--start", "0,1", "--reachable", "-r", run, "--json", "--radius", 0.8).stdout)["reachable_m2"]
        < 0.7 * wide["free_m2"]
    )
    assert wide["height"] == 0.5
    assert slamcli("plan", "--start", "0,0", "-r", run).exit_code == 2


def test_a_goal_does_not_move_the_place_where_the_recording_began(slamcli, run, tmp_path):
    """Else a path that begins beyond a barrier would pass for one from here."""
    folder = RunDir(run)
    alone = json.loads(slamcli("plan", "--reachable", "--start", "first", "-r", run, "--json").stdout)["start"]
    path = json.loads(slamcli("plan", "--start", "first", "--goal", "0,1", "-r", run, "--json").stdout)
    assert path["start"] == alone and list(path["moved"]) == ["start"]
    camera = placement.camera_path(folder)[0, :2]
    assert path["moved"]["start"] == pytest.approx(float(np.hypot(*(camera - alone))), abs=1e-3)


def test_where_no_way_leads_the_picture_shows_what_is_within_reach(slamcli, run, tmp_path):
    folder = RunDir(run)
    grid = folder.load(Grid, "grid2d")
    state = np.array(grid.state)
    state[:, state.shape[1] // 2] = 1
    halves = Grid(grid.p_occupied, grid.n_seen, state, grid.origin, grid.resolution)
    page = tmp_path / "halves.yaml"
    grid_map.write(page.with_suffix(".pgm"), grid_map.GridMap.of(halves))
    middle = float(grid.origin[0]) + state.shape[1] // 2 * float(grid.resolution)
    ends = [f"{middle - 1.0},0", f"{middle + 1.0},0"]
    result = slamcli("plan", "--map", page, "--start", ends[0], "--goal", ends[1], "--png", tmp_path / "no.png")
    assert result.exit_code == 1 and "no way leads" in result.stderr and "no.png" in result.stderr
    colours = cv2.imread(str(tmp_path / "no.png")).reshape(-1, 3)[:, ::-1]
    shown = {
        name: float((colours == np.array(rgb)).all(axis=1).mean()) for name, rgb in (("white", (255, 255, 255)), ("out", (245, 199, 126)))
    }
    assert shown["out"] > 0.1 and shown["white"] > 0.1
    assert "goal" not in slamcli("plan", "--reachable", "--start", "first", "-r", run).stderr


@pytest.mark.shows("robot.radius", "robot.mount")
def test_a_robot_described_once_is_used_by_plan_and_export(slamcli, run, tmp_path):
    folder = RunDir(run)
    before = folder.config()
    try:
        folder.write_config(Config(robot=RobotConfig(radius=0.35, mount="0.1,0,0.3,0,0.2,0")))
        assert json.loads(slamcli("plan", "--start", "0,0", "--goal", "3,0", "-r", run, "--json").stdout)["radius"] == 0.35
        assert json.loads(slamcli("plan", "--start", "0,0", "--goal", "3,0", "-r", run, "--json", "--radius", 0.1).stdout)["radius"] == 0.1
        told, given = (
            slamcli("export-grid", tmp_path / "m.pgm", "-r", run, "--json", *more).stdout for more in ((), ("--mount", "0.1,0,0.3,0,0.2,0"))
        )
        assert json.loads(told)["start"] == json.loads(given)["start"]
        folder.write_config(Config(robot=RobotConfig(mount="here")))
        result = slamcli("export-grid", tmp_path / "m.pgm", "-r", run)
        assert result.exit_code == 1 and "robot.mount" in result.stderr
    finally:
        folder.write_config(before)
