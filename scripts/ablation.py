#!/usr/bin/env python
"""What each lever gives: the error with it and without it, everything else at its default.

    python scripts/ablation.py OUT RECORDING... [--offsets 0 1] [--seeds 0 1] [--levers KEY...] [--json ablation.json] [--page docs/accuracy.md]

Each recording is run from each start frame with each seed under the default configuration, and again with each lever turned: off where it
is on by default, on where it is off. What a lever does not concern is taken over, so that a pair differs in nothing else. The gain is the
APE (RMSE, SE(3), no scale, after loop) without the lever minus that with it, in mm. Pairs that --json finds in its file are kept unless they
are measured again; --page puts the table between the marks in that file. Without RECORDING only the table is made.
"""

import argparse
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import accuracy
import bench
import numpy as np

from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.datasets import open_dataset
from slamcli.errors import SlamError
from slamcli.runs.run_directory import RunDir

LEVERS = {  # how each is turned, and what it is
    "extract.subpixel=false": "sub-pixel key points",
    "extract.depth_jump=0": "no depth for key points behind an outline",
    "extract.flow=true": "optical-flow matches where descriptors give few",
    "optimize.move_depth=false": "depth moved to the colour image's time",
    "optimize.depth_delay=false": "of that, the delay that the stamps do not show",
    "optimize.readout=false": "rolling shutter",
    "optimize.depth_icp_edges=0": "depth images of key frames aligned with each other",
    "loop.enabled=false": "loop closing",
    "loop.final_refinement=false": "final refinement after loops are closed",
    "optimize.intrinsics=true": "intrinsics found as well, where the calibration is good",
    "optimize.depth_scale=true": "scale and offset of depth found as well",
}
MARKS = "<!-- ablation: scripts/ablation.py --page -->", "<!-- end of ablation -->"


def main() -> None:
    """Read the arguments, run everything, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("recordings", nargs="*")
    parser.add_argument("--offsets", type=int, nargs="+", default=[0, 1], help="frames left out at the start")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--levers", nargs="+", choices=LEVERS, default=list(LEVERS), metavar="KEY=VALUE")
    parser.add_argument("--json", type=Path, metavar="FILE", help="figures, read and written")
    parser.add_argument("--page", type=Path, metavar="FILE", help="put the table into this file")
    given = parser.parse_args()
    try:
        pairs = json.loads(given.json.read_text(encoding="utf-8")) if given.json and given.json.exists() else []
        for recording, offset, seed in itertools.product(given.recordings, given.offsets, given.seeds):
            pairs = merged(pairs, measured(recording, offset, seed, given.levers, given.out))
            if given.json:
                given.json.write_text(json.dumps(pairs, indent=1) + "\n", encoding="utf-8")
        print(table(pairs))
        if given.page:
            bench.put_into(given.page, table(pairs), MARKS)
    except SlamError as error:
        sys.exit(f"Error: {error}")


def measured(recording: str, offset: int, seed: int, levers: list[str], out: Path) -> list[dict[str, Any]]:
    """Run a recording under the default configuration and with each lever turned; give a pair of results for each."""
    features = accuracy.features_of(recording, offset, 1, [], out)
    folder = features.path.parent
    default = accuracy.variant(features, folder / "default", replace(Config(), seed=seed))
    source = open_dataset(recording)
    of = {"recording": source.name, "is_simulated": (source.root / "scene.json").is_file(), "offset": offset, "seed": seed}
    pairs = []
    for lever in levers:
        turned = accuracy.variant(default, folder / "turned", toml.apply(default.config(), [lever]))
        pairs.append({**of, "lever": lever, "default": figures(default), "turned": figures(turned)})
        print(json.dumps(pairs[-1]), file=sys.stderr, flush=True)
    return pairs


def figures(run: RunDir) -> dict[str, float]:
    """Return APE after loop [m] and the share of frames with a pose."""
    result = accuracy.ours(run)
    return {"ape": result.ape["loop"], "coverage": result.coverage}


def merged(pairs: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Put new pairs in the place of the same ones measured before."""

    def key(pair: dict[str, Any]) -> tuple:
        return pair["recording"], pair["offset"], pair["seed"], pair["lever"]

    return list(({key(pair): pair for pair in pairs} | {key(pair): pair for pair in new}).values())


def table(pairs: list[dict[str, Any]]) -> str:
    """Render the gain of each lever in Markdown, of real and of simulated recordings apart."""
    rows = [["lever", "default"]]
    for kind in ("real", "simulated"):
        rows[0] += [f"gain, {kind} [mm]: median (range)", "better / worse"]
    for lever, name in LEVERS.items():
        of = [pair for pair in pairs if pair["lever"] == lever]
        real, simulated = ([pair for pair in of if pair["is_simulated"] == kind] for kind in (False, True))
        if of:
            rows.append([name, "on" if is_on(lever) else "off", *gain_cells(lever, real), *gain_cells(lever, simulated)])
    return bench.markdown(rows)


def is_on(lever: str) -> bool:
    """Say whether a lever is on by default: whether turning it turns it off."""
    return lever.endswith(("=false", "=0"))


def gain_cells(lever: str, pairs: list[dict[str, Any]]) -> list[str]:
    """Show a lever's gain over some pairs, and in how many the error fell or rose by more than a hundredth."""
    if not pairs:
        return ["", ""]
    default, turned = (np.array([pair[which]["ape"] for pair in pairs]) for which in ("default", "turned"))
    off, on = (turned, default) if is_on(lever) else (default, turned)
    gain = 1e3 * (off - on)
    better, worse = (int((sign * (off - on) > 0.01 * off).sum()) for sign in (1, -1))
    return [f"{np.median(gain):+.2f} ({gain.min():+.2f} to {gain.max():+.2f})", f"{better} / {worse} of {len(pairs)}"]


if __name__ == "__main__":
    main()
