"""What the options of a run, of the recording and of the camera do."""

import json
import sys
from pathlib import Path

import fakes
import numpy as np
import pytest
from recordings import write_recording

from slamcli.config.options import Config, RecordingConfig, RunConfig
from slamcli.datasets import open_dataset
from slamcli.stages import stage_named


@pytest.fixture(autouse=True)
def _fake_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in fakes.STAGES:
        monkeypatch.setitem(sys.modules, f"slamcli.stages.{name.name}", fakes.module(name))


def results(folder: Path, config: Config) -> dict[str, str]:
    pipeline = fakes.make_run(folder, folder.parent, config)
    pipeline.bring_up_to_date()
    return fakes.digests(pipeline.run)


@pytest.mark.shows("seed")
def test_the_same_seed_gives_the_same_bytes_and_another_one_others(tmp_path: Path) -> None:
    first, again, other = (results(tmp_path / f"run{k}", Config(seed=seed)) for k, seed in enumerate((3, 3, 4)))
    assert first == again and all(first[name] != other[name] for name in first)


@pytest.mark.shows("run.workers")
def test_a_stage_is_given_so_many_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, stage = [], fakes.module(stage_named("extract"))
    work = stage.run
    stage.run = lambda inputs, out, cfg, tools: given.append(tools.workers) or work(inputs, out, cfg, tools)
    monkeypatch.setitem(sys.modules, "slamcli.stages.extract", stage)
    pipeline = fakes.make_run(tmp_path / "run", tmp_path, Config(run=RunConfig(workers=5)))
    pipeline.bring_up_to_date(until="extract")
    assert given == [5]


def opened(folder: Path, **options):
    return open_dataset(str(folder), options=RecordingConfig(**options))


@pytest.mark.shows("recording.start", "recording.end", "recording.every")
def test_a_part_of_the_recording_is_used(tmp_path: Path) -> None:
    """Ten frames at 30 Hz."""
    folder = write_recording(tmp_path / "walk", frames=10)
    whole = opened(folder).stamp
    assert len(whole) == 10
    for options, kept in (({"start": 0.1}, slice(3, 10)), ({"end": 0.1}, slice(0, 4)), ({"every": 4}, slice(0, 10, 4))):
        np.testing.assert_allclose(opened(folder, **options).stamp, whole[kept], atol=1e-6)


@pytest.mark.shows("recording.fps")
def test_frames_without_stamps_are_so_many_a_second(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "walk", frames=6)
    for name in ("rgb", "depth"):
        lines = [f"{i} {name}/{i}.png" for i in range(6)]
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    assert [float(np.diff(opened(folder, fps=rate).stamp).mean()) for rate in (10.0, 20.0)] == pytest.approx([0.1, 0.05])


@pytest.mark.shows("recording.known_camera")
def test_a_known_camera_stands_in_for_a_calibration(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "walk", camera=None)
    assert opened(folder, known_camera="kinect1").camera.fx == pytest.approx(52.5)  # 525 px of 640, in pictures of 64


@pytest.mark.shows("camera")
def test_the_recordings_calibration_is_overridden(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "walk")
    assert json.loads((folder / "camera.json").read_text())["fx"] == 60.0
    found = open_dataset(str(folder), camera=Config(camera={"fx": 70.0}).camera).camera
    assert (found.fx, found.fy) == (70.0, 60.0)
