"""Print what people in view cost: simulated rooms with 1 to 4 people, the same drives without them, and the same with the search for moving objects off.

    python scripts/people.py FOLDER [--rooms 5] [--first 21] [--frames 250] [--people 1,2,3,4] [--compare] [--orbslam3 PYTHON WORDS]

Recordings and runs are kept in FOLDER and not made anew. Of each: APE, with and without people; the share of the view that people cover;
how much of it is found and how much of what stands still is taken for moving, median over the frames; the grid's figures; doubtful frames,
how many of those wrong by more than 5 cm are, and how many of those wrong by less than 1 cm. With --orbslam3, see orbslam3.py, it tracks
the same images.
"""

import argparse
import contextlib
import io
import json
from pathlib import Path

import cv2
import numpy as np
import rivals

from slamcli import artifacts, console
from slamcli.cli.main import cli
from slamcli.datasets.simulated import people
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Doubt, Features, Moving

LITTLE_TEXTURE = 0.4  # share of textured surfaces in every third room
HEADINGS = ("room", "people", "cover", "APE", "without", "search off", "found", "taken", "floor free", "occupied", "outlines", "doubtful",
            "of wrong", "of right", "ORB-SLAM3")  # fmt: skip


def main() -> None:
    """Make what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=5)
    parser.add_argument("--first", type=int, default=21, help="Number of the first room; each is another.")
    parser.add_argument("--frames", type=int, default=250)
    parser.add_argument("--people", default="1,2,3,4")
    parser.add_argument("--compare", action="store_true", help="Also run without the search for moving objects.")
    parser.add_argument("--orbslam3", nargs=2, metavar=("PYTHON", "WORDS"))
    given = parser.parse_args()
    rows = []
    for room in range(given.rooms):
        seed = given.first + room
        alone = figures(given.folder, record(given.folder, seed, 0, given.frames))
        for count in (int(text) for text in given.people.split(",")):
            recording = record(given.folder, seed, count, given.frames)
            found = figures(given.folder, recording)
            off = figures(given.folder, recording, "track.moving_objects=false")["ape"] if given.compare else None
            run = given.folder / f"run_{recording.name}"
            rival = rivals.orbslam3(RunDir.find(str(run)), *given.orbslam3)["ape"] if given.orbslam3 else None
            rows.append([*row(seed, count, recording, run, found, alone, off), "-" if rival is None else f"{rival:.4f}"])
            print(console.table([list(HEADINGS), *rows[-1:]]), flush=True)
    print(console.table([list(HEADINGS), *rows]))


def record(folder: Path, seed: int, count: int, frames: int) -> Path:
    """Simulate a drive through room `seed` with `count` people, who do other things in each room; in two of three one walks before the camera."""
    out = folder / f"room{seed}_{count}"
    if not out.exists():
        texture = LITTLE_TEXTURE if seed % 3 == 2 else 1.0
        known = list(people.ACTIVITIES)
        activities = [item for k in range(count) for item in ("--activity", known[(seed % 3 // 2 + (1 + seed % 2) * k) % len(known)])]
        call("simulate", out, "--seed", seed, "--frames", frames, "--laps", 0.75, "--textured", texture, "--people", count, *activities)
    return out


def figures(folder: Path, recording: Path, *settings: str) -> dict:
    """Run a recording where that was not done, and measure the result."""
    run = folder / f"run{'_off' * bool(settings)}_{recording.name}"
    if not (run / "grid2d").exists():
        call("run", recording, "-r", run, *(item for setting in settings for item in ("-s", setting)))
    ape = json.loads(call("eval", "ape", run, "--json"))
    grid = json.loads(call("eval", "map", "-r", run, "--json"))["grid"]
    return {"ape": ape["rmse"], "doubtful": ape["doubtful"], "frames": ape["n_frames"], **grid}


def row(seed: int, count: int, recording: Path, run: Path, found: dict, alone: dict, off: float | None) -> list[str]:
    """Format one line of the table."""
    cover, recall, taken = masks(recording, run)
    return [
        str(seed), str(count), f"{cover:.0%}", f"{found['ape']:.4f}", f"{alone['ape']:.4f}", "-" if off is None else f"{off:.4f}",
        f"{recall:.1%}", f"{taken:.1%}", f"{found['floor_is_free']:.1%} / {alone['floor_is_free']:.1%}",
        f"{found['floor_is_occupied']:.2%} / {alone['floor_is_occupied']:.2%}",
        f"{found['outline_is_occupied']:.1%} / {alone['outline_is_occupied']:.1%}", f"{found['doubtful']} of {found['frames']}",
        *doubt(run),
    ]  # fmt: skip


def doubt(run: Path) -> tuple[str, str]:
    """Count the doubtful among the frames wrong by more than 5 cm, and among those wrong by less than 1 cm."""
    folder = RunDir.find(str(run))
    found = trajectory_error.ape(
        run_trajectories.stage_trajectory(folder, "loop"),
        run_trajectories.ground_truth(folder),
        n_frames=rivals.n_frames(folder),
        name=run.name,
    )
    is_doubtful = np.isin(found.stamp, folder.load(Features, "extract").stamp[folder.load(Doubt, "loop").is_doubtful])
    wrong, right = (f"{(is_doubtful & which).sum()} of {which.sum()}" for which in (found.error > 0.05, found.error < 0.01))
    return wrong, right


def masks(recording: Path, run: Path) -> tuple[float, float, float]:
    """Measure the mean share of the view that people cover and, median over frames that show some, what is found and wrongly taken."""
    stamp, moving = artifacts.load(Features, run / "extract").stamp, artifacts.load(Moving, run / "track").moving
    cover, recall, taken = [], [], []
    for i, when in enumerate(stamp):
        truth = cv2.imread(str(recording / "moving" / f"{when:.6f}.png"), cv2.IMREAD_UNCHANGED) > 0
        mask = moving[i] if len(moving) else np.zeros((2, 2), dtype=bool)
        seen = cv2.resize(mask.astype(np.uint8), truth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        cover.append(truth.mean())
        taken.append((seen & ~truth).sum() / max((~truth).sum(), 1))
        if truth.mean() > 0.005:
            recall.append((seen & truth).sum() / truth.sum())
    return float(np.mean(cover)), float(np.median(recall)) if recall else float("nan"), float(np.median(taken))


def call(*arguments: object) -> str:
    """Run a command of slamcli in this process; returns what it prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        cli.main([str(argument) for argument in arguments], standalone_mode=False)
    return out.getvalue()


if __name__ == "__main__":
    main()
