#!/usr/bin/env python
"""What a covered lens and a gap do to a run: coverage and accuracy beside those of the undisturbed recording.

    python scripts/disturbance.py RECORDING OUT [--frames 30] [--seconds 3]

Frames in the middle of the recording are blacked out, or seconds cut out; RECORDING needs a ground truth. OUT keeps the recordings
(lists, with links to the images) and the runs, which are used again.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np
import rewritten

from slamcli import evaluate
from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.rundir import RunDir
from slamcli.schema import RELOCALISED, Tracks

HEADINGS = ["recording", "frames", "visible", "with a pose", "coverage", "relocalised", "APE [m]", "to undisturbed"]


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
        middle, last = len(lists.colour) // 2, lists.colour[-1][0] - lists.start
        variants = {
            "undisturbed": (lists, 0),
            "blackout": (rewritten.blackout(lists, middle, given.frames), given.frames),
            "jump": (rewritten.without(lists, 0.5 * (last - given.seconds), 0.5 * (last + given.seconds)), 0),
        }
        found, undisturbed = [HEADINGS], None
        for name, (changed, n_black) in variants.items():
            run = run_of(rewritten.write(given.out / name, changed), given.out / f"{name}.run")
            ape = evaluate.ape(evaluate.stage_trajectory(run, "loop"), evaluate.ground_truth(run), n_frames=len(changed.colour), name=name)
            rmse = evaluate.statistics(ape.error)["rmse"]
            undisturbed = undisturbed or rmse
            found.append(row(name, run, ape.n_frames, n_black, ape.n_poses, rmse, rmse / undisturbed))
        print(table(found, right=range(1, len(HEADINGS))))
    except SlamError as error:
        sys.exit(f"Error: {error}")


def run_of(recording: Path, folder: Path) -> RunDir:
    """Bring the run of a recording up to date, as far as the trajectory goes."""
    subprocess.run(
        [sys.executable, "-m", "slamcli", "run", str(recording), "-r", str(folder), "--until", "loop"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return RunDir.find(str(folder))


def row(name: str, run: RunDir, n_frames: int, n_black: int, n_poses: int, rmse: float, ratio: float) -> list[str]:
    """Make a line of the table."""
    n_visible = n_frames - n_black
    n_relocalised = int(np.count_nonzero(run.load(Tracks, "loop").state == RELOCALISED))
    coverage = f"{n_poses / n_visible:.4f}"
    return [name, str(n_frames), str(n_visible), str(n_poses), coverage, str(n_relocalised), f"{rmse:.4f}", f"{ratio:.3f}"]


if __name__ == "__main__":
    main()
