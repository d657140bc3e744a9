#!/usr/bin/env python
"""What each lever gives: the error with it and without it, everything else at its default.

    python scripts/ablation.py OUT RECORDING... [--offsets 0 1] [--seeds 0 1] [--levers KEY...] [--json ablation.json] [--readme README.md]

Each recording is run from each start frame with each seed under the default configuration, and again with each lever turned: off where it
is on by default, on where it is off. What a lever does not concern is taken over, so that a pair differs in nothing else. The gain is the
APE (RMSE, SE(3), no scale, after loop) without the lever minus that with it, in mm. Figures of an earlier session that --json finds are kept
for levers not named by --levers; --readme puts the table between the marks in that file.
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
import rewritten

from slamcli import config_io
from slamcli.config import Config
from slamcli.errors import SlamError
from slamcli.rundir import RunDir

LEVERS = {  # how each is turned, and what it is
    "extract.subpixel=false": "sub-pixel key points",
    "extract.smooth=false": "corners sought in a blurred copy",
    "optimize.move_depth=false": "depth moved to the colour image's time",
    "optimize.depth_delay=false": "of that, the delay that the stamps do not show",
    "optimize.readout=false": "rolling shutter",
    "loop.enabled=false": "loop closing",
    "loop.hindsight=false": "second look at every frame after loops are closed",
}
MARKS = "<!-- ablation: scripts/ablation.py --readme -->", "<!-- end of ablation -->"
DEFAULT = ""


def main() -> None:
    """Read the arguments, run everything, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("recordings", nargs="*")
    parser.add_argument("--offsets", type=int, nargs="+", default=[0, 1], help="frames left out at the start")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--levers", nargs="+", choices=LEVERS, default=list(LEVERS), metavar="KEY=VALUE")
    parser.add_argument("--json", type=Path, metavar="FILE", help="figures, read and written")
    parser.add_argument("--readme", type=Path, metavar="FILE", help="put the table into this file")
    given = parser.parse_args()
    try:
        cells = json.loads(given.json.read_text(encoding="utf-8")) if given.json and given.json.exists() else []
        for recording, offset, seed in itertools.product(given.recordings, given.offsets, given.seeds):
            cells = merged(cells, measured(recording, offset, seed, given.levers, given.out))
            if given.json:
                given.json.write_text(json.dumps(cells, indent=1) + "\n", encoding="utf-8")
        print(table(cells))
        if given.readme:
            bench.put_into(given.readme, table(cells), MARKS)
    except SlamError as error:
        sys.exit(f"Error: {error}")


def measured(recording: str, offset: int, seed: int, levers: list[str], out: Path) -> dict[str, Any]:
    """Run a recording under the default configuration and with each lever turned."""
    folder = out / f"{Path(recording).name}-{offset}"
    thinned = rewritten.write(folder / "recording", rewritten.thinned(rewritten.listed(recording), offset, 1))
    features = accuracy.features_of(thinned, [], folder / "features")
    default = accuracy.variant(features, folder / "default", replace(Config(), seed=seed))
    found = {DEFAULT: figures(default)}
    for lever in levers:
        found[lever] = figures(accuracy.variant(default, folder / "turned", config_io.apply(default.config(), [lever])))
        print(f"{folder.name}  seed {seed}  {lever:<28}  {found[lever]['ape']}  (default {found[DEFAULT]['ape']})", flush=True)
    is_simulated = (rewritten.listed(recording).source.root / "scene.json").is_file()
    return {"recording": Path(recording).name, "is_simulated": is_simulated, "offset": offset, "seed": seed, "found": found}


def figures(run: RunDir) -> dict[str, float]:
    """Give APE after loop [m] and the share of frames with a pose."""
    result = accuracy.ours(run)
    return {"ape": result.ape["loop"], "coverage": result.coverage}


def merged(cells: list[dict[str, Any]], cell: dict[str, Any]) -> list[dict[str, Any]]:
    """Add a cell; where the same one is there already with the same default result, its other levers stay."""
    keys = ("recording", "offset", "seed")
    others = [c for c in cells if [c[k] for k in keys] != [cell[k] for k in keys]]
    old = [c for c in cells if c not in others and c["found"][DEFAULT] == cell["found"][DEFAULT]]
    return [*others, cell | {"found": (old[0]["found"] if old else {}) | cell["found"]}]


def table(cells: list[dict[str, Any]]) -> str:
    """Render the gain of each lever in Markdown, of real and of simulated recordings apart."""
    kinds = [kind for kind in (False, True) if any(c["is_simulated"] == kind for c in cells)]
    heads = [f"gain, {'simulated' if kind else 'real'} [mm]: median (range)" for kind in kinds]
    rows = [["lever", "default", *itertools.chain(*((head, "better / worse") for head in heads))]]
    for lever, name in LEVERS.items():
        if any(lever in c["found"] for c in cells):
            rows.append([name, "on" if is_on(lever) else "off", *itertools.chain(*(gain_cells(cells, lever, kind) for kind in kinds))])
    return bench.markdown(rows)


def is_on(lever: str) -> bool:
    """Say whether a lever is on by default: whether turning it turns it off."""
    return lever.endswith("=false")


def gain_cells(cells: list[dict[str, Any]], lever: str, is_simulated: bool) -> list[str]:
    """Show a lever's gain over the pairs of one kind of recording, and in how many the error fell or rose by more than a hundredth."""
    pairs = [(c["found"][DEFAULT], c["found"][lever]) for c in cells if lever in c["found"] and c["is_simulated"] == is_simulated]
    if not pairs:
        return ["", ""]
    default, turned = np.array([[one["ape"], other["ape"]] for one, other in pairs]).T
    off, on = (turned, default) if is_on(lever) else (default, turned)
    gain = 1e3 * (off - on)
    better, worse = (int((sign * (off - on) > 0.01 * off).sum()) for sign in (1, -1))
    return [f"{np.median(gain):+.2f} ({gain.min():+.2f} to {gain.max():+.2f})", f"{better} / {worse} of {len(pairs)}"]


if __name__ == "__main__":
    main()
