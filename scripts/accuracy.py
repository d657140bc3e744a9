#!/usr/bin/env python
"""Compare two configurations over recordings x start frames x steps x seeds, pair by pair, and ORB-SLAM3 on the same images beside them.

    python scripts/accuracy.py OUT RECORDING... --change optimize.readout=false [--change KEY=VALUE ...]
    python scripts/accuracy.py OUT RECORDING... --offsets 0 1 2 --every 1 3 --seeds 0 1
    python scripts/accuracy.py OUT RECORDING... --orbslam3 ORB/bin/python words.txt --rival-runs 3

A is the default configuration (with what --both sets), B the same with what --change sets; B takes over from A the results of stages that
the change does not concern. A recording starts at frame 0, 1, ... (--offsets) and keeps every n-th frame (--every); both only rewrite its
lists. RECORDING is anything that `slamcli run` takes, with a true trajectory. ORB-SLAM3 needs an environment of its own, see orbslam3.py.
Printed are the APE [m] (RMSE, SE(3), no scale) after each stage, and of all pairs how often B is better, the median of B / A and its
range. OUT keeps recordings and features, which are used again, and results.json with every figure.
"""

import argparse
import itertools
import json
import os
import shutil
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import rewritten
import rivals

import slamcli
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories
from slamcli.runs.pipeline import Pipeline
from slamcli.runs.run_directory import RunDir
from slamcli.stages import stage_named

STAGES = ("track", "optimize", "loop")
CHAIN = ("extract", "match", *STAGES)


@dataclass(frozen=True)
class Result:
    """One run of one configuration, or of the rival."""

    recording: str
    offset: int
    every: int
    seed: int
    who: str  # "A", "B" or "ORB-SLAM3"
    ape: dict[str, float]  # [m] by stage; "final" for the rival; NaN without a pose
    coverage: float
    cpu_ms: float  # per frame: of the three stages, or of the rival's whole but decoding


def main() -> None:
    """Read the arguments, run everything, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--both", action="append", default=[], metavar="KEY=VALUE", help="set in A and B")
    parser.add_argument("--change", action="append", default=[], metavar="KEY=VALUE", help="set in B; without any there is only A")
    parser.add_argument("--offsets", type=int, nargs="+", default=[0], help="frames left out at the start")
    parser.add_argument("--every", type=int, nargs="+", default=[1], help="keep every n-th frame")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--orbslam3", nargs=2, metavar=("PYTHON", "WORDS"), help="its interpreter and its vocabulary")
    parser.add_argument("--rival-runs", type=int, default=1, help="how often, since its results differ from run to run")
    given = parser.parse_args()
    try:
        results = [result for recording in given.recordings for result in measured(recording, given)]
    except SlamError as error:
        sys.exit(f"Error: {error}")
    (given.out / "results.json").write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n")
    print(rows_of(results))
    if given.change:
        print("\n" + pairs_of(results))


def measured(recording: str, given: argparse.Namespace) -> list[Result]:
    """Run all variants of a recording."""
    found: list[Result] = []
    for offset, every in itertools.product(given.offsets, given.every):
        features = features_of(recording, offset, every, given.both, given.out)
        for seed in given.seeds:
            run = features
            for who, changes in (("A", []), ("B", given.change))[: 2 if given.change else 1]:
                config = replace(toml.apply(Config(), [*given.both, *changes]), seed=seed)
                run = variant(run, features.path.parent / who, config)
                found.append(replace(ours(run), recording=Path(recording).name, offset=offset, every=every, who=who))
                print(line_of(found[-1]), flush=True)
        for k in range(given.rival_runs if given.orbslam3 else 0):
            found.append(replace(rival(features, *given.orbslam3), recording=Path(recording).name, offset=offset, every=every, seed=k))
            print(line_of(found[-1]), flush=True)
    return found


def features_of(recording: str, offset: int, every: int, assignments: list[str], out: Path) -> RunDir:
    """Detect and match features of every n-th frame from a start frame on."""
    folder = out / f"{Path(recording).name}-{offset}-{every}"
    thinned = rewritten.write(folder / "recording", rewritten.thinned(rewritten.listed(recording), offset, every))
    return slamcli.run(thinned, path=folder / "features", settings=assignments, until="match").directory


def variant(source: RunDir, folder: Path, config: Config) -> RunDir:
    """Make a run anew under another configuration; what the change does not concern is taken over from `source`."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source.path, folder, copy_function=os.link)  # stages replace their folders, so that no file is written twice
    run = RunDir.find(str(folder))
    with run.lock():
        before = run.config()
        run.write_config(config)
        for stage in to_run(run, before, config):
            Pipeline(run, config).run_alone(stage)
    return run


def to_run(run: RunDir, before: Config, after: Config) -> tuple[str, ...]:
    """Name the stages that are not there yet or that a change of configuration concerns, and those after them."""
    for k, name in enumerate(CHAIN):
        is_seeded = name in STAGES and before.seed != after.seed
        if is_seeded or run.record(name) is None or any(getattr(before, s) != getattr(after, s) for s in stage_named(name).config):
            return CHAIN[k:]
    return ()


def ours(run: RunDir) -> Result:
    """Return the error after each stage of a run."""
    told = {stage: rivals.accuracy(run, run_trajectories.stage_trajectory(run, stage)) for stage in STAGES}
    errors = {stage: float("nan") if f["ape"] is None else f["ape"] for stage, f in told.items()}
    cpu = sum(run.record(stage)["cpu_seconds"] - run.record(stage)["compile_seconds"] for stage in STAGES)
    return Result("", 0, 1, run.config().seed, "", errors, told["loop"]["coverage"], 1e3 * cpu / rivals.n_frames(run))


def rival(run: RunDir, python: str, words: str) -> Result:
    """Let ORB-SLAM3 track the images of a run."""
    told = rivals.orbslam3(run, python, words)
    error = float("nan") if told["ape"] is None else told["ape"]
    return Result("", 0, 1, 0, "ORB-SLAM3", {"final": error}, told["coverage"], told["cpu_ms"])


def line_of(result: Result) -> str:
    """Tell of a result as soon as it is there."""
    errors = "  ".join(f"{stage} {value:.4f}" for stage, value in result.ape.items())
    return f"{result.recording}  from {result.offset} every {result.every}  seed {result.seed}  {result.who:<9}  {errors}  {result.coverage:.3f}"


def rows_of(results: list[Result]) -> str:
    """Make the table of medians over start frames, steps and seeds."""
    rows = [["recording", "every", "who", "runs", *(f"{stage} [m]" for stage in STAGES), "worst [m]", "coverage", "CPU [ms/frame]"]]
    keys = sorted({(r.recording, r.every, r.who) for r in results})
    for recording, every, who in keys:
        group = [r for r in results if (r.recording, r.every, r.who) == (recording, every, who)]
        medians = [np.median([r.ape[stage] for r in group]) if stage in group[0].ape else None for stage in (*STAGES[:2], last(group[0]))]
        worst, coverage = max(r.ape[last(r)] for r in group), min(r.coverage for r in group)
        shown = ["" if value is None else f"{value:.4f}" for value in medians]
        rows.append(
            [
                recording,
                str(every),
                who,
                str(len(group)),
                *shown,
                f"{worst:.4f}",
                f"{coverage:.3f}",
                f"{np.median([r.cpu_ms for r in group]):.1f}",
            ]
        )
    return table(rows, right=range(3, len(rows[0])))


def last(result: Result) -> str:
    """Name the figure that stands for the whole."""
    return list(result.ape)[-1]


def pairs_of(results: list[Result]) -> str:
    """Make the paired comparison of B with A."""
    rows = [["recording", "pairs", "B better", "median B / A", "lowest", "highest"]]
    a = {(r.recording, r.offset, r.every, r.seed): r.ape["loop"] for r in results if r.who == "A"}
    b = {(r.recording, r.offset, r.every, r.seed): r.ape["loop"] for r in results if r.who == "B"}
    for recording in (*dict.fromkeys(key[0] for key in a), None):
        ratio = np.array([b[key] / a[key] for key in a if recording in (None, key[0])])
        figures = (np.median(ratio), ratio.min(), ratio.max())
        rows.append([recording or "all", str(len(ratio)), str((ratio < 1.0).sum()), *(f"{value:.3f}" for value in figures)])
    return table(rows, right=range(1, len(rows[0])))


if __name__ == "__main__":
    main()
