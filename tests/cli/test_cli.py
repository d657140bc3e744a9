"""The commands as their user meets them: where a run goes, what is said where, exit statuses, one-line errors."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import click
import fakes
import pytest
from click.shell_completion import ShellComplete
from click.testing import Result

import slamcli as package
from slamcli import console, datasets, files
from slamcli.cli.main import cli
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.slam.doubt import Finding, to_summary
from slamcli.stages import NAMES, STAGES, stage_named

Slamcli = Callable[..., Result]
MIN_INLIERS = Config().track.min_inliers


@pytest.fixture
def fake(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Fake stages, and a fake recording under any name that is a folder here."""
    for stage in STAGES:
        monkeypatch.setitem(sys.modules, f"slamcli.stages.{stage.name}", fakes.module(stage))

    def open_dataset(target: str, *, camera: dict | None = None, **_: object) -> fakes.FakeDataset:
        if not Path(target).is_dir():
            raise SlamError(f"{target}: no such recording")
        made = fakes.FakeDataset(Path(target), content=f"{Path(target).name} {camera}")
        made.name = Path(target).name
        return made

    monkeypatch.setattr("slamcli.inspection.quick_look", lambda dataset: [])  # a fake has no images; loads what keeps the true open_dataset
    monkeypatch.setattr(datasets, "open_dataset", open_dataset)
    for name in ("desk", "room"):
        (here / "recordings" / name).mkdir(parents=True)
    return here


def states(slamcli: Slamcli, *arguments: object) -> dict[str, str]:
    return {row["stage"]: row["state"] for row in json.loads(slamcli("status", "--json", *arguments).stdout)}


# run


def test_run_makes_a_run_named_after_the_recording_and_prints_where(fake: Path, slamcli: Slamcli) -> None:
    result = slamcli("run", "recordings/desk")
    assert (result.exit_code, result.stdout) == (0, "runs/desk\n")
    made = ["trajectory", "cloud", "octree", "grid", "cost", "warnings"]
    assert [line.split()[0] for line in result.stderr.splitlines()] == ["desk", "Warning:", *NAMES, *made, "map", "next:", *["slamcli"] * 2]
    assert "extract: rgb.txt: 2 repeated stamps" in result.stderr
    assert "3 frames" in result.stderr
    assert os.readlink("runs/latest") == "desk"
    assert sorted(os.listdir("runs/desk")) == sorted([*NAMES, ".lock", "config.toml", "log.txt", "run.json"])


def test_a_finished_run_tells_what_it_made_and_what_comes_next(fake: Path, slamcli: Slamcli) -> None:
    told = slamcli("run", "recordings/desk").stderr
    for text in ("2 of 3 frames, 2 loops closed", "500 points", "60 occupied and 70 free cells", "8 x 9 cells", "grid2d/map.pgm"):
        assert text in told
    assert "next: slamcli report -r runs/desk\n" in told  # without a true trajectory there is nothing to evaluate
    (fake / "recordings" / "desk" / "groundtruth.txt").write_text("")
    assert "next: slamcli eval ape -r runs/desk\n      slamcli report -r runs/desk\n" in slamcli("run").stderr


def test_what_a_run_made_as_json(fake: Path, slamcli: Slamcli) -> None:
    made = json.loads(slamcli("run", "recordings/desk", "--json").stdout)
    assert made["run"] == "runs/desk"
    assert list(made["stages"]) == list(NAMES)
    assert made["stages"]["loop"]["summary"]["closures"] == 2
    assert made["map"] is None  # the fake stages make no map
    assert json.loads(slamcli("run", "recordings/desk", "--until", "track", "--json").stdout)["next"][0].endswith("-r runs/desk")


def test_quiet_tells_nothing_but_warnings_and_where_the_run_is(fake: Path, slamcli: Slamcli) -> None:
    result = slamcli("run", "recordings/desk", "--quiet")
    assert result.stdout == "runs/desk\n"
    assert result.stderr == "Warning: extract: rgb.txt: 2 repeated stamps\n"


def test_a_run_that_stops_on_the_way_tells_no_outcome(fake: Path, slamcli: Slamcli) -> None:
    assert "next:" not in slamcli("run", "recordings/desk", "--until", "octree").stderr


def test_run_again_runs_nothing_and_run_without_target_goes_on(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "--until", "track")
    assert states(slamcli)["optimize"] == "missing"
    result = slamcli("run")
    assert result.stdout == "runs/desk\n"
    assert result.stderr.count("up to date") == 3
    assert set(states(slamcli).values()) == {"up to date"}
    assert slamcli("run", "recordings/desk").stderr.count("up to date") == len(NAMES)


def test_a_run_goes_where_it_is_told(fake: Path, slamcli: Slamcli, monkeypatch: pytest.MonkeyPatch) -> None:
    assert slamcli("run", "recordings/desk", "-r", "out/mine").stdout == "out/mine\n"
    assert slamcli("status").stdout.startswith(f"{Path('out/mine')}: desk")
    monkeypatch.setenv("SLAMCLI_RUN", "out/env")
    assert slamcli("run", "recordings/room").stdout == "out/env\n"
    result = slamcli("run", "recordings/desk")
    assert result.exit_code == 1
    assert "out/env: holds a run of another recording" in result.stderr


def test_the_run_keeps_its_settings(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "-s", "track.min_inliers=20", "--until", "extract")
    assert slamcli("config", "track.min_inliers").stdout.splitlines()[-1] == "min_inliers = 20"
    slamcli("run", "recordings/desk", "-s", "seed=3", "--until", "extract")
    assert slamcli("config", "track.min_inliers").stdout.splitlines()[-1] == "min_inliers = 20"
    assert slamcli("config", "seed").stdout == "seed = 3\n"
    slamcli("run", "--config", "default", "--until", "extract")
    assert slamcli("config", "seed").stdout == "seed = 0\n"


def test_a_camera_given_once_stays_with_the_run(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "-s", "camera.fx=500")
    assert set(states(slamcli).values()) == {"up to date"}
    assert slamcli("run", "recordings/desk").stderr.count("up to date") == len(NAMES)
    assert states(slamcli, "-s", "camera.fx=510")["extract"] == "stale"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "recordings/none"], "recordings/none: no such recording"),
        (["run", "recordings/desk", "-s", "track.min_inlier=3"], "did you mean track.min_inliers?"),
        (["run", "recordings/desk", "--config", "quick"], "configuration quick: neither a file nor one of"),
        (["run", "recordings/desk", "--from", "loop", "--until", "track"], "track comes before loop"),
        (["run"], "make one with: slamcli run demo"),
        (["status"], "make one with: slamcli run demo"),
        (["track"], "make one with: slamcli run demo"),
        (["status", "-r", "recordings"], "runs/recordings: not a run directory"),
        (["run", "recordings/desk", "-r", "./recordings"], "the folder is not empty and not a run directory"),
    ],
)
def test_what_the_user_can_mend_is_one_line_and_status_1(fake: Path, slamcli: Slamcli, arguments: list[str], message: str) -> None:
    result = slamcli(*arguments)
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.startswith("Error: ")
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["statsu"], "Did you mean 'status'?"),
        (["run", "a", "--unti", "track"], "--until"),
        (["run", "a", "--until", "trak"], "'track'"),
        (["run", "a", "b"], "needs a name, such as -r runs/house"),
    ],
)
def test_usage_errors_are_status_2_and_suggest(slamcli: Slamcli, arguments: list[str], message: str) -> None:
    result = slamcli(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr


def fail_with(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(out: Path) -> None:
        raise error

    monkeypatch.setitem(sys.modules, "slamcli.stages.match", fakes.module(stage_named("match"), fail))


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (OSError(28, "No space left on device", "runs/desk/.match.1/word.npy"), 1, "No space left on device; free some space"),
        (PermissionError(13, "Permission denied", "x"), 1, "Error: x: Permission denied; choose a place you may write to"),
        (MemoryError(), 1, "Error: out of memory"),
        (SlamError("rgb.txt: empty"), 1, "Error: rgb.txt: empty"),
        (KeyboardInterrupt(), 130, "Error: interrupted in match; earlier stages are kept"),
    ],
)
def test_what_ends_a_stage_early_is_told_in_a_line_and_keeps_what_was_done(
    fake: Path, slamcli: Slamcli, monkeypatch: pytest.MonkeyPatch, error: BaseException, status: int, said: str
) -> None:
    fail_with(error, monkeypatch)
    result = slamcli("run", "recordings/desk")
    assert result.exit_code == status
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert states(slamcli) == {"extract": "up to date", **dict.fromkeys(NAMES[1:], "missing")}


def test_ctrl_c_that_numba_turned_into_another_error_is_still_ctrl_c(fake: Path, slamcli: Slamcli, monkeypatch: pytest.MonkeyPatch) -> None:
    error = SystemError("CPUDispatcher returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    fail_with(error, monkeypatch)
    result = slamcli("run", "recordings/desk")
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-1] == "Error: interrupted in match; earlier stages are kept"
    fail_with(SystemError("a bug of its own"), monkeypatch)
    with pytest.raises(SystemError):
        slamcli("run", "recordings/desk")


def test_a_bug_keeps_its_traceback(fake: Path, slamcli: Slamcli, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_with(ZeroDivisionError("a bug"), monkeypatch)
    with pytest.raises(ZeroDivisionError):
        slamcli("run", "recordings/desk")


def test_no_permission_to_write_is_one_line(fake: Path, slamcli: Slamcli) -> None:
    (fake / "runs").write_text("a file is in the way")
    result = slamcli("run", "recordings/desk")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: runs")
    assert result.stderr.count("\n") == 1


def test_ctrl_c_ends_the_program_with_130(fake: Path) -> None:
    code = (
        "import signal, sys, time, fakes; from slamcli.stages import STAGES; fakes.install(sys.modules)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # what is started in the background ignores it
        "sys.modules['slamcli.stages.track'] = fakes.module(STAGES[2], lambda out: (print('in', flush=True), time.sleep(60)))\n"
        f"from pathlib import Path; fakes.make_run(Path('run'), Path({str(fake / 'recordings' / 'desk')!r}))\n"
        "import slamcli.datasets; slamcli.datasets.open_dataset = lambda root, **_: fakes.FakeDataset(Path(root))\n"
        "from slamcli.cli.main import cli; cli(['run', '-r', 'run'])\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment, text=True)
    try:
        assert child.stdout.readline() == "in\n"
        time.sleep(0.1)
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=30)
    finally:
        child.kill()
        child.wait()
    assert child.returncode == 130
    assert said.splitlines()[-1] == "Error: interrupted in track; earlier stages are kept"
    assert not list((fake / "run").glob(".track.*"))


# one stage


def test_a_stage_command_edits_the_settings_and_runs_only_that_stage(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk")
    result = slamcli("track", "-s", "track.min_inliers=20")
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stderr.splitlines()] == ["track", "not"]
    behind = ", ".join(NAMES[NAMES.index("track") + 1 :])
    assert result.stderr.endswith(f"not up to date now: {behind}; make them anew with: slamcli run -r runs/desk\n")
    after = states(slamcli)
    assert [name for name in NAMES if after[name] == "up to date"] == ["extract", "match", "track"]
    assert slamcli("grid2d").stderr.startswith(
        f"Warning: grid2d rests on loop, which is stale (config: track.min_inliers {MIN_INLIERS} -> 20)"
    )


def test_a_stage_command_names_what_is_missing(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "--until", "match")
    result = slamcli("loop")
    assert result.exit_code == 1
    assert result.stderr == "Error: loop needs optimize, which has not been run; try: slamcli run --until optimize -r runs/desk\n"


# status


def test_status_tells_state_reason_and_time(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk")
    (fake / "runs/desk/loop/out.txt").write_text("")
    result = slamcli("status", "-s", "track.min_inliers=20")
    lines = {line.split()[0]: " ".join(line.split()) for line in result.stdout.splitlines()[1:]}
    assert lines["extract"].startswith("extract up to date 0.")
    assert lines["extract"].endswith(" fps 1 warning") and lines["match"].endswith(" fps")
    assert lines["track"].endswith(f"config: track.min_inliers {MIN_INLIERS} -> 20")
    assert lines["optimize"].endswith(f"config: track.min_inliers {MIN_INLIERS} -> 20"), "hindsight reads it too"
    assert lines["loop"].endswith("loop/out.txt has 0 bytes, 64 recorded")
    assert slamcli("config", "track.min_inliers").stdout.endswith(f"= {MIN_INLIERS}\n"), "status changed the run"


def test_status_json_has_the_promised_keys(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "--until", "match")
    rows = json.loads(slamcli("status", "--json").stdout)
    assert [row["stage"] for row in rows] == list(NAMES)
    assert all({"stage", "state", "reason", "seconds", "fps", "cpu_seconds", "peak_rss_mb"} <= set(row) for row in rows)
    assert rows[0]["seconds"] >= 0
    assert rows[0]["fps"] > 0
    assert (rows[2]["state"], rows[2]["seconds"], rows[2]["fps"]) == ("missing", None, None)


def test_status_verify_reads_every_byte(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk")
    (fake / "runs/desk/octree/out.txt").write_text("x" * 64)
    assert states(slamcli)["octree"] == "up to date"
    assert states(slamcli, "--verify")["octree"] == "damaged"


def test_status_says_that_the_recording_is_gone(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk")
    (fake / "recordings" / "desk").rmdir()
    result = slamcli("status")
    assert "desk: the recording is not there any more" in result.stdout
    assert set(states(slamcli).values()) == {"up to date"}
    assert "the recording is not there any more" in slamcli("status", "--json").stderr


def test_status_says_what_was_made_with_other_versions(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk")
    path = fake / "runs/desk/match/stage.json"
    record = files.read_sealed(path)
    files.write_sealed(path, {**record, "environment": {**record["environment"], "numpy": "1.0"}})
    result = slamcli("status")
    assert "note: match made with numpy 1.0, here is" in result.stdout
    assert set(states(slamcli).values()) == {"up to date"}


# the rest


def test_two_commands_on_one_run_at_a_time(fake: Path, slamcli: Slamcli) -> None:
    from slamcli.runs.run_directory import RunDir

    slamcli("run", "recordings/desk")
    with RunDir.find(None).lock():
        for command in (["run"], ["track"], ["run", "recordings/desk"]):
            result = slamcli(*command)
            assert result.exit_code == 1
            assert "in use by another slamcli" in result.stderr
        assert slamcli("status").exit_code == 0


def test_everything_that_was_said_is_in_the_log(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk")
    slamcli("track", "-s", "track.min_inliers=20")
    slamcli("grid2d")
    text = (fake / "runs/desk/log.txt").read_text()
    lines = text.splitlines()
    assert all(re.fullmatch(r" *\d+\.\d{3} s  [-a-z0-9]+ +(DEBUG|INFO|WARNING|ERROR) +\S.*", line) for line in lines)
    told = [re.split("  +", line.strip(), maxsplit=3) for line in lines]
    assert [stage for _, stage, level, message in told if message.startswith("done  ")] == [*NAMES, "track", "grid2d"]
    assert ["-", "WARNING", next(message for *_, message in told if message.startswith("grid2d rests on loop"))] in [
        row[1:] for row in told
    ]
    assert ["extract", "INFO", "begins: missing"] in [row[1:] for row in told]
    starts = [row for row in told if "slamcli" in row[3] and "desk" in row[3] and row[0] == "0.000 s"]
    assert len(starts) == 3 == sum(row[1:] == ["-", "INFO", "ended"] for row in told)
    assert all(float(a[0][:-2]) <= float(b[0][:-2]) or b in starts for a, b in pairwise(told))


def test_status_tells_what_was_warned_of_with_v(fake: Path, slamcli: Slamcli, monkeypatch: pytest.MonkeyPatch) -> None:
    module = fakes.module(stage_named("loop"))
    run = module.run

    def warn(inputs, out, cfg, tools) -> dict:
        for i in range(103):
            tools.warn(f"frame {i} is lost")
        texts = ("frame 7 is lost", "poses are doubtful")
        return {**run(inputs, out, cfg, tools), **to_summary(Finding("sign", text) for text in texts)}

    module.run = warn
    monkeypatch.setitem(sys.modules, "slamcli.stages.loop", module)
    slamcli("run", "recordings/desk")
    short, long = slamcli("status"), slamcli("status", "-v")
    assert "  104 warnings" in short.stdout and "poses are doubtful" not in short.stdout
    assert short.stderr == "what was warned of: slamcli status -v -r runs/desk\n"
    assert "extract: rgb.txt: 2 repeated stamps\n" in long.stdout and "warned of" not in long.stderr
    assert [line for line in long.stdout.splitlines() if line.startswith("loop: ")] == [
        *(f"loop: frame {i} is lost" for i in range(100)),
        "loop: poses are doubtful",
        "loop: 3 more; they are in log.txt",
    ]
    row = next(row for row in json.loads(slamcli("status", "--json").stdout) if row["stage"] == "loop")
    assert row["n_warned"] == 104 and len(row["warned"]) == 101 and row["warned"][-1] == "poses are doubtful"
    assert slamcli("status", "-r", "runs/desk", "--quiet").stderr == ""


def test_each_line_of_a_traceback_is_a_line_of_the_log(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), console.log_file(tmp_path / "log.txt", "a test"), console.at_work("match"):
        1 / 0  # noqa: B018
    lines = (tmp_path / "log.txt").read_text().splitlines()
    assert len(lines) > 4 and all(re.match(r" *\d+\.\d{3} s  - +(INFO|DEBUG)  ", line) for line in lines)
    assert lines[-1].endswith("ZeroDivisionError: division by zero")


def test_v_tells_more_on_either_side_of_the_command(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk")
    for arguments in (["-v", "run", "--from", "grid2d"], ["run", "--from", "grid2d", "-v"]):
        assert "grid2d: begins: asked for" in slamcli(*arguments).stderr
    assert "asked for" not in slamcli("run", "--from", "grid2d").stderr


def test_config_without_a_run_shows_the_defaults(here: Path, slamcli: Slamcli) -> None:
    from slamcli.config import toml

    assert slamcli("config").stdout == toml.dump(Config())
    assert slamcli("config", "--defaults", "--explain").stdout == toml.dump(Config(), explain=True)
    assert "[extract]" in slamcli("config", "--config", "fast").stdout
    assert slamcli("config", "trak.min_inliers").exit_code == 1


def test_version(slamcli: Slamcli) -> None:
    assert package.__version__ in slamcli("--version").stdout


def every_command(group: click.Group, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], click.Command]]:
    found = []
    for name, command in group.commands.items():
        found.append(((*path, name), command))
        if isinstance(command, click.Group):
            found += every_command(command, (*path, name))
    return found


@pytest.mark.parametrize("path", [path for path, _ in every_command(cli)], ids=" ".join)
def test_every_command_has_help(slamcli: Slamcli, path: tuple[str, ...]) -> None:
    result = slamcli(*path, "--help")
    assert result.exit_code == 0
    assert len(result.stdout.splitlines()) > 4


def test_each_stage_is_a_command() -> None:
    assert set(NAMES) <= set(cli.commands)


def test_config_tells_what_is_changed_finds_by_word_and_speaks_json(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "-s", "track.min_inliers=20", "--until", "extract")
    changed = slamcli("config", "--changed").stdout
    assert changed.splitlines()[1:] == ["min_inliers = 20  # default: 15"]
    assert slamcli("config", "--changed", "loop").stdout == "# nothing differs from the defaults\n"
    assert "band_high" in slamcli("config", "--explain", "passable").stdout
    assert json.loads(slamcli("config", "--json").stdout)["track"]["min_inliers"] == 20
    assert json.loads(slamcli("config", "--json", "--changed").stdout) == {"track": {"min_inliers": 20}}
    assert json.loads(slamcli("config", "--json", "seed", "track.min_inliers").stdout) == {"seed": 0, "track": {"min_inliers": 20}}
    assert slamcli("config", "--json", "trak").exit_code == 1
    unknown = slamcli("config", "--explain", "frobnicate")
    assert (unknown.exit_code, unknown.stdout) == (1, "")


def test_a_stage_takes_a_configuration_too(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "--until", "extract")
    assert slamcli("extract", "--config", "fast").exit_code == 0
    assert slamcli("config", "extract.features").stdout.splitlines()[-1] == "features = 600"


def completed(*arguments: str, incomplete: str) -> list[str]:
    found = ShellComplete(cli, {}, "slamcli", "_SLAMCLI_COMPLETE").get_completions(list(arguments), incomplete)
    return [item.value for item in found]


def test_recordings_runs_configurations_and_settings_are_completed(fake: Path, slamcli: Slamcli) -> None:
    slamcli("run", "recordings/desk", "--until", "extract")
    (fake / "data" / "tum" / "fr1_desk").mkdir(parents=True)
    assert completed("run", incomplete="de") == ["demo"]
    assert completed("run", incomplete="tum/") == ["tum/fr1_desk"]
    assert completed("status", "-r", incomplete="runs/") == ["runs/desk", "runs/latest"]
    for arguments in (["inspect"], ["convert"], ["batch"], ["inspect-features"], ["localize", "runs/desk"], ["add", "runs/desk"]):
        assert completed(*arguments, incomplete="de") == ["demo"], arguments
    for arguments in (["compare"], ["eval", "ape"], ["eval", "rpe"], ["localize"], ["add"]):
        assert completed(*arguments, incomplete="runs/d") == ["runs/desk"], arguments
    assert completed("run", "--config", incomplete="f") == ["fast"]
    assert completed("run", "-s", incomplete="track.min_") == ["track.min_inliers="]
    assert completed("run", "-s", incomplete="match.method=") == ["match.method=words", "match.method=brute"]
    assert completed("run", "-s", incomplete="loop.enabled=f") == ["loop.enabled=false"]
    assert completed("run", "-s", incomplete="nothing.here=") == []
