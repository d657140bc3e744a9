"""Recordings and runs that lie elsewhere: s3://, gs://, sftp:// and whatever else fsspec knows.

A worker has them in a folder of its own while it works on them. A stored stage is complete or absent, as a local one is: its `stage.json`
is written last, and whoever reads the stage compares every file with the digest recorded there.
"""

import os
import shutil
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from slamcli import files
from slamcli.errors import SlamError
from slamcli.runs.damage import outputs
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

HINTS = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "sftp": "paramiko", "ssh": "paramiko", "abfs": "adlfs"}  # what fsspec needs for each
LARGEST_TEXT = 16 << 20  # bytes of a list or a record


def is_url(text: str) -> bool:
    """Say whether a text names a place that fsspec opens, and no path of this machine."""
    return "://" in text


def connect(url: str) -> tuple[Any, str]:
    """Return fsspec's file system for a URL, and the path there; SlamError names the package that is missing."""
    scheme = url.partition("://")[0]
    try:
        from fsspec.core import url_to_fs

        return url_to_fs(url)
    except ImportError as error:
        needed = HINTS.get(scheme, "")
        also = f" {needed}" if needed else ""
        raise SlamError(f"{url}: cannot be opened ({error}); pip install 'slamcli[cluster]'{also}") from error
    except ValueError as error:
        raise SlamError(f"{url}: {error}") from error


def read_text(place: str) -> str:
    """Read a small text file, here or elsewhere; SlamError when it cannot be read."""
    try:
        if not is_url(place):
            text = files.read_bytes(place, limit=LARGEST_TEXT).decode("utf-8")
        else:
            system, path = connect(place)
            text = system.cat_file(path, start=0, end=LARGEST_TEXT + 1).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SlamError(f"{place}: cannot be read ({error})") from error
    if len(text) > LARGEST_TEXT:
        raise SlamError(f"{place}: too large for a list or a record")
    return text


def write_text(place: str, text: str) -> None:
    """Write a small text file, here or elsewhere, whole."""
    if not is_url(place):
        files.write_text(Path(place), text)
    else:
        system, path = connect(place)
        system.pipe_file(path, text.encode("utf-8"))


def finished_stages(run: str) -> list[str]:
    """List the stages of a run that are up to date, or of one that is stored elsewhere those that are complete."""
    if not is_url(run):
        directory = RunDir(Path(run))
        return [name for name, state in directory.states().items() if state.is_fresh] if (directory.path / "run.json").exists() else []
    system, path = connect(run)
    return [name for name in NAMES if system.exists(f"{path}/{name}/stage.json")]


def fetch_recording(url: str, folder: Path) -> Path:
    """Copy a recording, a folder or a single file, to ``folder/<its name>`` unless it is there; returns the copy, complete or absent."""
    system, path = connect(url)
    place = Path(folder) / (PurePosixPath(path).name or "recording")
    if place.exists():
        return place
    found = system.find(path)
    if not found:
        raise SlamError(f"{url}: no such recording")
    fresh = place.with_name(f".{place.name}.{os.getpid()}")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.parent.mkdir(parents=True, exist_ok=True)
    for name in found:
        inner = PurePosixPath(name).relative_to(path).parts if name.rstrip("/") != path.rstrip("/") else ()
        if ".." in inner:
            raise SlamError(f"{url}: the name {name!r} leads out of its folder")
        target = fresh.joinpath(*inner)
        target.parent.mkdir(parents=True, exist_ok=True)
        system.get_file(name, str(target))
    fresh.rename(place)
    return place


class StoredRun:
    """A run at a URL, and the copy of it that a worker has in ``run.path``."""

    def __init__(self, url: str, path: Path) -> None:
        self.url, self.path = url, Path(path)
        self._system, self._root = connect(url)

    def pull(self, root: str, *, until: str = NAMES[-1]) -> None:
        """Bring the copy up to what is stored, as far as a stage; `root` is where the recording lies on this machine.

        What is here already stays, and so does what cannot be read whole: the pipeline then makes it anew.
        """
        if not (self.path / "run.json").exists():
            try:
                info = _with_root(self._text("run.json") or "", root)
            except SlamError:  # absent or damaged
                return
            self.path.mkdir(parents=True, exist_ok=True)
            if (config := self._text("config.toml")) is not None:
                files.write_text(self.path / "config.toml", config)
            files.write_text(self.path / "run.json", info)
        run = RunDir(self.path)
        with run.lock():
            for stage in NAMES[: NAMES.index(until) + 1]:
                self._pull_stage(run, stage)

    def _pull_stage(self, run: RunDir, stage: str) -> None:
        if (self.path / stage / "stage.json").exists():
            return
        text = self._text(f"{stage}/stage.json")
        record = _record(text) if text is not None else None
        if record is None:
            return
        with run.writing(stage) as folder, suppress(FileNotFoundError):
            for name in record["outputs"]:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                self._system.get_file(f"{self._root}/{stage}/{name}", str(folder / name))
            if outputs(folder) == record["outputs"]:
                run.commit(stage, folder, record)

    def push(self, stage: str, recording: str) -> None:
        """Store a stage, its record last; run.json names the recording by `recording`, not by this machine's copy of it."""
        record = RunDir(self.path).record(stage)
        if record is None or self._text(f"{stage}/stage.json") == (self.path / stage / "stage.json").read_text(encoding="utf-8"):
            return
        if self._text(f"{stage}/stage.json") is not None:
            self._system.rm_file(f"{self._root}/{stage}/stage.json")
        self._system.makedirs(f"{self._root}/{stage}", exist_ok=True)
        self._system.pipe_file(f"{self._root}/run.json", _with_root((self.path / "run.json").read_text("utf-8"), recording).encode())
        self._put("config.toml")
        for name in record["outputs"]:
            self._put(f"{stage}/{name}")
        self._put(f"{stage}/stage.json")
        self._put("log.txt")

    def _put(self, name: str) -> None:
        self._system.makedirs(str(PurePosixPath(f"{self._root}/{name}").parent), exist_ok=True)
        self._system.put_file(str(self.path / name), f"{self._root}/{name}")

    def _text(self, name: str) -> str | None:
        try:
            return self._system.cat_file(f"{self._root}/{name}").decode("utf-8")
        except FileNotFoundError:
            return None


def _with_root(text: str, root: str) -> str:
    return files.sealed({**files.unsealed(text, source=Path("run.json")), "root": root})


def _record(text: str) -> dict[str, Any] | None:
    """Parse a stored stage's record; None for anything but an intact record whose files lie in the stage's folder."""
    try:
        record = files.unsealed(text, source=Path("stage.json"))
    except SlamError:
        return None
    if not isinstance(record.get("outputs"), dict):
        return None
    paths = [PurePosixPath(name) for name in record["outputs"]]
    return record if not any(path.is_absolute() or ".." in path.parts for path in paths) else None
