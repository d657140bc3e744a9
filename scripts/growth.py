#!/usr/bin/env python
"""How a run's cost grows with the length of its recording.

    python scripts/growth.py RECORDING OUT [--frames 10000] [--first 5000] [--restart]

RECORDING is played forward and backward again and again, or with --restart from its start each time, until there are as many frames. Of
each stage: CPU time per frame of the first part and of the rest, which is what the whole took more than a run of the first part alone, and
the peak memory of both; compiling is left out. OUT keeps recordings (lists, with links to the images) and runs, which are used again.
"""

import argparse
import sys
from pathlib import Path

import own_process
import rewritten

from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.evaluation import trajectory_error
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

HEADINGS = ["stage", "first part [ms/frame]", "rest [ms/frame]", "ratio", "share of the whole", "peak of first [MiB]", "of whole [MiB]"]


def main() -> None:
    """Make both recordings, run them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=10000, help="of the whole [10000]")
    parser.add_argument("--first", type=int, help="of the first part [half of them]")
    parser.add_argument("--restart", action="store_true", help="play from the start each time instead of turning back")
    given = parser.parse_args()
    first = given.first or given.frames // 2
    try:
        lists = rewritten.listed(given.recording)
        short, long = (run_of(lists, n, given.out, turning=not given.restart) for n in (first, given.frames))
        print(table([HEADINGS, *rows(short, long, first, given.frames)], right=range(1, len(HEADINGS))))
        for run in (short, long):
            print(summary(run))
    except SlamError as error:
        sys.exit(f"Error: {error}")


def run_of(lists: rewritten.Listed, frames: int, out: Path, *, turning: bool) -> RunDir:
    """Bring the run of so many frames up to date."""
    name = f"frames{frames}" if turning else f"restarted{frames}"
    recording = rewritten.write(out / name, rewritten.again(lists, frames, turning=turning))
    folder = out / f"{name}.run"
    for stage in NAMES:  # each in a process of its own: what it holds at its peak is its own, too
        run = own_process.run(recording, path=folder, until=stage)
    return run.directory


def rows(short: RunDir, long: RunDir, first: int, frames: int) -> list[list[str]]:
    """Make a line of each stage, and of all together."""
    cpu = {name: [seconds(run, name) for run in (short, long)] for name in NAMES}
    cpu["all"] = [sum(both) for both in zip(*cpu.values(), strict=True)]
    peak = {name: [run.record(name)["peak_rss_mb"] for run in (short, long)] for name in NAMES}
    peak["all"] = [max(of) for of in zip(*peak.values(), strict=True)]
    found = []
    for name, (before, both) in cpu.items():
        figures = (1e3 * before / first, 1e3 * (both - before) / (frames - first))
        shares = (f"{figures[1] / figures[0]:.2f}", f"{100 * both / cpu['all'][1]:.1f} %")
        found.append([name, *(f"{value:.2f}" for value in figures), *shares, *(f"{value:.0f}" for value in peak[name])])
    return found


def seconds(run: RunDir, stage: str) -> float:
    """Return a stage's CPU time without compiling [s]."""
    record = run.record(stage)
    return record["cpu_seconds"] - record["compile_seconds"]


def summary(run: RunDir) -> str:
    """Tell what became of a run."""
    loop, key_frames = run.record("loop")["summary"], run.record("track")["summary"]["key_frames"]
    found = trajectory_error.ape(
        trajectory_error.stage_trajectory(run, "loop"), trajectory_error.ground_truth(run), n_frames=loop["frames"], name="loop"
    )
    ape = trajectory_error.statistics(found.error)["rmse"]
    return f"{loop['frames']} frames: {key_frames} key frames, {loop['closures']} closures, {loop['lost']} lost, APE {ape:.4f} m"


if __name__ == "__main__":
    main()
