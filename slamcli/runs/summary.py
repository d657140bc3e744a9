"""What a finished run made, in a few lines, and what can be done with it."""

from dataclasses import dataclass
from typing import Any

from slamcli.console import table
from slamcli.runs.run_directory import RunDir
from slamcli.slam import doubt
from slamcli.stages import NAMES

MADE = (  # name, stage, what its summary says of it, where it is
    ("cloud", "densify", "{points} points", "densify/cloud.ply"),
    ("octree", "octree", "{occupied_cells} occupied and {free_cells} free cells", "octree/map.ot, map.bt"),
    ("grid", "grid2d", "{columns} x {rows} cells, {occupied} occupied, {free} free", "grid2d/map.pgm, map.yaml"),
)


def outcome(run: RunDir) -> str:
    """Say first if the result is doubtful, then tabulate what was made and where it is; "" while a stage is missing."""
    records = _records(run)
    if len(records) < len(NAMES):
        return ""
    said = doubt.headline(doubt.from_records(records))
    n_warnings = sum(warned(run, stage).count for stage in records)
    rows = [
        _trajectory(records),
        *([name, text.format_map(records[stage]["summary"]), place] for name, stage, text, place in MADE),
        _cost(records),
        *([["warnings", str(n_warnings), "log.txt"]] if n_warnings else []),
    ]
    return f"{said}\n" * bool(said) + table(rows)


@dataclass(frozen=True)
class Warned:
    """What a stage warned of."""

    texts: list[str]  # each once: its warnings, and what puts its result in doubt
    count: int  # of all, also those of which a record keeps no text


def warned(run: RunDir, stage: str) -> Warned:
    """Gather what a stage warned of; in a run of several recordings, what it warned of each alone too, after the recording's name."""
    own = [(run, "")] + [(RunDir(run.recording_path(entry["name"])), f"{entry['name']}: ") for entry in run.recordings]
    texts, unkept = [], 0
    for one, name in own:
        record = one.record(stage)
        if record is None:
            continue
        doubts = [row["text"] for row in record["summary"].get(doubt.DOUBTS, [])]
        texts += [f"{name}{text}" for text in dict.fromkeys([*record["warnings"], *doubts])]
        unkept += record["n_warnings"] - len(record["warnings"])
    return Warned(texts, len(texts) + unkept)


def to_dict(run: RunDir) -> dict[str, Any]:
    """Return what `outcome` tells, as plain values: by stage its counts, time and warnings."""
    names = ("seconds", "cpu_seconds", "peak_rss_mb", "digest", "summary", "warnings")
    stages = {stage: {name: record[name] for name in names} for stage, record in _records(run).items()}
    return {"run": str(run.path), "recording": run.info()["root"], "stages": stages}


def _records(run: RunDir) -> dict[str, Any]:
    return {name: record for name in NAMES if (record := run.record(name)) is not None}


def _trajectory(records: dict[str, Any]) -> list[str]:
    n_frames, loop = records["extract"]["summary"]["frames"], records["loop"]["summary"]
    apart = loop.get("apart", 0)
    doubtful = f", {loop['doubtful']} doubtful" if loop.get("doubtful") else ""
    told = (
        f"{n_frames - loop['lost'] - apart} of {n_frames} frames{doubtful}, {loop['closures']} loop{'s' * (loop['closures'] != 1)} closed"
    )
    if "recordings" in loop:
        n_joined, n = sum(row["located"] > 0 for row in loop["recordings"]), len(loop["recordings"])
        told = f"{n_joined} of {n} recordings in one frame: {told}"
    file = "loop/trajectory_<recording>.txt" if "recordings" in loop else "loop/trajectory.txt"
    return ["trajectory", f"{told}, {apart} frames in segments apart" if apart else told, file]


def _cost(records: dict[str, Any]) -> list[str]:
    seconds, n_frames = sum(record["seconds"] for record in records.values()), records["extract"]["summary"]["frames"]
    peak = max(record["peak_rss_mb"] for record in records.values())
    return ["cost", f"{seconds:.1f} s, {n_frames / max(seconds, 1e-3):.1f} frames/s, {peak:.0f} MiB"]
