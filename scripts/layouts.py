"""Write a recording into every layout that loses nothing, run each, and compare features and trajectory with those of its own folder.

    python scripts/layouts.py path/to/rgbd_dataset_freiburg1_xyz --frames 200 --until loop
    python scripts/layouts.py path/to/rgbd_dataset_freiburg1_xyz --layouts mcap ros1_compressed --cost
    python scripts/layouts.py path/to/rgbd_dataset_freiburg1_xyz --frames 1000 --phone

Depth keeps its readings and colour its bytes; pixels of bags without compression are those of a PNG. Stamps that a layout has must come
back bit for bit, and with them every array of features and every pose; where it has none, features are compared.
"""

import argparse
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import layouts
from layouts import LAYOUTS, Layout

import slamcli
from slamcli.config.options import RecordingConfig
from slamcli.console import table
from slamcli.datasets import open_dataset
from slamcli.evaluation import trajectory_error
from slamcli.formats.trajectory import read_tum
from slamcli.schema import Features

RAW_COLOUR = ("ros1_raw", "ros1_lz4", "ros2_zstd", "mcap")


def main() -> None:
    """Compare the layouts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--frames", type=int, default=100, help="from the beginning")
    parser.add_argument("--until", default="extract", help="the stage up to which each is run")
    parser.add_argument("--layouts", nargs="*", default=[layout.name for layout in LAYOUTS])
    parser.add_argument("--cost", action="store_true", help="CPU time of opening and of reading all frames instead of a run")
    parser.add_argument("--phone", action="store_true", help="compare APE with that of the same frames as a phone records them, lossy")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = as_phone(arguments, Path(folder)) if arguments.phone else compare(arguments, Path(folder))
    print(table(rows))


def compare(arguments: argparse.Namespace, folder: Path) -> list[list[str]]:
    """Return a row of the table for each layout."""
    from datasets.test_same_recording import content_of

    dataset = open_dataset(arguments.recording)
    frames = tuple(i for i in range(len(dataset)) if np.isfinite(dataset.depth_stamp[i]))[: arguments.frames]
    head = (
        ["layout", "open [CPU s]", "peak [MiB]", "read [CPU ms/frame]", "of the folder's"]
        if arguments.cost
        else ["layout", "features", "poses"]
    )
    rows = [head]
    for suffix in (".jpg", ".png"):
        content = content_of(dataset, frames, suffix=suffix)
        known = {key: value for key, value in content.camera.items() if key not in ("width", "height")}
        reference = layouts.tum(content, folder / f"tum{suffix}")
        own = cost(reference, known) if arguments.cost else run(reference, known, folder / f"run{suffix}", arguments.until)
        for layout in (item for item in LAYOUTS if item.name in arguments.layouts and (item.name in RAW_COLOUR) == (suffix == ".png")):
            camera = known if layout.override else {key: value for key, value in known.items() if key != "depth_scale"}
            path = layout.write(content, folder / layout.name)
            if arguments.cost:
                found = cost(path, camera)
                rows.append([layout.name, f"{found[0]:.2f}", f"{found[1]:.0f}", f"{1000 * found[2]:.1f}", f"{found[2] / own[2]:.2f}"])
            else:
                rows.append([layout.name, *verdict(run(path, camera, folder / f"run-{layout.name}", arguments.until), own, layout)])
    return rows


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
