#!/usr/bin/env python
"""Forge the arrays of a finished run, digests and seals all right, and give every command that reads them: a result or one line.

    python scripts/forged.py ONE [--only PART] [--share 1] [--seed 0] [--seconds 60] [--gib 2]

ONE is a short recording. A run of it is made; then, in one file at a time, values are put that no stage writes: indices beyond what they
point to, offsets that decrease, NaN and huge poses, headers that claim more than there is, a camera that is none. The stages that need it
and the commands that show it must end with status 0, or with status 1 and one line, without a traceback, a crash of the process, more than
so many seconds of CPU or GiB of memory. With --share less than 1 so large a share is tried, drawn with --seed. Exit status 1 where anything
did not hold.
"""

import argparse
import io
import json
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from extremes import bound
from stand import Command, Stand

from slamcli import files
from slamcli.runs import damage
from slamcli.stages import STAGES, WITH_TRAJECTORY

SHOWN: dict[str, tuple[Command, ...]] = {  # the commands that show what a stage made, beside those that show any trajectory
    "extract": (("report", "-o", "out/report.html", "--no-inspect"), ("localize", "run", "ONE", "--out", "out/found.txt")),
    "match": (("localize", "run", "ONE", "--out", "out/found.txt"),),
    "loop": (
        ("export-trajectory", "out/p.g2o"),
        ("export-colmap", "out/colmap"),
        ("export-mesh", "out/mesh.ply", "--voxel", "0.2"),
        ("report", "-o", "out/report.html", "--no-inspect"),
        ("localize", "run", "ONE", "--out", "out/found.txt"),
        ("plan", "--start", "first", "--goal", "last", "--radius", "0.05", "--allow-unknown", "-o", "out/way.csv"),
        ("render", "out/room.png", "--size", "64", "48", "--path"),
    ),
    "densify": (("render", "out/room.png", "--size", "64", "48", "--path"), ("export-cloud", "out/cloud.ply", "--frame", "world")),
    "octree": (("export-octree", "out/map.ot", "--colour"), ("render", "out/tree.png", "--what", "octree", "--size", "64", "48")),
    "grid2d": (
        ("export-grid", "out/map.pgm", "--png", "out/map.png"),
        ("plan", "--start", "first", "--reachable", "--radius", "0.1"),
        ("export-plan", "out/plan.json"),
        ("compare", "run", "kept", "-o", "out/compare.html"),
    ),
}
Forgery = tuple[str, Callable[[np.ndarray], np.ndarray | bytes]]


def main() -> int:
    """Forge one file after the other and give the commands."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("one", type=Path)
    options.add_argument(
        "--only", default="", metavar="PART", help="only forgeries in whose name PART occurs, as loop/kf_frame.npy: ones beyond"
    )
    options.add_argument("--share", type=float, default=1.0, help="of forgeries that are tried [1]")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--seconds", type=float, default=60.0, help="of CPU that a command may take [60]")
    options.add_argument("--gib", type=float, default=2.0, help="of memory that a command may take [2]")
    given = options.parse_args()
    rng, n_tried, n_refused, n_faults = random.Random(given.seed), 0, 0, 0
    with tempfile.TemporaryDirectory(prefix="slamcli-forged-") as folder:
        stand = Stand(Path(folder), given.one, given.one, ())
        shutil.copytree("run", "kept")
        for name, forge in list(forgeries(Path("kept"))):
            if given.only not in name or rng.random() >= given.share:
                continue
            stage = name.partition("/")[0]
            for command in readers(stage):
                shutil.rmtree("run")
                shutil.rmtree("out", ignore_errors=True)
                shutil.copytree("kept", "run")
                Path("out").mkdir()
                forge(Path("run"))
                ended = stand.call(command, within=partial(bound, given.seconds / 60, given.gib))
                n_tried += 1
                n_refused += ended.status == 1
                errors = [line for line in ended.said.splitlines() if line.startswith("Error")]
                if "Traceback" in ended.said or ended.status not in (0, 1) or (ended.status == 1 and len(errors) != 1):
                    n_faults += 1
                    print(f"FAULT {name}, {' '.join(command)}: status {ended.status} {ended.said[-600:].strip()}", flush=True)
        os.chdir("/")
    print(f"{n_tried} tried, {n_refused} refused, {n_faults} faults")
    return 1 if n_faults else 0


def readers(stage: str) -> Iterator[Command]:
    """List the commands that read what a stage made."""
    for reader in STAGES:
        if stage in reader.needs:
            yield reader.name, "-r", "run"
    if stage in WITH_TRAJECTORY:
        yield "export-trajectory", "out/t.txt", "-r", "run", "--stage", stage
        yield "eval", "ape", "-r", "run", "--stage", stage
    for command in SHOWN.get(stage, ()):
        yield command if command[0] in ("localize", "compare") else (*command, "-r", "run")


def forgeries(run: Path) -> Iterator[tuple[str, Callable[[Path], None]]]:
    """List what is forged, each with what does so to a copy of the run."""
    for path in sorted(run.glob("*/*.npy")):
        name = str(path.relative_to(run))
        for told, forge in of_array(np.load(path)):
            yield f"{name}: {told}", partial(put, name=name, data=packed(forge))
    for path in sorted(run.glob("*/camera.json")):
        name = str(path.relative_to(run))
        for key, value in (
            (key, value) for key in ("width", "height", "fx", "cx", "k1", "depth_scale") for value in (0, -1, 1e300, 1e-300, 2**31)
        ):
            camera = json.loads(path.read_bytes()) | {key: value}
            yield f"{name}: {key} = {value}", partial(put, name=name, data=json.dumps(camera).encode())


def of_array(column: np.ndarray) -> Iterator[tuple[str, np.ndarray | bytes]]:
    """List what may stand in the place of an array."""
    values: tuple[float, ...] = (np.nan, np.inf, -1e30, 1e30, 1e300, 0.0)
    if column.dtype.kind in "iu":
        least, most = np.iinfo(column.dtype).min, np.iinfo(column.dtype).max
        values = tuple(sorted({value for value in (least, -1, 1, len(column) if column.ndim else 7, most) if least <= value <= most}))
    elif column.dtype.kind == "b":
        values = (True, False)
    for value in values:
        with np.errstate(over="ignore"):
            yield f"all {value}", np.full_like(column, value)
            if column.size > 1:
                for place, at in (("first", 0), ("middle", column.size // 2), ("last", -1)):
                    other = column.copy()
                    other.reshape(-1)[at] = value
                    yield f"{place} {value}", other
    if column.ndim:
        yield "no row", column[:0]
        yield "one row less", column[:-1]
        yield "a row more", np.concatenate([column, column[-1:]])
        yield "backwards", np.ascontiguousarray(column[::-1])
        yield "a huge header", header((1 << 40, *column.shape[1:]), column.dtype.str)
    yield "objects", header(column.shape, "|O") + b"cos\nsystem\n(S'true'\ntR."


def header(shape: tuple[int, ...], descr: str) -> bytes:
    """Return an array's header without the array."""
    with io.BytesIO() as file:
        np.lib.format.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": descr})
        return file.getvalue()


def packed(column: np.ndarray | bytes) -> bytes:
    """Return the bytes of a file."""
    if isinstance(column, bytes):
        return column
    with io.BytesIO() as file:
        np.save(file, column)
        return file.getvalue()


def put(run: Path, *, name: str, data: bytes) -> None:
    """Put a file into a run, digests and seals as if a stage had written it."""
    (run / name).write_bytes(data)
    record = run / name.partition("/")[0] / "stage.json"
    told = {key: value for key, value in json.loads(record.read_bytes()).items() if key != files.SEAL}
    told["outputs"] = damage.outputs(record.parent)
    files.write_sealed(record, told)


if __name__ == "__main__":
    sys.exit(main())
