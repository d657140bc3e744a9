"""Who may write to a run: one process at a time, which first clears what a killed one left."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slamcli import files
from slamcli.errors import SlamError
from slamcli.runs.places import RECORDINGS
from slamcli.stages import NAMES


@contextmanager
def held(run: Path, *, wait: bool) -> Iterator[None]:
    """Hold the run directory `run` for writing; when another process does, wait or raise SlamError."""
    with files.open_own(run / ".lock") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise SlamError(f"{run}: in use by another slamcli (process {file.read(20).strip() or '?'}); wait for it") from None
        with files.written(run / ".lock"):
            file.truncate(0)
            os.write(file.fileno(), f"{os.getpid()}\n".encode())
        _recover(run)
        yield


def _recover(run: Path) -> None:
    """Clear what dead processes left; the lock is held, so every half-written folder is dead.

    Killed between the two renames of `RunDir.commit`, the stage's folder is gone and its predecessor lies beside it: it is put back.
    """
    for stage in (*NAMES, RECORDINGS):
        old = run / f".{stage}.old"
        if old.is_dir() and not (run / stage).exists():
            old.rename(run / stage)
        for leftover in run.glob(f".{stage}.*"):
            shutil.rmtree(leftover)
    for leftover in (run / RECORDINGS).glob(".*.part"):
        shutil.rmtree(leftover)
    for name in ("run.json", "config.toml"):
        files.clear_leftover(run / name)
