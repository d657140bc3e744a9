"""nerfstudio's transforms.json: poses of images and depth images for radiance fields and Gaussian splatting.

Poses are camera to world in OpenGL's axes: x right, y up, z back. Pixel (0, 0) is the corner of the top-left pixel. Depth is 16-bit PNG in
millimetres. https://docs.nerf.studio/quickstart/data_conventions.html
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.files import write_bytes
from slamcli.geometry.camera import EQUIDISTANT, Camera

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
HALF_PIXEL = 0.5
DEPTH_UNITS = 1000  # per metre
FARTHEST = np.iinfo(np.uint16).max


def depth_units(depth: np.ndarray) -> np.ndarray:
    """Convert depth (H, W) [m], NaN = none, to the file's units, 0 = none."""
    units = np.rint(np.nan_to_num(depth.astype(np.float64) * DEPTH_UNITS, nan=0.0))
    return np.where((units >= 0) & (units <= FARTHEST), units, 0).astype(np.uint16)


def write_transforms(path: Path, camera: Camera, T_wc: np.ndarray, *, image: list[str], depth: list[str], cloud: str | None = None) -> None:
    """Write transforms.json.

    T_wc : (N, 4, 4) camera to world, z up
    image, depth : (N,) paths beside the file; "" in `depth` = none
    cloud : path of a PLY beside the file from which splatting starts
    """
    about: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if camera.lens == EQUIDISTANT else "OPENCV",
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy,
        "cx": camera.cx + HALF_PIXEL, "cy": camera.cy + HALF_PIXEL,
        "k1": camera.k1, "k2": camera.k2, "k3": camera.k3, "k4": camera.k4, "p1": camera.p1, "p2": camera.p2,
        "depth_unit_scale_factor": 1.0 / DEPTH_UNITS,
    }  # fmt: skip
    if cloud is not None:
        about["ply_file_path"] = cloud
    about["frames"] = [
        {"file_path": name, **({"depth_file_path": of_depth} if of_depth else {}), "transform_matrix": (T @ OPENCV_TO_OPENGL).tolist()}
        for name, of_depth, T in zip(image, depth, T_wc, strict=True)
    ]
    write_bytes(path, (json.dumps(about, indent=1) + "\n").encode())
