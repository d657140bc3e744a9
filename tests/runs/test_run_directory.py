"""The run directory: which one is meant, damage, locks, commits, and what it says when it is not what it should be."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import fakes
import pytest

from slamcli import files
from slamcli.cli import evaluate
from slamcli.config.options import Config
from slamcli.errors import Damaged, SlamError
from slamcli.runs import damage, places
from slamcli.runs.creation import writing
from slamcli.runs.pipeline import Pipeline
from slamcli.runs.run_directory import RunDir
from slamcli.schema import FORMAT
from slamcli.stages import NAMES, STAGES


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunDir:
    """A finished run of fake stages."""
    for stage in STAGES:
        monkeypatch.setitem(sys.modules, f"slamcli.stages.{stage.name}", fakes.module(stage))
    (tmp_path / "recording").mkdir()
    pipeline = fakes.make_run(tmp_path / "runs" / "fake", tmp_path / "recording")
    pipeline.bring_up_to_date()
    monkeypatch.chdir(tmp_path)
    return pipeline.run


def create(path: Path, root: str = "/recording", digest: str = "sha256:1") -> RunDir:
    return RunDir.create(path, dataset="fake", root=root, digest=digest)


# which run


def test_the_named_run_goes_before_the_environment_and_that_before_the_latest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b", "c"):
        create(Path("runs") / name)
    RunDir(Path("runs/c")).mark_latest()
    assert RunDir.find(None).path == Path("runs/c")
    monkeypatch.setenv("SLAMCLI_RUN", "runs/b")
    assert RunDir.find(None).path == Path("runs/b")
    assert RunDir.find("runs/a").path == Path("runs/a")


def test_latest_follows_a_run_kept_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    create(tmp_path / "far" / "away").mark_latest()
    assert RunDir.find(None).path.resolve() == (tmp_path / "far" / "away").resolve()
    create(Path("runs") / "near").mark_latest()
    assert os.readlink("runs/latest") == "near"
    assert sorted(os.listdir("runs")) == ["latest", "near"]


def test_no_latest_where_the_current_folder_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = create(tmp_path / "far")
    monkeypatch.chdir(tmp_path)
    Path("runs").write_text("a file, not a folder")
    run.mark_latest()


def test_no_run_and_no_such_run_say_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SlamError, match=r'make one with: slamcli.run\("demo"\), or name one with path'):
        RunDir.find(None)
    with pytest.raises(SlamError, match="runs/x: not a run directory"):
        RunDir.find("runs/x")


def test_a_bare_name_is_one_under_runs_whether_it_is_there_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert places.named("fast") == Path("runs/fast")
    create(places.named("fast"))
    assert RunDir.find("fast").path == places.named("fast") == Path("runs/fast")
    with pytest.raises(SlamError, match=r"^runs/slow: not a run directory .*path='runs/slow'\)$"):
        RunDir.find("slow")


@pytest.mark.parametrize("path", ["./fast", "sub/fast", "/sub/fast", "..", ".", "fast/"])
def test_a_path_means_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert places.named(path) == Path(path)


def test_what_is_here_counts_before_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fast").mkdir()
    assert places.named("fast") == Path("fast")  # a folder, if no run yet
    create(Path("runs") / "fast")
    assert places.named("fast") == RunDir.find("fast").path == Path("runs/fast")  # a run counts before a folder
    create(Path("fast"))
    assert places.named("fast") == RunDir.find("fast").path == Path("fast")
    Path("slow").write_text("a file")
    assert places.named("slow") == Path("runs/slow")
    Path("desk/rgb").mkdir(parents=True)
    assert places.named("desk") == Path("runs/desk")  # the recording itself


def test_latest_is_no_name_for_a_new_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SlamError, match="no run here yet"):
        places.named("latest")
    create(Path("runs") / "near").mark_latest()
    assert places.named("latest").resolve() == (tmp_path / "runs" / "near").resolve()


@pytest.mark.parametrize("name", ["", "..", "../x", "/etc", "latest", "a/../../b"])
def test_no_recording_name_leads_out_of_runs(name: str) -> None:
    with pytest.raises(SlamError, match="name one with path"):
        places.default_path(name)


def test_a_run_belongs_to_one_recording_which_may_move_or_change(tmp_path: Path) -> None:
    path = tmp_path / "run"
    create(path, "/old", "sha256:1")
    assert create(path, "/new", "sha256:1").info()["root"] == "/new"
    assert create(path, "/new", "sha256:2").info()["digest"] == "sha256:2"
    with pytest.raises(
        SlamError, match=r"holds a run of another recording \(/new\); name another folder with path, or add .*\.add\(RECORDING\)$"
    ):
        create(path, "/other", "sha256:3")


def test_a_folder_of_something_else_is_never_taken_over(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(SlamError, match="not empty and not a run directory"):
        create(tmp_path)
    assert os.listdir(tmp_path) == ["thesis.txt"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f'{{"format": {FORMAT + 1}}}', f"a run of format {FORMAT + 1}, this slamcli reads {FORMAT}"),
        (f'{{"format": {FORMAT - 1}, "sealed": "sha256:0"}}', f"a run of format {FORMAT - 1}, this slamcli reads {FORMAT}"),
        (f'{{"format": {FORMAT}}}', "not as slamcli wrote it; restore it with: slamcli.open_run("),
        ("{", "not valid JSON"),
        ("", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("[]", "not a JSON object"),
    ],
)
def test_a_run_of_another_version_or_a_broken_one_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(SlamError) as caught:
        RunDir.find(str(tmp_path))
    assert message in str(caught.value)


# what a stage left


def state(run: RunDir, stage: str, *, verify: bool = False) -> tuple[str, str]:
    found = run.states(verify=verify)[stage]
    return found.state, found.reason


def test_a_short_file_is_damage_and_so_is_an_absent_one(run: RunDir) -> None:
    out = run.path / "loop" / "out.txt"
    out.write_text("")
    assert state(run, "loop") == ("damaged", "loop/out.txt has 0 bytes, 64 recorded")
    assert state(run, "densify") == ("stale", "input: loop is damaged")
    out.unlink()
    assert state(run, "loop") == ("damaged", "loop/out.txt is not there")


def test_other_content_of_the_same_size_is_found_by_verify(run: RunDir) -> None:
    (run.path / "loop" / "out.txt").write_text("x" * 64)
    assert state(run, "loop") == ("up to date", "")
    assert state(run, "loop", verify=True) == ("damaged", "loop/out.txt has other content than recorded")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "loop/stage.json: not valid JSON"),
        ("{}", "loop/stage.json: not as slamcli wrote it"),
        (json.dumps({"format": FORMAT, "outputs": {"a": 1}}), "loop/stage.json: not as slamcli wrote it"),
        (None, "loop/stage.json: not there"),
    ],
)
def test_a_broken_record_is_damage(run: RunDir, text: str | None, reason: str) -> None:
    path = run.path / "loop" / "stage.json"
    path.unlink() if text is None else path.write_text(text)
    assert state(run, "loop") == ("damaged", reason)


def test_a_record_is_read_once_and_again_after_each_write(run: RunDir, monkeypatch: pytest.MonkeyPatch) -> None:
    path = run.path / "loop" / "stage.json"
    time.sleep(2e-9 * files.TICK_NS)
    record = run.record("loop")
    with monkeypatch.context() as patch:
        patch.setattr(files, "read_sealed", lambda path: pytest.fail("read again"))
        run.record("loop").clear()  # a caller's own
        assert RunDir(run.path).record("loop") == record
    content = bytearray(path.read_bytes())
    content[10] ^= 1
    path.write_bytes(content)
    with pytest.raises(Damaged, match="loop/stage.json"):
        run.record("loop")
    files.write_sealed(path, {**record, "seconds": 99.0})
    assert run.record("loop") == {**record, "seconds": 99.0}


def test_a_record_is_read_again_where_the_clock_of_its_files_may_not_have_ticked(run: RunDir, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two writes within a tick give a file one time, and perhaps one size."""
    now = time.time_ns()
    monkeypatch.setattr(files, "version", lambda path: (1, 2, 3, now, now))
    record = run.record("loop")
    files.write_sealed(run.path / "loop" / "stage.json", {**record, "seconds": 99.0})
    assert run.record("loop") == {**record, "seconds": 99.0}


def test_no_more_records_are_kept_than_a_few_runs_have(run: RunDir, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(damage, "MOST_RECORDS", 3)
    monkeypatch.setattr(damage, "_records", {})
    time.sleep(2e-9 * files.TICK_NS)
    for name in NAMES:
        run.record(name)
        assert len(damage._records) <= 3


def test_a_file_in_the_place_of_a_stage_is_no_stage(run: RunDir, caplog: pytest.LogCaptureFixture) -> None:
    """What was made from it can still be read, with a word."""
    shutil.rmtree(run.path / "loop")
    (run.path / "loop").write_text("mine")
    assert run.stage_path("densify", "out.txt").is_file()
    assert "densify is stale (input: loop is missing)" in caplog.text
    with pytest.raises(SlamError, match="loop is not there any more"):
        run.stage_path("loop")


@pytest.mark.parametrize("entry", [{}, {"bytes": "64", "sha256": ""}, 3])
def test_a_hostile_record_is_damage_and_no_traceback(run: RunDir, entry: object) -> None:
    record = run.record("loop")
    files.write_sealed(run.path / "loop" / "stage.json", {**record, "outputs": {"../../../etc/passwd": entry}})
    assert state(run, "loop") == ("damaged", "loop/stage.json: not a stage's record")


def test_a_record_that_lacks_anything_is_damage(run: RunDir) -> None:
    record = run.record("loop")
    for name in record.keys() - {"format", "key", "recording"}:
        files.write_sealed(run.path / "loop" / "stage.json", {key: value for key, value in record.items() if key != name})
        assert state(run, "loop") == ("damaged", "loop/stage.json: not a stage's record")


def test_damage_is_mended_by_running_again(run: RunDir) -> None:
    before = fakes.digests(run)
    (run.path / "loop" / "out.txt").write_text("")
    (run.path / "match" / "stage.json").write_text("{")
    pipeline = Pipeline(run, run.config(), dataset=fakes.FakeDataset(Path(run.info()["root"])))
    pipeline.bring_up_to_date()
    assert all(found.is_fresh for found in run.states(verify=True).values())
    assert fakes.digests(run) == before


def test_a_result_of_another_version_is_stale(run: RunDir) -> None:
    record = run.record("track")
    for change, reason in (
        ({"code": {**record["code"], "slam/tracker.py": "0" * 12}}, "code: slam/tracker.py changed"),
        ({"format": FORMAT - 1}, f"code: format {FORMAT - 1} -> {FORMAT}"),
    ):
        files.write_sealed(run.path / "track" / "stage.json", {**record, **change})
        assert state(run, "track")[0] == "stale"
        assert state(run, "track")[1].startswith(reason)


def test_a_missing_stage_is_named_with_the_command_that_makes_it(run: RunDir, caplog: pytest.LogCaptureFixture) -> None:
    assert run.stage_path("loop", "out.txt").read_text()
    assert not caplog.text
    with pytest.raises(SlamError, match=r"loop/cloud.ply: not there; make it with: slamcli.open_run\(.*\).run_stage\('loop'\)$"):
        run.stage_path("loop", "cloud.ply")
    shutil.rmtree(run.path / "loop")
    with pytest.raises(SlamError, match=r"loop is not there any more; make it anew with: slamcli.open_run\(.*\).update\(until='loop'\)$"):
        run.stage_path("loop")
    for stage in NAMES[NAMES.index("loop") + 1 :]:
        shutil.rmtree(run.path / stage)
    with pytest.raises(SlamError, match=r"loop has not been run; try: slamcli.open_run\(.*\).update\(until='loop'\)$"):
        run.stage_path("loop")


def test_reading_a_stale_result_warns_once(run: RunDir, caplog: pytest.LogCaptureFixture) -> None:
    run.write_config(dataclasses.replace(run.config(), seed=1))
    run.stage_path("loop")
    run.stage_path("loop")
    assert caplog.text.count("loop is stale (config: seed 0 -> 1); bring it up to date with: slamcli.open_run(") == 1


# writing


def test_a_second_writer_is_refused_and_told_who_the_first_is(run: RunDir) -> None:
    with run.lock():
        with pytest.raises(SlamError, match=f"in use by another slamcli \\(process {os.getpid()}\\)"), RunDir(run.path).lock():
            pass
        code = f"from slamcli.runs.run_directory import RunDir; from pathlib import Path\nwith RunDir(Path({str(run.path)!r})).lock(): pass"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
        assert "in use by another slamcli" in done.stderr
    with RunDir(run.path).lock():
        pass


@pytest.mark.parametrize("name", [".lock", "log.txt"])
def test_a_run_from_someone_else_makes_no_other_file_change_and_no_command_wait(run: RunDir, tmp_path: Path, name: str) -> None:
    other, place = tmp_path / "precious", run.path / name
    other.write_text("precious")
    place.unlink(missing_ok=True)
    place.symlink_to(other)
    with pytest.raises(SlamError, match=f"{name}: a link has the place"), writing(run, Config()):
        pass
    assert other.read_text() == "precious"
    place.unlink()
    os.mkfifo(place)
    with pytest.raises(SlamError, match=f"{name}: a device or a pipe has the place"), writing(run, Config()):
        pass


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_what_leads_out_of_a_run_is_replaced_and_not_written_through(run: RunDir, tmp_path: Path, kind: str) -> None:
    other = tmp_path / "precious"
    other.write_text("precious")
    for name in ("config.toml", "run.json", "report.html"):
        (run.path / name).unlink(missing_ok=True)
        (run.path / name).symlink_to(other) if kind == "link" else os.mkfifo(run.path / name)
    run.restore()
    assert run.config() == Config() and run.info()["dataset"] == "fake"
    assert not run.own_file("report.html").exists()
    assert other.read_text() == "precious"


def test_figures_are_kept_within_the_run_and_not_where_a_link_in_it_leads(run: RunDir, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (run.path / "eval").symlink_to(elsewhere)
    evaluate._record(run, "ape.json", {"rmse": 0.1})
    assert not list(elsewhere.iterdir()) and files.read_sealed(run.path / "eval" / "ape.json")["rmse"] == 0.1


def test_readers_need_no_lock_and_no_permission_to_write(run: RunDir) -> None:
    with run.lock():
        assert set(run.states()) == set(NAMES)
        assert run.config() == Config()


def test_leftovers_of_the_dead_are_cleared_once_the_lock_is_held(run: RunDir) -> None:
    for leftover in (".track.4711", ".track.old", "recordings/.monday.part"):
        (run.path / leftover).mkdir(parents=True)
        (run.path / leftover / "half").write_text("x")
    before = fakes.digests(run)
    with run.lock():
        pass
    assert not list(run.path.glob(".track.*")) and not list((run.path / "recordings").iterdir())
    assert fakes.digests(run) == before


def test_outputs_lists_every_file_by_name_in_order(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    for name in ("b.txt", "a.txt", "sub/c.txt"):
        (tmp_path / name).write_text(name)
    found = damage.outputs(tmp_path)
    assert list(found) == ["a.txt", "b.txt", "sub/c.txt"]
    assert found["sub/c.txt"]["bytes"] == 9


def test_small_files_are_replaced_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "config.toml"
    files.write_text(path, "old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(SlamError, match="config.toml: cannot be written .No space left on device; free some space"):
        files.write_text(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["config.toml"]
