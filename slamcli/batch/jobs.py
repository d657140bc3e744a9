"""What a batch is to do: its recordings, where their runs go, and under which settings."""

import contextlib
import fcntl
import itertools
import os
import platform
import re
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamcli import files
from slamcli.batch import storage
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.hints import Hints, hint
from slamcli.stages import NAMES

LIST_SUFFIX = ".txt"
MOST_RECORDINGS = 100_000  # of a batch
MOST_PARTS = 16  # of a recording's path, from its end, that may be needed to name its run
MARKER = ".batch-"  # begins the names of the files by which workers know a folder again


@dataclass(frozen=True)
class Order:
    """What holds for every recording of a batch."""

    out: str  # folder of the runs: an absolute path that every worker sees, or a URL
    settings: tuple[str, ...] = ()  # as after -s
    config: Config | None = None  # to start from instead of a run's own
    data: str | None = None  # folder of recordings to look in first
    until: str = NAMES[-1]  # the last stage
    threads: int = 1  # of a stage
    marker: str = ""  # name of a file in `out` by which a worker knows that it sees the same folder; "" for a URL
    hints: type[Hints] = field(default_factory=lambda: type(hint()))  # in whose words workers advise: those of who gives the order


@dataclass(frozen=True)
class Job:
    """One recording of a batch."""

    name: str  # of its run, below the folder of the runs; unique within the batch
    recording: str  # what `slamcli run` takes, or a URL
    order: Order

    @property
    def run(self) -> str:
        """Where the run goes: an absolute path or a URL."""
        return f"{self.order.out}/{self.name}"

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages to run, in order."""
        return NAMES[: NAMES.index(self.order.until) + 1]


def jobs(recordings: Sequence[str], order: Order) -> list[Job]:
    """Return each recording a run of its own, named after it; SlamError for none, for one that is named twice, and for too many."""
    listed = _listed(recordings)
    if len(listed) > MOST_RECORDINGS:
        raise SlamError(f"{len(listed)} recordings: a batch has at most {MOST_RECORDINGS}; divide the list")
    found = [_absolute(recording) for recording in listed]
    if not found:
        raise SlamError("no recording to work off; name some, or a list of them: a .txt file with one a line")
    twice = [recording for recording, n in Counter(found).items() if n > 1]
    if twice:
        raise SlamError(f"{twice[0]}: named twice; each recording has one run")
    return [Job(name, recording, order) for name, recording in zip(names(found), found, strict=True)]


def _listed(recordings: Iterable[str]) -> list[str]:
    """Replace each list by what stands in it: a recording a line, # begins a comment."""
    found: list[str] = []
    for given in recordings:
        if given.endswith(LIST_SUFFIX) and (storage.is_url(given) or Path(given).is_file()):
            lines = (line.partition("#")[0].strip() for line in storage.read_text(given).splitlines())
            found += [line for line in lines if line]
        else:
            found.append(given)
    return found


def _absolute(recording: str) -> str:
    """Make a path independent of the current folder, which is another one where the workers are."""
    if not recording.strip():
        raise SlamError("an empty name among the recordings; name a folder, a list, tum/fr1_room or demo")
    if storage.is_url(recording):
        return recording.rstrip("/")
    path = files.user_path(recording)
    return str(path.resolve()) if path.exists() else recording


def names(recordings: Sequence[str]) -> list[str]:
    """Name runs after their recordings: by the last part of the path, where that is not unique by as many parts as it takes, else by number."""
    split = ([part for part in re.split(r"[/\\]+", text) if part] for text in recordings)
    parts = [[re.sub(r"[^A-Za-z0-9._-]", "_", part).lstrip(".") for part in path[-MOST_PARTS:]] for path in split]
    found = ["" for _ in parts]
    for length in range(1, max(map(len, parts)) + 1):
        tried = ["-".join(p for p in part[-length:] if p) or "recording" for part in parts]
        counts, taken = Counter(tried), {*found}
        fits = [counts[new] == 1 and new not in taken and len(new) <= files.LONGEST_NAME for new in tried]
        found = [name or (new if fit else "") for name, new, fit in zip(found, tried, fits, strict=True)]
    taken = {*found}
    numbered = (name for k in itertools.count() if (name := f"recording{k}") not in taken)
    return [name or next(numbered) for name in found]


def absolute_out(out: str) -> str:
    """Make the folder of the runs an absolute path; a URL stays one."""
    return out.rstrip("/") if storage.is_url(out) else os.path.abspath(files.user_path(out))


def with_threads(order: Order, threads: int) -> Order:
    """Return each stage so many threads; its result does not depend on them."""
    return replace(order, threads=threads)


@contextmanager
def prepared(order: Order) -> Iterator[Order]:
    """Make the folder of the runs, with a file in it by which workers know the folder again.

    The file goes with the block, and so do those that killed batches of this machine left.
    """
    if storage.is_url(order.out):
        storage.connect(order.out)
        yield order
        return
    out = Path(order.out)
    out.mkdir(parents=True, exist_ok=True)
    _clear_markers(out)
    path = out / f"{MARKER}{uuid.uuid4().hex[:12]}"
    with path.open("xb", buffering=0) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
            with files.written(path):
                file.write(os.fsencode(platform.node()))
            yield replace(order, marker=path.name)
        finally:
            path.unlink(missing_ok=True)


def _clear_markers(out: Path) -> None:
    """Remove the markers of this machine whose processes are dead; of another machine's nobody can tell."""
    for left in out.glob(f"{MARKER}*"):
        with contextlib.suppress(OSError), files.open_regular(left) as file:  # locked by one that lives, or removed just now
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if file.read() == os.fsencode(platform.node()):
                left.unlink()
