"""Talk to the person at the terminal: progress, log, tables. All of it goes to stderr; results go to stdout.

The library takes a `Progress` and a `Tell` from its caller: the command line gives `progress` and `say`, a notebook its own or none.
"""

import logging
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

Item = TypeVar("Item")
Progress = Callable[..., Iterable[Any]]  # (items, label, total=None) -> the same items, one by one
Tell = Callable[[str], Any]  # takes a line
ROOT = logging.getLogger("slamcli")


class _StderrHandler(logging.Handler):
    """Write a line above a progress bar that may be on screen, to whatever stderr is at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        say(f"{record.levelname.capitalize()}: {record.getMessage()}" if record.levelno >= logging.WARNING else record.getMessage())


def say(line: str) -> None:
    """Write one line to stderr, above a progress bar if there is one."""
    if "tqdm" in sys.modules:
        sys.modules["tqdm"].tqdm.write(line, file=sys.stderr)
    else:
        sys.stderr.write(line + "\n")


def set_up(verbosity: int) -> None:
    """Send the log to stderr: warnings, from 1 information, from 2 everything."""
    if not any(isinstance(handler, _StderrHandler) for handler in ROOT.handlers):
        ROOT.addHandler(_StderrHandler())
        ROOT.setLevel(logging.DEBUG)  # log.txt has everything whatever the terminal shows
    for handler in ROOT.handlers:
        if isinstance(handler, _StderrHandler):
            handler.setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[min(verbosity, 2)])


@contextmanager
def log_file(path: Path) -> Iterator[None]:
    """Append everything that is logged meanwhile to a file, and the traceback of what ends it early."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    ROOT.addHandler(handler)
    try:
        yield
    except BaseException:
        ROOT.debug("ended early", exc_info=True)
        raise
    finally:
        ROOT.removeHandler(handler)
        handler.close()


def silent(iterable: Iterable[Item], label: str = "", total: int | None = None) -> Iterable[Item]:
    """Pass the items through and show nothing."""
    return iterable


def progress(iterable: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Pass the items through under a bar with rate and time left; silent when stderr is no terminal.

    label : what is done; a last word in [brackets] says what is counted, else frames are
    """
    if not sys.stderr.isatty():
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


def stage_line(record: Mapping[str, Any]) -> str:
    """Tell one finished stage in a line: frames, time, rate, and the counts of its summary."""
    summary = record["summary"]
    parts = [f"{record['stage']:<9}"]
    if "frames" in summary:
        parts.append(f"{summary['frames']} frames")
    parts.append(f"{record['seconds']:.1f} s")
    if record["fps"]:
        parts.append(f"{record['fps']:.1f} fps")
    if record["compile_seconds"] >= 0.5:
        parts.append(f"({record['compile_seconds']:.1f} s of it compiling kernels, this once)")
    counts = [(name, value) for name, value in summary.items() if name != "frames" and isinstance(value, (int, float, str))]
    parts += [
        f"{name.replace('_', ' ')} {value:.4g}" if isinstance(value, float) else f"{name.replace('_', ' ')} {value}"
        for name, value in counts
    ]
    if record["n_warnings"]:
        parts.append(f"{record['n_warnings']} warnings")
    return "  ".join(parts)
