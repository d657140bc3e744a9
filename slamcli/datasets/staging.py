"""Folders that are complete or absent."""

import glob
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Return a hidden folder beside `target` that becomes it when the block ends well and is removed when not.

    What an earlier process left behind when it was killed is removed first.
    """
    for left in target.parent.glob(f".{glob.escape(target.name)}.*"):
        if not _is_running(left.suffix.removeprefix(".")):
            shutil.rmtree(left, ignore_errors=True)
    staging = target.with_name(f".{target.name}.{os.getpid()}")
    shutil.rmtree(staging, ignore_errors=True)
    try:
        staging.mkdir(parents=True)
        yield staging
        staging.rename(target)  # replaces an empty folder, and fails where something is in it
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _is_running(pid: str) -> bool:
    """Say whether a process number is in use; what is no number counts as such, so that foreign files stay."""
    if not pid.isdecimal():
        return True
    try:
        os.kill(int(pid), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
