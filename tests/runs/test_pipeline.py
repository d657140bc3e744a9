"""Staleness with its reasons, early cut-off, resuming after kill -9, determinism, one writer, what a stage may see."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import fakes
import pytest

from slamcli import console
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.runs.pipeline import Inputs, Pipeline, Settings, Tools
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES, STAGES, stage_named

ALL = list(NAMES)


@pytest.fixture
def pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pipeline:
    """A finished run of fake stages."""
    for stage in STAGES:
        monkeypatch.setitem(sys.modules, f"slamcli.stages.{stage.name}", fakes.module(stage))
    (tmp_path / "recording").mkdir()
    made = fakes.make_run(tmp_path / "run", tmp_path / "recording")
    made.bring_up_to_date()
    return made


def told_as_run(capsys: pytest.CaptureFixture) -> list[str]:
    """The stages whose closing line was printed."""
    lines = [line.split() for line in capsys.readouterr().err.splitlines()]
    return [words[0] for words in lines if words[0] in NAMES and "up" not in words]


def under(pipeline: Pipeline, *assignments: str) -> Pipeline:
    """The same run with other settings."""
    return Pipeline(pipeline.run, toml.apply(pipeline.config, assignments), dataset=pipeline.dataset(), tell=console.say)


def not_fresh(pipeline: Pipeline) -> dict[str, str]:
    return {name: state.reason or state.state for name, state in pipeline.states().items() if not state.is_fresh}


def after(first: str, *, reason: str, section: str = "") -> dict[str, str]:
    """The stages that a stale `first` pulls along: for the same reason if they declare the section, else for a need that is stale."""
    found = {first: reason}
    for stage in STAGES[NAMES.index(first) + 1 :]:
        stale = [need for need in stage.needs if need in found]
        if section in stage.config:
            found[stage.name] = reason
        elif stale:
            found[stage.name] = f"input: {stale[0]} is stale"
    return found


def test_a_finished_run_is_up_to_date_and_nothing_runs_again(pipeline: Pipeline) -> None:
    assert not_fresh(pipeline) == {}
    stamps = {name: (pipeline.run.path / name / "stage.json").stat().st_mtime_ns for name in NAMES}
    pipeline.bring_up_to_date()
    assert {name: (pipeline.run.path / name / "stage.json").stat().st_mtime_ns for name in NAMES} == stamps


@pytest.mark.parametrize(
    ("option", "value", "first"),
    [
        ("extract.features", 700, "extract"),
        ("match.method", "brute", "match"),
        ("track.min_inliers", 20, "track"),
        ("loop.enabled", False, "loop"),
        ("densify.voxel", 0.02, "densify"),
        ("ground.method", "paper", "densify"),
        ("octree.resolution", 0.1, "octree"),
        ("grid2d.resolution", 0.1, "grid2d"),
    ],
)
def test_an_edit_makes_exactly_the_right_stages_stale(pipeline: Pipeline, option: str, value: object, first: str) -> None:
    section, _, name = option.partition(".")
    before = getattr(getattr(Config(), section), name)
    edited = under(pipeline, f"{option}={json.dumps(value)}")
    assert not_fresh(edited) == after(first, reason=f"config: {option} {before} -> {value}", section=section)


def test_another_camera_concerns_extract_first(pipeline: Pipeline) -> None:
    edited = under(pipeline, "camera.fx=500")
    assert not_fresh(edited) == after("extract", reason="config: camera.fx unset -> 500.0")


def test_every_option_makes_the_stages_that_declare_it_stale_and_says_so(pipeline: Pipeline) -> None:
    for name, section in toml._sections().items():
        for spec in dataclasses.fields(section):
            value = getattr(getattr(pipeline.config, name), spec.name)
            changed = f"{value}x" if isinstance(value, str) else not value if isinstance(value, bool) else (value, 1)
            config = dataclasses.replace(pipeline.config, **{name: dataclasses.replace(section(), **{spec.name: changed})})
            states = Pipeline(pipeline.run, config, dataset=pipeline.dataset()).states()
            said = {stage for stage, state in states.items() if f"{name}.{spec.name} " in state.reason}
            assert said == {stage.name for stage in STAGES if name in stage.config}, f"{name}.{spec.name}"


def test_the_seed_concerns_every_stage(pipeline: Pipeline) -> None:
    assert not_fresh(under(pipeline, "seed=1")) == dict.fromkeys(ALL, "config: seed 0 -> 1")


def test_threads_concern_none(pipeline: Pipeline) -> None:
    assert not_fresh(under(pipeline, "run.workers=7")) == {}


def test_another_content_of_the_recording_is_noticed_by_whoever_reads_it(pipeline: Pipeline) -> None:
    changed = Pipeline(pipeline.run, pipeline.config, dataset=fakes.FakeDataset(pipeline.dataset().root, "other frames"))
    assert not_fresh(changed) == after("extract", reason="input: the recording has changed")


def test_the_same_bytes_again_stop_the_chain(pipeline: Pipeline, capsys: pytest.CaptureFixture) -> None:
    edited = under(pipeline, "extract.cell=40")  # the fake's output ignores it
    assert list(not_fresh(edited)) == ALL
    capsys.readouterr()
    edited.bring_up_to_date()
    assert told_as_run(capsys) == ["extract"]


def test_from_until_and_force_choose_stages(pipeline: Pipeline, capsys: pytest.CaptureFixture) -> None:
    def ran(**choice: object) -> list[str]:
        capsys.readouterr()
        pipeline.bring_up_to_date(**choice)
        return told_as_run(capsys)

    assert ran(start="loop") == list(NAMES[NAMES.index("loop") :])
    assert ran(start="match", until="track") == ["match", "track"]
    assert ran(force=True, until="match") == ["extract", "match"]
    assert ran(until="extract") == []
    with pytest.raises(SlamError, match="track comes before loop"):
        pipeline.bring_up_to_date(start="loop", until="track")


def test_a_stage_alone_runs_even_when_fresh_and_only_it(pipeline: Pipeline, caplog: pytest.LogCaptureFixture) -> None:
    before = fakes.digests(pipeline.run)
    pipeline.run_alone("track")
    assert fakes.digests(pipeline.run) == before
    under(pipeline, "track.min_inliers=20").run_alone("track")
    changed = {name for name, digest in fakes.digests(pipeline.run).items() if digest != before[name]}
    assert changed == {"track"}
    assert not_fresh(under(pipeline, "track.min_inliers=20"))["optimize"] == "config: track.min_inliers 15 -> 20"
    caplog.clear()
    under(pipeline, "track.min_inliers=20").run_alone("loop")
    assert "loop rests on optimize, which is stale (config: track.min_inliers 15 -> 20)" in caplog.text


def test_a_stage_alone_says_which_stage_it_waits_for(tmp_path: Path) -> None:
    pipeline = fakes.make_run(tmp_path / "run", tmp_path)
    with pytest.raises(
        SlamError, match=r"^track needs match, which has not been run; try: slamcli.open_run\(.*\).update\(until='match'\)$"
    ):
        pipeline.run_alone("track")


def test_a_file_that_an_option_names_counts_by_its_content(pipeline: Pipeline, tmp_path: Path) -> None:
    vocabulary = tmp_path / "words.npz"
    vocabulary.write_bytes(b"one")
    named = under(pipeline, f"match.vocabulary={vocabulary}")
    named.bring_up_to_date()
    vocabulary.write_bytes(b"two")
    assert not_fresh(named) == after("match", reason="input: match.vocabulary has changed")
    vocabulary.unlink()
    assert not_fresh(named) == {}
    with pytest.raises(SlamError, match="words.npz is not there"):
        named.run_alone("match")


def test_a_recording_that_is_gone_is_believed_and_that_is_said(pipeline: Pipeline) -> None:
    pipeline.dataset().root.rmdir()
    gone = Pipeline(pipeline.run, pipeline.config)
    states = gone.states()
    assert all(state.is_fresh for state in states.values())
    assert "recording: the recording is not there any more" in " ".join(gone.notes(states))
    gone.run_alone("track")
    with pytest.raises(SlamError, match="the recording is not there any more; put it back"):
        gone.run_alone("extract")


@pytest.mark.parametrize("name", NAMES)
def test_killed_inside_a_stage_the_same_command_finishes_with_the_same_bytes(pipeline: Pipeline, name: str, tmp_path: Path) -> None:
    root, path = pipeline.dataset().root, tmp_path / "killed"
    kill(path, root, name, "inside")
    run = RunDir.find(str(path))
    assert [leftover.name for leftover in path.glob(f".{name}.*")], "the half-written folder is there"
    assert [stage for stage, state in run.states().items() if state.is_fresh] == ALL[: NAMES.index(name)]
    resumed = fakes.make_run(path, root)
    with run.lock():
        resumed.bring_up_to_date()
    assert fakes.digests(run) == fakes.digests(pipeline.run)
    assert not list(path.glob(".*.*")), "nothing dead is left"


def test_killed_between_the_two_renames_the_earlier_result_comes_back(pipeline: Pipeline) -> None:
    path, before = pipeline.run.path, fakes.digests(pipeline.run)
    kill(path, pipeline.dataset().root, "track", "commit")
    assert not (path / "track").exists()
    assert (path / ".track.old" / "out.txt").exists()
    with pipeline.run.lock():
        assert fakes.digests(pipeline.run) == before
    assert not_fresh(pipeline) == {}
    assert not list(path.glob(".track.*"))


def kill(path: Path, root: Path, stage: str, where: str) -> None:
    code = f"import fakes; fakes.run_and_die({str(path)!r}, {str(root)!r}, {stage!r}, {where!r})"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=path.parent, timeout=60)
    assert done.returncode == -9


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(pipeline: Pipeline, tmp_path: Path) -> None:
    again = fakes.make_run(tmp_path / "again", pipeline.dataset().root)
    again.bring_up_to_date()
    assert fakes.digests(again.run) == fakes.digests(pipeline.run)
    other = fakes.make_run(tmp_path / "other", pipeline.dataset().root, toml.apply(Config(), ["seed=5"]))
    other.bring_up_to_date()
    assert not set(fakes.digests(other.run).values()) & set(fakes.digests(pipeline.run).values())


@pytest.mark.parametrize("error", [RuntimeError("a bug"), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_whatever_goes_wrong_in_a_stage_the_result_before_stays(
    pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def fail(out: Path) -> None:
        raise error

    before = fakes.digests(pipeline.run)
    monkeypatch.setitem(sys.modules, "slamcli.stages.track", fakes.module(stage_named("track"), fail))
    with pytest.raises(type(error)) as caught:
        pipeline.run_alone("track")
    if isinstance(error, KeyboardInterrupt):
        assert str(caught.value) == "interrupted in track; earlier stages are kept"
    assert fakes.digests(pipeline.run) == before
    assert not list(pipeline.run.path.glob(".track.*"))


def test_a_stage_sees_only_what_its_row_declares(pipeline: Pipeline) -> None:
    track = stage_named("track")
    settings = Settings(track, Config())
    assert settings.seed == 0
    assert settings.track == Config().track
    for hidden in ("extract", "run", "grid2d"):
        with pytest.raises(AttributeError, match=hidden):
            getattr(settings, hidden)
    inputs = Inputs(track, pipeline.run, pipeline.dataset)
    assert inputs.path("match", "out.txt").exists()
    with pytest.raises(AttributeError, match="loop"):
        inputs.path("loop")
    with pytest.raises(AttributeError, match="dataset"):
        _ = inputs.dataset


def test_random_numbers_follow_from_seed_and_stage_alone() -> None:
    draws = {(seed, name): Tools(name, toml.apply(Config(), [f"seed={seed}"])).rng().random() for seed in (0, 1) for name in NAMES}
    assert len(set(draws.values())) == len(draws)
    assert Tools("track", Config()).rng().random() == draws[0, "track"]


def test_the_first_record_keeps_what_is_wrong_with_the_recording(pipeline: Pipeline) -> None:
    assert pipeline.run.record("extract")["warnings"] == ["rgb.txt: 2 repeated stamps"]
    assert pipeline.run.record("densify")["warnings"] == []


def test_the_record_tells_what_a_stage_cost_and_said(pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    import numpy as np

    made = fakes.module(stage_named("match"))

    def run(inputs, out, cfg, tools):
        held = np.ones(8 << 20)
        for i in range(150):
            tools.warn(f"frame {i} is dark")
        return {"frames": 10, "rms": np.float64(held[0] / 2), "worst": np.nan, "sizes": np.arange(2)}

    made.run = run
    monkeypatch.setitem(sys.modules, "slamcli.stages.match", made)
    pipeline.run_alone("match")
    record = pipeline.run.record("match")
    assert record["summary"] == {"frames": 10, "rms": 0.5, "worst": None, "sizes": [0, 1]}
    assert len(record["warnings"]) == 100
    assert record["n_warnings"] == 150
    assert record["fps"] == pytest.approx(10 / record["seconds"], rel=0.2)
    assert 0 <= record["cpu_seconds"] < 60
    assert 64 < record["peak_rss_mb"] < 1 << 14
    assert record["key"].startswith("sha256:")
    assert set(record["inputs"]) == {"extract"}
