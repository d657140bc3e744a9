"""What commands write: whole or not at all, through links, and never into a run."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result
from test_files import largest_file

from slamcli.cli.main import cli
from slamcli.formats import vocabulary_file
from slamcli.vision import vocabulary

Slamcli = Callable[..., Result]

EXPORTS = {
    "export-trajectory": "t.txt",
    "export-cloud": "cloud.ply",
    "export-octree": "map.ot",
    "export-grid": "map.pgm",
    "export-plan": "plan.json",
    "export-mesh": "mesh.ply",
    "render": "room.png",
    "vocab export": "words.txt",
}
FOLDERS = {"export-colmap", "export-nerfstudio"}  # whose outputs are folders of files, each whole
OPTIONS = {"export-mesh": ["--voxel", "0.1"], "render": ["--size", "64", "48"]}


def export(slamcli: Slamcli, command: str, out: Path, run: Path) -> Result:
    arguments = [str(small_vocabulary(run.parent))] if command == "vocab export" else ["-r", run]
    return slamcli(*command.split(), out, *arguments, *OPTIONS.get(command, []))


def small_vocabulary(folder: Path) -> Path:
    """A vocabulary of four words."""
    import numpy as np

    path = folder / "small.npz"
    if not path.exists():
        centre = np.arange(4 * 32, dtype=np.uint8).reshape(4, 32)
        vocabulary_file.write(path, vocabulary.from_parents(np.zeros(4, np.int32), centre, np.ones(4), origin="", source="test"))
    return path


def test_every_export_is_in_the_table() -> None:
    found = {name for name in cli.commands if name.startswith("export-")}
    assert found <= set(EXPORTS) | FOLDERS


@pytest.mark.parametrize("command", sorted({*EXPORTS, *FOLDERS} - {"vocab export"}))
def test_every_export_tells_programs_what_it_wrote(slamcli: Slamcli, room_run: Path, here: Path, command: str) -> None:
    result = slamcli(command, here / EXPORTS.get(command, "folder"), "-r", room_run, *OPTIONS.get(command, []), "--json")
    told = json.loads(result.stdout)  # one object and nothing else
    written = told.pop("out")
    assert result.exit_code == 0 and all(Path(one).exists() for one in ([written] if isinstance(written, str) else written))
    assert len(told) >= 2 and not re.search(r"\de-\d", result.stdout), "numbers without tails"


@pytest.mark.parametrize("command", EXPORTS)
def test_an_export_that_fails_leaves_the_earlier_file_and_nothing_else(slamcli: Slamcli, room_run: Path, here: Path, command: str) -> None:
    out = here / EXPORTS[command]
    assert export(slamcli, command, out, room_run).exit_code == 0
    before = {path.name: path.read_bytes() for path in here.iterdir()}
    with largest_file(40):
        failed = export(slamcli, command, out, room_run)
    assert failed.exit_code == 1
    lines = [line for line in failed.stderr.splitlines() if not line.startswith("Warning")]
    assert len(lines) == 1
    assert f"{out.stem}." in lines[0] and "cannot be written (File too large" in lines[0]
    assert {path.name: path.read_bytes() for path in here.iterdir()} == before


@pytest.mark.parametrize("command", EXPORTS)
def test_an_export_goes_through_a_link_and_never_into_a_run(slamcli: Slamcli, room_run: Path, here: Path, command: str) -> None:
    name = EXPORTS[command]
    (here / "far").mkdir()
    (here / name).symlink_to(Path("far", name))
    assert export(slamcli, command, here / name, room_run).exit_code == 0
    assert (here / name).is_symlink() and (here / "far" / name).stat().st_size > 40
    (here / "into").symlink_to(room_run / "densify")
    files = sorted(path for path in room_run.rglob("*") if path.is_file())
    for place in (room_run / name, room_run / "loop" / name, here / "into" / name):
        refused = export(slamcli, command, place, room_run)
        assert refused.exit_code == 1
        assert "lies in the run directory" in refused.stderr
    assert sorted(path for path in room_run.rglob("*") if path.is_file()) == files


def test_the_run_s_own_files_are_never_a_target(slamcli: Slamcli, room_run: Path, here: Path) -> None:
    for arguments in (
        ["export-trajectory", "run.json"],
        ["export-cloud", "densify/cloud.ply"],
        ["export-octree", "octree/map.ot"],
        ["export-octree", "octree/map.ot", "--colour"],
        ["export-grid", "grid2d/map.pgm"],
        ["report", "-o", "config.toml"],
        ["report", "-o", "loop/report.html"],
        ["view", "--save", "x.rrd"],
        ["eval", "ape", "--plot", "ape.png"],
        ["plan", "--start", "0,0", "--goal", "1,0", "-o", "path.csv"],
        ["localize", str(room_run), "no recording", "--out", "loop/trajectory.txt"],
    ):
        place = next(k for k, word in enumerate(arguments) if Path(word).suffix in {".json", ".ply", ".ot", ".pgm", ".toml", ".html", ".rrd", ".png", ".csv", ".txt"})  # fmt: skip
        arguments[place] = str(room_run / arguments[place])
        result = slamcli(*arguments, *([] if arguments[0] == "localize" else ["-r", room_run]))
        assert result.exit_code == 1
        assert "lies in the run directory" in result.stderr


def test_no_folder_is_made_within_a_run(slamcli: Slamcli, room_run: Path, room: Path) -> None:
    before = sorted(room_run.rglob("*"))
    for arguments in (
        ["export-colmap", room_run / "model", "-r", room_run],
        ["export-nerfstudio", room_run / "densify" / "scene", "-r", room_run],
        ["convert", room, room_run / "recording"],
        ["simulate", room_run / "room", "--frames", "2"],
        ["batch", room, "--out", room_run],
        ["batch", room, "--out", room_run / "week"],
        ["run", room, "-r", room_run / "loop" / "again"],
    ):
        result = slamcli(*arguments)
        assert result.exit_code == 1
        assert "lies in the run directory" in result.stderr
    assert sorted(room_run.rglob("*")) == before


def test_the_report_and_the_plan_may_go_where_they_go_by_themselves(slamcli: Slamcli, room_run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(room_run, tmp_path / "run")
    assert slamcli("report", "-r", run, "-o", run / "report.html").exit_code == 0
    assert (run / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert not list(run.glob(".*.part"))


def test_a_report_to_a_device_leaves_the_device(slamcli: Slamcli, room_run: Path) -> None:
    assert slamcli("report", "-r", room_run, "-o", "/dev/null").exit_code == 0
    assert not os.path.isfile("/dev/null")
