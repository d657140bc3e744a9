"""The run directory: which one is meant, who may write to it, what a finished stage leaves, and whether that is still whole.

A stage writes to ``.<stage>.<pid>/``; its record comes last, then one rename puts the folder in place. So a stage's folder is complete
or absent, whatever kills the program.
"""

import fcntl
import json
import logging
import os
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.files import read_json, sha256, write_text
from slamcli.runs import source_code, staleness
from slamcli.runs.staleness import State
from slamcli.schema import FORMAT
from slamcli.stages import NAMES, STAGES

if TYPE_CHECKING:
    from slamcli.datasets import Dataset
    from slamcli.geometry.camera import Camera

Record = TypeVar("Record")
log = logging.getLogger(__name__)

RUNS = Path("runs")
LATEST = RUNS / "latest"
RECORD_KEYS: dict[str, Any] = {
    "stage": str,
    "config": dict,
    "inputs": dict,
    "outputs": dict,
    "digest": str,
    "environment": dict,
    "seconds": (int, float),
}


class RunDir:
    """One run: ``config.toml``, ``run.json``, ``log.txt`` and a folder per finished stage."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._warned: set[str] = set()

    # which run

    @classmethod
    def find(cls, run: str | None) -> "RunDir":
        """Open the run a command means: `run` (of -r), a folder or a name under runs/, else $SLAMCLI_RUN, else the one last touched."""
        named = run or os.environ.get("SLAMCLI_RUN")
        path = Path(named) if named else LATEST
        if named and not (path / "run.json").is_file() and (RUNS / named / "run.json").is_file():
            path = RUNS / named
        if (path / "run.json").is_file():
            return cls(path if named else Path(os.path.relpath(path.resolve())))._checked()
        if named:
            raise SlamError(f"{path}: not a run directory (it has no run.json); make one with: slamcli run TARGET -r {path}")
        raise SlamError("no run here yet (runs/latest leads nowhere); make one with: slamcli run demo, or name one with -r")

    @classmethod
    def create(cls, path: Path, *, dataset: str, root: str, digest: str) -> "RunDir":
        """Make a run of the recording `dataset` at `root`, or open the run that is already there for the same recording."""
        run = cls(path)
        if not (run.path / "run.json").exists():
            if run.path.is_dir() and any(not entry.name.startswith(".") for entry in run.path.iterdir()):
                raise SlamError(f"{path}: the folder is not empty and not a run directory; name another with -r")
            run.path.mkdir(parents=True, exist_ok=True)
            now = datetime.now(UTC).isoformat(timespec="seconds")
            run._write_info({"format": FORMAT, "dataset": dataset, "root": root, "digest": digest, "created": now})
            return run
        info = run._checked().info()
        if info["root"] != root and info["digest"] != digest:
            raise SlamError(f"{path}: holds a run of another recording ({info['root']}); name another folder with -r")
        if info["root"] != root or info["digest"] != digest:
            run._write_info({**info, "dataset": dataset, "root": root, "digest": digest})
        return run

    def _checked(self) -> "RunDir":
        info = self.info()
        if info.get("format") != FORMAT:
            raise SlamError(f"{self.path}: a run of format {info.get('format')}, this slamcli reads {FORMAT}; start another with -r")
        if not all(isinstance(info.get(name), str) for name in ("dataset", "root", "digest")):
            raise SlamError(f"{self.path / 'run.json'}: dataset, root or digest is missing; start another run with -r")
        return self

    def mark_latest(self) -> None:
        """Point ``runs/latest`` here. A current folder that cannot be written to only means that there is no such link."""
        try:
            RUNS.mkdir(exist_ok=True)
            link = RUNS / f".latest.{os.getpid()}"
            link.unlink(missing_ok=True)
            link.symlink_to(os.path.relpath(self.path.resolve(), RUNS.resolve()))
            os.replace(link, LATEST)
        except OSError as error:
            log.debug("no runs/latest: %s", error)

    # what belongs to the whole run

    @property
    def flag(self) -> str:
        """Return the words that make a command act on this run, for hints that are pasted whole."""
        return f"-r {shlex.quote(str(self.path))}"

    def info(self) -> dict[str, Any]:
        """Read ``run.json``."""
        return read_json(self.path / "run.json")

    def _write_info(self, info: Mapping[str, Any]) -> None:
        write_text(self.path / "run.json", json.dumps(info, indent=1) + "\n")

    def config(self) -> Config:
        """Read the run's configuration; the defaults before there is any."""
        path = self.path / "config.toml"
        return toml.read(path) if path.exists() else Config()

    def write_config(self, config: Config) -> None:
        """Make `config` the run's configuration."""
        write_text(self.path / "config.toml", toml.dump(config))

    def dataset(self, config: Config | None = None) -> "Dataset":
        """Open the recording again, with the camera of `config` (the run's own)."""
        from slamcli.datasets import open_dataset

        root = self.info()["root"]
        if not Path(root).exists():
            raise SlamError(f"{root}: the recording is not there any more; put it back, or: slamcli run TARGET {self.flag}")
        config = config or self.config()
        return open_dataset(root, camera=dict(config.camera) or None, options=config.recording)

    def camera(self, stage: str = "extract") -> "Camera":
        """Read the intrinsics that extract used, or those known after optimize or loop."""
        from slamcli.geometry.camera import Camera

        path = self.stage_path(stage, "camera.json")
        return Camera.from_dict(read_json(path), source=str(path))

    # what a stage left

    def load(self, cls: type[Record], stage: str) -> Record:
        """Read a record of arrays that `stage` wrote."""
        from slamcli import artifacts

        return artifacts.load(cls, self.stage_path(stage))

    def stage_path(self, stage: str, *names: str) -> Path:
        """Name the folder of a finished stage, or a file in it; SlamError says how to make it when it is not there."""
        path = self.path.joinpath(stage, *names)
        if not (self.path / stage / "stage.json").exists():
            raise SlamError(f"{self.path}: {stage} has not been run; try: slamcli run --until {stage} {self.flag}")
        if not path.exists():
            raise SlamError(f"{path}: not there; make it with: slamcli {stage} {self.flag}")
        self._warn_unless_fresh(stage)
        return path

    def _warn_unless_fresh(self, stage: str) -> None:
        """Say once that a result is not what the run's configuration would give now."""
        if stage in self._warned or (state := self.states()[stage]).is_fresh or self._is_cleaned(state):
            return
        if state.reason not in self._warned:  # of several stages that are stale for one reason, one tells it
            log.warning(
                "%s: %s is %s (%s); bring it up to date with: slamcli run %s", self.path, stage, state.state, state.reason, self.flag
            )
        self._warned |= {stage, state.reason}

    def mark_cleaned(self, stage: str) -> None:
        """Remember that a stage was deleted on purpose: what was made from it still stands, and may be exported without a warning."""
        info = self.info()
        self._write_info({**info, "cleaned": sorted({*info.get("cleaned", []), stage})})

    def _is_cleaned(self, state: State) -> bool:
        """Tell whether a stage is stale only because stages before it were deleted on purpose."""
        cleaned = self.info().get("cleaned", [])
        if state.stage in cleaned and state.state == staleness.MISSING:
            return True
        needed = state.reason.removeprefix("input: ").partition(" is ")[0]
        return needed in NAMES and NAMES.index(needed) < NAMES.index(state.stage) and self._is_cleaned(self.states()[needed])

    def states(
        self,
        config: Config | None = None,
        *,
        verify: bool = False,
        input_digest: Callable[[str], str | None] = lambda name: None,
    ) -> dict[str, State]:
        """Judge every stage under `config` (the run's own); without `input_digest` the recording is believed to be unchanged."""
        config = config or self.config()
        states: dict[str, State] = {}
        for stage in STAGES:
            damage = self.damage(stage.name, verify=verify)
            record = None if damage else self.record(stage.name)
            states[stage.name] = staleness.assess(stage, config, record, damage, states, input_digest, source_code.of_stage(stage.name))
        return states

    def record(self, stage: str) -> dict[str, Any] | None:
        """Read a stage's ``stage.json``; None before it was run. SlamError when it cannot be what this program wrote."""
        path = self.path / stage / "stage.json"
        if not path.parent.is_dir():
            return None
        record = read_json(path)
        if "format" not in record or (record["format"] == FORMAT and not _is_record(record)):
            raise SlamError(f"{path}: not a stage's record")
        return record

    def damage(self, stage: str, *, verify: bool = False) -> str:
        """Say what is wrong with a stage's files, or "": each has its recorded size and, with `verify`, its recorded digest."""
        try:
            record = self.record(stage)
        except SlamError as error:
            return str(error).removeprefix(f"{self.path}/")
        if record is None or record["format"] != FORMAT:
            return ""
        for name, entry in record["outputs"].items():
            path = self.path / stage / name
            if not path.is_file():
                return f"{stage}/{name} is not there"
            if path.stat().st_size != entry["bytes"]:
                return f"{stage}/{name} has {path.stat().st_size} bytes, {entry['bytes']} recorded"
            if verify and sha256(path) != entry["sha256"]:
                return f"{stage}/{name} has other content than recorded"
        return ""

    # writing

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the run for writing; SlamError when another process does. Whatever a killed process left is cleared first."""
        with open(self.path / ".lock", "a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise SlamError(f"{self.path}: in use by another slamcli (process {file.read(20).strip() or '?'}); wait for it") from None
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
            self._recover()
            yield

    def _recover(self) -> None:
        """Clear what dead processes left; the lock is held, so every half-written folder is dead.

        Killed between the two renames of `commit`, the stage's folder is gone and its predecessor lies beside it: it is put back.
        """
        for stage in NAMES:
            old = self.path / f".{stage}.old"
            if old.is_dir() and not (self.path / stage).exists():
                old.rename(self.path / stage)
            for leftover in self.path.glob(f".{stage}.*"):
                shutil.rmtree(leftover)

    @contextmanager
    def writing(self, stage: str) -> Iterator[Path]:
        """Give a fresh folder for a stage's output; it is removed again unless `commit` put it in place."""
        folder = self.path / f".{stage}.{os.getpid()}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def commit(self, stage: str, folder: Path, record: Mapping[str, Any]) -> None:
        """Put a stage's finished folder in place of the one before, with its record."""
        write_text(folder / "stage.json", json.dumps(record, indent=1) + "\n")
        place, old = self.path / stage, self.path / f".{stage}.old"
        if place.exists():
            place.rename(old)
        folder.rename(place)
        shutil.rmtree(old, ignore_errors=True)


def default_path(dataset: str) -> Path:
    """Name the run directory of a recording; SlamError for a name that would not stay under ``runs/``."""
    parts = Path(dataset).parts
    if not parts or ".." in parts or Path(dataset).is_absolute() or dataset == LATEST.name:
        raise SlamError(f"no run directory can be named after a recording called {dataset!r}; name one with -r")
    return RUNS / dataset


def outputs(folder: Path) -> dict[str, dict[str, Any]]:
    """List a stage's files with size and digest, by name."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "stage.json")
    return {path.relative_to(folder).as_posix(): {"bytes": path.stat().st_size, "sha256": sha256(path)} for path in paths}


def _is_record(record: Mapping[str, Any]) -> bool:
    if not all(isinstance(record.get(name), kind) for name, kind in RECORD_KEYS.items()) or "slamcli" not in record["environment"]:
        return False
    entries = record["outputs"].values()
    return isinstance(record.get("code", {}), dict) and all(
        isinstance(e, dict) and isinstance(e.get("bytes"), int) and isinstance(e.get("sha256"), str) for e in entries
    )
