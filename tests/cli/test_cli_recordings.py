"""formats, convert, and the options that choose a part of a recording."""

import json
from pathlib import Path

import numpy as np
import pytest
from recordings import write_recording

from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.datasets import READERS, open_dataset


def test_formats_lists_every_reader_and_what_tells_it(slamcli) -> None:
    listed = slamcli("formats").stdout.splitlines()
    assert len(listed) == len(READERS)
    rows = json.loads(slamcli("formats", "--json").stdout)
    assert [row["name"] for row in rows] == [reader.name for reader in READERS]
    assert all(row["title"] and row["told_by"] for row in rows)
    assert {row["extra"] for row in rows} == {"", "video", "phone"}


def test_convert_writes_a_recording_that_is_read_the_same(slamcli, tmp_path: Path) -> None:
    source = write_recording(tmp_path / "walk", frames=12)
    (source / "groundtruth.txt").write_text("0.0 1 2 3 0 0 0 1\n0.2 1 2 4 0 0 0 1\n")
    slamcli("convert", source, tmp_path / "out", "--start", "0.09", "--every", "2")
    before, after = open_dataset(str(source)), open_dataset(str(tmp_path / "out"))
    assert len(after) == 5 and after.warnings == []
    np.testing.assert_allclose(after.stamp, before.stamp[3::2], atol=1e-6)
    for i in range(5):
        assert np.array_equal(after.rgb(i), before.rgb(3 + 2 * i))
        np.testing.assert_array_equal(after.depth(i), before.depth(3 + 2 * i))
    assert after.camera == before.camera
    assert after.ground_truth().T_wc[1, 2, 3] == 4.0


def test_convert_does_not_write_over_anything(slamcli, tmp_path: Path) -> None:
    source = write_recording(tmp_path / "walk")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x")
    failed = slamcli("convert", source, tmp_path / "out")
    assert failed.exit_code == 1 and "exists already" in failed.stderr and (tmp_path / "out" / "mine.txt").read_text() == "x"


def test_inspect_takes_a_part_of_a_recording(slamcli, tmp_path: Path) -> None:
    source = write_recording(tmp_path / "walk", frames=30)
    facts = json.loads(slamcli("inspect", source, "--end", "0.5", "--json").stdout)["facts"]
    assert facts["frames"] == 16


@pytest.mark.parametrize(
    ("flags", "settings"),
    [
        (["--start", "1.5", "--end", "9", "--every", "3"], {"start": 1.5, "end": 9.0, "every": 3}),
        (["--fps", "15"], {"fps": 15.0}),
        (["--camera", "d435"], {"known_camera": "d435"}),
    ],
)
def test_flags_of_run_become_settings_of_the_run(slamcli, monkeypatch: pytest.MonkeyPatch, flags: list[str], settings: dict) -> None:
    from slamcli import api

    seen = {}

    def run(target: str, **options: object) -> None:
        seen.update(options)
        raise SystemExit(0)

    monkeypatch.setattr(api, "run", run)
    slamcli("run", "anything", *flags)
    config = toml.resolve(Config(), None, seen["settings"])
    assert {key: getattr(config.recording, key) for key in settings} == settings
    assert config.optimize.intrinsics == ("--camera" in flags)
