"""A test stand for commands: a folder with recordings, finished runs and what every command makes of them; and commands that are spoilt.

Commands run in forked children of this process, which has loaded the libraries: a hundredth of a second each instead of a second.
"""

import contextlib
import hashlib
import os
import select
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from slamcli.cli.main import cli
from slamcli.jit import compilation

Command = tuple[str, ...]
CHANGING = (  # hold times, or nothing that is read again
    ".lock", "log.txt", "stage.json", "run.json", "report.html", "compare.html", "run.zip", "latest", "batch.csv", "batch.html",
)  # fmt: skip
COMMANDS: tuple[Command, ...] = (
    ("run", "-r", "run", "--from", "match"),
    ("run", "-r", "run", "--from", "densify"),
    ("run", "ONE", "TWO", "-r", "./house", "--from", "track"),
    ("add", "grown", "TWO"),
    ("batch", "ONE", "TWO", "--out", "week", "--workers", "2"),
    ("export-trajectory", "out/t.txt", "-r", "run"),
    ("export-trajectory", "out/p.g2o", "-r", "run"),
    ("export-cloud", "out/cloud.ply", "-r", "run"),
    ("export-cloud", "out/cloud.las", "-r", "run"),
    ("export-octree", "out/map.bt", "-r", "run"),
    ("export-octree", "out/colour.ot", "-r", "run", "--colour"),
    ("export-grid", "out/map.pgm", "-r", "run", "--png", "out/map.png"),
    ("export-plan", "out/plan.json", "-r", "run"),
    ("export-plan", "out/plan.dxf", "-r", "run"),
    ("export-mesh", "out/mesh.glb", "-r", "run", "--voxel", "0.1"),
    ("export-mesh", "out/mesh.obj", "-r", "run", "--voxel", "0.1"),
    ("render", "out/room.png", "-r", "run", "--size", "64", "48"),
    (
        "plan",
        "-r",
        "run",
        "--start",
        "first",
        "--goal",
        "last",
        "--radius",
        "0.05",
        "--allow-unknown",
        "-o",
        "out/way.csv",
        "--png",
        "out/way.png",
    ),
    ("report", "-r", "run", "-o", "out/report.html", "--no-inspect"),
    ("eval", "ape", "-r", "run", "--plot", "out/ape.png"),
    ("compare", "run", "grown", "-o", "out/compare.html"),
    ("archive", "out/run.zip", "-r", "run"),
    ("localize", "run", "TWO", "--out", "out/localized.txt"),
    ("vocab", "export", "out/words.txt", "words.npz"),
)
TOPS = ("run", "house", "grown", "week", "out")


@dataclass(frozen=True)
class Ended:
    """How a command ended and what it said."""

    status: int  # minus the signal's number where one ended it
    said: str


class Stand:
    """A folder of finished runs in which every command has been given once; it becomes the current folder."""

    def __init__(self, folder: Path, one: Path, two: Path, commands: Sequence[Command] = COMMANDS) -> None:
        compilation.ensure()
        compilation.declared()  # so that no child has to import them
        self.folder, self._places = folder, {"ONE": str(one.resolve()), "TWO": str(two.resolve())}
        os.environ |= {"TMPDIR": str(folder / "tmp"), "OPENBLAS_NUM_THREADS": "1"}
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  # as long as the process
        tempfile.tempdir = str(folder / "tmp")  # children look there, this process has looked already
        os.chdir(folder)
        for name in ("out", "tmp"):
            Path(name).mkdir()
        _few_words(Path("words.npz"))
        self._must("run", "ONE", "-r", "./run")
        shutil.copytree("run", "grown")
        shutil.copytree("run", "grown.before")
        self.commands = []
        self.seconds: dict[Command, float] = {}
        for command in commands:
            ended = self.call(command)
            if ended.status:
                print(f"left out: {' '.join(command)}: {ended.said[-300:].strip()}", flush=True)
            else:
                self.commands.append(command)
        self.good = self.contents()

    def _must(self, *command: str) -> None:
        ended = self.call(command)
        if ended.status:
            raise RuntimeError(f"{' '.join(command)}: {ended.said}")

    def call(self, command: Command, *, within: Callable[[], object] = lambda: None, kill_after: float | None = None) -> Ended:
        """Run a command in a forked child; `within` is called there before it begins, SIGKILL comes after so many seconds."""
        self._said.truncate(0)  # a file without a name: it takes no room of the stand's
        child = os.fork()
        if child == 0:
            _be([self._places.get(word, word) for word in command], self._said.fileno(), within)
        watched = os.pidfd_open(child)
        if not select.select([watched], [], [], kill_after)[0]:
            os.kill(child, signal.SIGKILL)
        os.close(watched)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        self._said.seek(0)
        return Ended(status, self._said.read().decode(errors="replace"))

    def reset(self, command: Command) -> None:
        """Bring back what a command changes for good."""
        if command[0] == "add":
            shutil.rmtree("grown", ignore_errors=True)
            shutil.copytree("grown.before", "grown")
        if command[0] == "batch":  # it is to go on with one recording and to begin with the others
            first, *others = sorted(path for path in Path("week").iterdir() if path.is_dir())
            for folder in (first / "densify", *others):
                shutil.rmtree(folder, ignore_errors=True)

    def contents(self, *tops: str) -> dict[str, str]:
        """Digest what must be the same whenever it is made."""
        paths = (path for top in tops or TOPS for path in Path(top).rglob("*") if path.is_file() and not path.is_symlink())
        return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.name not in CHANGING}

    def differing(self, now: dict[str, str] | None = None) -> list[str]:
        """Name the files that are not what they were."""
        now = self.contents() if now is None else now
        return sorted(name for name in now.keys() | self.good.keys() if now.get(name) != self.good.get(name))

    def left_over(self) -> Iterator[str]:
        """Name hidden and temporary files, and remove them."""
        hidden = (path for top in TOPS for path in Path(top).rglob(".*") if path.name != ".lock")
        for path in [*Path("tmp").iterdir(), *hidden]:
            yield str(path)
            shutil.rmtree(path, ignore_errors=True)
            path.unlink(missing_ok=True)


def _be(arguments: list[str], said: int, within: Callable[[], object]) -> None:
    """Become a command; never returns."""
    os.lseek(said, 0, os.SEEK_SET)
    os.dup2(said, 1)
    os.dup2(said, 2)
    status = 1
    try:
        within()
        cli(arguments, prog_name="slamcli")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(bool(end.code))
    except BaseException:
        traceback.print_exc()
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def _few_words(path: Path) -> None:
    import numpy as np

    from slamcli.formats import vocabulary_file
    from slamcli.vision import vocabulary

    centre = np.arange(4 * 32, dtype=np.uint8).reshape(4, 32)
    vocabulary_file.write(path, vocabulary.from_parents(np.zeros(4, np.int32), centre, np.ones(4), origin="", source="test"))
