"""The examples run as they stand, on a small room instead of the demo."""

import importlib.util
import json
import os
import re
import runpy
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

import slamcli
from slamcli.config.options import Config
from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate
from slamcli.depth.icp import Alignment
from slamcli.estimation.bundle_adjustment import BundleResult
from slamcli.geometry.octree import Octree
from slamcli.schema import Map, Tracks

EXAMPLES = Path(__file__).parents[2] / "examples"
EXECUTE = """
import sys, nbformat
from nbclient import NotebookClient
notebook = nbformat.read(sys.argv[1], as_version=4)
NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
for cell in notebook.cells:
    for output in cell.get("outputs", ()):
        print(output.get("text") or output.get("data", {}).get("text/plain"))
"""


@pytest.fixture
def play(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    """Run a script of the folder in an empty current folder; gives what it printed."""
    monkeypatch.setenv("MPLBACKEND", "Agg")

    def play(name: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return play


def test_plot_run_draws_a_picture(play, here: Path, room: Path) -> None:
    assert play("plot_run.py", room, here / "run.png").strip() == str(here / "run.png")
    assert (here / "run.png").stat().st_size > 5000


def test_compare_setting_prints_a_line_of_each_run_and_the_setting_matters(play, room: Path) -> None:
    before, after = play("compare_setting.py", room, "extract.features=300", "both").splitlines()
    assert before.startswith("default") and after.startswith("extract.features=300")
    assert before.split("APE")[1] != after.split("APE")[1]
    assert "of 40 frames" in before


def test_another_setting_is_compared_by_itself(play, here: Path, room: Path) -> None:
    play("compare_setting.py", room, "extract.features=300", "both")
    play("compare_setting.py", room, "loop.candidates=1", "both")
    config = slamcli.open_run(here / "both" / "loop.candidates=1").config()
    assert (config.loop.candidates, config.extract) == (1, Config().extract)


def test_plan_path_stays_in_the_room(play, here: Path) -> None:
    recording = simulate(here / "floor", progress=silent, frames=30, laps=0.2, width=160, height=120, pitch=-35.0, noise="none")
    first, *points = play("plan_path.py", recording).splitlines()
    assert 0.1 < float(first.split()[0]) < 10.0
    assert len(points) >= 2
    assert all(abs(float(value)) < 10.0 for point in points for value in point.split())


def test_plan_path_says_so_when_there_is_no_floor_to_drive_on(play, room: Path) -> None:
    with pytest.raises(SystemExit, match="fits nowhere in this grid: try a smaller radius"):
        play("plan_path.py", room)


def test_the_notebook_runs(here: Path, room: Path) -> None:
    if importlib.util.find_spec("nbclient") and importlib.util.find_spec("ipykernel"):
        command = [sys.executable, "-c", EXECUTE, str(EXAMPLES / "tour.ipynb")]
    else:  # its cells one after another: what a kernel would do, without a kernel
        cells = json.loads((EXAMPLES / "tour.ipynb").read_text())["cells"]
        code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        command = [sys.executable, "-c", code]
    environment = {**os.environ, "RECORDING": str(room), "MPLBACKEND": "Agg", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "grid2d" in done.stdout
    assert (here / "runs" / "tour" / "report.html").is_file()


def test_another_key_frame_rule_makes_another_map_of_the_same_trajectory(play, room: Path) -> None:
    default, thrifty, apart = play("own_key_frame_rule.py", room).splitlines()
    fewer, more = (int(text.split()[1]) for text in (thrifty, default))
    assert 2 <= fewer < more
    assert f"half is left: {fewer - 1}" in thrifty
    assert thrifty.endswith(" 0 lost") and default.endswith(" 0 lost")
    assert 0.0 < float(apart.split()[4]) < 20.0


def test_the_parts_work_without_the_pipeline_and_print_each_field(play, room: Path) -> None:
    printed = play("parts.py", room)
    assert "40 of 40 frames tracked" in printed
    overlap = float(re.search(r"overlap +(\d+)%", printed)[1])
    before, after = (float(value) for value in re.search(r"is ([\d.]+) mm off before, ([\d.]+) mm after", printed).groups())
    assert 50.0 < overlap <= 100.0
    assert before == 20.0 and after < 5.0
    results = (Tracks, Map, Alignment, Octree, BundleResult)
    said = {name for line in printed.splitlines() if line.startswith("  ") for name in line[2:26].replace(",", " ").split()}
    left_out = {"kf_segment", "edge_kf", "edge_T_ij", "edge_information", "resolution", "key"}
    assert {field.name for result in results for field in fields(result)} - said <= left_out
