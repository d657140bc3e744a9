"""What many tests share: a tiny simulated room, a finished run of it, and the command line in one process."""

import os
from collections.abc import Callable
from pathlib import Path

import option_marks as options
import pytest
from click.testing import CliRunner, Result
from hypothesis import settings

from slamcli.jit import compilation
from slamcli.runs.places import LATEST

LATEST_BEFORE = pytest.StashKey[tuple[Path, str | None]]()
ROOM_FRAMES = 40
ROOM = {"seed": 1, "frames": ROOM_FRAMES, "laps": 0.15, "width": 160, "height": 120}  # settings of the simulated recording `room`

# A kernel's first call compiles it, which takes longer than any deadline; and the same examples every time, as a red run must be repeatable.
settings.register_profile("slamcli", deadline=None, derandomize=True)
settings.load_profile("slamcli")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the check of the tests that show what options do."""
    parser.addoption("--disconnected", action="store_true", help="with -m shows: name the options that a test does not miss")


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels once, before several processes begin to test with them; remember which run was the latest here."""
    if not hasattr(config, "workerinput"):
        latest = LATEST.absolute()
        config.stash[LATEST_BEFORE] = latest, os.readlink(latest) if latest.is_symlink() else None
        compilation.ensure()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Let `runs/latest` lead where it led before: tests make runs in folders that are gone afterwards."""
    latest, target = config.stash.get(LATEST_BEFORE, (None, None))
    if latest is None or not latest.is_symlink() or os.readlink(latest) == target:
        return
    latest.unlink()
    if target is not None:
        latest.symlink_to(target)
    elif not any(latest.parent.iterdir()):
        latest.parent.rmdir()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the slow tests unless they are asked for."""
    if "SLAMCLI_SLOW" not in os.environ:
        for item in items:
            if item.get_closest_marker("slow"):
                item.add_marker(pytest.mark.skip(reason="slow: set SLAMCLI_SLOW=1 to run it"))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Under --disconnected, note which of the options that a test shows it misses where nothing can set them."""
    if not pyfuncitem.config.getoption("--disconnected"):
        return None
    for name in options.shown_by(pyfuncitem):
        arguments = {key: pyfuncitem.funcargs[key] for key in pyfuncitem._fixtureinfo.argnames}
        if "tmp_path" in arguments:
            arguments["tmp_path"] = arguments["tmp_path"] / name
            arguments["tmp_path"].mkdir()
        options.note(name, is_missed=options.is_missed(name, lambda arguments=arguments: pyfuncitem.obj(**arguments)))
    return True


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where no test missed an option."""
    if dead := options.not_missed():
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
        session.config.get_terminal_writer().line(f"\nno test misses {', '.join(dead)}")


@pytest.fixture(autouse=True)
def _no_run_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SLAMCLI_RUN", raising=False)


@pytest.fixture
def slamcli() -> Callable[..., Result]:
    """Run a command in this process: ``slamcli("status", "--json")``; a bug in it raises here instead of becoming a status."""
    from slamcli.cli.main import cli

    def invoke(*arguments: object) -> Result:
        result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
        if result.exception and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return invoke


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, so that `runs/` is the test's own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a simulated room in the TUM layout: 40 frames of 160 x 120 with Kinect-like noise. Only to be read."""
    from slamcli.datasets import silent
    from slamcli.datasets.simulate import simulate

    folder = tmp_path_factory.mktemp("recordings") / "room"
    return simulate(folder, progress=silent, **ROOM)


@pytest.fixture(scope="session")
def room_run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a finished run of `room`. Only to be read; copy it to change it."""
    from slamcli.cli.main import cli

    path = tmp_path_factory.mktemp("runs") / "room"
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        result = CliRunner().invoke(cli, ["run", str(room), "-r", str(path)])
    finally:
        os.chdir(before)
    assert result.exit_code == 0, f"{result.output}\n{result.exception!r}"
    return path
