#!/usr/bin/env python
"""How a run's cost grows with the length of its recording.

    python scripts/growth.py RECORDING OUT [--frames 10000] [--first 5000] [--restart]
    python scripts/growth.py RECORDING OUT --frames 100000 --tenths

RECORDING is played forward and backward again and again, or with --restart from its start each time, until there are as many frames. Of
each stage: CPU time per frame of the first part and of the rest, which is what the whole took more than a run of the first part alone, and
the peak memory of both; compiling is left out. With --tenths there is one run only: of each loop over all frames, the CPU time per frame of
its first and its last tenth, and of each stage its share and its peak memory. OUT keeps recordings (lists, with links to the images) and runs, which are used again.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import own_process
import rewritten

from slamcli import console
from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

HEADINGS = ["stage", "first part [ms/frame]", "rest [ms/frame]", "ratio", "share of the whole", "peak of first [MiB]", "of whole [MiB]"]
TENTHS_HEADINGS = ["stage", "loop", "first tenth [ms/frame]", "last tenth [ms/frame]", "ratio"]


def main() -> None:
    """Make both recordings, run them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=10000, help="of the whole [10000]")
    parser.add_argument("--first", type=int, help="of the first part [half of them]")
    parser.add_argument("--restart", action="store_true", help="play from the start each time instead of turning back")
    parser.add_argument("--tenths", action="store_true", help="run the whole alone, and compare its first tenth with its last")
    given = parser.parse_args()
    first = given.first or given.frames // 2
    try:
        lists = rewritten.listed(given.recording)
        if given.tenths:
            tell_tenths(run_of(lists, given.frames, given.out, turning=not given.restart), given.frames)
            return
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
        marks = partial(marked, out / f"{name}.{stage}.json")
        run = own_process.run(recording, path=folder, until=stage, progress=marks)
    return run.directory


def marked(file: Path, items: Iterable[Any], label: str, total: int | None = None) -> Iterator[Any]:
    """Pass items through under a bar, and keep in a file the process's CPU time [s] at every tenth of them."""
    items = list(items) if total is None and not hasattr(items, "__len__") else items
    n = len(items) if total is None else total  # type: ignore[arg-type]
    marks = [time.process_time()]
    for number, item in enumerate(console.progress(items, label, n), start=1):
        yield item
        if 10 * number // n > len(marks) - 1:
            marks.append(time.process_time())
    known = json.loads(file.read_text()) if file.exists() else []
    file.write_text(json.dumps([*known, {"label": label, "items": n, "cpu_seconds": marks}]))


def tell_tenths(run: RunDir, frames: int) -> None:
    """Print the first and the last tenth of each loop over at least half of the frames, and what each stage takes."""
    found, first, last = [TENTHS_HEADINGS], 0.0, 0.0
    for stage in NAMES:
        file = run.path.with_name(f"{run.path.name.removesuffix('.run')}.{stage}.json")
        for loop in json.loads(file.read_text()) if file.exists() else []:
            marks = loop["cpu_seconds"]
            if 2 * loop["items"] > frames and len(marks) == 11:
                a, b = (1e4 * (marks[k + 1] - marks[k]) / frames for k in (0, 9))
                found.append([stage, loop["label"], f"{a:.2f}", f"{b:.2f}", f"{b / a:.2f}"])
                first, last = first + a, last + b
    found.append(["all", "", f"{first:.2f}", f"{last:.2f}", f"{last / first:.2f}"])
    print(table(found, right=range(2, 5)))
    whole = sum(seconds(run, stage) for stage in NAMES)
    rows = [
        [s, f"{1e3 * seconds(run, s) / frames:.2f}", f"{100 * seconds(run, s) / whole:.1f} %", f"{run.record(s)['peak_rss_mb']:.0f}"]
        for s in NAMES
    ]
    print(table([["stage", "CPU [ms/frame]", "share", "peak [MiB]"], *rows], right=range(1, 4)))
    print(f"{1e3 * whole / frames:.2f} ms of CPU time and {disk_bytes(run) / frames / 1e3:.1f} kB of disk a frame")
    print(summary(run))


def disk_bytes(run: RunDir) -> int:
    """Return how much the stages' files take."""
    return sum(entry["bytes"] for stage in NAMES for entry in run.record(stage)["outputs"].values())


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
        run_trajectories.stage_trajectory(run, "loop"), run_trajectories.ground_truth(run), n_frames=loop["frames"], name="loop"
    )
    ape = found.rmse
    return f"{loop['frames']} frames: {key_frames} key frames, {loop['closures']} closures, {loop['lost']} lost, APE {ape:.4f} m"


if __name__ == "__main__":
    main()
