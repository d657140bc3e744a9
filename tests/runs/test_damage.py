"""One flipped bit, one missing end: noticed by whoever reads the file, repaired by `run`, and never a traceback."""

import json
import os
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path

import fakes
import pytest
from click.testing import Result

from slamcli import files
from slamcli.cli.main import cli
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.errors import Damaged, SlamError
from slamcli.runs import damage, housekeeping
from slamcli.runs.pipeline import Inputs, Pipeline
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Features
from slamcli.stages import NAMES, STAGES, stage_named

Slamcli = Callable[..., Result]
CHANGED = ["track.min_inliers=21", "grid2d.resolution=0.1", "seed=3", "match.window=2"]


@pytest.fixture
def pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pipeline:
    """A finished run of fake stages with settings of its own."""
    for stage in STAGES:
        monkeypatch.setitem(__import__("sys").modules, f"slamcli.stages.{stage.name}", fakes.module(stage))
    (tmp_path / "recording").mkdir()
    made = fakes.make_run(tmp_path / "run", tmp_path / "recording", toml.apply(Config(), CHANGED))
    with made.run.lock():
        made.bring_up_to_date()
    return made


def contents(run: Path) -> dict[str, bytes]:
    return {str(path.relative_to(run)): path.read_bytes() for path in sorted(run.rglob("*")) if path.is_file()}


def flip(path: Path, *, bit: int | None = None) -> None:
    """Flip one bit, which one follows from the file's name."""
    data = bytearray(path.read_bytes())
    bit = zlib.crc32(str(path.name).encode()) % (8 * len(data)) if bit is None else bit
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def repaired(pipeline: Pipeline) -> RunDir:
    """What `slamcli run` does."""
    run = RunDir.find(str(pipeline.run.path), restore=True)
    with run.lock():
        Pipeline(run, run.config(), dataset=fakes.FakeDataset(Path(run.info()["root"]))).bring_up_to_date()
    return run


@pytest.mark.parametrize("spoil", [flip, cut, Path.unlink])
def test_whatever_file_is_spoilt_run_makes_it_what_it_was(pipeline: Pipeline, spoil: Callable[[Path], None]) -> None:
    path, before = pipeline.run.path, contents(pipeline.run.path)
    digests, created = fakes.digests(pipeline.run), pipeline.run.info()["created"]
    for name in before:
        if name in (".lock", "log.txt"):
            continue
        spoil(path / name)
        run = repaired(pipeline)
        assert fakes.digests(run) == digests, name
        assert run.config() == pipeline.config, name
        assert {**run.info(), "created": created} == {**pipeline.run.info(), "created": created}
        assert all(state.is_fresh for state in run.states(verify=True).values()), name
        changed = {key for key, value in contents(path).items() if value != before[key] and not key.endswith("stage.json")}  # its times
        assert changed <= {".lock", "run.json"}, name


def test_every_single_bit_of_the_run_s_own_files_counts(pipeline: Pipeline) -> None:
    run = pipeline.run
    for name, read in (("run.json", run.info), ("config.toml", run.config), ("loop/stage.json", lambda: run.record("loop"))):
        good = (run.path / name).read_bytes()
        for bit in range(0, 8 * len(good), 7):
            flip(run.path / name, bit=bit)
            with pytest.raises(SlamError, match="not "):
                read()
            (run.path / name).write_bytes(good)
        read()


def test_a_configuration_cut_short_is_not_taken_for_one_of_few_words(pipeline: Pipeline) -> None:
    path = pipeline.run.path / "config.toml"
    good = path.read_text()
    for n in (0, 1, good.index("[match]"), good.rindex("#"), len(good) - 1):
        path.write_text(good[:n])
        with pytest.raises(SlamError, match=r"restore it .* with: slamcli.open_run\(.*, restore=True\).update\(\)"):
            pipeline.run.config()
    (pipeline.run.path / "log.txt").touch()
    for stage in NAMES:
        shutil.rmtree(pipeline.run.path / stage)
    run = RunDir(pipeline.run.path)
    run.restore()
    assert run.config() == Config()


def test_without_any_record_the_recording_must_be_named(pipeline: Pipeline) -> None:
    path = pipeline.run.path
    for stage in NAMES:
        shutil.rmtree(path / stage)
    flip(path / "run.json")
    with pytest.raises(SlamError, match=r"run.json: not .*slamcli.run\(TARGET, path="):
        RunDir.find(str(path), restore=True)
    info = RunDir.create(path, dataset="fake", root="/elsewhere", digest="sha256:1").info()
    assert info["root"] == "/elsewhere"


def test_damaged_findings_are_named_and_removed_for_no_stage_makes_them(pipeline: Pipeline, caplog: pytest.LogCaptureFixture) -> None:
    run = pipeline.run
    (run.path / "eval").mkdir()
    figures = [run.path / "eval" / "ape.json", run.path / "inspection.json"]
    for path in figures:
        files.write_sealed(path, {"rmse": 0.01})
    assert run.damaged_figures() == [] and pipeline.notes(pipeline.states()) == []
    flip(figures[0], bit=13)
    assert run.damaged_figures() == ["eval/ape.json"]
    assert any("eval/ape.json is damaged" in note for note in pipeline.notes(pipeline.states()))
    with pytest.raises(Damaged, match=r"eval/ape\.json: it is damaged"):
        housekeeping.archive(run, run.path.parent / "run.zip")
    repaired(pipeline)
    assert [path.exists() for path in figures] == [False, True]
    assert "eval/ape.json was damaged, and is removed" in caplog.text


def test_a_record_is_read_only_where_a_result_rests_on_it(pipeline: Pipeline, caplog: pytest.LogCaptureFixture) -> None:
    flip(pipeline.run.path / "octree" / "stage.json")
    RunDir(pipeline.run.path).stage_path("densify")
    assert caplog.text == ""
    RunDir(pipeline.run.path).stage_path("grid2d")
    assert "grid2d is stale (input: octree is damaged)" in caplog.text
    flip(pipeline.run.path / "match" / "stage.json")
    RunDir(pipeline.run.path).stage_path("densify")
    assert "densify is stale (input: match is damaged)" in caplog.text


def test_a_foreign_folder_is_not_restored(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / "config.toml").write_text("mine = true")
    (tmp_path / "eval").mkdir()
    (tmp_path / "eval" / "mine.json").write_text("[]")
    RunDir(tmp_path).restore()
    assert (tmp_path / "config.toml").read_text() == "mine = true"
    assert (tmp_path / "eval" / "mine.json").read_text() == "[]"
    assert sorted(os.listdir(tmp_path)) == ["config.toml", "eval", "run.json"]


def test_a_stage_and_an_export_refuse_an_altered_input(pipeline: Pipeline) -> None:
    flip(pipeline.run.path / "match" / "out.txt")
    inputs = Inputs(stage_named("track"), pipeline.run, pipeline.dataset)
    for read in (lambda: inputs.path("match", "out.txt"), lambda: pipeline.run.stage_path("match", "out.txt")):
        with pytest.raises(
            SlamError,
            match=r"match/out.txt has other content than recorded: it is damaged; repair it with: slamcli.open_run\(.*, restore=True\).update\(\)$",
        ):
            read()
    with pytest.raises(SlamError, match="other content"):
        pipeline.run_alone("track")
    with pytest.raises(SlamError, match=r"stamp.npy: not there; make it with: slamcli.open_run\(.*\).run_stage\('extract'\)$"):
        pipeline.run.load(Features, "extract")


@pytest.fixture
def real(room_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room_run, tmp_path / "run"))


READERS = [["export-trajectory", "t.txt"], ["export-cloud", "c.ply"], ["export-octree", "o.bt"], ["export-grid", "g.pgm"], ["status"]]


def test_no_command_ends_in_a_traceback_or_a_wrong_file_where_a_bit_is_flipped(slamcli: Slamcli, real: Path, here: Path) -> None:
    """Every seventh file in turn; scripts/kills.py has them all."""
    for command in READERS[:-1]:
        assert slamcli(*command, "-r", real).exit_code == 0
    good = {path.name: path.read_bytes() for path in here.glob("*.*")}
    names = [path for path in sorted(real.rglob("*.*")) if path.is_file() and path.name != "log.txt" and not path.name.startswith(".")]
    noticed = 0
    for path in names[::7]:
        before = path.read_bytes()
        flip(path)
        for command in READERS:
            result = slamcli(*command, "-r", real)
            assert result.exit_code in (0, 1)
            noticed += result.exit_code
        path.write_bytes(before)
        assert {path.name: path.read_bytes() for path in here.glob("*.*")} == good
    assert noticed > 0


def test_run_repairs_a_real_run(slamcli: Slamcli, real: Path) -> None:
    spoilt = [real / "match" / "word.npy", real / "loop" / "stage.json", real / "densify" / "cloud.ply", real / "config.toml"]
    before = [path.read_bytes() for path in (spoilt[0], spoilt[2], spoilt[3])]
    for path in spoilt:
        flip(path)
    result = slamcli("run", "-r", real)
    assert result.exit_code == 0, result.stderr
    assert "config.toml was damaged; restored from what the stages recorded" in result.stderr
    assert [path.read_bytes() for path in (spoilt[0], spoilt[2], spoilt[3])] == before
    assert files.read_sealed(spoilt[1])["stage"] == "loop"


def test_every_stage_is_a_command_that_says_what_is_damaged(slamcli: Slamcli, real: Path) -> None:
    for name in NAMES[1:]:
        needed = next(need for need in stage_named(name).needs if need in NAMES)
        path = next(path for path in sorted((real / needed).glob("*.npy")))
        flip(path)
        result = slamcli(name, "-r", real)
        assert (result.exit_code, "damaged" in result.stderr) in {(1, True), (0, False)}, result.stderr
        flip(path)
    assert set(NAMES) <= set(cli.commands)


def test_a_run_of_another_version_is_refused_and_stays_as_it_is(slamcli: Slamcli, room_run: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(room_run, tmp_path / "run"))
    info = {name: value for name, value in files.read_json(run / "run.json").items() if name != files.SEAL}
    (run / "run.json").write_text(json.dumps({**info, "format": 4}))
    (run / "config.toml").write_text("[track]\nrelocalise_inliers = 50\n")
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name != ".lock"}
    for command in (("run", "-r", run), ("status", "-r", run)):
        result = slamcli(*command)
        assert result.exit_code == 1
        assert "a run of format 4" in result.stderr.splitlines()[-1]
    assert {path: path.read_bytes() for path in before} == before


def test_a_run_with_an_option_of_another_version_says_so(tmp_path: Path) -> None:
    """The file is whole, so that the user has not mistyped: without a word of the version he would look for his own slip."""
    text = b"[densify]\nnoise_of_old = 0.5\n"
    (tmp_path / "config.toml").write_bytes(text + damage.seal(text))
    with pytest.raises(
        SlamError, match=r"noise_of_old is not known.*another version of slamcli made this run; start another one with path"
    ):
        damage.read_config(tmp_path / "config.toml")
    with pytest.raises(SlamError, match="another version of slamcli made this run"):
        damage.restored_config({"densify": {"config": {"densify": {"noise_of_old": 0.5}}}})
