#!/usr/bin/env python
"""Let the real ORB-SLAM3 load a vocabulary that slamcli exported, and track a recording with it.

    slamcli vocab export words.txt
    pip install pyorbslam3 opencv-python-headless        (an environment of its own: it needs nothing of slamcli)
    python scripts/orbslam3_vocabulary.py words.txt RUN

RUN is a run directory of slamcli: its extract/frames.txt and extract/camera.json say which images go together, and its run.json where they are.
"""

import argparse
import json
import tempfile
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


def main() -> None:
    """Track the recording of a run and print how many frames ORB-SLAM3 gave a pose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("vocabulary", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=0, help="how many frames; default: all")
    arguments = parser.parse_args()
    import pyorbslam3

    root = Path(json.loads((arguments.run / "run.json").read_text())["root"])
    camera = json.loads((arguments.run / "extract" / "camera.json").read_text())
    lines = [line.split() for line in (arguments.run / "extract" / "frames.txt").read_text().splitlines() if not line.startswith("#")]
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as settings:
        settings.write(SETTINGS.format(**as_decimals(camera)))
        settings.flush()
        slam = pyorbslam3.Slam(arguments.vocabulary, settings.name, pyorbslam3.Sensor.RGBD)
        n_tracked, points = 0, []
        for stamp, colour, _, depth in lines[: arguments.frames or None]:
            rgb = cv2.cvtColor(cv2.imread(str(root / colour)), cv2.COLOR_BGR2RGB)
            result = slam.track_rgbd(rgb, cv2.imread(str(root / depth), cv2.IMREAD_UNCHANGED), float(stamp))
            n_tracked += bool(result.pose_valid)
            points.append(result.num_tracked_points)
        slam.shutdown()
    n = len(points)
    print(f"{arguments.vocabulary}: ORB-SLAM3 tracked {n_tracked} of {n} frames, {np.median(points):.0f} map points a frame (median)")


if __name__ == "__main__":
    main()
