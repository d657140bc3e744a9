"""Replica as NICE-SLAM renders it: results/frame000000.jpg and depth000000.png, traj.txt, cam_params.json."""

from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import DEPTH_SUFFIXES, IMAGE_SUFFIXES, Folder, number_of
from slamcli.datasets.recorded import BY_NUMBER, Recorded, Stream, Truth, read_matrices, truth_when_asked
from slamcli.datasets.sources import ImageFiles
from slamcli.errors import SlamError

IMAGES = "results"
DEPTH_SCALE = 6553.5
# Z. Zhu et al., CVPR 2022; the file of all scenes is the same and lies beside them.
PUBLISHED = {"width": 1200, "height": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "depth_scale": DEPTH_SCALE}


def recognises(path: Path) -> bool:
    """Look for the folder of both kinds of images."""
    return any((path / IMAGES).glob("frame*.jpg")) or any((path / IMAGES).glob("frame*.png"))


def read(path: Path) -> Recorded:
    """Pair images by number."""
    files = Folder(path).files(IMAGES)
    colour = {number_of(n): f"{IMAGES}/{n}" for n in files if n.startswith("frame") and Path(n).suffix.lower() in IMAGE_SUFFIXES}
    depth = {number_of(n): f"{IMAGES}/{n}" for n in files if n.startswith("depth") and Path(n).suffix.lower() in DEPTH_SUFFIXES}
    if not any(number in depth for number in colour):
        raise SlamError(f"{path}: no {IMAGES}/depth* has the number of a {IMAGES}/frame*")
    return Recorded(
        reader="replica",
        root=path,
        colour=Stream(ImageFiles(path, list(colour.values())), None, str(path), BY_NUMBER),
        depth=Stream(ImageFiles(path, [depth.get(number, "") for number in colour]), None, str(path), BY_NUMBER),
        calibration=_calibration(path),
        is_paired=True,
        depth_scale=DEPTH_SCALE,
        truth=_truth(path, len(colour)),
    )


def _calibration(path: Path) -> Calibration:
    for place in (path, path.parent):
        found = find_calibration(place, ("cam_params.json",))
        if found.values:
            return found
    return Calibration(dict(PUBLISHED), "published calibration of Replica")


def _truth(path: Path, n: int) -> Truth | None:
    if not (path / "traj.txt").is_file():
        return None

    def load() -> np.ndarray:
        poses = read_matrices(path / "traj.txt")
        if len(poses) < n:
            raise SlamError(f"{path / 'traj.txt'}: {len(poses)} poses for {n} images")
        return poses[:n]

    return truth_when_asked(load)
