"""Talk to the person at the terminal: progress, log, tables. All of it goes to stderr; results go to stdout.

The library takes a `Progress` and a `Tell` from its caller: the command line gives `progress` and `say`, a notebook its own or none.
"""

import contextlib
import logging
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from io import TextIOWrapper
from pathlib import Path
from typing import Any, TypeVar

from slamcli import files

Item = TypeVar("Item")
Progress = Callable[..., Iterable[Any]]  # (items, label, total=None) -> the same items, one by one
Tell = Callable[[str], Any]  # takes a line
ROOT = logging.getLogger("slamcli")
AMBER, PLAIN = "\x1b[33m", "\x1b[0m"
_stage: ContextVar[str] = ContextVar("_stage", default="")  # that is at work


class _Voice:
    """How much is told: -v counts up, --quiet leaves nothing but warnings."""

    verbosity = 0
    is_quiet = False


class _StderrHandler(logging.Handler):
    """Write a line above a progress bar that may be on screen, to whatever stderr is at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        _write(f"{record.levelname.capitalize()}: {record.getMessage()}" if record.levelno >= logging.WARNING else record.getMessage())


class _LogLines(logging.Formatter):
    """Give each line of a message the seconds since the log was begun, the stage that is at work, "-" for none, and the level."""

    def __init__(self) -> None:
        super().__init__()
        self._began = time.time()

    def format(self, record: logging.LogRecord) -> str:
        """Lay a record out; a message that begins with its stage, as on the terminal, is not told it twice."""
        stage = _stage.get()
        head = f"{max(0.0, record.created - self._began):9.3f} s  {stage or '-':<8}  {record.levelname:<7}  "
        return "\n".join(head + line for line in super().format(record).removeprefix(f"{stage}: ").splitlines())


class _LogFile(logging.FileHandler):
    """The run's log. A disk that is full stops the run where it writes results, and says so there."""

    def tell(self, message: str) -> None:
        """Write a line that the terminal does not show."""
        self.handle(ROOT.makeRecord(ROOT.name, logging.INFO, "", 0, message, (), None))

    def _open(self) -> TextIOWrapper:
        """Follow no link, and wait for no pipe."""
        return files.open_own(self.baseFilename)

    def handleError(self, record: logging.LogRecord) -> None:
        """Go on without this line."""


def say(line: str) -> None:
    """Write one line to stderr, above a progress bar if there is one; nothing under `--quiet`."""
    if not _Voice.is_quiet:
        _write(line)


def amber(text: str) -> str:
    """Colour what asks for attention, where stderr is a terminal that wants colours."""
    return f"{AMBER}{text}{PLAIN}" if sys.stderr and sys.stderr.isatty() and "NO_COLOR" not in os.environ else text


def _write(line: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # full or gone, closed, absent: no reason to stop
        if "tqdm" in sys.modules:
            sys.modules["tqdm"].tqdm.write(line, file=sys.stderr)
        else:
            sys.stderr.write(line + "\n")


def is_verbose() -> bool:
    """Say whether more was asked for, by -v."""
    return _Voice.verbosity > 0


def set_up(verbosity: int, *, quiet: bool = False) -> None:
    """Send the log to stderr: warnings, from 1 information, from 2 everything; `quiet` leaves out progress and what was made."""
    _Voice.verbosity, _Voice.is_quiet = verbosity, quiet
    if not any(isinstance(handler, _StderrHandler) for handler in ROOT.handlers):
        ROOT.addHandler(_StderrHandler())
        ROOT.setLevel(logging.DEBUG)  # log.txt has everything whatever the terminal shows
    for handler in ROOT.handlers:
        if isinstance(handler, _StderrHandler):
            handler.setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[min(verbosity, 2)])


@contextmanager
def at_work(stage: str) -> Iterator[None]:
    """Put the stage's name into the lines of the log meanwhile."""
    token = _stage.set(stage)
    try:
        yield
    finally:
        _stage.reset(token)


@contextmanager
def log_file(path: Path, what: str) -> Iterator[None]:
    """Append everything that is logged meanwhile to a file, after date and time and `what` is done, and the traceback of what ends it early."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(_LogLines())
    ROOT.addHandler(handler)
    handler.tell(f"{time.strftime('%Y-%m-%d %H:%M:%S %z')}: {what}")
    try:
        yield
        handler.tell("ended")
    except BaseException:
        ROOT.debug("ended early", exc_info=True)
        raise
    finally:
        ROOT.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()


def silent(iterable: Iterable[Item], label: str = "", total: int | None = None) -> Iterable[Item]:
    """Pass the items through and show nothing."""
    return iterable


def progress(iterable: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Pass the items through under a bar with rate and time left; silent when stderr is no terminal.

    label : what is done; a last word in [brackets] says what is counted, else frames are
    """
    if sys.stderr is None or not sys.stderr.isatty() or _Voice.is_quiet:
        yield from iterable
        return
    from tqdm import tqdm

    name, _, unit = label.removesuffix("]").partition(" [")
    yield from tqdm(
        iterable, desc=name, total=total, unit=f" {unit or 'frames'}", file=sys.stderr, leave=False, dynamic_ncols=True, mininterval=0.2
    )


def table(rows: Sequence[Sequence[str]], *, right: Iterable[int] = ()) -> str:
    """Align columns by blanks; the columns numbered in `right` to the right."""
    right = set(right)
    width = [max(len(row[column]) for row in rows if column < len(row)) for column in range(max(map(len, rows)))]
    lines = ("  ".join(cell.rjust(width[i]) if i in right else cell.ljust(width[i]) for i, cell in enumerate(row)).rstrip() for row in rows)
    return "\n".join(lines)


def stage_line(record: Mapping[str, Any], told: Sequence[str] | None) -> str:
    """Tell one finished stage in a line: frames, time, rate, and those counts of its summary that are `told`; all of them for None, and under -v."""
    summary = record["summary"]
    parts = [f"{record['stage']:<9}"]
    if "frames" in summary:
        parts.append(f"{summary['frames']} frames")
    parts.append(f"{record['seconds']:.1f} s")
    if record["fps"]:
        parts.append(f"{record['fps']:.1f} fps")
    if record["compile_seconds"] >= 0.5:
        parts.append(f"({record['compile_seconds']:.1f} s of it compiling kernels, this once)")
    parts += counts(summary, None if is_verbose() else told)
    if record["n_warnings"]:
        parts.append(warning_count(record["n_warnings"]))
    return "  ".join(parts)


def _singular(word: str) -> str:
    """Take the plural from "closures", "key frames" or "frames without depth"."""
    noun, preposition, rest = word.partition(" without ")
    return noun.removesuffix("s") + preposition + rest


def warning_count(n: int) -> str:
    """Write a number of warnings."""
    return f"{n} warning{'s' * (n != 1)}"


def counts(summary: Mapping[str, Any], names: Sequence[str] | None = None) -> list[str]:
    """Write the numbers, words and counts by name of a stage's summary as "8609 landmarks"; of those in `names` that are there and not 0, or all."""
    found = []
    for name, value in summary.items():
        if (
            name == "frames"
            or not isinstance(value, (int, float, str, Mapping))
            or (names is not None and (name not in names or value == 0))
        ):
            continue
        word = name.replace("_", " ")
        if type(value) is int and value == 1:
            word = _singular(word)
        if isinstance(value, Mapping):
            found.append(f"{word}: {', '.join(f'{count} {kind}' for kind, count in value.items())}")
        elif isinstance(value, (bool, str)):
            found.append(f"{word}: {'yes' if value is True else 'no' if value is False else value}")
        else:
            found.append(f"{value:.4g} {word}" if isinstance(value, float) else f"{value} {word}")
    return found
