"""No wrong result without a word: recordings spoilt in one way each, and what the commands say of them."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import wrong_inputs

from slamcli.runs.run_directory import RunDir

Slamcli = Callable[..., Result]
# Said by the first stage; the others by the optimized map, or when the recording is opened.
BY_IMAGES = {
    "depth x 1.5": "7500",
    "depth scale x 1.5": "5000",
    "one depth image": "frames 0 to 39 are one and the same",
    "one colour image": "frames 0 to 39 are one and the same",
    "both frozen": "frames 0 to 39 are one and the same",
    "depth constant": "one distance",
    "depth random": "noise",
}


def spoilt(name: str, room: Path, folder: Path) -> Path:
    spoil, _ = wrong_inputs.CASES[name]
    spoil(copied := wrong_inputs.copy(room, folder / wrong_inputs.plain(name)))
    return copied


def told(run: Path) -> dict[str, str]:
    return {finding.name: finding.text for finding in wrong_inputs.findings(RunDir(run))}


@pytest.mark.parametrize("name", BY_IMAGES)
def test_the_first_stage_names_what_is_wrong_with_the_images(name: str, room: Path, tmp_path: Path, slamcli: Slamcli) -> None:
    without_search = "-s", "recording.find_depth_camera=false"  # in noise it takes twenty times as long as the stage itself
    result = slamcli("run", spoilt(name, room, tmp_path), "-r", tmp_path / "run", "--until", "extract", *without_search)
    (cause,) = wrong_inputs.CASES[name][1]
    assert result.exit_code == 0
    assert BY_IMAGES[name] in told(tmp_path / "run")[cause] and told(tmp_path / "run")[cause] in result.stderr


@pytest.mark.parametrize(
    ("name", "words"), [("fx, fy halved", "about fx = 1"), ("cx 20 px off", "principal point"), ("cy 20 px off", "principal point")]
)
def test_the_map_names_a_calibration_that_is_not_the_recordings(
    name: str, words: str, room: Path, tmp_path: Path, slamcli: Slamcli
) -> None:
    run = tmp_path / "run"
    assert slamcli("run", spoilt(name, room, tmp_path), "-r", run, "--until", "optimize").exit_code == 0
    (cause,) = wrong_inputs.CASES[name][1]
    assert words in told(run)[cause]


@pytest.mark.parametrize("name", ["depth byte-swapped", "k1 = 1e6", "k1 = 1e300"])
def test_what_cannot_be_is_refused(name: str, room: Path, tmp_path: Path, slamcli: Slamcli) -> None:
    result = slamcli("run", spoilt(name, room, tmp_path), "-r", tmp_path / "run")
    assert result.exit_code == 1 and len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "check"),
    [
        ("fx, fy halved", "focal length"),
        ("one colour image", "frozen colour"),
        ("depth one frame late", "time offset"),
    ],
)
def test_inspect_names_it_too(name: str, check: str, room: Path, tmp_path: Path, slamcli: Slamcli) -> None:
    found = json.loads(slamcli("inspect", spoilt(name, room, tmp_path), "--json").stdout)["findings"]
    assert check in {one["check"] for one in found if one["level"] != "note"}


def test_the_summary_and_the_first_line_of_the_report_carry_it(room: Path, tmp_path: Path, slamcli: Slamcli) -> None:
    """All depth is empty: the commands after the run end well, too."""
    run = tmp_path / "run"
    result = slamcli("run", spoilt("all depth zero", room, tmp_path), "-r", run)
    assert result.exit_code == 1 and "no frame has a pose" in result.stderr
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("DOUBTFUL")]
    assert "none of 40 depth images holds a reading" in line
    assert slamcli("report", "-r", run, "--no-inspect").exit_code == 0
    assert line in (run / "report.html").read_text()
    assert slamcli("export-mesh", tmp_path / "mesh.ply", "-r", run).exit_code == 1


def test_a_sound_recording_is_in_no_doubt(room_run: Path, room: Path, slamcli: Slamcli) -> None:
    assert told(room_run) == {}
    found = json.loads(slamcli("inspect", room, "--json").stdout)["findings"]
    assert [one for one in found if one["level"] != "note"] == []
