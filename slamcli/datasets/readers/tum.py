"""TUM RGB-D, ETH3D-SLAM and Bonn: a folder with rgb.txt, depth.txt and, where known, groundtruth.txt."""

import os
from pathlib import Path

from slamcli.datasets.calibration import find_calibration
from slamcli.datasets.clock import read_clock
from slamcli.datasets.folder import Folder
from slamcli.datasets.lists import read_list
from slamcli.datasets.recorded import LISTED, Recorded, Stream, truth_file
from slamcli.datasets.sources import ImageFiles

DEPTH_SCALE = 5000.0  # of the TUM data set and of ETH3D, where a calibration is known and says nothing of it


def recognises(path: Path) -> bool:
    """Look for the list of colour images; one that cannot be read, as a dead link, is told of then."""
    return os.path.lexists(path / "rgb.txt")


def read(path: Path) -> Recorded:
    """Read both lists; where their stamps are no clock, a file that pairs the images counts more."""
    from slamcli.datasets.readers import associations

    folder = Folder(path)
    colour = read_list(path / "rgb.txt", folder)
    if associations.recognises(path) and not read_clock(colour.stamp, len(colour.names), what="").is_clock:
        return associations.read(path)
    depth = read_list(path / "depth.txt", folder)
    calibration = find_calibration(path)
    return Recorded(
        reader="tum",
        root=path,
        colour=Stream(ImageFiles(path, colour.names), colour.stamp, str(colour.path), LISTED),
        depth=Stream(ImageFiles(path, depth.names), depth.stamp, str(depth.path), LISTED),
        calibration=calibration,
        depth_scale=DEPTH_SCALE if calibration.source.endswith("calibration.txt") else None,
        truth=truth_file(path / "groundtruth.txt"),
        warnings=colour.warnings + depth.warnings,
    )
