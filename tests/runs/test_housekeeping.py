"""Runs on a disk: listed, cleaned and packed, and what is kept stays usable."""

import json
import shutil
import zipfile
from pathlib import Path

import finished
import numpy as np
import pytest

from slamcli.cli import plan
from slamcli.errors import SlamError
from slamcli.runs import housekeeping
from slamcli.runs.run_directory import RunDir
from slamcli.runs.staleness import MISSING
from slamcli.schema import Grid
from slamcli.stages import INTERMEDIATE, NAMES

MADE = NAMES[: NAMES.index("densify") + 1]
RESULTS = set(MADE) - set(INTERMEDIATE)
NOTHING_SEEN = Grid(
    p_occupied=np.full((4, 4), np.nan, np.float32), n_seen=np.zeros((4, 4), np.int32), state=np.full((4, 4), -1, np.int8),
    origin=np.zeros(2), resolution=np.array(0.05),
)  # fmt: skip


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


@pytest.mark.parametrize("name", ["run.json", "densify/stage.json"])
def test_a_damaged_run_is_listed_as_that(made, slamcli, name: str) -> None:
    data = (made / name).read_bytes()
    (made / name).write_bytes(data[:-5] + b"\0" + data[-4:])
    (listed,) = json.loads(slamcli("list", "--json").stdout)
    assert listed["path"] == "runs/mine" and listed["size"] > 1000 and "slamcli run -r runs/mine" in listed["damage"]
    shown = slamcli("list")
    assert "damaged" in shown.stdout and f"Warning: runs/mine/{name}: " in shown.stderr


def test_clean_keeps_the_results_and_says_what_it_freed(made, slamcli, tmp_path) -> None:
    before = {path: path.stat().st_size for stage in INTERMEDIATE for path in (made / stage).rglob("*") if path.is_file()}
    freed = json.loads(slamcli("clean", "--keep", "results", "-r", "mine", "--json").stdout)["freed"]
    assert sum(freed.values()) == sum(before.values())
    assert list(freed) == list(INTERMEDIATE)
    assert sorted(path.name for path in made.iterdir() if path.is_dir()) == sorted(RESULTS)
    assert json.loads(slamcli("clean", "--keep", "results", "-r", "mine", "--json").stdout)["freed"] == {}
    states = RunDir.find("mine").states()
    assert all(states[stage].state == MISSING for stage in INTERMEDIATE)
    for command in (["export-trajectory", "t.txt", "--frame", "level"], ["export-cloud", "c.ply"], ["render", "c.png", "--path"]):
        result = slamcli(*command, "-r", "mine")
        assert result.exit_code == 0, result.stderr
        assert "Warning" not in result.stderr  # it was cleaned on purpose
    assert slamcli("clean", "-r", "mine").exit_code == 2
    lines = slamcli("status", "-r", "mine").stdout.splitlines()[1:]
    said = {name: state for name, state, *_ in map(str.split, lines)}
    assert all(said[stage] == ("cleaned" if stage in INTERMEDIATE else "kept") for stage in MADE)
    assert "stale" not in "".join(lines)


@pytest.fixture
def whole(room_run: Path, here: Path) -> Path:
    """A copy of a finished run of the simulated room, with its grid, at runs/room."""
    shutil.copytree(room_run, here / "runs" / "room")
    return Path("runs/room")


FROM_RESULTS = (
    "export-trajectory t.txt", "export-trajectory t.csv --sure-only --frame level", "export-trajectory g.g2o", "export-cloud c.ply --frame world",
    "export-octree m.bt", "export-octree m.ot --colour", "export-mesh s.ply --voxel 0.1", "export-grid g.pgm --costs costs.pgm",
    "export-nerfstudio nerf --images jpg", "render c.png --path", "render o.png --what octree", "render p.png --what plan",
    "eval ape", "eval rpe", "eval map", "report -o r.html", "compare runs/room runs/room", "status", "list",
    "localize runs/room ROOM --out l.txt", "export-colmap colmap --text",
)  # fmt: skip
NEEDS = {"export-colmap": "extract", "localize": "match"}  # what reads more than results, and the stage that it names
GIVEN_BY_NAME = ("compare", "list", "localize")


@pytest.mark.parametrize("is_cleaned", [True, False])
def test_every_export_works_from_what_is_kept_or_says_how_to_bring_the_rest_back(
    whole: Path, room: Path, slamcli, is_cleaned: bool
) -> None:
    """Deleting extract by hand stops no more than cleaning does; and what stays comes out the same as from the whole run."""
    before = slamcli("export-trajectory", "before.txt", "-r", "room"), slamcli("eval", "rpe", "--json", "-r", "room")
    assert all(result.exit_code == 0 for result in before)
    if is_cleaned:
        housekeeping.clean(RunDir.find("room"))
    else:
        for stage in ("extract", "match"):
            shutil.rmtree(whole / stage)
    why = "was cleaned away; bring it back with" if is_cleaned else "is not there any more; make it anew with"
    for words in FROM_RESULTS:
        name, *rest = words.replace("ROOM", str(room)).split()
        result = slamcli(name, *rest, *(() if name in GIVEN_BY_NAME else ("-r", "room")))
        assert not isinstance(result.exception, Exception) or isinstance(result.exception, SystemExit), (words, result.exception)
        if name in NEEDS:
            assert result.exit_code == 1, words
            assert (
                result.stderr.splitlines()[-1] == f"Error: runs/room: {NEEDS[name]} {why}: slamcli run --until {NEEDS[name]} -r runs/room"
            )
        else:
            assert result.exit_code == 0, (words, result.stderr)
            assert not is_cleaned or "stale" not in result.stdout + result.stderr, words
    assert Path("t.txt").read_bytes() == Path("before.txt").read_bytes()
    assert slamcli("eval", "rpe", "--json", "-r", "room").stdout == before[1].stdout
    if is_cleaned:
        assert "extract, match, track, optimize were cleaned away" in Path("r.html").read_text()
    assert slamcli("run", "--until", "extract", "-r", "room").exit_code == 0
    result = slamcli("export-colmap", "colmap", "-r", "room")
    assert result.exit_code == 0 and len(list(Path("colmap/images").iterdir())) > 1, result.stderr


def test_a_map_stage_needs_no_features(whole: Path, slamcli) -> None:
    housekeeping.clean(RunDir.find("room"))
    for stage in ("densify", "octree"):
        result = slamcli(stage, "-r", "room")
        assert result.exit_code == 0, result.stderr


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
        assert {name.split("/")[1] for name in packed.namelist()} == {"config.toml", "run.json", *RESULTS}
        packed.extractall(here / "results")
    said = slamcli("export-trajectory", "t.txt", "-r", here / "results" / "mine")
    assert said.exit_code == 0 and "Warning" not in said.stderr  # it was left out on purpose
    assert "cleaned" not in RunDir.find("mine").info()


def test_an_archive_of_more_is_not_overwritten_without_a_word(made, slamcli, here) -> None:
    assert slamcli("archive", "a.zip", "-r", "mine").exit_code == 0
    whole = (here / "a.zip").read_bytes()
    assert slamcli("archive", "a.zip", "-r", "mine").exit_code == 0  # as much as before
    housekeeping.clean(RunDir.find("mine"))
    result = slamcli("archive", "a.zip", "-r", "mine")
    assert result.exit_code == 1 and "a.zip: holds extract, match, track, optimize, which" in result.stderr
    assert (here / "a.zip").read_bytes() == whole
    assert slamcli("archive", "a.zip", "-r", "mine", "--overwrite").exit_code == 0
    assert len((here / "a.zip").read_bytes()) < len(whole)


def test_an_archive_whose_names_are_no_text_is_replaced_like_any_file(made, slamcli, here) -> None:
    with zipfile.ZipFile(here / "a.zip", "w") as packed:
        packed.writestr("\u00e9/loop/stage.json", "{}")
    (here / "a.zip").write_bytes((here / "a.zip").read_bytes().replace("\u00e9".encode(), b"\xff\xff"))
    assert slamcli("archive", "a.zip", "-r", "mine").exit_code == 0
    with zipfile.ZipFile(here / "a.zip") as packed:
        assert "mine/run.json" in packed.namelist()


def test_nothing_is_deleted_from_a_run_that_was_not_named(made, slamcli, here, monkeypatch) -> None:
    (here / "runs" / "latest").symlink_to("mine")
    result = slamcli("clean", "--keep", "results")
    assert result.exit_code == 2 and "-r runs/mine" in result.stderr and (made / "extract").is_dir()
    monkeypatch.setenv("SLAMCLI_RUN", str(made))
    assert slamcli("clean", "--keep", "results").exit_code == 0 and not (made / "extract").exists()


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
        plan._walls(RunDir.find("mine"), NOTHING_SEEN)
    cloud.unlink()
    assert plan._walls(RunDir.find("mine"), NOTHING_SEEN) == []
