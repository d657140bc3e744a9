"""Write a recording into every layout that loses nothing, run each, and compare features and trajectory with those of its own folder.

    python scripts/layouts.py path/to/rgbd_dataset_freiburg1_xyz --frames 200 --until grid2d
    python scripts/layouts.py path/to/rgbd_dataset_freiburg1_xyz --layouts mcap ros1_compressed --cost
    python scripts/layouts.py path/to/rgbd_dataset_freiburg1_xyz --frames 1000 --phone
    python scripts/layouts.py path/to/rgbd_dataset_freiburg1_xyz --frames 20 --opening 10000

Depth keeps its readings and colour its bytes; pixels of bags without compression are those of a PNG. Stamps that a layout has must come
back bit for bit, and with them every array of features and every pose; where it has none, features are compared.

`--opening` repeats the frames until a bag has as many as asked for, and fails where it takes longer to open, or more memory, than allowed.
"""

import argparse
import dataclasses
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import layouts
from layouts import LAYOUTS, RAW_COLOUR, Layout

import slamcli
from slamcli.config.options import RecordingConfig
from slamcli.console import table
from slamcli.datasets import open_dataset
from slamcli.evaluation import trajectory_error
from slamcli.formats.trajectory import read_tum
from slamcli.schema import Features
from slamcli.stages import NAMES

BAGS = {"ros1": layouts.ros1, "ros2": layouts.ros2, "mcap": layouts.mcap}
OPENING_S = 3.0  # CPU time of opening a bag at most
OPENING_MIB = 300.0  # memory that takes at most, over that of a bag of a few frames


def main() -> None:
    """Compare the layouts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--frames", type=int, default=100, help="from the beginning")
    parser.add_argument("--until", default="extract", help="the stage up to which each is run")
    parser.add_argument("--layouts", nargs="*", default=[layout.name for layout in LAYOUTS])
    parser.add_argument("--cost", action="store_true", help="CPU time of opening and of reading all frames instead of a run")
    parser.add_argument("--phone", action="store_true", help="compare APE with that of the same frames as a phone records them, lossy")
    parser.add_argument("--opening", type=int, metavar="N", help="measure opening a bag of N frames of each kind instead of a run")
    parser.add_argument("--open", nargs=2, help=argparse.SUPPRESS)  # a bag of a few frames and that of N, in a process of its own
    arguments = parser.parse_args()
    if arguments.open:
        measure_opening(*arguments.open)
        return
    with tempfile.TemporaryDirectory() as folder:
        if arguments.opening:
            rows = opening(arguments, Path(folder))
        else:
            rows = as_phone(arguments, Path(folder)) if arguments.phone else compare(arguments, Path(folder))
    print(table(rows))
    if arguments.opening and any(float(row[2]) > OPENING_S or float(row[3]) > OPENING_MIB for row in rows[1:]):
        raise SystemExit(f"a bag took more than {OPENING_S:.0f} s or {OPENING_MIB:.0f} MiB to open")


def compare(arguments: argparse.Namespace, folder: Path) -> list[list[str]]:
    """Return a row of the table for each layout."""
    from datasets.test_same_recording import content_of

    dataset = open_dataset(arguments.recording)
    frames = tuple(i for i in range(len(dataset)) if np.isfinite(dataset.depth_stamp[i]))[: arguments.frames]
    head = (
        ["layout", "open [CPU s]", "peak [MiB]", "read [CPU ms/frame]", "of the folder's"]
        if arguments.cost
        else ["layout", "features", "poses", "CPU of the folder's"]
    )
    rows = [head]
    for suffix in (".jpg", ".png"):
        content = content_of(dataset, frames, suffix=suffix)
        known = {key: value for key, value in content.camera.items() if key not in ("width", "height")}
        reference = layouts.tum(content, folder / f"tum{suffix}")
        if not arguments.cost:
            run(reference, known, folder / f"warm{suffix}", arguments.until)  # libraries loaded, kernels compiled
        own = cost(reference, known) if arguments.cost else run(reference, known, folder / f"run{suffix}", arguments.until)
        for layout in (item for item in LAYOUTS if item.name in arguments.layouts and (item.name in RAW_COLOUR) == (suffix == ".png")):
            camera = known if layout.override else {key: value for key, value in known.items() if key != "depth_scale"}
            path = layout.write(content, folder / layout.name)
            if arguments.cost:
                found = cost(path, camera)
                rows.append([layout.name, f"{found[0]:.2f}", f"{found[1]:.0f}", f"{1000 * found[2]:.1f}", f"{found[2] / own[2]:.2f}"])
            else:
                done = run(path, camera, folder / f"run-{layout.name}", arguments.until)
                rows.append([layout.name, *verdict(done, own, layout), f"{cpu_seconds(done) / cpu_seconds(own):.2f}"])
    return rows


def opening(arguments: argparse.Namespace, folder: Path) -> list[list[str]]:
    """Write bags of JPEG colour and depth as compressedDepth, and open each in a process of its own."""
    from datasets.test_same_recording import content_of

    dataset = open_dataset(arguments.recording)
    frames = tuple(i for i in range(len(dataset)) if np.isfinite(dataset.depth_stamp[i]))[: arguments.frames]
    content = content_of(dataset, frames, suffix=".png")
    jpeg = [cv2.imencode(".jpg", content.bgr(i))[1].tobytes() for i in range(len(frames))]
    content = dataclasses.replace(content, colour=jpeg, suffix=".jpg")
    rows = [["bag", "frames", "open [CPU s]", "memory [MiB]"]]
    for name, write in BAGS.items():
        paths = [str(write(repeated(content, n), folder / f"{name}_{n}", depth="png")) for n in (len(frames), arguments.opening)]
        told = subprocess.run([sys.executable, __file__, arguments.recording, "--open", *paths], capture_output=True, text=True, check=True)
        rows.append([name, *told.stdout.split()])
    return rows


def repeated(content: layouts.Content, n: int) -> layouts.Content:
    """Repeat frames until there are n, at 30 Hz."""
    index = np.arange(n) % len(content.stamp)
    stamp = [content.stamp[0] + 33_333_333 * i for i in range(n)]
    return dataclasses.replace(
        content, stamp=stamp, depth_stamp=stamp, colour=[content.colour[i] for i in index], raw=[content.raw[i] for i in index],
        T_wc=content.T_wc[index],
    )  # fmt: skip


def measure_opening(small: str, large: str) -> None:
    """Print how many frames the large bag has, the CPU time [s] of opening it, and the memory [MiB] over that of the small one."""
    open_dataset(small)  # libraries loaded
    before = peak_mib()
    start = time.process_time()
    dataset = open_dataset(large)
    opened = time.process_time() - start
    print(len(dataset), f"{opened:.2f}", f"{peak_mib() - before:.0f}")


def peak_mib() -> float:
    """Return this program's largest memory so far; that of getrusage begins at what the parent had when it started it."""
    status = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:")) / 1024


def as_phone(arguments: argparse.Namespace, folder: Path) -> list[list[str]]:
    """Run the same frames as stored and as a phone records them."""
    from datasets.test_same_recording import content_of

    dataset = open_dataset(arguments.recording)
    frames = tuple(i for i in range(len(dataset)) if np.isfinite(dataset.depth_stamp[i]))[: arguments.frames]
    content = content_of(dataset, frames, suffix=".jpg")
    rows = [["as", "APE [m]", "frames with a pose"]]
    for name, write in (("stored", layouts.tum), ("phone", layouts.phone)):
        path = write(content, folder / name)
        (path / "groundtruth.txt").symlink_to(dataset.root.resolve() / "groundtruth.txt")
        ape = trajectory_error.ape(
            slamcli.run(str(path), path=folder / f"run-{name}", until="loop").trajectory("loop"),
            read_tum(path / "groundtruth.txt"), n_frames=len(frames), name=name, stage="loop",
        )  # fmt: skip
        rows.append([name, f"{np.sqrt(np.mean(ape.error**2)):.4f}", f"{ape.n_poses} of {len(frames)}"])
    return rows


def run(path: Path, camera: dict[str, float], out: Path, until: str) -> slamcli.Run:
    """Run a recording with this calibration."""
    return slamcli.run(str(path), path=out, settings={f"camera.{key}": value for key, value in camera.items()}, until=until)


def cpu_seconds(done: slamcli.Run) -> float:
    """Return the CPU time [s] of all stages of a run."""
    records = [record for stage in NAMES if (record := done.record(stage)) is not None]
    return sum(record["cpu_seconds"] for record in records)


def verdict(found: slamcli.Run, own: slamcli.Run, layout: Layout) -> list[str]:
    """Compare features and, where stamps are kept, poses."""
    a, b = (r.directory.load(Features, "extract") for r in (found, own))
    names = ["offset", "xy", "depth", "octave", "angle", "desc", "slope"] + (["stamp"] if layout.keeps_stamps else [])
    differing = [
        name for name in names if not np.array_equal(getattr(a, name), getattr(b, name), equal_nan=getattr(a, name).dtype.kind == "f")
    ]
    features = "the same bytes" if not differing else f"differ in {', '.join(differing)}"
    stages = [stage for stage in ("track", "optimize", "loop") if found.record(stage) is not None]
    if not stages:
        return [features, "-"]
    one, other = found.trajectory(stages[-1]), own.trajectory(stages[-1])
    if len(one.stamp) != len(other.stamp):
        return [features, f"{len(one.stamp)} instead of {len(other.stamp)}"]
    apart = float(np.abs(one.T_wc[:, :3, 3] - other.T_wc[:, :3, 3]).max())
    return [features, "the same bytes" if np.array_equal(one.T_wc, other.T_wc) else f"{1000 * apart:.2f} mm apart at most"]


def cost(path: Path, camera: dict[str, float]) -> tuple[float, float, float]:
    """Measure CPU time [s] of opening, the memory that takes [MiB], and CPU time [s] of reading a frame: grey and depth."""
    open_dataset(str(path), camera=camera).depth(0)  # libraries loaded, kernels compiled
    tracemalloc.start()
    open_dataset(str(path), camera=camera)
    peak = tracemalloc.get_traced_memory()[1] / 2**20
    tracemalloc.stop()
    start = time.process_time()
    dataset = open_dataset(str(path), camera=camera, options=RecordingConfig())
    opened = time.process_time() - start
    start = time.process_time()
    for i in range(len(dataset)):
        dataset.grey(i)
        dataset.depth(i)
    return opened, peak, (time.process_time() - start) / len(dataset)


if __name__ == "__main__":
    main()
