"""slamcli eval and export-trajectory, on a run whose errors are known."""

import csv
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import finished
import numpy as np
import pytest
from click.testing import Result

from slamcli import files
from slamcli.evaluation import trajectory_error
from slamcli.formats.trajectory import read_tum, write_tum
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Ground, Trajectory
from slamcli.stages import WITH_TRAJECTORY

Command = Callable[..., Result]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> finished.Finished:
    return finished.make(tmp_path_factory.mktemp("finished"))


def test_ape_as_json(slamcli: Command, made: finished.Finished) -> None:
    result = slamcli("eval", "ape", "-r", made.run, "--json")
    assert result.exit_code == 0
    figures = json.loads(result.stdout)
    assert {"rmse", "mean", "median", "max", "n_poses", "n_frames", "coverage", "scale", "rmse_scaled"} <= figures.keys()
    assert figures["stage"] == "loop"
    assert (figures["n_poses"], figures["n_frames"], figures["lost"]) == (84, 90, 6)
    assert 0.006 < figures["rmse"] < 0.011  # 0.005 m along three axes
    assert figures["rmse_scaled"] <= figures["rmse"]
    assert files.read_sealed(made.run / "eval" / "ape.json") == figures


def test_ape_of_each_stage_is_that_of_its_trajectory_file(slamcli: Command, made: finished.Finished) -> None:
    rmse = {}
    for stage in WITH_TRAJECTORY:
        figures = json.loads(slamcli("eval", "ape", "-r", made.run, "--stage", stage, "--json").stdout)
        file = trajectory_error.ape(read_tum(made.run / stage / "trajectory.txt"), made.truth, n_frames=90, name="file")
        assert figures["rmse"] == pytest.approx(file.to_dict()["rmse"], abs=1e-9)
        rmse[stage] = figures["rmse"]
    assert rmse["loop"] < rmse["track"]


def test_all_stages_in_one_table(slamcli: Command, made: finished.Finished) -> None:
    rows = json.loads(slamcli("eval", "ape", "-r", made.run, "--stage", "all", "--json").stdout)
    assert [row["stage"] for row in rows] == ["track", "optimize", "loop"]
    assert files.read_sealed(made.run / "eval" / "ape.json") == rows[-1]


def test_run_that_may_not_be_written_to(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(made.run, run, ignore=shutil.ignore_patterns("eval"))
    (run / "eval").write_text("a file where the folder should be")
    result = slamcli("eval", "ape", "-r", run, "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["n_frames"] == 90
    assert "cannot be written" in result.stderr


def test_last_stage_there_is(slamcli: Command, tmp_path: Path) -> None:
    part = finished.make(tmp_path, until="track", frames=30, n_lost=0)
    assert json.loads(slamcli("eval", "ape", "-r", part.run, "--json").stdout)["stage"] == "track"
    result = slamcli("eval", "ape", "-r", part.run, "--stage", "loop")
    assert result.exit_code == 1
    assert "loop has not been run; try: slamcli run --until loop" in result.stderr


def test_nothing_tracked_yet(slamcli: Command, tmp_path: Path) -> None:
    part = finished.make(tmp_path, until="match", frames=30, n_lost=0)
    result = slamcli("eval", "ape", "-r", part.run)
    assert result.exit_code == 1 and "slamcli run --until track" in result.stderr


def test_no_ground_truth(slamcli: Command, tmp_path: Path) -> None:
    made = finished.make(tmp_path, with_truth=False, frames=30, n_lost=0)
    for metric in ("ape", "rpe"):
        result = slamcli("eval", metric, "-r", made.run)
        assert result.exit_code == 1
        assert "no ground truth" in result.stderr and len(result.stderr.splitlines()) == 1


def test_too_few_poses(slamcli: Command, tmp_path: Path) -> None:
    made = finished.make(tmp_path, frames=12, n_lost=6)
    part = finished.make(tmp_path / "b", frames=2, n_lost=0)
    assert slamcli("eval", "ape", "-r", made.run).exit_code == 0
    result = slamcli("eval", "ape", "-r", part.run)
    assert result.exit_code == 1 and "too few" in result.stderr


def test_several_runs_in_one_table(slamcli: Command, made: finished.Finished, here: Path) -> None:
    shutil.copytree(made.run, here / "runs" / "a_1")
    shutil.copytree(made.run, here / "runs" / "b")
    text = slamcli("eval", "ape", "runs/a_1", "runs/b").stdout
    assert [line.split()[0] for line in text.splitlines()] == ["trajectory", "a_1", "b"]
    rows = list(csv.DictReader(io.StringIO(slamcli("eval", "ape", "runs/a_1", "runs/b", "--style", "csv").stdout)))
    assert [row["name"] for row in rows] == ["a_1", "b"]
    assert float(rows[0]["rmse"]) == json.loads((here / "runs/a_1/eval/ape.json").read_text())["rmse"]
    latex = slamcli("eval", "ape", "runs/a_1", "runs/b", "--style", "latex").stdout
    assert r"a\_1 & loop" in latex and r"93.3\%" in latex and latex.count(r"\\") == 3
    assert len(json.loads(slamcli("eval", "ape", "runs/a_1", "runs/b", "--json").stdout)) == 2
    assert slamcli("eval", "ape", "runs/a_1", "-r", "runs/b").exit_code == 2


def test_other_systems_stand_beside(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    write_tum(tmp_path / "theirs.txt", finished.disturb(rng, made.truth, metres=0.1))
    ours, theirs = json.loads(slamcli("eval", "ape", "-r", made.run, "--other", f"Theirs={tmp_path / 'theirs.txt'}", "--json").stdout)
    assert theirs["name"] == "Theirs" and theirs["rmse"] > 5 * ours["rmse"] and theirs["coverage"] == 1.0
    assert slamcli("eval", "ape", "-r", made.run, "--other", "no-equals-sign").exit_code == 2
    missing = slamcli("eval", "ape", "-r", made.run, "--other", f"A={tmp_path / 'none.txt'}")
    assert missing.exit_code == 1 and "none.txt" in missing.stderr


def test_a_truth_of_half_the_recording_is_told_beside_the_coverage(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    half = Trajectory(made.truth.stamp[:40], made.truth.T_wc[:40])
    write_tum(tmp_path / "half.txt", half)
    table = slamcli("eval", "ape", "-r", made.run, "--truth", tmp_path / "half.txt", "--style", "csv").stdout
    (row,) = csv.DictReader(io.StringIO(table))
    assert 30 < int(row["n_matched"]) <= 40 and float(row["coverage"]) == pytest.approx(84 / 90)


def test_rpe(slamcli: Command, made: finished.Finished) -> None:
    figures = json.loads(slamcli("eval", "rpe", "-r", made.run, "--json").stdout)
    assert (figures["unit"], figures["delta"], figures["per_frame"]["unit"]) == ("s", 1.0, "frame")
    assert 0.008 < figures["rmse"] < 0.017  # two poses with 0.005 m along three axes
    assert figures["per_frame"]["n_pairs"] == 82  # 84 poses in two pieces
    assert files.read_sealed(made.run / "eval" / "rpe.json") == figures
    lines = slamcli("eval", "rpe", "-r", made.run).stdout.splitlines()
    assert len(lines) == 3


@pytest.mark.parametrize("metric", ["ape", "rpe"])
def test_plot_shows_something(slamcli: Command, made: finished.Finished, tmp_path: Path, metric: str) -> None:
    file = tmp_path / "plot.png"
    assert slamcli("eval", metric, "-r", made.run, "--plot", file).exit_code == 0
    picture = cv2.imread(str(file))
    assert min(picture.shape[:2]) > 500
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert slamcli("eval", metric, "-r", made.run, "--plot", tmp_path / "plot.xyz").exit_code == 1
    result = slamcli("eval", metric, "-r", made.run, "--plot", tmp_path / "nowhere" / "plot.png")
    assert result.exit_code == 1 and "nowhere" in result.stderr


def test_export_trajectory(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    assert slamcli("export-trajectory", tmp_path / "t.txt", "-r", made.run).exit_code == 0
    assert (tmp_path / "t.txt").read_text() == (made.run / "loop" / "trajectory.txt").read_text()
    assert slamcli("export-trajectory", tmp_path / "level.txt", "-r", made.run, "--frame", "level").exit_code == 0
    T_lw = RunDir.find(str(made.run)).load(Ground, "densify").T_lw
    expected = T_lw @ read_tum(tmp_path / "t.txt").T_wc
    np.testing.assert_allclose(read_tum(tmp_path / "level.txt").T_wc, expected, atol=1e-7)
    result = slamcli("export-trajectory", tmp_path / "k.txt", "-r", made.run, "--format", "kitti")
    assert np.loadtxt(tmp_path / "k.txt").shape == (84, 12)
    assert "84 poses of 90 frames" in result.stderr and "not frame numbers" in result.stderr
    assert slamcli("export-trajectory", tmp_path / "no" / "t.txt", "-r", made.run).exit_code == 1


def test_export_of_the_sure_leaves_out_what_the_run_doubts_and_nothing_else(slamcli: Command, tmp_path: Path) -> None:
    made = finished.make(tmp_path, n_doubtful=10)
    run, doubtful = made.run, made.lost | (np.arange(90) < 10)
    result = slamcli("export-trajectory", tmp_path / "all.txt", "-r", run)
    assert result.exit_code == 0, result.stderr
    result = slamcli("export-trajectory", tmp_path / "sure.txt", "-r", run, "--sure-only")
    assert result.exit_code == 0, result.stderr
    assert "74 poses of 90 frames" in result.stderr
    whole, sure = read_tum(tmp_path / "all.txt"), read_tum(tmp_path / "sure.txt")
    kept = np.isin(whole.stamp, made.truth.stamp[~doubtful])
    np.testing.assert_array_equal(sure.stamp, whole.stamp[kept])
    np.testing.assert_array_equal(sure.T_wc, whole.T_wc[kept])
    figures = json.loads(slamcli("eval", "ape", "-r", run, "--json").stdout)
    assert figures["doubtful"] == 10 and figures["rmse_sure"] != figures["rmse"]


def test_map_against_the_depth_images_and_the_scene(slamcli: Command, room_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(room_run, run)
    figures = json.loads(slamcli("eval", "map", "-r", run, "--json").stdout)
    assert 0.9 < figures["octree"]["accuracy"] <= 1.0
    assert 0.5 < figures["grid"]["free_is_free"] <= 1.0
    assert files.read_sealed(run / "eval" / "map.json") == figures
    text = slamcli("eval", "map", "-r", run).stdout
    assert "of the cells seen are right" in text
    assert "called free are free" in text


def test_map_needs_an_octree(slamcli: Command, made: finished.Finished) -> None:
    result = slamcli("eval", "map", "-r", made.run)
    assert result.exit_code == 1
    assert "octree has not been run" in result.stderr


def test_export_trajectory_refuses_an_ending_that_promises_something_else(slamcli, made, tmp_path):
    result = slamcli("export-trajectory", tmp_path / "t.json", "-r", made.run)
    assert result.exit_code == 1
    assert "t.json: the name must end in .txt" in result.stderr
    assert not (tmp_path / "t.json").exists()


def test_the_base_of_a_robot_moves_rigidly_with_its_camera(slamcli, made, tmp_path):
    for name, more in (("camera.txt", ()), ("base.txt", ("--mount", "0.1,0.2,0.3,0,0.2,0.5"))):
        assert slamcli("export-trajectory", tmp_path / name, "-r", made.run, *more).exit_code == 0
    camera, base = read_tum(tmp_path / "camera.txt").T_wc, read_tum(tmp_path / "base.txt").T_wc
    T_cb = np.linalg.inv(camera) @ base
    np.testing.assert_allclose(T_cb, np.broadcast_to(T_cb[0], T_cb.shape), atol=1e-7)
    assert np.linalg.norm(T_cb[0, :3, 3]) == pytest.approx(np.linalg.norm([0.1, 0.2, 0.3]), abs=1e-7)


def test_a_trajectory_can_be_exported_after_extract_was_cleared_away(slamcli, tmp_path):
    made = finished.make(tmp_path, frames=30, n_lost=2)
    assert slamcli("export-trajectory", tmp_path / "before.txt", "-r", made.run).exit_code == 0
    shutil.rmtree(made.run / "extract")
    result = slamcli("export-trajectory", tmp_path / "after.txt", "-r", made.run, "--json")
    assert json.loads(result.stdout) == {"out": str(tmp_path / "after.txt"), "poses": 28, "frames": 30, "frame": "world", "format": "tum"}
    np.testing.assert_allclose(read_tum(tmp_path / "after.txt").T_wc, read_tum(tmp_path / "before.txt").T_wc, atol=2e-9)


def test_a_true_trajectory_of_another_clock(slamcli, made, tmp_path):
    stamp = made.truth.stamp - 7.25
    write_tum(tmp_path / "mocap.txt", Trajectory(stamp=stamp, T_wc=made.truth.T_wc))
    given = ("eval", "ape", "-r", made.run, "--json", "--truth", tmp_path / "mocap.txt")
    assert slamcli(*given).exit_code == 1  # no pose within 0.02 s
    moved = json.loads(slamcli(*given, "--truth-offset", "7.25").stdout)
    assert moved["rmse"] == pytest.approx(json.loads(slamcli("eval", "ape", "-r", made.run, "--json").stdout)["rmse"], abs=1e-6)


def test_json_is_a_list_whenever_several_were_asked_for(slamcli, made):
    assert isinstance(json.loads(slamcli("eval", "ape", "-r", made.run, "--json").stdout), dict)
    assert isinstance(json.loads(slamcli("eval", "ape", "-r", made.run, "--json", "--stage", "all").stdout), list)
    assert isinstance(json.loads(slamcli("eval", "rpe", made.run, made.run, "--json").stdout), list)


def test_a_run_may_be_called_by_its_name_under_runs(slamcli, here):
    made = finished.make(here, frames=30, n_lost=0)
    (here / "runs").mkdir()
    shutil.move(made.run, here / "runs" / "mine")
    assert json.loads(slamcli("eval", "ape", "mine", "--json").stdout)["n_frames"] == 30
    assert slamcli("status", "-r", "mine").exit_code == 0
