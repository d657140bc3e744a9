#!/usr/bin/env python
"""Let the real ORB-SLAM3 load a vocabulary that slamcli exported, and track a recording with it.

    slamcli vocab export words.txt
    pip install pyorbslam3 evo opencv-python-headless        (an environment of its own: it needs nothing of slamcli)
    python scripts/orbslam3_vocabulary.py words.txt RUN

RUN is a run directory of slamcli: its extract/frames.txt and extract/camera.json say which images go together, and its run.json where they are.
The wheel is linked against libGL and libGLEW even without a window (Debian: libgl1, libglew2.2, libegl1).
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx}
Camera1.fy: {fy}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera1.k1: {k1}
Camera1.k2: {k2}
Camera1.p1: {p1}
Camera1.p2: {p2}
Camera1.k3: {k3}
Camera.width: {width}
Camera.height: {height}
Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: {depth_scale}
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def as_decimals(camera: dict) -> dict:
    """Write each number with a point: the reader tells floats from whole numbers by it."""
    return {name: int(value) if name in ("width", "height") else f"{float(value):.9f}" for name, value in camera.items()}


def track(slam, frames: list[tuple[str, Path, Path]]) -> tuple[list[int], float]:
    """Feed frames, each stamp, colour and depth image. Returns the map points matched in each and the CPU time of tracking a frame [ms]."""
    points, seconds = [], 0.0
    for stamp, colour, depth in frames:
        rgb, z = cv2.cvtColor(cv2.imread(str(colour)), cv2.COLOR_BGR2RGB), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
        start = time.thread_time()
        points.append(slam.track_rgbd(rgb, z, float(stamp)).num_tracked_points)
        seconds += time.thread_time() - start
    return points, seconds / len(frames) * 1e3


def ape(truth: Path, estimate: Path) -> tuple[float, int]:
    """Give the RMSE of the positions after SE(3) alignment without scale [m], and how many were compared."""
    from evo.core import metrics, sync
    from evo.tools import file_interface

    reference, found = (file_interface.read_tum_trajectory_file(str(path)) for path in (truth, estimate))
    reference, found = sync.associate_trajectories(reference, found, max_diff=0.02)
    found.align(reference)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, found))
    return error.get_statistic(metrics.StatisticsType.rmse), found.num_poses


def main() -> None:
    """Track the recording of a run and print the coverage, the APE and the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("vocabulary", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=0, help="how many frames; default: all")
    parser.add_argument("--trajectory", type=Path, help="keep the trajectory in this file, TUM format")
    arguments = parser.parse_args()
    import pyorbslam3

    root = Path(json.loads((arguments.run / "run.json").read_text())["root"])
    camera = json.loads((arguments.run / "extract" / "camera.json").read_text())
    lines = [line.split() for line in (arguments.run / "extract" / "frames.txt").read_text().splitlines() if not line.startswith("#")]
    frames = [(stamp, root / colour, root / depth) for stamp, colour, _, depth in lines[: arguments.frames or None]]
    with tempfile.TemporaryDirectory() as folder:
        settings, trajectory = Path(folder, "settings.yaml"), arguments.trajectory or Path(folder, "trajectory.txt")
        settings.write_text(SETTINGS.format(**as_decimals(camera)))
        start = time.perf_counter()
        slam = pyorbslam3.Slam(arguments.vocabulary, settings, pyorbslam3.Sensor.RGBD)
        loading = time.perf_counter() - start
        points, ms = track(slam, frames)
        slam.shutdown()  # before saving: it waits for the other threads
        slam.save_trajectory_tum(str(trajectory))
        n_posed = sum(1 for line in trajectory.read_text().splitlines() if line.strip())
        print(f"{arguments.vocabulary}: ORB-SLAM3 loaded it in {loading:.2f} s, with the rest of its start")
        print(f"  {n_posed} of {len(frames)} frames with a pose, {np.median(points):.0f} map points a frame (median)")
        print(
            f"  {ms:.1f} ms of the tracking thread's CPU a frame; process with its other threads {time.process_time() / len(frames) * 1e3:.1f} ms"
        )
        if (root / "groundtruth.txt").exists():
            rmse, n = ape(root / "groundtruth.txt", trajectory)
            print(f"  APE {rmse:.4f} m over {n} poses")


if __name__ == "__main__":
    main()
