"""What a finished run made, in a few lines, and what can be done with it."""

from pathlib import Path
from typing import Any

from slamcli.console import table
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

MADE = (  # name, stage, what its summary says of it, where it is
    ("cloud", "densify", "{points} points", "densify/cloud.ply"),
    ("octree", "octree", "{occupied_cells} occupied and {free_cells} free cells", "octree/map.ot, octree/map.bt"),
    ("grid", "grid2d", "{columns} x {rows} cells, {occupied} occupied, {free} free", "grid2d/map.pgm, grid2d/map.yaml"),
)


def outcome(run: RunDir) -> str:
    """Tabulate what was made and where it is, then the commands that come next; "" while a stage is missing."""
    records = {name: record for name in NAMES if (record := run.record(name)) is not None}
    if len(records) < len(NAMES):
        return ""
    n_warnings = sum(record["n_warnings"] for record in records.values())
    rows = [
        _trajectory(records),
        *([name, text.format_map(records[stage]["summary"]), place] for name, stage, text, place in MADE),
        _cost(records),
        *([["warnings", str(n_warnings), "log.txt"]] if n_warnings else []),
    ]
    return f"{table(rows)}\nnext: " + "; ".join(_next(run))


def _trajectory(records: dict[str, Any]) -> list[str]:
    n_frames, loop = records["extract"]["summary"]["frames"], records["loop"]["summary"]
    return [
        "trajectory",
        f"{n_frames - loop['lost']} of {n_frames} frames, {loop['closures']} loop{'s' * (loop['closures'] != 1)} closed",
        "loop/trajectory.txt",
    ]


def _cost(records: dict[str, Any]) -> list[str]:
    seconds, n_frames = sum(record["seconds"] for record in records.values()), records["extract"]["summary"]["frames"]
    peak = max(record["peak_rss_mb"] for record in records.values())
    return ["cost", f"{seconds:.1f} s, {n_frames / max(seconds, 1e-3):.1f} frames/s, {peak:.0f} MiB"]


def _next(run: RunDir) -> list[str]:
    has_truth = (Path(run.info()["root"]) / "groundtruth.txt").is_file()
    return [
        *(["slamcli eval ape"] if has_truth else []),
        "slamcli report",
        "slamcli export-grid map.pgm --png map.png",
        "slamcli plan --start X,Y --goal X,Y",
    ]
