"""A recording localized in a run: its own frames are found where the run has them, and what shows another place is refused."""

import json
import shutil

import numpy as np
import pytest
from recordings import write_recording

from slamcli.datasets import open_dataset
from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories
from slamcli.formats.trajectory import read_tum
from slamcli.geometry import se3
from slamcli.runs import localization
from slamcli.runs.run_directory import RunDir


def every_other_frame(source, folder):
    """A recording of every other image of another, an hour later."""
    folder.mkdir()
    for name in ("rgb", "depth"):
        (folder / name).symlink_to(source / name)
        lines = [line.split() for line in (source / f"{name}.txt").read_text().splitlines() if not line.startswith("#")][::2]
        (folder / f"{name}.txt").write_text("".join(f"{float(stamp) + 3600:.6f} {image}\n" for stamp, image in lines))
    shutil.copy(source / "camera.json", folder)
    return folder


def test_frames_are_found_where_the_run_has_them(slamcli, room, room_run, tmp_path):
    again, out = every_other_frame(room, tmp_path / "again"), tmp_path / "t.txt"
    before = {path: path.stat().st_mtime_ns for path in room_run.rglob("*")}
    told = slamcli("localize", room_run, again, "--out", out, "--json")
    figures = json.loads(told.stdout)
    found, own = read_tum(out), run_trajectories.stage_trajectory(RunDir(room_run), "loop")
    assert figures["coverage"] == 1.0 and figures["n_poses"] == len(found.stamp) == 20
    np.testing.assert_allclose(found.stamp - 3600, own.stamp[::2], atol=1e-5)
    apart = se3.log(se3.inverse(own.T_wc[::2]) @ found.T_wc)  # in the run's own frame: nothing is aligned
    assert 0.0 < np.linalg.norm(apart[:, :3], axis=1).max() < 0.01
    assert np.linalg.norm(apart[:, 3:], axis=1).max() < 0.005
    assert {path: path.stat().st_mtime_ns for path in room_run.rglob("*")} == before


def test_it_says_where_the_base_stands_on_the_map(slamcli, room, room_run, tmp_path):
    again, mount = every_other_frame(room, tmp_path / "again"), "0.1,0,0.3,0,0.2,0"
    of_base = ("--frame", "level", "--mount", mount)
    told = slamcli("localize", room_run, again, "--out", tmp_path / "t.txt", *of_base, "--json")
    slamcli("export-trajectory", tmp_path / "own.txt", "-r", room_run, *of_base)
    last, own = json.loads(told.stdout)["last"], read_tum(tmp_path / "own.txt").T_wc[38]
    assert [last["x"], last["y"]] == pytest.approx(own[:2, 3], abs=0.01)
    assert last["yaw"] == pytest.approx(np.arctan2(own[1, 0], own[0, 0]), abs=0.005)
    apart = se3.log(se3.inverse(own) @ read_tum(tmp_path / "t.txt").T_wc[-1])
    assert np.abs(apart).max() < 0.01


def test_another_place_is_not_recognized(room_run, tmp_path):
    noise = open_dataset(str(write_recording(tmp_path / "noise", frames=3)))
    with pytest.raises(SlamError, match="no frame was recognized in the map of"):
        localization.localize(RunDir(room_run), noise, progress=lambda items, label, total=None: items)


def test_a_run_without_a_map_says_what_to_do(slamcli, room, room_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(room_run, run)
    shutil.rmtree(run / "loop")
    told = slamcli("localize", run, room, "--out", tmp_path / "t.txt")
    assert told.exit_code == 1 and "loop is not there any more; make it anew with: slamcli run --until loop" in told.output
    assert not (tmp_path / "t.txt").exists()
