#!/usr/bin/env python
"""What slamcli costs and how accurate it is, beside others on the same images.

    python scripts/bench.py                                    what each stage of the last run cost, from its records
    python scripts/bench.py -r runs/tum/fr1_xyz
    python scripts/bench.py RECORDING... [--png] [--rounds 3] [--orbslam3 ORB/bin/python words.txt] [--open3d]
                            [--json figures.json] [--docs] [--flame graph.svg]

With recordings, every stage runs anew in a process of its own, the others track the same images after it, and tables follow, in
Markdown: time, in all and by stage (Table 3 of Zhao et al. 2020), APE (their Table 4) and map sizes (their Table 5). What others published is marked so.
CPU time is of all threads, files included, per colour frame; compiling kernels, which happens once per machine, is no part of it.
Machines differ: "of plain ORB" tells it as a multiple of what cv2.ORB_create(1000).detectAndCompute needs for the same images in the same
session. --compare FILE warns where that multiple has grown by more than a tenth since FILE, the --json of an earlier session, was written;
--docs puts one table into README.md and all into docs/figures.md, between the marks there. Each recording's ledger follows, see ledger.py: medians over --rounds; with --png
also of the recording with its colour rewritten as PNG, which costs more to decode than JPEG does. --flame draws a flame graph.
ORB-SLAM3 needs an environment of its own, see orbslam3.py.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import ledger
import own_process
import published
import rivals

from slamcli.console import table
from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

HEADINGS = ["stage", "wall [s]", "CPU [s]", "compiling [s]", "CPU [ms/frame]", "frames/s", "peak [MiB]", "output [MB]"]
GROWTH = 1.1  # of the CPU time since the baseline that is warned of
YARDSTICK_FRAMES = 100
MARKS = "<!-- figures: scripts/bench.py --docs -->", "<!-- end of figures -->"
ROOT = Path(__file__).resolve().parents[1]
OURS = "slamcli"


# one run, stage by stage


def show(run: RunDir) -> None:
    """Print what each stage of a run cost."""
    records = measured(run)
    n_frames = records[0]["summary"]["frames"]
    environment = records[-1]["environment"]
    print(f"{run.info()['dataset']}: {n_frames} frames, {os.cpu_count()} cores; " + ", ".join(f"{k} {v}" for k, v in environment.items()))
    print(table(rows(records, n_frames), right=range(1, len(HEADINGS))))


def measured(run: RunDir) -> list[dict[str, Any]]:
    """Return the record of each stage that has been run, in order."""
    records = [record for name in NAMES if (record := run.record(name)) is not None]
    if not records or records[0]["stage"] != "extract":
        raise SlamError(f"{run.path}: extract has not been run, so there is nothing to show")
    return records


def rows(records: list[dict[str, Any]], n_frames: int) -> list[list[str]]:
    """Make the table: a row a stage, and their sum. The sum's memory is the largest, its rate that of the whole."""
    found = [HEADINGS]
    for record in records:
        found.append(row(record["stage"], [record], n_frames))
    return [*found, row("all", records, n_frames)]


def row(name: str, records: list[dict[str, Any]], n_frames: int) -> list[str]:
    """Add up records and show them per frame of the recording."""
    wall, cpu, compiling = (sum(record[key] for record in records) for key in ("seconds", "cpu_seconds", "compile_seconds"))
    size = sum(entry["bytes"] for record in records for entry in record["outputs"].values())
    rate = n_frames / (wall - compiling) if wall > compiling else float("inf")
    peak = max(record["peak_rss_mb"] for record in records)
    per_frame = cpu_ms(records, n_frames)
    return [name, f"{wall:.1f}", f"{cpu:.1f}", f"{compiling:.1f}", f"{per_frame:.1f}", f"{rate:.1f}", f"{peak:.0f}", f"{size / 1e6:.1f}"]


def cpu_ms(records: list[dict[str, Any]], n_frames: int) -> float:
    """Return the CPU time of stages without compilation [ms a frame]."""
    return 1e3 * sum(record["cpu_seconds"] - record["compile_seconds"] for record in records) / n_frames


# recordings, side by side


def measure(recording: str, given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run everything on a recording, as often as asked for, and give its figures: the medians of times, all else of the last round."""
    rounds = [one_round(recording, given, folder / str(k)) for k in range(given.rounds)]
    found = rounds[-1]
    found["plain_orb_ms"] = median(one["plain_orb_ms"] for one in rounds)
    for system, figures in found["systems"].items():
        for name in ("cpu_ms", "cpu_with_decoding_ms", "wall_seconds"):
            if name in figures:
                figures[name] = median(one["systems"][system][name] for one in rounds)
        figures["of_plain_orb"] = figures["cpu_ms"] / found["plain_orb_ms"]
    mine = found["systems"][OURS]
    mine["costs"] = ledger.middle([one["systems"][OURS]["costs"] for one in rounds])
    mine["stages"] = {stage: figures["cpu_ms"] for stage, figures in mine["costs"].items()}
    return found


def one_round(recording: str, given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run everything on a recording once."""
    run = own_process.run(recording, path=folder).directory
    systems = {OURS: ours(run)}
    if given.orbslam3:
        systems["ORB-SLAM3"] = rivals.orbslam3(run, *given.orbslam3)
    if given.open3d:
        systems["Open3D SLAM"] = rivals.open3d(run)
    return {
        "recording": run.info()["dataset"],
        "is_simulated": (run.dataset().root / "scene.json").is_file(),
        "frames": rivals.n_frames(run),
        "plain_orb_ms": plain_orb_ms(run),
        "systems": systems,
        "bytes": {name: run.stage_path(*place).stat().st_size for name, place in MAP_FILES.items()},
    }


MAP_FILES = {
    "cloud.ply": ("densify", "cloud.ply"),
    "map.ot": ("octree", "map.ot"),
    "map.bt": ("octree", "map.bt"),
    "map.pgm": ("grid2d", "map.pgm"),
}


def ours(run: RunDir) -> dict[str, Any]:
    """Return the figures of our own run, from its records."""
    records = measured(run)
    n_frames = records[0]["summary"]["frames"]
    figures = {
        "cpu_ms": cpu_ms(records, n_frames),
        "costs": ledger.stage_costs(records, n_frames),
        "wall_seconds": sum(record["seconds"] - record["compile_seconds"] for record in records),
        "peak_mib": max(record["peak_rss_mb"] for record in records),
    }
    return {**figures, **rivals.accuracy(run, run_trajectories.stage_trajectory(run, "loop"))}


def plain_orb_ms(run: RunDir) -> float:
    """Return the CPU time of OpenCV's ORB on images of the recording [ms], one thread, the least of three rounds."""
    dataset = run.dataset()
    images = [dataset.grey(i) for i in range(0, len(dataset), -(-len(dataset) // YARDSTICK_FRAMES))]
    orb, rounds = cv2.ORB_create(1000), []
    cv2.setNumThreads(1)
    for _ in range(3):
        start = time.process_time()
        for image in images:
            orb.detectAndCompute(image, None)
        rounds.append(time.process_time() - start)
    return 1e3 * min(rounds) / len(images)


# tables


def tables(found: list[dict[str, Any]]) -> str:
    """Render all tables in Markdown."""
    return "\n\n".join([time_table(found), stage_table(found), ape_table(found), size_table(found)])


def ledgers(found: list[dict[str, Any]]) -> str:
    """Where our time goes, stage by stage: CPU and wall time, the share of two cores, multiples of others in the same session."""
    blocks = []
    for figures in found:
        rival = figures["systems"].get("ORB-SLAM3", {}).get("cpu_with_decoding_ms")
        rows = ledger.rows(figures["systems"][OURS]["costs"], plain_orb_ms=figures["plain_orb_ms"], orbslam3_ms=rival)
        blocks.append(markdown([[f"{name_of(figures)}, {figures['frames']} frames", *ledger.HEADINGS], *rows]))
    return "\n\n".join(blocks)


def name_of(figures: dict[str, Any]) -> str:
    """Name a recording so that a simulated one cannot be taken for a real one."""
    return f"{figures['recording']} (simulated)" if figures["is_simulated"] else figures["recording"]


def summary_table(found: list[dict[str, Any]]) -> str:
    """Accuracy and cost beside the best-known rival, in one table."""
    rival = "ORB-SLAM3"
    rows = [["", "frames", "APE [m]", f"{rival}'s", "CPU [ms/frame], maps included", f"{rival}'s, without maps"]]
    for figures in found:
        ours, theirs = (figures["systems"].get(system) for system in (OURS, rival))
        cpu = [f"{f['cpu_ms']:.0f}" if f else "" for f in (ours, theirs)]
        rows.append([name_of(figures), str(figures["frames"]), ape_cell(ours), ape_cell(theirs), *cpu])
    return markdown(rows)


def time_table(found: list[dict[str, Any]]) -> str:
    """What each system costs."""
    rows = [["measured here", "system", "frames", "CPU [ms/frame]", "of plain ORB", "peak memory [MiB]"]]
    for figures in found:
        for system, f in figures["systems"].items():
            cells = [str(figures["frames"]), f"{f['cpu_ms']:.0f}", f"{f['of_plain_orb']:.1f}", f"{f['peak_mib']:.0f}"]
            rows.append([name_of(figures), f"{system}, maps included" if system == OURS else system, *cells])
    return markdown(rows)


def stage_table(found: list[dict[str, Any]]) -> str:
    """Where our time goes."""
    rows = [["slamcli, CPU [ms/frame], measured here", *NAMES]]
    rows += [[name_of(figures), *(f"{figures['systems'][OURS]['stages'][stage]:.1f}" for stage in NAMES)] for figures in found]
    return markdown(rows)


def ape_table(found: list[dict[str, Any]]) -> str:
    """How accurate each system is, and what others published."""
    systems = list(dict.fromkeys(system for figures in found for system in figures["systems"]))
    rows = [["APE RMSE [m] (frames with a pose)", *(f"{system}, measured here" for system in systems), *published.COLUMNS]]
    for figures in found:
        cells = [ape_cell(figures["systems"].get(system)) for system in systems]
        rows.append([name_of(figures), *cells, *published.ape(figures["recording"])])
    return markdown(rows)


def ape_cell(f: dict[str, Any] | None) -> str:
    """Show APE and coverage of one system."""
    if f is None:
        return ""
    return f"{f['ape']:.4f} ({100 * f['coverage']:.1f} %)" if f["ape"] is not None else "no pose"


def size_table(found: list[dict[str, Any]]) -> str:
    """How large the maps are; the published share is of files whose formats the paper does not name."""
    rows = [
        ["map files", *(f"`{name}` [MB]" for name in MAP_FILES), "`map.bt` / `cloud.ply`", "`map.ot` / `cloud.ply`", published.SIZE_COLUMN]
    ]
    for figures in found:
        size = figures["bytes"]
        shares = [f"{100 * size[name] / size['cloud.ply']:.2f} %" for name in ("map.bt", "map.ot")]
        rows.append(
            [name_of(figures), *(f"{size[name] / 1e6:.3f}" for name in MAP_FILES), *shares, published.size_share(figures["recording"])]
        )
    return markdown(rows)


def markdown(rows: list[list[str]]) -> str:
    """Render rows, the first of them headings."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def put_into(path: Path, text: str, marks: tuple[str, str] = MARKS) -> None:
    """Replace what stands between the marks."""
    start, stop = marks
    before, found, rest = path.read_text(encoding="utf-8").partition(start)
    _, end, after = rest.partition(stop)
    if not (found and end):
        raise SlamError(f"{path}: there is no {start} ... {stop}")
    path.write_text(f"{before}{start}\n{text}\n{stop}{after}", encoding="utf-8")


def slower(found: list[dict[str, Any]], baseline: list[dict[str, Any]]) -> list[str]:
    """Tell which stages cost more than in the baseline, in multiples of plain ORB."""
    before, told = {figures["recording"]: figures for figures in baseline}, []
    for figures in found:
        old = before.get(figures["recording"])
        for stage, cpu in figures["systems"][OURS]["stages"].items() if old else ():
            was = old["systems"][OURS]["stages"].get(stage, cpu) / old["plain_orb_ms"]
            now = cpu / figures["plain_orb_ms"]
            if now > GROWTH * was and now - was > 0.02:
                told.append(f"{figures['recording']}: {stage} costs {now:.2f} x plain ORB a frame, it was {was:.2f}")
    return told


def recordings(given: argparse.Namespace, folder: Path) -> list[str]:
    """List the recordings to measure: those named, and with --png each of them once more as PNG."""
    more = [str(ledger.as_png(name, folder / f"{Path(name).name}_png")) for name in given.recordings] if given.png else []
    return [*given.recordings, *more]


def main() -> None:
    """Read the arguments and show what they ask for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", metavar="RECORDING")
    parser.add_argument("-r", "--run", help="show the records of this run; without recordings")
    parser.add_argument("--orbslam3", nargs=2, metavar=("PYTHON", "WORDS"))
    parser.add_argument("--open3d", action="store_true", help="Open3D's dense RGB-D SLAM beside it")
    parser.add_argument("--png", action="store_true", help="each recording also with its colour images rewritten as PNG")
    parser.add_argument("--rounds", type=int, default=1, help="how often; times are medians [1]")
    parser.add_argument("--flame", type=Path, metavar="FILE", help="draw a flame graph of the first recording, SVG; needs py-spy")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    parser.add_argument("--docs", action="store_true", help="put the tables into README.md and docs/figures.md")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="figures of an earlier session")
    given = parser.parse_args()
    try:
        if not given.recordings:
            show(RunDir.find(given.run))
            return
        with tempfile.TemporaryDirectory() as folder:
            found = [
                measure(recording, given, Path(folder) / "runs" / str(k)) for k, recording in enumerate(recordings(given, Path(folder)))
            ]
            if given.flame:
                ledger.flame(given.recordings[0], given.flame, Path(folder) / "flame")
        if given.json:
            given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        print(f"{tables(found)}\n\n{ledgers(found)}")
        if given.docs:
            put_into(ROOT / "README.md", summary_table(found))
            put_into(ROOT / "docs" / "figures.md", tables(found))
        if given.compare:
            for line in slower(found, json.loads(given.compare.read_text(encoding="utf-8"))):
                print(f"warning: {line}", file=sys.stderr)
    except SlamError as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    main()
