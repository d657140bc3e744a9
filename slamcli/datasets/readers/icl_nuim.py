"""ICL-NUIM in its TUM-compatible form: frame numbers for stamps, and a truth ``*.gt.freiburg`` that counts from 1."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.cameras import ICL
from slamcli.datasets.folder import Folder, number_of
from slamcli.datasets.lists import read_pairs
from slamcli.datasets.readers import associations, numbered
from slamcli.datasets.recorded import Recorded, truth_when_asked
from slamcli.formats.trajectory import read_tum
from slamcli.geometry.algebra import product

# POV-Ray's y axis points up, which the official negative fy makes up for; poses are mirrored instead.
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def recognises(path: Path) -> bool:
    """Look for the truth."""
    return _truth_file(path) is not None and (associations.recognises(path) or numbered.recognises(path))


def read(path: Path) -> Recorded:
    """Read the pairs, or pair by number, with the published intrinsics where no file says others."""
    calibration = find_calibration(path)
    if not calibration.values:
        calibration = Calibration(dict(ICL), "published calibration of ICL-NUIM")
    source = associations.association_file(path)
    if source is None:
        found = numbered.of_folders(path, reader="icl_nuim", calibration=calibration, depth_scale=ICL["depth_scale"])
    else:
        pairs = read_pairs(source, Folder(path))
        found = associations.of_pairs(pairs, path, reader="icl_nuim", truth=None, depth_scale=ICL["depth_scale"])
    numbers = [number_of(name) for name in found.colour.images.names]
    return replace(found, calibration=calibration, truth=truth_when_asked(lambda: _poses(path, numbers)))


def _poses(path: Path, numbers: list[int | None]) -> np.ndarray:
    """Return each image the pose of its number, (N, 4, 4); number 0 has none."""
    truth = read_tum(_truth_file(path) or path)
    of = {round(float(stamp)): T_wc for stamp, T_wc in zip(truth.stamp, truth.T_wc, strict=True)}
    unknown = np.full((4, 4), np.nan)
    return np.array([product(MIRROR, of.get(-1 if number is None else number, unknown), MIRROR) for number in numbers])


def _truth_file(path: Path) -> Path | None:
    found = sorted(path.glob("*.gt.freiburg")) if path.is_dir() else []
    return found[0] if found else None
