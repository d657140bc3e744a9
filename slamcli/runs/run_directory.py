"""The run directory: what belongs to the whole run, what a finished stage leaves, and whether that is still whole.

A stage writes to ``.<stage>.<pid>/``; its record comes last, then one rename puts the folder in place. So a stage's folder is complete
or absent, whatever kills the program.
"""

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

from slamcli import files
from slamcli.config.options import Config
from slamcli.errors import Damaged, SlamError
from slamcli.hints import hint
from slamcli.runs import damage, places, run_lock, source_code, staleness
from slamcli.runs.places import RECORDINGS
from slamcli.runs.staleness import State
from slamcli.schema import FORMAT
from slamcli.stages import NAMES, STAGES, basis

if TYPE_CHECKING:
    from slamcli.datasets import Dataset
    from slamcli.geometry.camera import Camera

Record = TypeVar("Record")
log = logging.getLogger(__name__)

FIGURES = ("eval/*.json", "inspection.json")  # what eval and report keep of their findings, each file sealed


class RunDir:
    """One run: ``config.toml``, ``run.json``, ``log.txt`` and a folder per finished stage."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._warned: set[str] = set()
        self._judged: dict[str, tuple[tuple, State]] = {}  # stages judged for a warning, each with the versions of what says so

    # which run

    @classmethod
    def find(cls, run: str | None, *, restore: bool = False) -> "RunDir":
        """Open the run a command means: `run` (of -r), a folder or a name under runs/, else $SLAMCLI_RUN, else the one last touched.

        restore : where the run's own files are damaged, restore them first
        """
        found = cls(places.find(run))
        if restore:
            found.restore()
        return found._checked()

    @classmethod
    def create(cls, path: Path, *, dataset: str, root: str, digest: str, recordings: Sequence[Mapping[str, str]] = ()) -> "RunDir":
        """Make a run of the recording `dataset` at `root`, or open the run that is already there for the same recording.

        recordings : of a run of several, in their order, what each is: name, dataset, root, digest
        """
        run = cls(path)
        about: dict[str, Any] = {"dataset": dataset, "root": root, "digest": digest}
        if recordings:
            about["recordings"] = [dict(entry) for entry in recordings]
        if not places.is_run(run.path):
            if run.path.is_dir() and not places.is_free(run.path):
                raise SlamError(f"{path}: the folder is not empty and not a run directory; name another with {hint().argument('path')}")
            if run.path.parent.name != RECORDINGS:  # where a run of several has those of each
                places.refuse_inside(run.path)
            run.path.mkdir(parents=True, exist_ok=True)
            run._write_info(about)
            return run
        if not run._is_sealed("run.json"):  # nothing is left that would say of which recording the run is: its stages will tell
            run._write_info(about)
        info = run._checked().info()
        there, here = (sorted(entry["root"] for entry in entries) or [of["root"]]
                       for entries, of in ((info.get("recordings", []), info), (recordings, about)))  # fmt: skip
        if there != here and info["digest"] != digest:
            raise SlamError(_holds_another(path, there))
        if any(info.get(name) != value for name, value in about.items() if name != "dataset"):
            run._write_info({**about, "created": info["created"]})
        return run

    def _checked(self) -> "RunDir":
        info = self.info()
        if info.get("format") != FORMAT:
            raise SlamError(
                f"{self.path}: a run of format {info.get('format')}, this slamcli reads {FORMAT}; start another with {hint().argument('path')}"
            )
        if not all(isinstance(info.get(name), str) for name in ("dataset", "root", "digest", "created")):
            raise SlamError(
                f"{self.path / 'run.json'}: dataset, root, digest or created is missing; start another run with {hint().argument('path')}"
            )
        if not all(_is_entry(entry) for entry in info.get("recordings", [])):
            raise SlamError(
                f"{self.path / 'run.json'}: a recording lacks name, dataset, root or digest; start another run with {hint().argument('path')}"
            )
        return self

    def mark_latest(self) -> None:
        """Point ``runs/latest`` here. A current folder that cannot be written to only means that there is no such link."""
        places.mark_latest(self.path)

    # what belongs to the whole run

    @property
    def recordings(self) -> list[dict[str, str]]:
        """List the recordings of a run of several as ``run.json`` has them, in their order; empty for a run of one."""
        return list(self.info().get("recordings", []))

    def recording_path(self, name: str) -> Path:
        """Name the folder of the run of one recording inside a run of several."""
        return self.path / RECORDINGS / name

    def info(self) -> dict[str, Any]:
        """Read ``run.json``."""
        path = self.path / "run.json"
        try:
            return files.read_sealed(path)
        except SlamError as error:
            with contextlib.suppress(SlamError):
                info = files.read_json(path)
                if files.SEAL not in info and info.get("format") not in (None, FORMAT):  # older, not damaged
                    return info
            raise Damaged(f"{error}; restore it with: {hint().repair(self.path)}, or: {hint().make(self.path)}") from error

    def _write_info(self, info: Mapping[str, Any]) -> None:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        files.write_sealed(self.path / "run.json", {"format": FORMAT, "created": now, **info})

    def extend(self, *, dataset: str, root: str, digest: str, recordings: Sequence[Mapping[str, str]]) -> None:
        """Make it a run of these recordings; what was made of fewer is stale from then on. The arguments are those of `create`."""
        about = {"dataset": dataset, "root": root, "digest": digest, "recordings": [dict(entry) for entry in recordings]}
        self._write_info({**self.info(), **about})

    def own_file(self, name: str) -> Path:
        """Name a file that a command puts into the run; a link, a device or a pipe in its place leads elsewhere, and is removed."""
        path = self.path / name
        if path.is_symlink() or (path.exists() and not path.is_file() and not path.is_dir()):
            path.unlink()
        return path

    def config(self) -> Config:
        """Read the run's configuration; the defaults before there is any."""
        path = self.path / "config.toml"
        return damage.read_config(path) if path.exists() else Config()

    def write_config(self, config: Config) -> None:
        """Make `config` the run's configuration."""
        damage.write_config(self.path / "config.toml", config)

    def restore(self) -> None:
        """Write ``run.json`` and ``config.toml`` anew where they are damaged, from what the finished stages recorded; drop damaged findings."""
        is_run = places.has_stage(self.path) or ((self.path / ".lock").is_file() and (self.path / "run.json").exists())
        lacking = [name for name in ("run.json", "config.toml") if is_run and not self._is_sealed(name)]
        figures = self.damaged_figures() if is_run else []
        if not lacking and not figures:
            return
        if "run.json" not in lacking:
            self._checked()  # a run of another version is not damaged: it is refused, and stays as it is
        with self.lock():
            records = self._records()
            if "run.json" in lacking and (info := damage.restored_info(records)):
                self._write_info(info)
                log.warning("%s was damaged; restored from what the stages recorded", self.path / "run.json")
            if "config.toml" in lacking:
                self.write_config(damage.restored_config(records))
                source = "what the stages recorded" if records else "the defaults, as no stage recorded its own"
                log.warning("%s was damaged; restored from %s", self.path / "config.toml", source)
            for name in figures:  # no stage makes them, the commands that found them do
                (self.path / name).unlink(missing_ok=True)
                again = f"{hint().measure(self.path)} or {hint().report(self.path)}"
                log.warning("%s was damaged, and is removed; make it again with: %s", self.path / name, again)

    def damaged_figures(self) -> list[str]:
        """Name the files in which `eval` and `report` kept their findings and that are not as they were written."""
        names = [path.relative_to(self.path).as_posix() for pattern in FIGURES for path in sorted(self.path.glob(pattern))]
        return [name for name in names if not self._is_sealed(name)]

    def _is_sealed(self, name: str) -> bool:
        try:
            read = {"run.json": lambda _: self.info(), "config.toml": damage.read_config}.get(name, files.read_sealed)
            read(self.path / name)
        except (SlamError, FileNotFoundError):
            return False
        return True

    def _records(self) -> dict[str, dict[str, Any]]:
        """Return the records of the stages that have a sound one, in the order in which they were written."""
        found = {}
        for stage in NAMES:
            with contextlib.suppress(SlamError):
                record = self.record(stage)
                if record is not None and record["format"] == FORMAT:
                    found[stage] = record
        return dict(sorted(found.items(), key=lambda item: (self.path / item[0] / "stage.json").stat().st_mtime_ns))

    def dataset(self, config: Config | None = None) -> "Dataset":
        """Open the recording again, or all of several, with the camera of `config` (the run's own)."""
        config, info = config or self.config(), self.info()
        entries = info.get("recordings", [])
        if not entries:
            return open_recording(info["root"], config, self.path)
        from slamcli.datasets.joined import JoinedDataset

        opened = [open_recording(entry["root"], config, self.path) for entry in entries]
        return JoinedDataset(opened, [entry["name"] for entry in entries])

    def camera(self, stage: str = "extract") -> "Camera":
        """Read the intrinsics that extract used, or those known after optimize or loop."""
        from slamcli.geometry.camera import Camera

        path = self.stage_path(stage, "camera.json")
        return Camera.from_dict(files.read_json(path), source=str(path))

    # what a stage left

    def load(self, cls: type[Record], stage: str) -> Record:
        """Read a record of arrays that `stage` wrote."""
        from slamcli import artifacts

        folder = self.stage_path(stage)
        self.intact(stage, *artifacts.file_names(cls))
        return artifacts.load(cls, folder)

    def stage_path(self, stage: str, *names: str) -> Path:
        """Name the folder of a finished stage, or a file in it; SlamError says how to make it when it is not there."""
        path = self.path.joinpath(stage, *names)
        if not (self.path / stage / "stage.json").exists():
            raise SlamError(f"{self.path}: {stage} {self.why_missing(stage)}: {hint().update(self.path, until=stage)}")
        if not path.exists():
            raise SlamError(f"{path}: not there; make it with: {hint().stage(self.path, stage)}")
        if names:
            self.intact(stage, "/".join(names))
        self._warn_unless_fresh(stage)
        return path

    def why_missing(self, stage: str) -> str:
        """Say why a stage has no folder, as what comes before the command that makes one."""
        if stage in self.info().get("cleaned", []):
            return "was cleaned away; bring it back with"
        is_made_from = any(stage in one.needs and self.record(one.name) is not None for one in STAGES)
        return "is not there any more; make it anew with" if is_made_from else "has not been run; try"

    def intact(self, stage: str, *names: str) -> Path:
        """Return the folder of a finished stage after comparing files of it with the digests recorded; Damaged where one differs."""
        record = self.record(stage) or {"outputs": {}}
        for name in names:
            if name not in record["outputs"]:
                raise SlamError(f"{self.path / stage / name}: not there; make it with: {hint().stage(self.path, stage)}")
        if found := damage.find(self.path / stage, record["outputs"], names, verify=True):
            raise Damaged(f"{self.path}/{found}: it is damaged; repair it with: {hint().repair(self.path)}")
        return self.path / stage

    def _warn_unless_fresh(self, stage: str) -> None:
        """Say once that a result is not what the run's configuration would give now."""
        config = files.version(self.path / "config.toml")
        known = {name: state for name, (seen, state) in self._judged.items() if seen == (config, self._version(name))}
        if stage in known:
            return
        judged = self.states(until=stage, known=known)
        self._judged |= {name: ((config, self._version(name)), state) for name, state in judged.items()}
        state = judged[stage]
        if stage in self._warned or state.is_fresh or self.is_cleaned(state):
            return
        if state.reason not in self._warned:  # of several stages that are stale for one reason, one tells it
            log.warning(
                "%s: %s is %s (%s); bring it up to date with: %s", self.path, stage, state.state, state.reason, hint().update(self.path)
            )
        self._warned |= {stage, state.reason}

    def _version(self, stage: str) -> tuple[int, ...]:
        return files.version(os.path.join(self.path, stage, "stage.json"))

    def mark_cleaned(self, stage: str) -> None:
        """Remember that a stage was deleted on purpose: what was made from it still stands, and may be exported without a warning."""
        self._write_info(self.without([stage]))

    def without(self, stages: Sequence[str]) -> dict[str, Any]:
        """Return ``run.json`` as it is to be when stages are left out on purpose."""
        info = self.info()
        return {**info, "cleaned": sorted({*info.get("cleaned", []), *stages})} if stages else info

    def is_cleaned(self, state: State) -> bool:
        """Tell whether a stage is stale only because stages before it were deleted on purpose."""
        cleaned = self.info().get("cleaned", [])
        if state.stage in cleaned and state.state == staleness.MISSING:
            return True
        needed = state.reason.removeprefix("input: ").partition(" is ")[0]
        return needed in NAMES and NAMES.index(needed) < NAMES.index(state.stage) and self.is_cleaned(self.states(until=needed)[needed])

    def states(
        self,
        config: Config | None = None,
        *,
        verify: bool = False,
        until: str | None = None,
        input_digest: Callable[[str], str | None] = lambda name: None,
        known: Mapping[str, State] = MappingProxyType({}),
    ) -> dict[str, State]:
        """Judge every stage under `config` (the run's own); without `input_digest` the recording is believed to be unchanged.

        until : judge no more than this stage and those that it rests on
        known : states judged already, which are believed
        """
        config = config or self.config()
        states: dict[str, State] = {}
        for stage in STAGES if until is None else [stage for stage in STAGES if stage.name in basis(until)]:
            if stage.name in known:
                states[stage.name] = known[stage.name]
                continue
            record, found = self._looked_at(stage.name, verify=verify)
            sources = {} if record is None else source_code.of_stage(stage.name, record.get("reader", ""))
            states[stage.name] = staleness.assess(stage, config, record, found, states, input_digest, sources)
        return states

    def record(self, stage: str) -> dict[str, Any] | None:
        """Read a stage's ``stage.json``; None before it was run. Damaged when it cannot be what this program wrote."""
        folder = os.path.join(self.path, stage)
        if not os.path.isdir(folder):
            return None
        try:
            return damage.read_record(Path(folder, "stage.json"))
        except SlamError as error:
            raise Damaged(f"{error}; repair it with: {hint().repair(self.path)}") from error

    def damage(self, stage: str, *, verify: bool = False) -> str:
        """Say what is wrong with a stage's files, or "": each has its recorded size and, with `verify`, its recorded digest."""
        return self._looked_at(stage, verify=verify)[1]

    def _looked_at(self, stage: str, *, verify: bool) -> tuple[dict[str, Any] | None, str]:
        """Return a stage's record and what is wrong with its files, or ""; None before it was run, and where anything is wrong."""
        try:
            record = self.record(stage)
        except SlamError as error:
            return None, str(error).removeprefix(f"{self.path}/").partition("; repair")[0]
        if record is None or record["format"] != FORMAT:
            return record, ""
        found = damage.find(self.path / stage, record["outputs"], record["outputs"], verify=verify)
        return (None, found) if found else (record, "")

    # writing

    @contextmanager
    def lock(self, *, wait: bool = False) -> Iterator[None]:
        """Hold the run for writing; when another process does, wait or raise SlamError. What a killed process left is cleared first."""
        with run_lock.held(self.path, wait=wait):
            yield

    @contextmanager
    def writing(self, stage: str) -> Iterator[Path]:
        """Return a fresh folder for a stage's output; it is removed again unless `commit` put it in place."""
        folder = self.path / f".{stage}.{os.getpid()}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def commit(self, stage: str, folder: Path, record: Mapping[str, Any]) -> None:
        """Put a stage's finished folder in place of the one before, with its record."""
        files.write_sealed(folder / "stage.json", record)
        place, old = self.path / stage, self.path / f".{stage}.old"
        if place.exists():
            place.rename(old)
        folder.rename(place)
        shutil.rmtree(old, ignore_errors=True)


def open_recording(root: str, config: Config, run: Path) -> "Dataset":
    """Open a recording that a run was made of; SlamError where it is gone, with the `run` in the advice."""
    from slamcli.datasets import open_dataset

    if not Path(root).exists():
        raise SlamError(f"{root}: the recording is not there any more; put it back, or: {hint().make(run)}")
    return open_dataset(root, camera=dict(config.camera) or None, options=config.recording)


def _holds_another(path: Path, roots: list[str]) -> str:
    told = f"another recording ({roots[0]})" if len(roots) == 1 else f"other recordings ({', '.join(roots)})"
    return f"{path}: holds a run of {told}; name another folder with {hint().argument('path')}, or add to that map with: {hint().add(path)}"


def _is_entry(entry: Any) -> bool:
    """Say whether a recording is described as runs of several list it; its name is a folder's, and cannot lead elsewhere."""
    if not isinstance(entry, dict) or not all(isinstance(entry.get(name), str) for name in ("name", "dataset", "root", "digest")):
        return False
    return bool(entry["name"]) and Path(entry["name"]).name == entry["name"] and not entry["name"].startswith(".")
