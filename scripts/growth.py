#!/usr/bin/env python
"""How a run's cost grows with the length of its recording.

    python scripts/growth.py RECORDING OUT [--frames 10000]

RECORDING is played forward and backward again and again, until there are as many frames, and half as many. Of each stage: CPU time per
frame of the first half and of the second, which is what the longer run took more than the shorter; compiling is left out. OUT keeps
recordings (lists, with links to the images) and runs, which are used again.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import rewritten

from slamcli import evaluate
from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.rundir import RunDir
from slamcli.stages import NAMES

HEADINGS = ["stage", "first half [ms/frame]", "second half [ms/frame]", "ratio", "share of the long run", "peak [MiB]"]


def main() -> None:
    """Make both recordings, run them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=10000, help="of the longer recording")
    given = parser.parse_args()
    try:
        lists = rewritten.listed(given.recording)
        short, long = (run_of(lists, n, given.out) for n in (given.frames // 2, given.frames))
        print(table([HEADINGS, *rows(short, long, given.frames)], right=range(1, len(HEADINGS))))
        for run in (short, long):
            print(summary(run))
    except SlamError as error:
        sys.exit(f"Error: {error}")


def run_of(lists: rewritten.Listed, frames: int, out: Path) -> RunDir:
    """Bring the run of so many frames up to date."""
    recording = rewritten.write(out / f"frames{frames}", rewritten.to_and_fro(lists, frames))
    folder = out / f"frames{frames}.run"
    subprocess.run([sys.executable, "-m", "slamcli", "run", str(recording), "-r", str(folder)], check=True, stdout=subprocess.DEVNULL)
    return RunDir.find(str(folder))


def rows(short: RunDir, long: RunDir, frames: int) -> list[list[str]]:
    """Make a line of each stage, and of their sum."""
    cpu = {name: [seconds(run, name) for run in (short, long)] for name in NAMES}
    cpu["all"] = [sum(both) for both in zip(*cpu.values(), strict=True)]
    peak = {name: long.record(name)["peak_rss_mb"] for name in NAMES}
    peak["all"] = max(peak.values())
    half = frames // 2
    found = []
    for name, (first, both) in cpu.items():
        second = both - first
        figures = (1e3 * first / half, 1e3 * second / (frames - half))
        shares = (f"{second / first:.2f}", f"{100 * both / cpu['all'][1]:.1f} %", f"{peak[name]:.0f}")
        found.append([name, *(f"{value:.2f}" for value in figures), *shares])
    return found


def seconds(run: RunDir, stage: str) -> float:
    """Give a stage's CPU time without compiling [s]."""
    record = run.record(stage)
    return record["cpu_seconds"] - record["compile_seconds"]


def summary(run: RunDir) -> str:
    """Tell what became of a run."""
    loop, key_frames = run.record("loop")["summary"], run.record("track")["summary"]["key_frames"]
    found = evaluate.ape(evaluate.stage_trajectory(run, "loop"), evaluate.ground_truth(run), n_frames=loop["frames"], name="loop")
    ape = evaluate.statistics(found.error)["rmse"]
    return f"{loop['frames']} frames: {key_frames} key frames, {loop['closures']} closures, {loop['lost']} lost, APE {ape:.4f} m"


if __name__ == "__main__":
    main()
