"""7-Scenes and tsdf-fusion: frame-000000.color.png, .depth.png, .pose.txt in one folder, or in its seq-01."""

from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import DEPTH_SUFFIXES, IMAGE_SUFFIXES, Folder, numbered
from slamcli.datasets.recorded import BY_NUMBER, Recorded, Stream, poses_by_number, truth_when_asked
from slamcli.datasets.sources import ImageFiles
from slamcli.errors import SlamError

DEPTH_SCALE = 1000.0  # 65535 = none
# J. Shotton et al., CVPR 2013: both cameras uncalibrated; the data set's page names f = 585, (320, 240) for depth. Colour is the Kinect's
# nominal; it looks from 25 mm to the left of the depth camera, as calibrations of that device have it.
COLOUR = {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 320.0, "cy": 240.0}
DEPTH = {"width": 640, "height": 480, "fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0}
BASELINE = 0.025  # [m]


def recognises(path: Path) -> bool:
    """Look for the first frame's colour image."""
    return path.is_dir() and (any(path.glob("frame-*.color.png")) or any(path.glob("frame-*.color.jpg")))


def read(path: Path) -> Recorded:
    """Pair images by number; with intrinsics of its own the recording counts as registered, as tsdf-fusion's is."""
    folder = Folder(path)
    colour = numbered(folder, "", IMAGE_SUFFIXES, ending=".color")
    depth = numbered(folder, "", DEPTH_SUFFIXES, ending=".depth")
    if not any(number in depth for number in colour):
        raise SlamError(f"{path}: no frame-*.depth.png has the number of a frame-*.color image")
    calibration = find_calibration(path)
    if not calibration.values and (path.parent / "camera-intrinsics.txt").is_file():
        calibration = find_calibration(path.parent)
    if not calibration.values:
        T_cd = np.eye(4)
        T_cd[0, 3] = BASELINE
        calibration = Calibration(dict(COLOUR), "nominal calibration of 7-Scenes", dict(DEPTH), T_cd)
    poses = numbered(folder, "", (".txt",), ending=".pose")
    return Recorded(
        reader="seven_scenes",
        root=path,
        colour=Stream(ImageFiles(path, list(colour.values())), None, str(path), BY_NUMBER),
        depth=Stream(ImageFiles(path, [depth.get(number, "") for number in colour]), None, str(path), BY_NUMBER),
        calibration=calibration,
        is_paired=True,
        depth_scale=DEPTH_SCALE,
        truth=truth_when_asked(lambda: poses_by_number(path, poses, list(colour))) if poses else None,
    )
