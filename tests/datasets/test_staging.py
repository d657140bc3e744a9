"""Folders that are complete or absent, whatever happens in between."""

import subprocess
import sys
from pathlib import Path

import pytest

from slamcli.datasets.staging import staged


def test_the_folder_appears_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "a" / "folder"
    with staged(target) as staging:
        (staging / "file").write_text("x")
        assert not target.exists()
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*"))] == ["a", "a/folder", "a/folder/file"]


def test_an_error_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with staged(tmp_path / "folder") as staging:
            (staging / "file").write_text("x")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_is_replaced_and_a_full_one_kept(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with staged(tmp_path / "empty") as staging:
        (staging / "file").write_text("x")
    assert (tmp_path / "empty" / "file").exists()
    with pytest.raises(OSError, match="not empty"), staged(tmp_path / "empty"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    dead, foreign = tmp_path / f".folder.{process.pid}", tmp_path / ".folder.txt"
    dead.mkdir()
    (tmp_path / ".folder.\u00b2").mkdir()
    foreign.write_text("x")
    with staged(tmp_path / "folder"):
        assert not dead.exists() and foreign.exists() and (tmp_path / ".folder.\u00b2").exists()
