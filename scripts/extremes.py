#!/usr/bin/env python
"""Run a recording with each number of the configuration at the ends of what it may be: a result or one line, in bounded time and memory.

    python scripts/extremes.py ONE [--only PART] [--minutes 5] [--gib 4]

ONE is a short recording. A finished run of it is made first and then brought up to date, again and again from the same state, with one
option at its least or its largest value. What must hold each time: status 0, or status 1 with a line that begins with Error; no traceback;
no more than so many minutes of CPU and GiB of memory. Exit status 1 where anything did not hold.
"""

import argparse
import dataclasses
import math
import os
import resource
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from stand import Stand

from slamcli.config.options import Config

NEXT = 1e-9  # how near to a bound that is not itself allowed, as a share of it


def main() -> int:
    """Try both ends of every number."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("one", type=Path)
    options.add_argument("--only", default="", metavar="PART", help="only options in whose name PART occurs")
    options.add_argument("--minutes", type=float, default=5.0, help="of CPU that a run may take [5]")
    options.add_argument("--gib", type=float, default=4.0, help="of memory that a run may take [4]")
    given = options.parse_args()
    n_tried = n_refused = n_faults = 0
    with tempfile.TemporaryDirectory(prefix="slamcli-extremes-") as folder:
        stand = Stand(Path(folder), given.one, given.one, ())
        shutil.copytree("run", "kept")
        for name, value in ends():
            if given.only not in name:
                continue
            shutil.rmtree("run")
            shutil.copytree("kept", "run")
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            ended = stand.call(("run", "-r", "run", "-s", f"{name}={value!r}"), within=lambda: bound(given.minutes, given.gib))
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            n_tried += 1
            n_refused += ended.status == 1
            errors = [line for line in ended.said.splitlines() if line.startswith("Error")]
            is_fault = "Traceback" in ended.said or ended.status not in (0, 1) or (ended.status == 1 and len(errors) > 1)
            n_faults += is_fault
            told = ended.said[-300:].strip() if is_fault else (errors or [""])[0]
            print(f"{'FAULT ' * is_fault}{name} = {value!r}: status {ended.status}, {seconds:.1f} s  {told}", flush=True)
        os.chdir("/")
    print(f"{n_tried} tried, {n_refused} refused, {n_faults} faults")
    return 1 if n_faults else 0


def ends() -> Iterator[tuple[str, float]]:
    """List the least and the largest value of every number."""
    for section in dataclasses.fields(Config):
        value = getattr(Config(), section.name)
        for spec in dataclasses.fields(value) if dataclasses.is_dataclass(value) else ():
            bounds, kind = spec.metadata["bounds"], type(spec.default)
            if kind not in (int, float) or not bounds:
                continue
            for closed, open_, inward in (("ge", "gt", 1), ("le", "lt", -1)):
                at = kind(bounds.get(closed, bounds.get(open_)))
                if open_ in bounds:
                    at += inward if kind is int else inward * NEXT * max(abs(at), 1.0)
                yield f"{section.name}.{spec.name}", at


def bound(minutes: float, gib: float) -> None:
    """Bound the time and the memory of this process."""
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(60 * minutes), math.ceil(60 * minutes) + 5))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + int(gib * (1 << 30))
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


if __name__ == "__main__":
    sys.exit(main())
