#!/usr/bin/env python
"""Loop closing in simulated rooms: whether the revisit is closed, whether any closure is false, and what it gains.

    python scripts/places.py OUT [--seeds 0 1 2 ...] [--alias-seeds 0] [--laps 2.09] [--frames 540] [--orbslam3 PYTHON WORDS]

For each seed a furnished room of 8 m x 5 m is driven round twice by a camera with a Kinect's noise. Rooms built to alias follow: twin
walls with the same posters opposite, and corridors of equal doors. OUT keeps recordings and runs, which are used again; the table comes
from the runs' records, the truth from groundtruth.txt. With --orbslam3, see orbslam3.py, it tracks the same images.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rivals

import slamcli
from slamcli import console
from slamcli.console import table
from slamcli.datasets.association import associate
from slamcli.datasets.simulate import simulate
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.geometry import se3
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Closures, Features, Map
from slamcli.stages import NAMES, WITH_TRAJECTORY

FALSE_M, FALSE_DEG = 0.2, 5.0  # a closure that is off by more claims the wrong place
REVISIT = 0.6  # laps that lie between two visits at least
HEADINGS = [
    "room",
    "frames",
    "lost",
    "segments",
    "closures",
    "of revisits",
    "false",
    "track [m]",
    "optimize [m]",
    "loop [m]",
    "loop CPU",
    "ORB-SLAM3 [m]",
]
ROOMS = {"posters": ("posters", 0), "corridor": ("corridor", 0), "corridor2": ("corridor", 1)}  # alias and how much is added to the seed


@dataclass(frozen=True)
class Figures:
    """What became of one room."""

    name: str
    n_frames: int
    lost: int
    segments: int
    closures: int
    revisits: int  # true closures between visits
    false: int
    ape: dict[str, float]  # [m], by stage
    loop_share: float  # of the run's CPU time
    rival: float | None  # [m], ORB-SLAM3's APE

    def row(self) -> list[str]:
        """Make a line of the table."""
        counts = (self.n_frames, self.lost, self.segments, self.closures, self.revisits, self.false)
        errors = (f"{self.ape[stage]:.4f}" for stage in WITH_TRAJECTORY)
        rival = "" if self.rival is None else f"{self.rival:.4f}"
        return [self.name, *map(str, counts), *errors, f"{100 * self.loop_share:.1f} %", rival]


def main() -> None:
    """Simulate, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(10)))
    parser.add_argument("--alias-seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--laps", type=float, default=2.09)
    parser.add_argument("--frames", type=int, default=540)
    parser.add_argument("--orbslam3", nargs=2, metavar=("PYTHON", "WORDS"))
    given = parser.parse_args()
    rooms: dict[str, dict[str, Any]] = {f"room{seed}": {"seed": seed} for seed in given.seeds}
    for seed in given.alias_seeds:
        rooms |= {f"{name}{seed}": {"alias": alias, "seed": seed + more} for name, (alias, more) in ROOMS.items()}
    found = []
    for name, options in rooms.items():
        drive = {"laps": given.laps, "frames": given.frames}
        found.append(one(given.out / name, name, {**options, **drive}, given.laps, given.orbslam3))
        print(table([HEADINGS, found[-1].row()], right=range(1, len(HEADINGS))), flush=True)
    print("\n" + table([HEADINGS, *(figures.row() for figures in found)], right=range(1, len(HEADINGS))))
    summary(found)


def one(folder: Path, name: str, settings: dict[str, Any], laps: float, rival: list[str] | None) -> Figures:
    """Render and run one room, unless done already, and compare with the truth."""
    recording, path = folder / "recording", folder / "run"
    folder.mkdir(parents=True, exist_ok=True)
    if not recording.exists():
        simulate(recording, progress=console.progress, **settings)
    run = slamcli.run(recording, path=path, progress=console.progress, tell=console.say).directory
    truth, n_frames = run_trajectories.ground_truth(run), len(run.load(Features, "extract").stamp)
    ape = {}
    for stage in WITH_TRAJECTORY:
        error = trajectory_error.ape(run_trajectories.stage_trajectory(run, stage), truth, n_frames=n_frames, name=stage).error
        ape[stage] = trajectory_error.rmse(error)
    frames, is_true = closures(run)
    summary_ = run.record("loop")["summary"]
    cpu = {stage: record["cpu_seconds"] - record["compile_seconds"] for stage in NAMES if (record := run.record(stage)) is not None}
    is_revisit = np.abs(frames[:, 0] - frames[:, 1]) > REVISIT * n_frames / laps
    return Figures(
        name=name,
        n_frames=n_frames,
        lost=int(summary_["lost"]),
        segments=int(summary_["segments"]),
        closures=len(frames),
        revisits=int((is_revisit & is_true).sum()),
        false=int((~is_true).sum()),
        ape=ape,
        loop_share=cpu["loop"] / sum(cpu.values()),
        rival=rivals.orbslam3(run, *rival)["ape"] if rival else None,
    )


def closures(run: RunDir) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames (C, 2) of each accepted closure and whether it is true (C,)."""
    found, stamp, truth = run.load(Closures, "loop"), run.load(Features, "extract").stamp, run_trajectories.ground_truth(run)
    T_gc = np.full((len(stamp), 4, 4), np.nan)
    rows = associate(stamp, truth.stamp)
    T_gc[rows[:, 0]] = truth.T_wc[rows[:, 1]]
    frames = run.load(Map, "loop").kf_frame[found.closure_kf].reshape(-1, 2)
    error = (
        se3.log(se3.inverse(T_gc[frames[:, 0]]) @ T_gc[frames[:, 1]] @ se3.inverse(found.closure_T_ij)) if len(frames) else np.empty((0, 6))
    )
    is_near = np.linalg.norm(error[:, :3], axis=1) < FALSE_M
    return frames, is_near & (np.degrees(np.linalg.norm(error[:, 3:], axis=1)) < FALSE_DEG)


def summary(found: list[Figures]) -> None:
    """Say whether what a loop stage should do was done."""
    honest = [figures for figures in found if figures.name.startswith("room")]
    before, after = (np.array([figures.ape[stage] for figures in honest]) for stage in ("track", "loop"))
    print(f"false closures: {sum(figures.false for figures in found)} of {sum(figures.closures for figures in found)}")
    print(f"rooms whose revisit is closed: {sum(figures.revisits > 0 for figures in honest)} of {len(honest)}")
    if len(honest):
        others = [figures.rival for figures in honest if figures.rival is not None]
        if others:
            print(f"ORB-SLAM3's APE, median of {len(others)} rooms: {np.median(others):.4f} m")
        drifted = before > 0.02
        print(
            f"APE after loop, median: {np.median(after):.4f} m; worse than after track by at most {max(0.0, (after - before).max()):.4f} m"
        )
        if drifted.any():
            print(f"where track drifted by more than 0.02 m, loop leaves at most {(after / before)[drifted].max():.2f} of it")


if __name__ == "__main__":
    main()
