"""Compile all kernels of a run before their first use on a machine, side by side, into the cache that later runs load them from."""

import contextlib
import fcntl
import functools
import hashlib
import importlib
import logging
import os
import pkgutil
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from slamcli.console import Progress, Tell, silent

PACKAGE = Path(__file__).parents[1]
PACKAGES = (
    "geometry",
    "vision",
    "depth",
    "estimation",
    "sparse_map",
    "datasets",
    "calibration",
    "slam",
    "dense",
    "navigation",
)  # that hold the kernels of a run
CHILD = "import sys; from slamcli.jit import compilation; compilation.compile_share(int(sys.argv[1]), int(sys.argv[2]))"
MOST_PROCESSES = 8
COMPILING = "compiling kernels; this happens once"
log = logging.getLogger(__name__)


class IncompleteError(Exception):
    """Some kernels were not compiled, or not kept."""


def ensure(*, progress: Progress = silent, tell: Tell = log.info) -> None:
    """Compile what the run will call, if that was not done on this machine for these sources."""
    from slamcli.jit import cache

    done = cache.folder() / f"compiled-{_digest(PACKAGES)}"
    if done.exists():
        return
    with _alone(done):
        if done.exists():
            return
        start, n = time.perf_counter(), 0
        tell(COMPILING)
        try:
            for _ in progress(compile_all(_cores()), "compiling [kernels]"):
                n += 1
        except IncompleteError:  # not marked as done: the next run tries again
            log.warning("%s: not every kernel could be kept there, so they are compiled anew each time; is the disk full?", done.parent)
            return
        log.info("compiled %d kernels in %.1f s", n, time.perf_counter() - start)
        with contextlib.suppress(OSError):  # a full disk: the next run looks again, and finds what could be kept
            done.touch()


@contextlib.contextmanager
def _alone(done: Path) -> Iterator[None]:
    """Let one program at a time compile what `done` stands for: the others would only do the same work beside it."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a file system without locks, or a full one: then side by side
            done.parent.mkdir(parents=True, exist_ok=True)
            fcntl.flock(stack.enter_context(open(done.with_name(f".{done.name}.lock"), "a")), fcntl.LOCK_EX)
        yield


def compile_all(processes: int) -> Iterator[str]:
    """Compile all declared kernels in several processes; yield a name as each is done. What fails is left to numba at the first call.

    Raises IncompleteError in the end where a process failed, or could not keep what it compiled.
    Nobody reads the errors that numba words, in colour, for every candidate type it tries in vain: without them it is a tenth faster.
    """
    from slamcli.jit import cache

    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache.folder().parent), "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
    home = Path(__file__).parents[2]  # there a child finds this very package first: another copy's kernels are cached apart
    children: list[subprocess.Popen] = []
    with contextlib.ExitStack() as stack:
        read, write = os.pipe()
        names = stack.enter_context(os.fdopen(read))
        for share in range(processes):
            command = [sys.executable, "-c", CHILD, str(share), str(processes)]
            child = subprocess.Popen(command, cwd=home, env=environment, stdin=subprocess.DEVNULL, stdout=write, stderr=subprocess.DEVNULL)
            children.append(child)
            stack.callback(child.wait)
            stack.callback(child.terminate)
        os.close(write)  # so that the pipe ends with the last child
        for name in names:
            yield name.strip()
        if any(child.wait() for child in children):
            raise IncompleteError


def compile_share(share: int, shares: int) -> None:
    """Compile every `shares`-th kernel, from number `share` on; a line on standard output tells of each."""
    from slamcli.jit.cache import UNSAVED
    from slamcli.jit.kernel import argument_types

    for compiled in declared()[share::shares]:
        compiled.compile(argument_types(compiled))
        sys.stdout.write(f"{compiled.py_func.__qualname__}\n")
        sys.stdout.flush()
    sys.exit(1 if UNSAVED else 0)


def declared() -> list[Any]:
    """Import every module that holds kernels of a run; give the declared ones, the largest first."""
    from slamcli.jit.kernel import DECLARED

    for package in PACKAGES:
        for module in pkgutil.iter_modules([str(PACKAGE / package)]):
            importlib.import_module(f"slamcli.{package}.{module.name}")
    return sorted(DECLARED, key=lambda k: (-len(k.py_func.__code__.co_code), k.py_func.__module__, k.py_func.__qualname__))


def _cores() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_PROCESSES)


@functools.cache
def _digest(packages: tuple[str, ...]) -> str:
    """Digest what compiled kernels depend on, and where their sources are: numba keeps them apart by that too.

    Once a process: a source that changes later is not imported again.
    """
    digest = hashlib.sha256(f"{platform.node()} {platform.python_version()} {version('numba')} {PACKAGE}".encode())
    for package in packages:
        for source in sorted((PACKAGE / package).glob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
