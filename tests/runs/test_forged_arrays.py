"""Arrays that a forger put into a run, digests and seals all right: the stage or command that reads them ends in one line."""

import io
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

sys.path.append(str(Path(__file__).parents[2] / "scripts"))  # last: both have a module `layouts`

import forged

Slamcli = Callable[..., Result]


@pytest.fixture
def run(room_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room_run, tmp_path / "run"))


def change(run: Path, name: str, value: float, at: int) -> None:
    column = np.load(run / name)
    column.reshape(-1)[at] = value
    with io.BytesIO() as file:
        np.save(file, column)
        forged.put(run, name=name, data=file.getvalue())


@pytest.mark.parametrize(
    ("name", "value", "at", "command", "said"),
    [
        ("extract/offset.npy", 1 << 40, -2, ("track",), "Features.offset: does not divide"),
        ("extract/xy.npy", np.inf, 7, ("track",), "Features.xy: inf is more than"),
        ("match/word.npy", 60_000, 3, ("track",), "Words.word: row 60000 of"),
        ("match/row.npy", 60_000, 3, ("track",), "matches are not of the features that extract left"),
        ("track/obs_row.npy", 1 << 31, 3, ("optimize",), "Map.obs_row: row 2147483648 of"),
        ("track/ref_kf.npy", 1 << 30, 3, ("loop",), "Tracks.ref_kf: row 1073741824 of"),
        ("optimize/T_wk.npy", np.nan, 0, ("loop",), "Map.T_wk: not a rigid motion"),
        ("loop/kf_frame.npy", 40, -1, ("export-trajectory", "t.txt"), "Map.kf_frame: row 40 of 40"),
        ("densify/T_lw.npy", 0, 0, ("export-cloud", "c.ply", "--frame", "world"), "Ground.T_lw: not a rigid motion"),
    ],
)
def test_what_no_stage_writes_ends_in_one_line(
    slamcli: Slamcli, here: Path, run: Path, name: str, value: float, at: int, command: tuple[str, ...], said: str
) -> None:
    change(run, name, value, at)
    result = slamcli(*command, "-r", run)
    assert result.exit_code == 1
    assert said in result.stderr
    assert sum(line.startswith("Error") for line in result.stderr.splitlines()) == 1


def test_a_stage_that_rests_on_features_made_anew_since_says_so(slamcli: Slamcli, here: Path, run: Path) -> None:
    assert slamcli("extract", "-r", run, "-s", "extract.features=60").exit_code == 0
    result = slamcli("optimize", "-r", run)
    assert result.exit_code == 1
    assert "Map.obs_row: row" in result.stderr
    assert slamcli("export-trajectory", "t.txt", "-r", run).exit_code == 0  # which needs no features
    result = slamcli("export-colmap", "colmap", "-r", run)
    assert result.exit_code == 1
    assert "the map rests on other features than those that extract left" in result.stderr
