"""Measure several recordings of one house in one map: one frame, the order, the cost of adding one, and joins that are wrong.

    python scripts/several_recordings.py FOLDER [--frames 240] [--width 640] [--seed 1] [--pairs 20] [--pair-width 160] [--first-pair 100]
                                                [--orbslam3 PYTHON WORDS]

Renders into FOLDER what is not there yet: four recordings of one room (other starts, directions and light, the same stamps, each
seeing a part of what the next sees), and pairs of look-alike places, every second pair two corridors whose doors are all equal. Prints

* the error of A, B and C in their common frame, together and each, and how far the maps of A B C and C A B part;
* the cost of adding D in CPU seconds, beside a run of D alone and the common part, and its error beside that of a run of all four;
* with --orbslam3, see orbslam3.py, what its atlas of maps makes of A, B and C handed over one after another;
* of how many pairs of look-alike places the two were joined, and why the others were not.
"""

import argparse
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rewritten
import rivals

from slamcli import api
from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate
from slamcli.evaluation import of_several, run_trajectories, trajectory_error
from slamcli.formats.trajectory import write_tum
from slamcli.runs.run_directory import RunDir
from slamcli.runs.several import LAST
from slamcli.schema import Map, Recordings, Trajectory
from slamcli.stages import NAMES

TAKES: dict[str, dict[str, Any]] = {
    "a": {},
    "b": {"start": 0.35, "light": 0.75, "take": 1},
    "c": {"start": 0.3, "backwards": True, "light": 1.2, "take": 2},
    "d": {"start": 0.6, "light": 0.9, "take": 3},
}
PAUSE = 10.0  # [s] between recordings handed over one after another: ORB-SLAM3 gives a place up after 3
FRONT = NAMES[: NAMES.index(LAST) + 1]  # stages of each recording alone


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=240, help="of each recording of the house")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--seed", type=int, default=1, help="of the house")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--pair-width", type=int, default=160)
    parser.add_argument("--first-pair", type=int, default=100, help="seed of the first pair; the others follow on it")
    parser.add_argument("--orbslam3", nargs=2, metavar=("PYTHON", "WORDS"), help="also measure ORB-SLAM3")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    os.chdir(given.folder)
    takes = {
        name: rendered(Path("house") / name, given.width, frames=given.frames, seed=given.seed, laps=0.55, **how)
        for name, how in TAKES.items()
    }
    one_house(takes)
    if given.orbslam3:
        python, words = (str(Path(path).absolute()) for path in given.orbslam3)
        row = api.run(in_a_row(Path("house/abc"), [takes[name] for name in "abc"]), path="runs/in_a_row", until="extract").directory
        found = rivals.orbslam3(row, python, words)
        print(f"ORB-SLAM3 on A, B, C in a row: APE {1000 * (found['ape'] or np.nan):.2f} mm, {100 * found['coverage']:.1f} % of the frames")
    adding(takes)
    look_alikes(range(given.first_pair, given.first_pair + given.pairs), given.pair_width)


def rendered(folder: Path, width: int, **settings: Any) -> Path:
    """Render a recording unless it is there."""
    return folder if folder.is_dir() else simulate(folder, progress=silent, width=width, height=width * 3 // 4, **settings)


def one_house(takes: dict[str, Path]) -> None:
    """Print the error of three recordings in one frame, and how far the order in which they are named moves the map."""
    runs = [api.run([takes[name] for name in order], path=f"runs/{order}", until="loop").directory for order in ("abc", "cab")]
    whole = error(runs[0])
    print(f"A B C together: APE {1000 * whole.rmse:.2f} mm, {whole.n_poses} of {whole.n_frames} frames in one frame")
    for part in of_several.apes(runs[0], whole, run_trajectories.ground_truth(runs[0])):
        print(f"  {part.name}: {1000 * part.rmse:.2f} mm")
    T_wk = [run.load(Map, "loop").T_wk for run in runs]
    same = T_wk[0].shape == T_wk[1].shape
    print(f"A B C and C A B: {1000 * np.abs(T_wk[0] - T_wk[1])[:, :3, 3].max():.6f} mm apart at most" if same else "other key frames")


def in_a_row(folder: Path, takes: Sequence[Path]) -> Path:
    """Write one recording of several, each after the one before it and a pause, the truth in their common frame; what is there is kept."""
    if folder.is_dir():
        return folder
    folder.mkdir(parents=True)
    lists, stamp, T_wc, begin = {"rgb": "", "depth": ""}, [], [], 0.0
    for take in takes:
        listed = rewritten.listed(take)
        shift = begin - listed.start
        (folder / take.name).symlink_to(take.resolve())
        for name, images in (("rgb", listed.colour), ("depth", listed.depth)):
            lists[name] += "".join(f"{at + shift:.6f} {take.name}/{file}\n" for at, file in images)
        stamp.append(listed.truth.stamp + shift)
        T_wc.append(listed.truth.T_wc)
        begin = float(stamp[-1].max()) + PAUSE
    for name, text in lists.items():
        (folder / f"{name}.txt").write_text(text)
    (folder / "camera.json").write_bytes((takes[0] / "camera.json").read_bytes())
    write_tum(folder / "groundtruth.txt", Trajectory(np.concatenate(stamp), np.concatenate(T_wc)))
    return folder


def adding(takes: dict[str, Path]) -> None:
    """Print what adding a fourth recording costs and gives."""
    four, alone = (
        api.run(targets, path=path, until=until).directory
        for targets, path, until in ((list(takes.values()), "runs/abcd", NAMES[-1]), ([takes["d"]], "runs/d", NAMES[-1]))
    )
    grown = api.run([takes[name] for name in "abc"], path="runs/abc+d").add(takes["d"]).directory
    common = cpu_seconds(four, NAMES[len(FRONT) :])
    allowed = 1.3 * cpu_seconds(alone, NAMES) + common
    spent = cpu_seconds(grown, NAMES)
    print(
        f"adding D: {spent:.1f} s of CPU; D alone {cpu_seconds(alone, NAMES):.1f}, common part of all four {common:.1f}: {spent / allowed:.2f} of"
    )
    print("  1.3 times D alone and the common part")
    print(f"  APE {1000 * error(grown).rmse:.2f} mm, of a run of all four {1000 * error(four).rmse:.2f} mm")


def look_alikes(pairs: Sequence[int], width: int) -> None:
    """Print of how many pairs of look-alike places, each of a seed, the two were joined."""
    joined, reasons = [], Counter[str]()
    for pair in pairs:
        places = [rendered(Path("pairs") / f"{pair}-{twin}", width, frames=120, laps=1.05, **of_a_pair(pair, twin)) for twin in (0, 1)]
        run = api.run(places, path=f"runs/pair{pair}", until="loop").directory
        offset, map_ = int(run.load(Recordings, "extract").recording_offset[1]), run.load(Map, "loop")
        frame = map_.kf_frame
        if set(map_.kf_segment[frame < offset]) & set(map_.kf_segment[frame >= offset]):
            joined.append(pair)
        rows = (run.path / "loop" / "candidates.csv").read_text().splitlines()[1:]
        for row in rows:
            i, j, *_, reason = row.split(",", 6)
            if (frame[int(i)] < offset) != (frame[int(j)] < offset) and "matches" not in reason and "motion" not in reason:
                reasons["".join(c for c in reason if not c.isdigit())] += 1
    print(f"look-alike places: {len(joined)} of {len(pairs)} pairs joined {joined or ''}")
    for reason, n in reasons.most_common(6):
        print(f"  {n} closures between them: {reason or 'accepted'}")


def of_a_pair(pair: int, twin: int) -> dict[str, Any]:
    """Choose one of two look-alike places: a room of the same patterns and pieces in another order, or another corridor of equal doors."""
    if pair % 2:
        return {"alias": "corridor", "seed": pair + 500 * twin}
    return {"seed": pair, "twin": twin, "take": twin}


def error(run: RunDir) -> trajectory_error.Ape:
    """Measure a run's last trajectory."""
    n_frames = run_trajectories.frame_count(run)
    truth = run_trajectories.ground_truth(run)
    return trajectory_error.ape(run_trajectories.stage_trajectory(run, "loop"), truth, n_frames=n_frames, name="", stage="loop")


def cpu_seconds(run: RunDir, stages: tuple[str, ...]) -> float:
    """Add up what stages cost when they were run last, without compiling."""
    records = [run.record(stage) for stage in stages]
    return sum(record["cpu_seconds"] - record["compile_seconds"] for record in records if record is not None)


if __name__ == "__main__":
    main()
