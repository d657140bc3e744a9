"""Recordings from which no map can come, or hardly one: the program ends well, says so, and never with a traceback."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import faults
import numpy as np
import pytest
from click.testing import Result

Slamcli = Callable[..., Result]
FRAMES = 6


@pytest.fixture
def short(room: Path, tmp_path: Path) -> Path:
    """The first frames of the simulated room, to be spoilt."""
    folder = faults.copy(room, tmp_path / "short")
    for kind in ("rgb", "depth"):
        faults.write(folder, kind, faults.entries(folder, kind)[:FRAMES])
    return folder


def run(slamcli: Slamcli, recording: Path, *more: object) -> tuple[Result, dict]:
    path = recording.parent / "run"
    result = slamcli("run", recording, "-r", path, *more)
    rows = json.loads(slamcli("status", "-r", path, "--json").stdout) if path.exists() else []
    return result, {row["stage"]: row["state"] for row in rows}


def blank(value: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda picture: np.full_like(picture, value)


BLANK = pytest.mark.parametrize("value", [0, 255, 90], ids=["black", "over-exposed", "wall without texture"])


@BLANK
def test_nothing_but_blank_frames_is_refused_in_one_line(short: Path, slamcli: Slamcli, value: int) -> None:
    faults.repaint(short, "rgb", blank(value))
    faults.repaint(short, "depth", blank(0))
    result, _ = run(slamcli, short)
    assert result.exit_code == 1
    start, *error = [line for line in result.stderr.splitlines() if not line.startswith("Warning")]
    assert start.startswith("short -> ") and len(error) == 1
    assert "no feature" in error[0]
    assert "slamcli inspect" in error[0]


def test_blank_frames_with_depth_are_mapped_by_shape_or_lost_with_the_reason(short: Path, slamcli: Slamcli) -> None:
    faults.repaint(short, "rgb", blank(0))
    result, states = run(slamcli, short)
    assert result.exit_code == 0, result.output
    assert set(states.values()) == {"up to date"}
    assert "by the shape alone" in result.stderr and "Traceback" not in result.output
    assert n_poses(short) == FRAMES


@BLANK
def test_blank_frames_on_the_way_are_lost_and_the_rest_is_mapped(short: Path, slamcli: Slamcli, value: int) -> None:
    faults.repaint(short, "rgb", blank(value), slice(FRAMES // 2, None))
    faults.repaint(short, "depth", blank(0), slice(FRAMES // 2, None))
    result, states = run(slamcli, short)
    assert result.exit_code == 0, result.output
    assert set(states.values()) == {"up to date"}
    assert "lost" in result.stderr
    assert n_poses(short) == FRAMES // 2


def test_no_depth_anywhere_gives_empty_maps_and_warnings(short: Path, slamcli: Slamcli) -> None:
    faults.repaint(short, "depth", blank(0))
    result, states = run(slamcli, short)
    assert result.exit_code == 1
    assert "no frame has a pose" in result.stderr.splitlines()[-1]
    assert set(states.values()) == {"up to date"}
    assert "depth" in result.stderr.lower()
    assert "Traceback" not in result.output


def n_poses(recording: Path) -> int:
    lines = (recording.parent / "run" / "loop" / "trajectory.txt").read_text().splitlines()
    return sum(not line.startswith("#") for line in lines)


def test_a_recording_of_one_frame_is_mapped(short: Path, slamcli: Slamcli) -> None:
    for kind in ("rgb", "depth"):
        faults.write(short, kind, faults.entries(short, kind)[:1])
    result, states = run(slamcli, short)
    assert result.exit_code == 0, result.output
    assert set(states.values()) == {"up to date"}
    assert n_poses(short) == 1


def test_smaller_depth_of_the_same_view_is_taken(short: Path, slamcli: Slamcli) -> None:
    faults.repaint(short, "depth", lambda picture: cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST))
    result, _ = run(slamcli, short)
    assert result.exit_code == 0, result.output
    assert n_poses(short) == len(faults.entries(short, "rgb"))


def test_depth_of_another_shape_than_colour_is_refused(short: Path, slamcli: Slamcli) -> None:
    faults.repaint(short, "depth", lambda picture: picture[:, : picture.shape[1] // 2])
    result, _ = run(slamcli, short)
    assert result.exit_code == 1
    assert "Traceback" not in result.output
    assert "80 x 120" in result.stderr


def test_depth_of_8_bits(short: Path, slamcli: Slamcli) -> None:
    faults.repaint(short, "depth", lambda picture: (picture // 256).astype(np.uint8))
    result, _ = run(slamcli, short)
    assert "Traceback" not in result.output
    assert "bit" in result.stderr


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"fx": 0.0}, "fx"),
        ({"fy": -80.0}, "fy"),
        ({"cx": 1e9}, "cx"),
        ({"depth_scale": 0.0}, "depth_scale"),
        ({"width": 0}, "width"),
        ({"k1": "x"}, "k1"),
    ],
)
def test_intrinsics_that_cannot_be_right_name_the_key(short: Path, slamcli: Slamcli, change: dict, key: str) -> None:
    camera = json.loads((short / "camera.json").read_text())
    (short / "camera.json").write_text(json.dumps({**camera, **change}))
    result, _ = run(slamcli, short)
    assert result.exit_code == 1
    assert len(result.stderr.strip().splitlines()) == 1
    assert key in result.stderr
    assert "camera.json" in result.stderr


def test_one_unreadable_picture_costs_one_frame(short: Path, slamcli: Slamcli) -> None:
    name = faults.entries(short, "rgb")[3][1]
    data = (short / name).read_bytes()
    (short / name).unlink()
    (short / name).write_bytes(data[: len(data) // 2])
    result, states = run(slamcli, short)
    assert result.exit_code == 0, result.output
    assert set(states.values()) == {"up to date"}
    assert Path(name).name in result.stderr
    record = json.loads((short.parent / "run" / "extract" / "stage.json").read_text())
    assert record["summary"]["bad_images"] == 1
