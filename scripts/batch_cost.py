#!/usr/bin/env python
"""What a batch adds to the recordings' own cost, and how many recordings a minute two workers do for each one of one worker.

    python scripts/batch_cost.py OUT [--recordings 6] [--frames 120] [--rounds 3] [--width 320]

The same simulated recordings run as batches of one and of two workers of this machine, in turn, after one recording each to load what
workers import. Overhead is what a recording takes in a batch of one worker more than its stages' own sum: wall and CPU time. OUT keeps
the recordings. Wall times tell something only on a machine that does nothing else; CPU times hold anyway.
"""

import argparse
import shutil
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamcli.batch import cluster, jobs
from slamcli.batch.jobs import Job, Order
from slamcli.console import table
from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate


@dataclass(frozen=True)
class Measured:
    """One batch, per recording [s]."""

    wall: float
    cpu: float  # of the workers
    stages_wall: float
    stages_cpu: float


def main() -> None:
    """Make the recordings, run, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--recordings", type=int, default=6)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--width", type=int, default=320)
    given = parser.parse_args()
    recordings = [recording(given.out.resolve() / "recordings" / f"room{k}", k, given) for k in range(given.recordings)]
    found: dict[int, list[Measured]] = {1: [], 2: []}
    for _ in range(given.rounds):
        for workers in found:
            found[workers].append(measure(workers, recordings, given.out.resolve() / "runs"))
    print(
        table(
            [
                ["workers", "recordings a minute", "wall [s]", "its stages [s]", "CPU [s]", "its stages [s]"],
                *([str(n), *row(of)] for n, of in found.items()),
            ],
            right=range(1, 6),
        )
    )
    ratio = statistics.median(one.wall / two.wall for one, two in zip(found[1], found[2], strict=True))
    over_wall, over_cpu = (statistics.median(getattr(m, n) - getattr(m, f"stages_{n}") for m in found[1]) for n in ("wall", "cpu"))
    print(f"two workers do {ratio:.2f} x the recordings of one; overhead a recording: {over_wall:.2f} s wall, {over_cpu:.2f} s CPU")


def row(found: list[Measured]) -> list[str]:
    """Show the medians of some rounds."""
    wall, stages_wall, cpu, stages_cpu = (
        statistics.median(getattr(m, name) for m in found) for name in ("wall", "stages_wall", "cpu", "stages_cpu")
    )
    return [f"{60.0 / wall:.1f}", *(f"{value:.2f}" for value in (wall, stages_wall, cpu, stages_cpu))]


def recording(folder: Path, seed: int, given: argparse.Namespace) -> str:
    """Render a recording unless it is there."""
    if not folder.exists():
        laps = 0.003 * given.frames
        simulate(folder, progress=silent, seed=seed, frames=given.frames, laps=laps, width=given.width, height=given.width * 3 // 4)
    return str(folder)


def measure(workers: int, recordings: list[str], out: Path) -> Measured:
    """Run a batch anew."""
    shutil.rmtree(out, ignore_errors=True)
    _, _, memory = cluster.local_size(workers)
    with jobs.prepared(Order(out=str(out))) as order, cluster.local(workers, memory) as client:
        warm = [Job(f"warm{k}", recordings[k % len(recordings)], order) for k in range(2 * workers)]
        list(cluster.work_off(client, warm))
        before, start = sum(client.run(time.process_time).values()), time.perf_counter()
        rows: list[dict[str, Any]] = list(cluster.work_off(client, jobs.jobs(recordings, order)))
        wall, cpu = time.perf_counter() - start, sum(client.run(time.process_time).values()) - before
    n = len(rows)
    return Measured(wall / n, cpu / n, sum(row["seconds"] for row in rows) / n, sum(row["cpu_seconds"] for row in rows) / n)


if __name__ == "__main__":
    main()
