"""The ledger of a run: of each stage, CPU and wall time a frame, the share of two cores that it used, and what that is in multiples of others.

The multiples are of figures taken in the same session on the same images, so that they hold on another machine, and on a busy one: of what
cv2.ORB_create(1000).detectAndCompute needs, and of ORB-SLAM3 with its decoding. Compiling, which happens once, is no part of it.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import rewritten

from slamcli.errors import SlamError

CORES = 2  # that shares are told of
HEADINGS = ["CPU [ms/frame]", "wall [ms/frame]", "of two cores", "of plain ORB", "of ORB-SLAM3"]


def stage_costs(records: list[dict[str, Any]], n_frames: int) -> dict[str, dict[str, float]]:
    """Compute each stage's CPU and wall time [ms a frame] from its record."""
    return {
        record["stage"]: {
            "cpu_ms": 1e3 * (record["cpu_seconds"] - record["compile_seconds"]) / n_frames,
            "wall_ms": 1e3 * (record["seconds"] - record["compile_seconds"]) / n_frames,
        }
        for record in records
    }


def middle(rounds: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Take the median of each figure over rounds of `stage_costs`."""
    return {stage: {name: median(of[stage][name] for of in rounds) for name in figures} for stage, figures in rounds[0].items()}


def rows(costs: dict[str, dict[str, float]], *, plain_orb_ms: float, orbslam3_ms: float | None = None) -> list[list[str]]:
    """Make a row of each stage and of all, under HEADINGS.

    plain_orb_ms, orbslam3_ms : CPU time of these on the same images [ms a frame]; without the latter its column stays empty
    """
    total = {name: sum(figures[name] for figures in costs.values()) for name in ("cpu_ms", "wall_ms")}
    found = []
    for stage, figures in {**costs, "all": total}.items():
        cpu, wall = figures["cpu_ms"], figures["wall_ms"]
        share = f"{100 * cpu / (CORES * wall):.0f} %" if wall > 0 else ""
        rival = "" if orbslam3_ms is None else f"{cpu / orbslam3_ms:.2f}"
        found.append([stage, f"{cpu:.2f}", f"{wall:.2f}", share, f"{cpu / plain_orb_ms:.2f}", rival])
    return found


def as_png(recording: str, folder: Path) -> Path:
    """Write a recording in the TUM layout whose colour images are PNG files of the same pixels, as the data set's originals are.

    Depth images are linked to. A folder that is there already is kept as it is.
    """
    if folder.exists():
        return folder
    lists = rewritten.listed(recording)
    root, colour = lists.source.root, [(stamp, f"png/{Path(name).stem}.png") for stamp, name in lists.colour]
    rewritten.write(folder, replace(lists, colour=[], depth=lists.depth))
    (folder / "png").mkdir()
    (folder / "rgb.txt").write_text("".join(f"{stamp:.6f} {name}\n" for stamp, name in colour))
    for (_, source), (_, name) in zip(lists.colour, colour, strict=True):
        image = cv2.imread(str(root / source), cv2.IMREAD_COLOR)
        if image is None or not cv2.imwrite(str(folder / name), image):
            raise SlamError(f"{root / source}: cannot be rewritten as {folder / name}")
    return folder


def flame(recording: str, out: Path, run: Path) -> None:
    """Run everything on a recording under py-spy and draw a flame graph of it, in SVG."""
    program = [sys.executable, "-m", "slamcli", "run", recording, "-r", str(run), "--force"]
    try:
        subprocess.run(["py-spy", "record", "--threads", "-o", str(out), "--", *program], check=True, stdout=subprocess.DEVNULL)
    except FileNotFoundError:
        raise SlamError("a flame graph needs py-spy; try: pip install py-spy") from None
