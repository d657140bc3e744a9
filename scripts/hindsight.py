#!/usr/bin/env python
"""What hindsight is worth: the same final map, with the frames as track left them and as the second look found them.

    python scripts/hindsight.py RUN [RUN ...]

Each RUN holds a finished loop stage, and its recording a ground truth. Only frames that have a pose in both are compared.
"""

import argparse
import sys

import numpy as np

from slamcli import evaluate
from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.rundir import RunDir
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
    print(f"median APE {before:.5f} m before, {after:.5f} m after; lower in {sum(b > a for b, a in errors)} of {len(errors)} runs")


def compared(run: RunDir) -> tuple[list[str], tuple[float, float]]:
    """Give a line of the table and both errors [m]."""
    stamp, map_, truth = run.load(Features, "extract").stamp, run.load(Map, "loop"), evaluate.ground_truth(run)
    T_wc = [frame_poses(run.load(Tracks, stage), map_) for stage in ("track", "loop")]
    has_pose = [np.isfinite(T[:, 0, 0]) for T in T_wc]
    both = has_pose[0] & has_pose[1]
    ape = (evaluate.ape(Trajectory(stamp=stamp[both], T_wc=T[both]), truth, n_frames=len(stamp), name=str(run.path)) for T in T_wc)
    before, after = (evaluate.statistics(found.error)["rmse"] for found in ape)
    counts = [str(int(one.sum())) for one in has_pose]
    return [str(run.path), str(len(stamp)), *counts, f"{before:.5f}", f"{after:.5f}", f"{100 * (after / before - 1):+.1f} %"], (
        before,
        after,
    )


if __name__ == "__main__":
    main()
