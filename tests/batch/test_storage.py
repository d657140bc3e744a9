"""Runs and recordings that lie elsewhere: complete or absent, checked, and never outside their folder."""

import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("fsspec", reason="runs elsewhere need fsspec")

from slamcli import files
from slamcli.batch import storage
from slamcli.batch.storage import StoredRun
from slamcli.errors import SlamError
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES


@pytest.fixture
def stored(room_run: Path, tmp_path: Path) -> str:
    """A URL at which a run is stored; below it is a folder of this machine, so that a test can look."""
    url = f"file://{tmp_path}/stored/run"
    run = StoredRun(url, room_run)
    for stage in NAMES:
        run.push(stage, "s3://bucket/room")
    return url


def folder_of(url: str) -> Path:
    return Path(url.removeprefix("file://"))


def test_a_run_comes_back_byte_for_byte_and_names_the_recording_where_it_lies(
    stored: str, room_run: Path, room: Path, tmp_path: Path
) -> None:
    assert json.loads((folder_of(stored) / "run.json").read_text())["root"] == "s3://bucket/room"
    StoredRun(stored, tmp_path / "copy").pull(str(room))
    copy, original = RunDir(tmp_path / "copy"), RunDir(room_run)
    assert {name: copy.record(name) for name in NAMES} == {name: original.record(name) for name in NAMES}
    assert all(state.is_fresh for state in copy.states(verify=True).values())
    assert copy.info() == original.info()
    assert storage.finished_stages(stored) == list(NAMES)


def test_a_stage_without_its_record_is_absent_and_a_damaged_file_too(stored: str, tmp_path: Path) -> None:
    (folder_of(stored) / "loop" / "stage.json").unlink()
    trajectory = folder_of(stored) / "track" / "trajectory.txt"
    trajectory.write_text(trajectory.read_text().replace("0.", "1.", 1))
    (folder_of(stored) / "grid2d" / "map.pgm").unlink()
    StoredRun(stored, tmp_path / "copy").pull("/data/room")
    there = [name for name in NAMES if (tmp_path / "copy" / name).exists()]
    assert there == ["extract", "match", "optimize", "densify", "octree"]
    assert [path.name for path in (tmp_path / "copy").glob(".*")] == [".lock"], "nothing half-copied is left"


def test_the_record_is_stored_last(room_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, order = StoredRun(f"file://{tmp_path}/run", room_run), []
    monkeypatch.setattr(StoredRun, "_put", lambda self, name: order.append(name))
    run.push("match", "/data/room")
    names = [name for name in order if name.startswith("match/")]
    assert names[-1] == "match/stage.json" and len(names) == len(RunDir(room_run).record("match")["outputs"]) + 1


def test_a_changed_stage_replaces_the_stored_one_and_an_equal_one_is_not_sent_again(stored: str, room_run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(room_run, tmp_path / "mine")
    before = (folder_of(stored) / "loop" / "stage.json").stat().st_mtime_ns
    StoredRun(stored, copy).push("loop", "/data/room")
    assert (folder_of(stored) / "loop" / "stage.json").stat().st_mtime_ns == before
    record = files.read_sealed(copy / "loop" / "stage.json")
    files.write_sealed(copy / "loop" / "stage.json", {**record, "seconds": 99.0})
    StoredRun(stored, copy).push("loop", "/data/room")
    assert json.loads((folder_of(stored) / "loop" / "stage.json").read_text())["seconds"] == 99.0


@pytest.mark.parametrize("name", ["../../outside.txt", "/etc/slamcli-outside", "a/../../../b"])
def test_a_stored_record_whose_files_lie_elsewhere_is_not_followed(stored: str, tmp_path: Path, name: str) -> None:
    path = folder_of(stored) / "match" / "stage.json"
    files.write_sealed(path, {**files.read_sealed(path), "outputs": {name: {"bytes": 1, "sha256": ""}}})
    StoredRun(stored, tmp_path / "deep" / "copy").pull("/data/room")
    assert not (tmp_path / "deep" / "copy" / "match").exists()
    assert not list(tmp_path.glob("**/outside.txt"))


def test_a_damaged_run_json_makes_the_run_absent(stored: str, tmp_path: Path) -> None:
    path = folder_of(stored) / "run.json"
    path.write_text(path.read_text().replace("bucket", "basket"))
    StoredRun(stored, tmp_path / "copy").pull("/data/room")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize("text", ["", "[]", "{", '{"outputs": 3}', "[" * 100000])
def test_a_hostile_record_is_no_record(stored: str, tmp_path: Path, text: str) -> None:
    (folder_of(stored) / "match" / "stage.json").write_text(text)
    StoredRun(stored, tmp_path / "copy").pull("/data/room")
    assert not (tmp_path / "copy" / "match").exists()


def test_a_recording_is_copied_whole_or_not_at_all(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = storage.fetch_recording(f"file://{room}", tmp_path / "copies")
    assert copy == tmp_path / "copies" / "room"
    assert {p.relative_to(copy): p.read_bytes() for p in copy.rglob("*") if p.is_file()} == {
        p.relative_to(room): p.read_bytes() for p in room.rglob("*") if p.is_file()
    }
    single = storage.fetch_recording(f"file://{room}/rgb.txt", tmp_path / "copies")
    assert single.read_text() == (room / "rgb.txt").read_text()
    with pytest.raises(SlamError, match="no such recording"):
        storage.fetch_recording(f"file://{tmp_path}/nowhere", tmp_path / "copies")
    monkeypatch.setattr(Path, "rename", lambda *_: (_ for _ in ()).throw(OSError("killed")))
    with pytest.raises(OSError, match="killed"):
        storage.fetch_recording(f"file://{room}", tmp_path / "others")
    assert not (tmp_path / "others" / "room").exists()


def test_text_too_large_or_absent_is_said(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match=r"list.txt: cannot be read"):
        storage.read_text(str(tmp_path / "list.txt"))
    with pytest.raises(SlamError, match="cannot be read"):
        storage.read_text(f"file://{tmp_path}/list.txt")
    (tmp_path / "list.txt").write_bytes(b"x" * (storage.LARGEST_TEXT + 1))
    for place in (str(tmp_path / "list.txt"), f"file://{tmp_path}/list.txt"):
        with pytest.raises(SlamError, match="too large"):
            storage.read_text(place)
