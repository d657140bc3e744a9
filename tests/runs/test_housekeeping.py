"""Runs on a disk: listed, cleaned and packed, and what is kept stays usable."""

import json
import shutil
import zipfile
from pathlib import Path

import finished
import pytest

from slamcli.cli import plan
from slamcli.errors import SlamError
from slamcli.runs import housekeeping
from slamcli.runs.run_directory import RunDir
from slamcli.runs.staleness import MISSING


@pytest.fixture
def made(here: Path) -> Path:
    """A run of fake results at runs/mine, up to densify."""
    run = finished.make(here, frames=30, n_lost=2).run
    (here / "runs").mkdir()
    shutil.move(run, here / "runs" / "mine")
    return Path("runs/mine")


def test_list_names_runs_below_runs_and_nothing_else(made, here, slamcli) -> None:
    (here / "runs" / "notes").mkdir()
    shutil.copytree(made, here / "runs" / "tum" / "fr1")
    (here / "runs" / "latest").symlink_to("mine")
    (here / "runs" / "broken").mkdir()
    (here / "runs" / "broken" / "run.json").write_text("{")
    listed = json.loads(slamcli("list", "--json").stdout)
    assert [one["path"] for one in listed] == ["runs/mine", "runs/tum/fr1"]
    assert listed[0]["is_latest"] and not listed[1]["is_latest"]
    assert listed[0]["stages"][-1] == "densify" and listed[0]["frames"] == 30
    assert listed[0]["size"] == sum(path.stat().st_size for path in made.rglob("*") if path.is_file() and path.name != ".lock")
    assert "runs/mine *" in slamcli("list").stdout
    assert slamcli("list", here / "nowhere").stdout == ""


def test_clean_keeps_the_results_and_says_what_it_freed(made, slamcli, tmp_path) -> None:
    before = {path: path.stat().st_size for stage in housekeeping.INTERMEDIATE for path in (made / stage).rglob("*") if path.is_file()}
    freed = json.loads(slamcli("clean", "--keep", "results", "-r", "mine", "--json").stdout)["freed"]
    assert sum(freed.values()) == sum(before.values())
    assert list(freed) == list(housekeeping.INTERMEDIATE)
    assert sorted(path.name for path in made.iterdir() if path.is_dir()) == ["densify", "loop"]
    assert json.loads(slamcli("clean", "--keep", "results", "-r", "mine", "--json").stdout)["freed"] == {}
    states = RunDir.find("mine").states()
    assert all(states[stage].state == MISSING for stage in housekeeping.INTERMEDIATE)
    for command in (["export-trajectory", "t.txt", "--frame", "level"], ["export-cloud", "c.ply"], ["render", "c.png", "--path"]):
        result = slamcli(*command, "-r", "mine")
        assert result.exit_code == 0, result.stderr
        assert "Warning" not in result.stderr  # it was cleaned on purpose
    assert "extract was cleaned away; try: slamcli run -r runs/mine" in slamcli("report", "-r", "mine").stderr
    assert slamcli("clean", "-r", "mine").exit_code == 2
    lines = slamcli("status", "-r", "mine").stdout.splitlines()[1:]
    assert [line.split()[1] for line in lines[:6]] == ["cleaned"] * 4 + ["kept"] * 2
    assert "stale" not in "".join(lines)


def test_a_missing_stage_that_nobody_cleaned_away_is_still_warned_of(made, slamcli) -> None:
    shutil.rmtree(made / "extract")
    assert "loop is stale" in slamcli("export-trajectory", "t.txt", "-r", "mine").stderr


def test_nothing_is_cleaned_where_there_are_no_results(made) -> None:
    shutil.rmtree(made / "loop")
    with pytest.raises(SlamError, match="no results to keep"):
        housekeeping.clean(RunDir.find("mine"))
    assert (made / "extract").is_dir()


def test_an_archive_unpacked_elsewhere_is_a_run_again(made, slamcli, here) -> None:
    assert json.loads(slamcli("archive", "a.zip", "-r", "mine", "--json").stdout)["bytes"] == (here / "a.zip").stat().st_size
    slamcli("archive", "b.zip", "-r", "mine")
    assert (here / "a.zip").read_bytes() == (here / "b.zip").read_bytes()
    with zipfile.ZipFile(here / "a.zip") as packed:
        assert packed.testzip() is None
        packed.extractall(here / "elsewhere")
    for path in housekeeping.files_of(RunDir.find("mine")):
        assert (here / "elsewhere" / "mine" / path.relative_to(made)).read_bytes() == path.read_bytes()
    states = RunDir.find(str(here / "elsewhere" / "mine")).states(verify=True)
    assert states["densify"].is_fresh
    slamcli("archive", "r.zip", "--results", "-r", "mine")
    with zipfile.ZipFile(here / "r.zip") as packed:
        assert {name.split("/")[1] for name in packed.namelist()} == {"config.toml", "run.json", "loop", "densify"}
        packed.extractall(here / "results")
    said = slamcli("export-trajectory", "t.txt", "-r", here / "results" / "mine")
    assert said.exit_code == 0 and "Warning" not in said.stderr  # it was left out on purpose
    assert "cleaned" not in RunDir.find("mine").info()


@pytest.mark.parametrize(
    ("out", "says"), [("a.tar", "must end in .zip"), ("runs/mine/a.zip", "lies in the run"), ("no/a.zip", "cannot be written")]
)
def test_archive_says_what_is_wrong_and_leaves_nothing(made, slamcli, here, out: str, says: str) -> None:
    result = slamcli("archive", out, "-r", "mine")
    assert result.exit_code == 1
    assert says in result.stderr
    assert not [path for path in here.rglob("*") if "a.zip" in path.name]


def test_a_damaged_run_is_not_packed(made, slamcli, here) -> None:
    for name in ("loop/trajectory.txt", "loop/stage.json", "extract/xy.npy", "config.toml"):
        before = (made / name).read_bytes()
        (made / name).write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
        result = slamcli("archive", "a.zip", "-r", "mine")
        assert result.exit_code == 1 and name.rpartition("/")[2] in result.stderr and "slamcli run" in result.stderr
        assert not (here / "a.zip").exists()
        assert (slamcli("archive", "r.zip", "--results", "-r", "mine").exit_code == 0) == (name == "extract/xy.npy")
        (made / name).write_bytes(before)


def test_a_plan_with_walls_refuses_a_damaged_cloud(made) -> None:
    cloud = made / "densify" / "cloud.ply"
    before = cloud.read_bytes()
    cloud.write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
    with pytest.raises(SlamError, match="other content than recorded"):
        plan._walls(RunDir.find("mine"))
    cloud.unlink()
    assert plan._walls(RunDir.find("mine")) == []
