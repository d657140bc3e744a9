"""How the program ends when something outside goes wrong: signals, closed or full streams, no memory, no descriptors, a full disk."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import fakes
import pytest
from click.testing import Result
from test_files import largest_file

from slamcli import interruption
from slamcli.stages import STAGES

Slamcli = Callable[..., Result]
FAKE_RUN = (
    "import sys, time, fakes; from slamcli.stages import STAGES; fakes.install(sys.modules)\n"
    "from pathlib import Path; import slamcli.datasets; slamcli.datasets.open_dataset = lambda root, **_: fakes.FakeDataset(Path(root))\n"
    "fakes.make_run(Path('run'), Path('recording'))\n"
)
PROGRAM = "sys.argv[1:] = {arguments!r}\nfrom slamcli.__main__ import main; main()\n"


@pytest.fixture
def place(here: Path) -> Path:
    (here / "recording").mkdir()
    return here


def start(code: str, *, arguments: tuple[str, ...] = ("run", "-r", "run"), **options: object) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", FAKE_RUN + code + PROGRAM.format(arguments=["slamcli", *arguments][1:])]
    return subprocess.Popen(command, env=environment, text=True, **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options})


def listening() -> None:
    """What is started in the background ignores Ctrl-C or a hang-up; a program at a terminal does not."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize(
    ("number", "status", "word"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated"), (signal.SIGHUP, 129, "terminated")],
)
def test_a_signal_ends_a_stage_with_a_word_and_leaves_nothing_half(place: Path, number: int, status: int, word: str) -> None:
    wait = "sys.modules['slamcli.stages.track'] = fakes.module(STAGES[2], lambda out: (print('in', flush=True), time.sleep(60)))\n"
    child = start(wait, preexec_fn=listening)
    try:
        assert child.stdout.readline() == "in\n"
        time.sleep(0.1)
        child.send_signal(number)
        _, said = child.communicate(timeout=30)
    finally:
        child.kill()
        child.wait()
    assert child.returncode == status
    assert said.splitlines()[-1] == f"Error: {word} in track; earlier stages are kept"
    assert not list((place / "run").glob(".*.*"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_libraries_load_needs_no_traceback(place: Path, number: int) -> None:
    child = start(
        f"import os; from slamcli import interruption; interruption.catch(); os.kill(os.getpid(), {int(number)})\n", preexec_fn=listening
    )
    _, said = child.communicate(timeout=60)
    assert child.returncode == 128 + number
    assert len(said.splitlines()) == 1


def test_what_is_ignored_stays_ignored(place: Path) -> None:
    ignored = "import signal, os; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    hang_up = "sys.modules['slamcli.stages.track'] = fakes.module(STAGES[2], lambda out: os.kill(os.getpid(), signal.SIGHUP))\n"
    child = start(ignored + hang_up)
    child.communicate(timeout=60)
    assert child.returncode == 0


def test_ctrl_c_within_a_kernel_is_no_bug(slamcli: Slamcli, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrapped(out: Path) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("CPUDispatcher returned a result with an exception set") from error

    for stage in STAGES:
        monkeypatch.setitem(sys.modules, f"slamcli.stages.{stage.name}", fakes.module(stage))
    monkeypatch.setitem(sys.modules, "slamcli.stages.track", fakes.module(STAGES[2], wrapped))
    pipeline = fakes.make_run(here / "run", here)
    with pytest.raises(interruption.Interrupted, match="^interrupted in track; earlier stages are kept$"):
        pipeline.bring_up_to_date()
    monkeypatch.setitem(
        sys.modules, "slamcli.stages.track", fakes.module(STAGES[2], lambda out: (_ for _ in ()).throw(SystemError("a bug")))
    )
    with pytest.raises(SystemError, match="a bug"):
        pipeline.bring_up_to_date()


@pytest.mark.parametrize("closed", [(2,), (0,), (1, 2), (0, 1, 2)])
def test_closed_streams_stop_nothing_and_get_nothing_into_the_run(place: Path, closed: tuple[int, ...]) -> None:
    child = start("", preexec_fn=lambda: [os.close(number) for number in closed])
    child.communicate(timeout=60)
    assert child.returncode == 0
    assert sorted(path.name for path in (place / "run").glob("[!.]*")) == sorted(
        [*(s.name for s in STAGES), "config.toml", "log.txt", "run.json"]
    )
    for stage in STAGES:
        assert len((place / "run" / stage.name / "out.txt").read_text()) == 64


def test_a_full_error_stream_stops_nothing(place: Path) -> None:
    with open("/dev/full", "w") as full:
        child = start("", stderr=full)
        child.communicate(timeout=60)
    assert child.returncode == 0


def test_results_that_nobody_gets_are_an_error(place: Path) -> None:
    start("").communicate(timeout=60)
    with open("/dev/full", "w") as full:
        child = start("", arguments=("status", "-r", "run"), stdout=full)
        _, said = child.communicate(timeout=60)
    assert child.returncode != 0
    assert "Traceback" not in said


@pytest.mark.parametrize("limit", [0, 30, 1500, 4096])
def test_a_full_disk_stops_a_run_with_a_line_that_names_the_place(slamcli: Slamcli, room_run: Path, tmp_path: Path, limit: int) -> None:
    import shutil

    run = Path(shutil.copytree(room_run, tmp_path / "run"))
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name not in ("log.txt", ".lock")}
    with largest_file(limit):
        result = slamcli("run", "-r", run, "--from", "extract")
    assert result.exit_code == 1
    error = [line for line in result.stderr.splitlines() if line.startswith("Error")]
    assert len(error) == 1
    assert "(File too large; choose" in error[0] and str(run) in error[0]
    assert {path: path.read_bytes() for path in before} == before
    assert not list(run.glob(".*.*"))


@pytest.mark.parametrize("mebibytes", [640, 760, 1023])
def test_a_run_begins_no_stage_where_libraries_could_end_it_without_a_word(room_run: Path, tmp_path: Path, mebibytes: int) -> None:
    """Below a gibibyte of address space threads of C libraries abort, now and then; above, what lacks memory is told by our own."""
    run, amount = Path(shutil.copytree(room_run, tmp_path / "run")), mebibytes << 20
    done = subprocess.run(
        [sys.executable, "-m", "slamcli", "run", "-r", str(run), "--from", "densify"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (amount, amount)),
    )
    assert done.returncode == 1
    assert f"Error: this process may reserve {mebibytes} MiB" in done.stderr and "ulimit -v unlimited" in done.stderr


def test_too_few_descriptors_and_too_little_memory_are_told(room_run: Path, tmp_path: Path) -> None:
    for limit, amount in ((resource.RLIMIT_NOFILE, 9), (resource.RLIMIT_AS, 250 << 20)):
        command = [sys.executable, "-m", "slamcli", "export-mesh", str(tmp_path / "m.ply"), "-r", str(room_run)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            preexec_fn=lambda: resource.setrlimit(limit, (amount, amount)),  # noqa: B023
        )
        assert done.returncode == 1
        assert "Traceback" not in done.stderr
        assert done.stderr.splitlines()[-1].startswith("Error: ")
        assert not list(tmp_path.iterdir())
