#!/usr/bin/env python
"""Kill a worker, the client and the scheduler of a batch at random moments, and see whether the batch is whole in the end.

    python scripts/batch_kills.py OUT [--victims worker client scheduler] [--kills 20] [--recordings 3] [--frames 30] [--seed 0]

Small simulated recordings are run once by `slamcli.run`; then, for each kill, as a batch on a scheduler and two workers of the loopback.
At a random moment between the start and the end of an undisturbed batch one process dies by SIGKILL and is started again; the batch is
given again until it ends with status 0. Checked each time: one row a recording, all done, every stage of the same bytes as the local
run's, nothing half-written left. OUT keeps the recordings.
"""

import argparse
import csv
import json
import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import slamcli
from slamcli.console import table
from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

VICTIMS = ("worker", "client", "scheduler")
PATIENCE = 300.0  # [s] for one batch
MOST_ATTEMPTS = 5


class Cluster:
    """A scheduler and two workers, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen] = {}
        self.start()

    def start(self) -> None:
        """Start what does not run."""
        if not self._runs("scheduler"):
            for name in ("one", "two"):
                self.kill(name)  # they belong to the scheduler that is gone
            file = self.folder / "scheduler.json"
            file.unlink(missing_ok=True)
            self._start(
                "scheduler",
                "scheduler",
                "--host",
                "127.0.0.1",
                "--port",
                "0",
                "--dashboard-address",
                "127.0.0.1:0",
                "--scheduler-file",
                file,
            )
            while not file.exists() or not file.read_text().endswith("}"):
                time.sleep(0.05)
            self.address = json.loads(file.read_text())["address"]
        for name in ("one", "two"):
            if not self._runs(name):
                scratch = self.folder / "scratch"
                self._start(
                    name,
                    "worker",
                    self.address,
                    "--nthreads",
                    1,
                    "--no-nanny",
                    "--name",
                    name,
                    "--local-directory",
                    scratch,
                    "--no-dashboard",
                )
        self._wait_for_workers()

    def kill(self, name: str) -> None:
        """End a process as a power cut would."""
        if name in self.processes:
            self.processes[name].kill()
            self.processes[name].wait()

    def stop(self) -> None:
        """End all of them."""
        for name in list(self.processes):
            self.kill(name)

    def _runs(self, name: str) -> bool:
        return name in self.processes and self.processes[name].poll() is None

    def _start(self, name: str, what: str, *arguments: object) -> None:
        with open(self.folder / "dask.log", "a") as log:
            command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *map(str, arguments)]
            self.processes[name] = subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log)

    def _wait_for_workers(self) -> None:
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)


def main() -> None:
    """Make the recordings, kill, print the table; status 1 when a batch was not whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--victims", nargs="+", choices=VICTIMS, default=VICTIMS)
    parser.add_argument("--kills", type=int, default=20, help="of each victim")
    parser.add_argument("--recordings", type=int, default=3)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.out = given.out.resolve()
    recordings = [recording(given.out / "recordings" / f"room{k}", k, given.frames) for k in range(given.recordings)]
    reference = {path.name: digests(slamcli.run(path, path=given.out / "reference" / path.name).directory) for path in recordings}
    rng = random.Random(given.seed)
    rows = [["victim", "kills", "whole in the end", "batches given", "stages run twice"]]
    cluster = Cluster(given.out)
    try:
        batch(cluster, recordings, given.out / "undisturbed")  # the workers import what they need
        start = time.monotonic()
        batch(cluster, recordings, given.out / "undisturbed2")
        duration = time.monotonic() - start
        for victim in given.victims:
            found = [one(cluster, victim, rng.uniform(0.0, duration), recordings, reference, given.out) for _ in range(given.kills)]
            rows.append([victim, str(len(found)), *(str(sum(column)) for column in zip(*found, strict=True))])
            print(table(rows, right=range(1, 5)), flush=True)
    finally:
        cluster.stop()
    sys.exit(any(row[1] != row[2] for row in rows[1:]))


def recording(folder: Path, seed: int, frames: int) -> Path:
    """Render a small recording unless it is there."""
    if not folder.exists():
        simulate(folder, progress=silent, seed=seed, frames=frames, laps=0.004 * frames, width=160, height=120)
    return folder


def start_batch(cluster: Cluster, recordings: list[Path], out: Path) -> subprocess.Popen:
    """Return the command."""
    command = [sys.executable, "-m", "slamcli", "batch", *map(str, recordings), "--out", str(out), "--cluster", cluster.address]
    with open(out.parent / "batch.log", "a") as log:
        return subprocess.Popen(command, stdout=log, stderr=log)


def batch(cluster: Cluster, recordings: list[Path], out: Path) -> None:
    """Run a batch that nobody disturbs."""
    shutil.rmtree(out, ignore_errors=True)
    if start_batch(cluster, recordings, out).wait(PATIENCE):
        sys.exit(f"an undisturbed batch failed; see {out.parent / 'batch.log'}")


def one(
    cluster: Cluster, victim: str, moment: float, recordings: list[Path], reference: dict[str, dict[str, str]], folder: Path
) -> tuple[bool, int, int]:
    """Kill once; returns whether the batch was whole in the end, how often it was given, and how many stages were run more than once."""
    out = folder / "killed"
    shutil.rmtree(out, ignore_errors=True)
    client = start_batch(cluster, recordings, out)
    time.sleep(moment)
    if victim == "client":
        client.kill()
    else:
        cluster.kill("one" if victim == "worker" else victim)
    if victim != "worker":
        client.wait(PATIENCE)
    cluster.start()
    attempts = 1
    while client.wait(PATIENCE) and attempts < MOST_ATTEMPTS:
        attempts += 1
        client = start_batch(cluster, recordings, out)
    n_lines = sum(stage_lines(path) for path in out.glob("*/log.txt"))
    return is_whole(out, reference), attempts, max(0, n_lines - len(NAMES) * len(recordings))


def stage_lines(log: Path) -> int:
    """Count the ends of stages that a run's log tells of."""
    return sum(f" s  {name:<8}  DEBUG    done  " in line for line in log.read_text().splitlines() for name in NAMES)


def digests(run: RunDir) -> dict[str, str]:
    """Return each stage's digest."""
    return {name: record["digest"] for name in NAMES if (record := run.record(name)) is not None}


def is_whole(out: Path, reference: dict[str, dict[str, str]]) -> bool:
    """Compare a batch with the local runs."""
    with open(out / "batch.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = sorted(os.path.basename(row["run"]) for row in rows)
    return (
        names == sorted(reference)
        and all(row["state"] == "done" for row in rows)
        and all(digests(RunDir(out / name)) == reference[name] for name in names)
        and all(not RunDir(out / name).damage(stage, verify=True) for name in names for stage in NAMES)
        and not [path for path in out.glob("*/.*") if path.name != ".lock"]
    )


if __name__ == "__main__":
    main()
