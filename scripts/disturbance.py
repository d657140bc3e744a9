#!/usr/bin/env python
"""What a covered lens and a gap do to a run, and how well one half of a recording is localized in a run of the other.

    python scripts/disturbance.py RECORDING OUT [--frames 30] [--seconds 3]

Frames in the middle of the recording are blacked out, or seconds cut out; its second half is localized in a run of its first.
RECORDING needs a ground truth. Coverage is of the frames that are not black, the last column APE as a multiple of the undisturbed
run's over the same frames. OUT keeps the recordings (lists, with links to the images) and the runs, which are used again.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import rewritten

import slamcli
from slamcli import console
from slamcli.console import table
from slamcli.datasets import open_dataset
from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.runs.localization import localize
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Trajectory

HEADINGS = ["recording", "frames", "visible", "with a pose", "coverage", "segments", "APE [m]", "to undisturbed"]


def main() -> None:
    """Make the recordings, run them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=30, help="blacked out")
    parser.add_argument("--seconds", type=float, default=3.0, help="cut out")
    given = parser.parse_args()
    try:
        lists = rewritten.listed(given.recording)
        reference = run_trajectories.stage_trajectory(run_of(rewritten.write(given.out / "undisturbed", lists), given.out), "loop")
        rows = [row("undisturbed", lists, 0, 1, reference, reference), *disturbed(lists, reference, given.out, given.frames, given.seconds)]
        print(table([HEADINGS, *rows, half_in_half(lists, reference, given.out)], right=range(1, len(HEADINGS))))
    except SlamError as error:
        sys.exit(f"Error: {error}")


def disturbed(lists: rewritten.Listed, reference: Trajectory, out: Path, frames: int, seconds: float) -> list[list[str]]:
    """Run the recording with black images and with a gap in its middle."""
    middle = 0.5 * (lists.colour[-1][0] - lists.start)
    variants = {
        "blackout": (rewritten.blackout(lists, len(lists.colour) // 2, frames), frames),
        "jump": (rewritten.without(lists, middle - 0.5 * seconds, middle + 0.5 * seconds), 0),
    }
    rows = []
    for name, (changed, n_black) in variants.items():
        run = run_of(rewritten.write(out / name, changed), out)
        n_segments = int(run.record("loop")["summary"]["segments"])
        rows.append(row(name, changed, n_black, n_segments, run_trajectories.stage_trajectory(run, "loop"), reference))
    return rows


def half_in_half(lists: rewritten.Listed, reference: Trajectory, out: Path) -> list[str]:
    """Localize the second half of the recording in a run of the first."""
    middle = 0.5 * (lists.colour[-1][0] - lists.start)
    run = run_of(rewritten.write(out / "first_half", rewritten.between(lists, 0.0, middle)), out)
    second = rewritten.between(lists, middle, np.inf)
    recording = rewritten.write(out / "second_half", second)
    found = localize(run, open_dataset(str(recording)), progress=console.progress)
    return row("second half in first", second, 0, 1, found.trajectory, reference)


def run_of(recording: Path, out: Path) -> RunDir:
    """Bring the run of a recording up to date, as far as the trajectory goes."""
    folder = out / f"{recording.name}.run"
    return slamcli.run(recording, path=folder, until="loop", progress=console.progress, tell=console.say).directory


def row(name: str, lists: rewritten.Listed, n_black: int, n_segments: int, found: Trajectory, reference: Trajectory) -> list[str]:
    """Make a line of the table."""
    n_frames = len(lists.colour)
    rmse = error(found, lists.truth, n_frames)
    among = np.isin(np.round(reference.stamp, 5), np.round(found.stamp, 5))
    undisturbed = error(Trajectory(stamp=reference.stamp[among], T_wc=reference.T_wc[among]), lists.truth, n_frames)
    coverage = len(found.stamp) / (n_frames - n_black)
    counts = [n_frames, n_frames - n_black, len(found.stamp), f"{coverage:.4f}", n_segments]
    return [name, *map(str, counts), f"{rmse:.4f}", f"{rmse / undisturbed:.3f}"]


def error(found: Trajectory, truth: Trajectory | None, n_frames: int) -> float:
    """Return the RMSE of the absolute pose error [m]."""
    if truth is None:
        raise SlamError("the recording has no ground truth to compare with")
    return trajectory_error.ape(found, truth, n_frames=n_frames, name="trajectory").rmse


if __name__ == "__main__":
    main()
