#!/usr/bin/env python
"""Tracking where texture ends, in simulated rooms: without light, with plain colours, and with pictures on some of the walls.

    python scripts/textureless.py OUT [--seeds 0 1 2] [--laps 1.33] [--frames 440] [--orbslam3 PYTHON WORDS]

For each seed a furnished room of 8 m x 5 m is driven round by a camera with a Kinect's noise. OUT keeps recordings and runs, which are used
again. With --orbslam3, see orbslam3.py, it tracks the same images; a dash means that it gave no pose.
"""

import argparse
from pathlib import Path
from typing import Any

import rivals

import slamcli
from slamcli import console
from slamcli.console import table
from slamcli.datasets.simulate import simulate
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Features
from slamcli.stages import WITH_TRAJECTORY

ROOMS: dict[str, dict[str, Any]] = {"dark": {"dark": True}, "plain": {"textured": 0.0}, "mixed": {"textured": 0.3}}
HEADINGS = ["room", "frames", "with a pose", "on shape", "track [m]", "optimize [m]", "loop [m]", "track CPU [ms/frame]", "ORB-SLAM3 [m]"]


def main() -> None:
    """Simulate, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--laps", type=float, default=1.33)
    parser.add_argument("--frames", type=int, default=440)
    parser.add_argument("--orbslam3", nargs=2, metavar=("PYTHON", "WORDS"))
    given = parser.parse_args()
    rows = []
    for kind, options in ROOMS.items():
        for seed in given.seeds:
            drive = {"seed": seed, "laps": given.laps, "frames": given.frames}
            rows.append(one(given.out / f"{kind}{seed}", {**options, **drive}, given.orbslam3))
            print(table([HEADINGS, rows[-1]], right=range(1, len(HEADINGS))), flush=True)
    print("\n" + table([HEADINGS, *rows], right=range(1, len(HEADINGS))))


def one(folder: Path, settings: dict[str, Any], rival: list[str] | None) -> list[str]:
    """Render and run one room, unless done already, and compare with the truth; gives a line of the table."""
    recording, path = folder / "recording", folder / "run"
    folder.mkdir(parents=True, exist_ok=True)
    if not recording.exists():
        simulate(recording, progress=console.progress, **settings)
    run = slamcli.run(recording, path=path, until="loop", progress=console.progress, tell=console.say).directory
    truth, n_frames = run_trajectories.ground_truth(run), len(run.load(Features, "extract").stamp)
    errors = [
        trajectory_error.ape(run_trajectories.stage_trajectory(run, s), truth, n_frames=n_frames, name=s).error for s in WITH_TRAJECTORY
    ]
    track = run.record("track")
    cpu = 1e3 * (track["cpu_seconds"] - track["compile_seconds"]) / n_frames
    return [
        folder.name,
        str(n_frames),
        f"{100 * len(errors[-1]) / n_frames:.1f} %",
        str(track["summary"]["on_depth"]),
        *(f"{trajectory_error.rmse(error):.4f}" for error in errors),
        f"{cpu:.1f}",
        of_rival(run, *rival) if rival else "",
    ]


def of_rival(run: RunDir, python: str, words: str) -> str:
    """Return ORB-SLAM3's APE, a dash where it has no pose to compare."""
    ape = rivals.orbslam3(run, python, words)["ape"]
    return "-" if ape is None else f"{ape:.4f}"


if __name__ == "__main__":
    main()
