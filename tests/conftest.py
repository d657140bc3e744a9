"""What many tests share: a tiny simulated room, a finished run of it, and the command line in one process."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from hypothesis import settings

from slamcli.jit import compilation

ROOM_FRAMES = 40
ROOM = {"seed": 1, "frames": ROOM_FRAMES, "laps": 0.15, "width": 160, "height": 120}  # settings of the simulated recording `room`

# A kernel's first call compiles it, which takes longer than any deadline; and the same examples every time, as a red run must be repeatable.
settings.register_profile("slamcli", deadline=None, derandomize=True)
settings.load_profile("slamcli")


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels once, before several processes begin to test with them."""
    if not hasattr(config, "workerinput"):
        compilation.ensure()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the slow tests unless they are asked for."""
    if "SLAMCLI_SLOW" not in os.environ:
        for item in items:
            if item.get_closest_marker("slow"):
                item.add_marker(pytest.mark.skip(reason="slow: set SLAMCLI_SLOW=1 to run it"))


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
