#!/usr/bin/env python
"""Measure what it costs to check a run: digests of arrays, seals, the recording's identity, and the digests of sources.

    python scripts/checking_cost.py RECORDING OUT [--data FOLDER] [--rounds 3]

Each round makes the run OUT anew in a process of its own, in which the functions that check are timed, those within others not twice, and
without the parsing of the configuration, which is read in any case. What is printed is the CPU time [ms] of each and its share of that of
the whole process, workers included, kernels compiled before; the round with the median total.
"""

import argparse
import contextlib
import functools
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROUND = "--one-round"


def main() -> None:
    """Run the rounds and print the table of the middle one."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("recording")
    options.add_argument("out", type=Path)
    options.add_argument("--data", default=os.environ.get("SLAMCLI_DATA", "data"))
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument(ROUND, action="store_true", help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.one_round:
        print(json.dumps(one_round(given.recording, given.out, given.data)))
        return
    command = [sys.executable, __file__, given.recording, str(given.out), "--data", given.data, ROUND]
    rounds = []
    for _ in range(given.rounds):
        shutil.rmtree(given.out, ignore_errors=True)
        rounds.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout.splitlines()[-1]))
    middle = sorted(rounds, key=lambda found: sum(found["checks"].values()) / found["all"])[len(rounds) // 2]
    for what, seconds in sorted(middle["checks"].items(), key=lambda item: -item[1]):
        print(f"{what:<45} {1e3 * seconds:7.1f} ms {seconds / middle['all']:7.2%}")
    checks = sum(middle["checks"].values())
    print(f"{'all of it':<45} {1e3 * checks:7.1f} ms {checks / middle['all']:7.2%} of {middle['all']:.1f} s")


def one_round(recording: str, out: Path, data: str) -> dict[str, Any]:
    """Run a recording with what checks it timed; returns the seconds of each part and of the whole process."""
    from slamcli import artifacts, files
    from slamcli.cli.main import cli
    from slamcli.datasets.recording import Recording
    from slamcli.runs import damage, source_code
    from slamcli.runs.run_directory import RunDir

    spent: Counter[str] = Counter()
    timed(spent, "digests of files read", RunDir, "intact")
    timed(spent, "digests of files read", damage, "outputs")
    timed(spent, "values of arrays read", artifacts, "check_values")
    timed(spent, "lengths of arrays read beside", artifacts, "lengths")
    timed(spent, "what is stale, sizes of files", RunDir, "states")
    timed(spent, "seals", files, "_closed")
    timed(spent, "seals", damage, "seal")
    timed(spent, "digests of sources", source_code, "of_stage")
    timed(spent, "the recording's identity", Recording, "digest")
    timed(Counter(), "read in any case, whoever asks first", RunDir, "config")
    timed_digests(spent, artifacts.files)
    with contextlib.redirect_stdout(sys.stderr):
        cli.main(["run", recording, "--data", data, "-r", str(out)], standalone_mode=False)
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {"checks": spent, "all": sum(one.ru_utime + one.ru_stime for one in used)}


_open: list[float] = []  # of each timed function under way, the time spent in those within it


def timed(spent: Counter[str], what: str, home: object, name: str) -> None:
    """Count the CPU time of a function or method under `what`, less that of timed ones within."""
    inner: Callable[..., Any] = getattr(home, name)

    @functools.wraps(inner)
    def outer(*arguments: Any, **named: Any) -> Any:
        start = time.thread_time()
        _open.append(0.0)
        try:
            return inner(*arguments, **named)
        finally:
            took = time.thread_time() - start
            spent[what] += took - _open.pop()
            if _open:
                _open[-1] += took

    setattr(home, name, outer)


def timed_digests(spent: Counter[str], module: Any) -> None:
    """Count the digests made while arrays are written."""
    hashlib = module.hashlib

    class Timed:
        def __init__(self) -> None:
            self._digest = hashlib.sha256()

        def update(self, piece: bytes) -> None:
            start = time.thread_time()
            self._digest.update(piece)
            spent["digests of files written"] += time.thread_time() - start

        def hexdigest(self) -> str:
            return str(self._digest.hexdigest())

    inner = module.write_new

    @functools.wraps(inner)
    def outer(*arguments: Any) -> None:
        module.hashlib = Stand()
        try:
            inner(*arguments)
        finally:
            module.hashlib = hashlib

    class Stand:
        sha256 = Timed

    module.write_new = outer


if __name__ == "__main__":
    main()
