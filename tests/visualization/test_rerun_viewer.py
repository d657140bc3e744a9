"""The viewer's file holds every part of a run, and without the optional package the user learns how to get it."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import finished
import numpy as np
import pytest
from click.testing import Result

from slamcli.visualization import rerun_viewer

Command = Callable[..., Result]
RERUN = Path(sys.executable).with_name("rerun")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> finished.Finished:
    return finished.make(tmp_path_factory.mktemp("finished"), frames=40, n_lost=4)


def test_without_the_package_there_is_a_hint(slamcli: Command, made: finished.Finished, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = slamcli("view", "-r", made.run)
    assert result.exit_code == 1
    assert result.stderr.splitlines() == ["Error: the viewer needs an optional package; install it with: pip install 'slamcli[view]'"]


def entities(file: Path) -> str:
    subprocess.run([RERUN, "rrd", "verify", file], check=True, capture_output=True, timeout=120)
    return subprocess.run([RERUN, "rrd", "stats", file], check=True, capture_output=True, text=True, timeout=120).stdout


def test_saved_file(slamcli: Command, made: finished.Finished, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    file = tmp_path / "run.rrd"
    result = slamcli("view", "-r", made.run, "--save", file, "--images", 10)
    assert result.exit_code == 0, result.stderr
    text = entities(file)
    for path in ("trajectory", "key_frames", "ground_truth", "loops", "camera", "camera/image", "camera/image/features"):
        assert f"/world/{path}:" in text
    for name in ("inliers", "features", "error"):
        assert f"/curves/{name}:" in text
    shutil.rmtree(made.recording)
    assert slamcli("view", "-r", made.run, "--save", file).exit_code == 0
    assert "/world/camera/image/features:" not in entities(file)


def test_saved_file_with_maps(slamcli: Command, room_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    file = tmp_path / "run.rrd"
    assert slamcli("view", "-r", room_run, "--save", file, "--images", 0).exit_code == 0
    text = entities(file)
    for path in ("cloud", "octree", "grid"):
        assert f"/world/{path}:" in text
    assert "/world/camera/image/features:" not in text


def test_line_is_cut_where_frames_are_lost() -> None:
    position = np.arange(30.0).reshape(10, 3)
    position[[3, 4, 8]] = np.nan
    assert [len(piece) for piece in rerun_viewer._pieces(position)] == [3, 3]  # a single pose makes no line
