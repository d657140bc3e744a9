#!/usr/bin/env python
"""Track a recording with the real ORB-SLAM3 and a vocabulary that slamcli exported.

    slamcli vocab export words.txt
    pip install pyorbslam3 opencv-python-headless        (an environment of its own: it needs nothing of slamcli)
    python scripts/orbslam3.py words.txt RUN [--out trajectory.txt] [--pace 1.0]

RUN is a run directory of slamcli: its extract/frames.txt and extract/camera.json say which images go together, and its run.json where
they are. Frames are handed over at the pace of their stamps, as its own examples do, since mapping goes on in other threads meanwhile: on
a machine that is busy with something else, a lower --pace gives mapping the time it needs.
The wheel is linked against libGL and libGLEW even without a window (Debian: libgl1 libglew2.2 libegl1).
The last line on standard output is a JSON object: frames, tracked, cpu_seconds and decode_cpu_seconds of the whole, wall seconds.
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


def track(slam, root: Path, lines: list[list[str]], pace: float) -> dict:
    """Hand over every frame that has depth, at a multiple of the recording's pace; give counts and times."""
    n_tracked, decoding, points, start = 0, 0.0, [], time.perf_counter()
    first = float(lines[0][0])
    for stamp, colour, *depth in lines:
        before = time.thread_time()
        rgb = cv2.cvtColor(cv2.imread(str(root / colour)), cv2.COLOR_BGR2RGB)
        raw = cv2.imread(str(root / depth[-1]), cv2.IMREAD_UNCHANGED) if len(depth) == 2 else np.zeros(rgb.shape[:2], np.uint16)
        decoding += time.thread_time() - before
        time.sleep(max(0.0, (float(stamp) - first) / pace - (time.perf_counter() - start)))
        result = slam.track_rgbd(rgb, raw, float(stamp))
        n_tracked += bool(result.pose_valid)
        points.append(result.num_tracked_points)
    return {"frames": len(lines), "tracked": n_tracked, "points": float(np.median(points)), "decode_cpu_seconds": decoding}


def main() -> None:
    """Track the recording of a run and print how many frames ORB-SLAM3 gave a pose, and what that cost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("vocabulary", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, help="where to write its final trajectory, in the TUM format")
    parser.add_argument("--pace", type=float, default=1.0, help="multiple of the pace at which the recording was taken")
    arguments = parser.parse_args()
    import pyorbslam3

    root = Path(json.loads((arguments.run / "run.json").read_text())["root"])
    camera = json.loads((arguments.run / "extract" / "camera.json").read_text())
    lines = [line.split() for line in (arguments.run / "extract" / "frames.txt").read_text().splitlines() if not line.startswith("#")]
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as settings:
        settings.write(SETTINGS.format(**as_decimals(camera)))
        settings.flush()
        slam = pyorbslam3.Slam(arguments.vocabulary, settings.name, pyorbslam3.Sensor.RGBD)
        cpu, wall = time.process_time(), time.perf_counter()
        found = track(slam, root, lines, arguments.pace)
        slam.shutdown()
        found |= {"cpu_seconds": time.process_time() - cpu, "wall_seconds": time.perf_counter() - wall}
        if arguments.out and found["tracked"]:  # it ends the process where there is nothing to write
            slam.save_trajectory_tum(str(arguments.out))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
