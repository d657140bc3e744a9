"""Where runs lie: which one is meant, where a new one goes, and what is inside one."""

import logging
import os
from pathlib import Path

from slamcli.errors import SlamError
from slamcli.hints import hint
from slamcli.stages import NAMES

log = logging.getLogger(__name__)

RUNS = Path("runs")
LATEST = RUNS / "latest"
RECORDINGS = "recordings"  # folder of the runs of single recordings inside a run of several


def find(run: str | None) -> Path:
    """Return the run a command means: `run` (of -r), a folder or a name under runs/, else $SLAMCLI_RUN, else the one last touched."""
    name = run or os.environ.get("SLAMCLI_RUN")
    path = named(name) if name else _latest()
    if not is_run(path):
        raise SlamError(f"{path}: not a run directory (it has no run.json); make one with: {hint().make(path)}")
    return path


def named(run: str) -> Path:
    """Return the run directory that `run` names, a folder or a name under runs/, whether it is there yet or not.

    What is a run counts first, here before under runs/. Else a bare name is one under runs/, unless a folder here is free to become the
    run; a path with a separator means what it says.
    """
    if is_run(Path(run)):
        return Path(run)
    if is_run(RUNS / run):
        return RUNS / run
    if os.path.basename(run) != run or run in (os.curdir, os.pardir) or is_free(Path(run)):
        return Path(run)
    return _latest() if run == LATEST.name else default_path(run)


def _latest() -> Path:
    """Return the run that was touched last."""
    if is_run(LATEST):
        return Path(os.path.relpath(LATEST.resolve()))
    raise SlamError(
        f"no run here yet (runs/latest leads nowhere); make one with: {hint().demo()}, or name one with {hint().argument('path')}"
    )


def mark_latest(path: Path) -> None:
    """Point ``runs/latest`` to a run; where the current folder cannot be written to there is no such link."""
    try:
        RUNS.mkdir(exist_ok=True)
        link = RUNS / ".latest.part"
        link.unlink(missing_ok=True)
        link.symlink_to(os.path.relpath(path.resolve(), RUNS.resolve()))
        os.replace(link, LATEST)
    except OSError as error:
        log.debug("no runs/latest: %s", error)


def default_path(dataset: str) -> Path:
    """Name the run directory of a recording; SlamError for a name that would not stay under ``runs/``."""
    parts = Path(dataset).parts
    if not parts or ".." in parts or Path(dataset).is_absolute() or dataset == LATEST.name:
        raise SlamError(f"no run directory can be named after a recording called {dataset!r}; name one with {hint().argument('path')}")
    return RUNS / dataset


def is_free(path: Path) -> bool:
    """Say whether a folder holds nothing, so that it may become a run."""
    return path.is_dir() and not any(not entry.name.startswith(".") for entry in path.iterdir())


def is_run(path: Path) -> bool:
    """Say whether a folder is a run, if need be one that lost its ``run.json``."""
    return (path / "run.json").is_file() or has_stage(path)


def has_stage(path: Path) -> bool:
    """Say whether a folder holds a finished stage."""
    return any((path / stage / "stage.json").is_file() for stage in NAMES)


def refuse_inside(path: Path, *, own: str = "") -> None:
    """Raise SlamError where a file or folder to be written lies in a run directory, except by the name `own` in its top folder."""
    real = Path(os.path.realpath(path))
    for folder in real.parents:
        if (folder / "run.json").is_file() and (folder / "config.toml").is_file() and (real.name != own or folder != real.parent):
            raise SlamError(f"{path}: lies in the run directory {folder}, whose files are the run's own; choose a place outside")
