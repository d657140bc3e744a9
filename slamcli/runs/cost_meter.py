"""What a stage costs: wall and CPU time, peak memory, and the time numba spent compiling."""

import contextlib
import ctypes
import gc
import os
import resource
import sys
import threading
import time
from types import TracebackType
from typing import Any

from slamcli.console import Tell
from slamcli.jit.compilation import COMPILING

SAMPLING = 0.02  # [s] between looks at the resident memory
MUCH = 256.0  # [MiB] taken by a stage, from which on 50 ms and more of looking for what can be freed are worth it


class Meter:
    """Measure the block it is wrapped around.

    Memory is sampled, since the kernel's own high-water mark belongs to the whole process and an earlier stage may have set it.
    """

    seconds = cpu_seconds = compile_seconds = 0.0
    peak_rss_mb = 0.0
    _before_mb = 0.0
    _watch: Any = None

    def __enter__(self) -> "Meter":
        self._done, self._before_mb = threading.Event(), _resident_mb()
        self._sampler = threading.Thread(target=self._sample, name="slamcli-memory", daemon=True)
        self._start, self._cpu_start = time.perf_counter(), time.process_time()
        self._sampler.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.seconds = time.perf_counter() - self._start
        self.cpu_seconds = time.process_time() - self._cpu_start
        self._done.set()
        self._sampler.join()
        if self._watch is not None:
            from numba.core import event

            event.unregister("numba:compile", self._watch)
            self.compile_seconds = self._watch.total

    @property
    def taken_mb(self) -> float:
        """Return by how much memory has grown at its peak [MiB]."""
        return self.peak_rss_mb - self._before_mb

    def watch_compiler(self, tell: Tell) -> None:
        """Count compilation from here on, if numba has been imported by now; `tell` hears of the first."""
        if "numba" in sys.modules:
            from numba.core import event

            self._watch = _compiler_watch(tell)
            event.register("numba:compile", self._watch)

    def add(self, *, seconds: float, cpu_seconds: float, peak_rss_mb: float) -> None:
        """Count what a part of the work has cost elsewhere."""
        self.seconds += seconds
        self.cpu_seconds += cpu_seconds
        self.peak_rss_mb = max(self.peak_rss_mb, peak_rss_mb)

    def _sample(self) -> None:
        while True:
            self.peak_rss_mb = max(self.peak_rss_mb, _resident_mb())
            if self._done.wait(SAMPLING):
                self.peak_rss_mb = max(self.peak_rss_mb, _resident_mb())
                return


def return_free_memory(taken_mb: float) -> None:
    """Hand what a stage left back to the system, where the C library can: else it would count as the next stage's too.

    taken_mb : what the stage took; where that is much, what its objects hold by referring to one another is looked for too
    """
    if taken_mb > MUCH:
        gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # a C library other than glibc
        ctypes.CDLL(None).malloc_trim(0)


def _resident_mb() -> float:
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:  # no /proc: the process's own high-water mark, in kB but on macOS in bytes
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _compiler_watch(tell: Tell) -> Any:
    """Build the listener that adds up the time of real compilations; loading from numba's cache is none."""
    from numba.core import event

    class Watch(event.Listener):
        depth, start, total = 0, 0.0, 0.0  # a kernel compiles the helpers it calls within its own compilation

        def on_start(self, _: event.Event) -> None:
            if self.depth == 0:
                self.start = time.perf_counter()
                if self.total == 0.0:
                    tell(COMPILING)
            self.depth += 1

        def on_end(self, _: event.Event) -> None:
            self.depth -= 1
            if self.depth == 0:
                self.total += time.perf_counter() - self.start

    return Watch()
