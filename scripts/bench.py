#!/usr/bin/env python
"""What each stage of a run cost, from the records the stages left.

    python scripts/bench.py                                   the last run
    python scripts/bench.py -r runs/tum/fr1_xyz
    python scripts/bench.py --run tum/fr1_xyz [-s KEY=VALUE]   run every stage anew first, in a folder of its own

CPU time is of all threads; per frame it is divided by the recording's colour frames. Compiling kernels, which happens once per
installation, is shown apart and is not part of the per-frame figures.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.rundir import RunDir
from slamcli.stages import NAMES

HEADINGS = ["stage", "wall [s]", "CPU [s]", "compiling [s]", "CPU [ms/frame]", "frames/s", "peak [MiB]", "output [MB]"]


def whole_process(n_frames: int) -> str:
    """Tell what the child process cost in all: starting, importing and hashing belong to no stage."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = used.ru_utime + used.ru_stime
    return f"whole process: {cpu:.1f} s CPU, {cpu / n_frames * 1e3:.1f} ms a frame with compiling; peak {used.ru_maxrss / 2**10:.0f} MiB"


def run_anew(target: str, assignments: list[str], folder: Path) -> RunDir:
    """Run every stage in a process of its own, so that nothing here weighs on its memory."""
    settings = [argument for assignment in assignments for argument in ("-s", assignment)]
    subprocess.run([sys.executable, "-m", "slamcli", "run", target, "-r", str(folder), *settings], check=True, stdout=subprocess.DEVNULL)
    return RunDir.find(str(folder))


def measured(run: RunDir) -> list[dict[str, Any]]:
    """Give the record of each stage that has been run, in order."""
    return [record for name in NAMES if (record := run.record(name)) is not None]


def rows(records: list[dict[str, Any]], n_frames: int) -> list[list[str]]:
    """Make the table: a row a stage, and their sum. The sum's memory is the largest, its rate that of the whole."""
    found = [HEADINGS]
    for record in records:
        found.append(row(record["stage"], [record], n_frames))
    return [*found, row("all", records, n_frames)]


def row(name: str, records: list[dict[str, Any]], n_frames: int) -> list[str]:
    """Add up records and show them per frame of the recording."""
    wall, cpu, compiling = (sum(record[key] for record in records) for key in ("seconds", "cpu_seconds", "compile_seconds"))
    size = sum(entry["bytes"] for record in records for entry in record["outputs"].values())
    per_frame = (cpu - compiling) / n_frames * 1e3
    rate = n_frames / (wall - compiling) if wall > compiling else float("inf")
    peak = max(record["peak_rss_mb"] for record in records)
    return [name, f"{wall:.1f}", f"{cpu:.1f}", f"{compiling:.1f}", f"{per_frame:.1f}", f"{rate:.1f}", f"{peak:.0f}", f"{size / 1e6:.1f}"]


def show(run: RunDir) -> int:
    """Print the table of a run; give its number of frames."""
    records = measured(run)
    if not records or records[0]["stage"] != "extract":
        raise SlamError(f"{run.path}: extract has not been run, so there is nothing to show")
    n_frames = records[0]["summary"]["frames"]
    environment = records[-1]["environment"]
    print(f"{run.info()['dataset']}: {n_frames} frames, {os.cpu_count()} cores; " + ", ".join(f"{k} {v}" for k, v in environment.items()))
    print(table(rows(records, n_frames), right=range(1, len(HEADINGS))))
    return n_frames


def main() -> None:
    """Read the arguments and show what they ask for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-r", metavar="DIR", help="the run to show; default: $SLAMCLI_RUN, else runs/latest")
    parser.add_argument("--run", metavar="TARGET", help="run this recording anew and show that")
    parser.add_argument("-s", metavar="KEY=VALUE", action="append", default=[], help="setting for --run")
    given = parser.parse_args()
    try:
        if given.run:
            with tempfile.TemporaryDirectory(prefix="slamcli-bench-") as folder:
                print(whole_process(show(run_anew(given.run, given.s, Path(folder)))))
        else:
            show(RunDir.find(given.r))
    except SlamError as error:
        sys.exit(f"Error: {error}")
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)


if __name__ == "__main__":
    main()
