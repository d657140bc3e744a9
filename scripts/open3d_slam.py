#!/usr/bin/env python
"""Map a recording with Open3D's dense RGB-D SLAM: each frame is aligned with the surface model that the frames before it made.

    python scripts/open3d_slam.py RUN [--out trajectory.txt] [--voxel 0.0058]

RUN is a run directory of slamcli: its extract/frames.txt and extract/camera.json say which images go together. Colour and depth are taken
as they are; lens distortion is left out, as Open3D does. Prints a JSON object like orbslam3.py.
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np

from slamcli.formats.trajectory import write_tum
from slamcli.open3d_loader import load_open3d
from slamcli.schema import Trajectory

DEPTH_MAX, FARTHEST = 3.0, 0.07  # [m]: depth used, and point pairs; the defaults of Open3D's own example
BLOCKS, BLOCK_SIDE, TRUNCATION = 40_000, 16, 8.0  # truncation of the signed distance in voxels


def main() -> None:
    """Align and integrate every frame that has depth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--voxel", type=float, default=3.0 / 512.0, help="[m]")
    given = parser.parse_args()
    root = Path(json.loads((given.run / "run.json").read_text())["root"])
    camera = json.loads((given.run / "extract" / "camera.json").read_text())
    lines = [line.split() for line in (given.run / "extract" / "frames.txt").read_text().splitlines() if not line.startswith("#")]
    start, cpu = time.perf_counter(), time.process_time()
    stamps, poses, decoding = track(root, lines, camera, given.voxel)
    found = {"frames": len(lines), "tracked": len(poses), "decode_cpu_seconds": decoding}
    found |= {"cpu_seconds": time.process_time() - cpu, "wall_seconds": time.perf_counter() - start}
    if given.out:
        write_tum(given.out, Trajectory(stamp=np.array(stamps), T_wc=np.array(poses).reshape(-1, 4, 4)))
    print(json.dumps(found))


def track(root: Path, lines: list[list[str]], camera: dict, voxel: float) -> tuple[list[float], list[np.ndarray], float]:
    """Return stamp and pose (4, 4) camera to world of each frame, and the CPU time spent on decoding [s]."""
    o3d = load_open3d()
    device = o3d.core.Device("CPU:0")
    matrix = o3d.core.Tensor([[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]])
    T_wc = np.eye(4)
    model = o3d.t.pipelines.slam.Model(voxel, BLOCK_SIDE, BLOCKS, o3d.core.Tensor(T_wc), device)
    seen, synthesized = (o3d.t.pipelines.slam.Frame(camera["height"], camera["width"], matrix, device) for _ in range(2))
    scale, stamps, poses, decoding = float(camera["depth_scale"]), [], [], 0.0
    for k, (stamp, colour, _, depth) in enumerate(lines):
        before = time.thread_time()
        rgb = cv2.cvtColor(cv2.imread(str(root / colour)), cv2.COLOR_BGR2RGB)
        raw = cv2.imread(str(root / depth), cv2.IMREAD_UNCHANGED)
        decoding += time.thread_time() - before
        seen.set_data_from_image("depth", o3d.t.geometry.Image(raw))
        seen.set_data_from_image("color", o3d.t.geometry.Image(rgb))
        if k:
            try:
                moved = model.track_frame_to_model(seen, synthesized, scale, DEPTH_MAX, FARTHEST)
            except RuntimeError:  # too few pixels agree: lost
                continue
            T_wc = T_wc @ moved.transformation.numpy()
        model.update_frame_pose(k, o3d.core.Tensor(T_wc))
        model.integrate(seen, scale, DEPTH_MAX, TRUNCATION)
        model.synthesize_model_frame(synthesized, scale, 0.1, DEPTH_MAX, TRUNCATION, False)
        stamps.append(float(stamp))
        poses.append(T_wc.copy())
    return stamps, poses, decoding


if __name__ == "__main__":
    main()
