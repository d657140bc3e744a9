#!/usr/bin/env python
"""Measure what the final refinement is worth: poses as they are known when the last loop is closed, and as it leaves them.

    python scripts/final_refinement.py RUN [RUN ...]

Each RUN holds a finished loop stage, and its recording a ground truth. Before: loop is run again without its final refinement, and frames hang
on their key frames as track hung them. Where no loop was closed, the final refinement is that of optimize. Only frames that have a pose in both
are compared.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import accuracy
import numpy as np

from slamcli.config import toml
from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Features, Map, Tracks, Trajectory, frame_poses

HEADINGS = ["run", "frames", "with a pose before", "after", "APE before [m]", "after [m]", "change"]


def main() -> None:
    """Print the table and the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="+")
    given = parser.parse_args()
    rows, errors = [HEADINGS], []
    try:
        for name in given.run:
            row, pair = compared(RunDir.find(name))
            rows.append(row)
            errors.append(pair)
    except SlamError as error:
        sys.exit(f"Error: {error}")
    print(table(rows, right=range(1, len(HEADINGS))))
    before, after = np.median(errors, axis=0)
    change = np.median([b / a - 1 for a, b in errors])
    print(
        f"median APE {before:.5f} m before, {after:.5f} m after; lower in {sum(b > a for b, a in errors)} of {len(errors)} runs, "
        f"median of the paired changes {100 * change:+.1f} %"
    )


def compared(run: RunDir) -> tuple[list[str], tuple[float, float]]:
    """Return a line of the table and both errors [m]."""
    stamp, truth = run.load(Features, "extract").stamp, run_trajectories.ground_truth(run)
    with tempfile.TemporaryDirectory(dir=run.path.parent) as folder:  # where files can be linked instead of copied
        without = accuracy.variant(run, Path(folder) / "without", toml.apply(run.config(), ["loop.final_refinement=false"]))
        before = frame_poses(run.load(Tracks, "track"), without.load(Map, "loop"))
    T_wc = (before, frame_poses(run.load(Tracks, "loop"), run.load(Map, "loop")))
    has_pose = [np.isfinite(T[:, 0, 0]) for T in T_wc]
    both = has_pose[0] & has_pose[1]
    ape = (trajectory_error.ape(Trajectory(stamp=stamp[both], T_wc=T[both]), truth, n_frames=len(stamp), name=str(run.path)) for T in T_wc)
    errors = tuple(found.rmse for found in ape)
    counts = [str(int(one.sum())) for one in has_pose]
    change = f"{100 * (errors[1] / errors[0] - 1):+.1f} %"
    return [str(run.path), str(len(stamp)), *counts, *(f"{error:.5f}" for error in errors), change], errors


if __name__ == "__main__":
    main()
