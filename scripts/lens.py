#!/usr/bin/env python
"""Bend a recording's images as other lenses do, tell slamcli of the lens, and compare the errors with those of the straight images.

    python scripts/lens.py RECORDING [--frames N]

RECORDING must be free of distortion, as simulated rooms are. OpenCV bends the images, so that its models, and not ours, decide what is
right. What the lens sees beyond the straight image is black and without depth.
"""

import argparse
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import slamcli
from slamcli.console import table
from slamcli.datasets import Dataset, open_dataset
from slamcli.geometry.camera import EQUIDISTANT, Camera

# The first as colour cameras of the Azure Kinect have it, rounded; the second a cheap web camera's; the third a fisheye of moderate angle.
LENSES = {
    "rational, as of an Azure Kinect": {"k1": 0.45, "k2": -2.6, "p1": 0.0008, "p2": -0.0002, "k3": 1.6, "k4": 0.33, "k5": -2.4, "k6": 1.5},
    "rational, strong": {"k1": 0.9, "k2": 0.1, "p1": 0.001, "p2": -0.001, "k3": 0.01, "k4": 1.2, "k5": 0.25, "k6": 0.02},
    "polynomial, k1 = -0.25": {"k1": -0.25, "k2": 0.08, "p1": 0.001, "p2": -0.001},
    "equidistant": {"lens": EQUIDISTANT, "k1": -0.02, "k2": 0.004},
}


def main() -> None:
    """Run the recording straight, and through every lens."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--frames", type=int, default=10**9, help="from the beginning")
    given = parser.parse_args()
    dataset = open_dataset(given.recording)
    if dataset.camera.is_distorted:
        parser.error(f"{given.recording}: its own lens bends images")
    rows = [["lens", "APE [m]", "of straight", "frames"]]
    with tempfile.TemporaryDirectory() as folder:
        straight = 0.0
        for name, values in {"none": {}, **LENSES}.items():
            camera = replace(dataset.camera, **values)
            place = Path(folder, "recording")
            write(dataset, place, min(given.frames, len(dataset)), camera)
            ape = slamcli.run(str(place), path=Path(folder, "run"), until="loop", force=True).ape()
            straight = straight or ape.rmse
            rows.append([name, f"{ape.rmse:.4f}", f"{ape.rmse / straight:.2f}", str(ape.n_poses)])
            print(table(rows[-1:]), flush=True)
            shutil.rmtree(place)
            shutil.rmtree(Path(folder, "run"))
    print(table(rows))


def write(dataset: Dataset, out: Path, n: int, camera: Camera) -> None:
    """Write a folder of the first `n` images as `camera` takes them."""
    (out / "depth").mkdir(parents=True)
    (out / "rgb").mkdir()
    column, row = straight_pixels(dataset.camera, camera)
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for i in range(n):
        depth, colour = dataset.depth(i), dataset.rgb(i)
        if depth is None or colour is None:
            continue
        raw = np.rint(np.nan_to_num(depth * dataset.camera.depth_scale)).clip(0, 65534).astype(np.uint16)
        bent = {"rgb": cv2.remap(colour[:, :, ::-1], column, row, cv2.INTER_CUBIC), "depth": cv2.remap(raw, column, row, cv2.INTER_NEAREST)}
        for kind, stamp in (("rgb", dataset.stamp[i]), ("depth", dataset.depth_stamp[i])):
            cv2.imwrite(str(out / kind / f"{i}.png"), bent[kind])
            lists[kind].append(f"{stamp:.6f} {kind}/{i}.png")
    for kind, lines in lists.items():
        (out / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    (out / "camera.toml").write_text("\n".join(f"{key} = {value!r}" for key, value in camera.to_dict().items()) + "\n")
    shutil.copy(dataset.root / "groundtruth.txt", out)


def straight_pixels(straight: Camera, bent: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return where in the straight image each pixel of the bent one lies, as OpenCV has it: column and row (H, W) float32."""
    K = np.array([[bent.fx, 0.0, bent.cx], [0.0, bent.fy, bent.cy], [0.0, 0.0, 1.0]])
    column, row = np.meshgrid(np.arange(bent.width, dtype=np.float64), np.arange(bent.height, dtype=np.float64))
    pixels = np.stack([column, row], axis=-1).reshape(-1, 1, 2)
    if bent.lens == EQUIDISTANT:
        normal = cv2.fisheye.undistortPoints(pixels, K, bent.coefficients[[0, 1, 4, 5]])
    else:
        exact = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
        normal = cv2.undistortPoints(pixels, K, bent.coefficients, criteria=exact)
    there = normal.reshape(bent.height, bent.width, 2) * [straight.fx, straight.fy] + [straight.cx, straight.cy]
    return there[..., 0].astype(np.float32), there[..., 1].astype(np.float32)


if __name__ == "__main__":
    main()
