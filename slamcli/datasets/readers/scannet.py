"""ScanNet as its own tool extracts it: color/, depth/, pose/ and intrinsic/."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import Folder, number_of, numbered
from slamcli.datasets.intrinsics import read_intrinsics
from slamcli.datasets.readers import numbered as numbered_reader
from slamcli.datasets.recorded import Recorded, poses_by_number, read_matrices, truth_when_asked
from slamcli.errors import SlamError
from slamcli.geometry.algebra import inverse, product

DEPTH_SCALE = 1000.0


def recognises(path: Path) -> bool:
    """Look for the intrinsics beside the folders of images."""
    return (path / "intrinsic" / "intrinsic_color.txt").is_file() and (path / "color").is_dir() and (path / "depth").is_dir()


def read(path: Path) -> Recorded:
    """Pair images by number; the depth camera has intrinsics of its own."""
    calibration = find_calibration(path)
    if not calibration.values:
        calibration = _calibration(path / "intrinsic")
    found = numbered_reader.of_folders(
        path, reader="scannet", calibration=calibration, colour="color", depth="depth", depth_scale=DEPTH_SCALE
    )
    numbers = [number_of(name) for name in found.colour.images.names]
    poses = numbered(Folder(path), "pose", (".txt",))
    return replace(found, truth=truth_when_asked(lambda: poses_by_number(path, poses, numbers)) if poses else None)


def _calibration(folder: Path) -> Calibration:
    colour = read_intrinsics(folder / "intrinsic_color.txt")
    if not colour:
        raise SlamError(f"{folder / 'intrinsic_color.txt'}: no intrinsic matrix")
    if not (folder / "intrinsic_depth.txt").is_file():
        return Calibration(colour, str(folder / "intrinsic_color.txt"))
    depth = read_intrinsics(folder / "intrinsic_depth.txt")
    return of_two(colour, depth, _extrinsic(folder / "extrinsic_color.txt"), _extrinsic(folder / "extrinsic_depth.txt"), str(folder))


def of_two(colour: dict, depth: dict, T_bc: np.ndarray, T_bd: np.ndarray, source: str) -> Calibration:
    """Return the calibration of both cameras, each with its pose on the body; equal ones mean that depth is registered.

    Raises SlamError where intrinsics of one of them are missing.
    """
    T_cd = product(inverse(T_bc), T_bd)
    keys = ("fx", "fy", "cx", "cy")
    for which, values in (("colour", colour), ("depth", depth)):
        if missing := [key for key in keys if key not in values]:
            raise SlamError(f"{source}: the calibration of the {which} camera lacks {', '.join(missing)}; copy it from the recorder again")
    is_same = all(abs(colour[key] - depth[key]) < 1e-6 for key in keys) and np.allclose(T_cd, np.eye(4), atol=1e-9)
    return Calibration(colour, source) if is_same else Calibration(colour, source, depth, T_cd)


def _extrinsic(path: Path) -> np.ndarray:
    return read_matrices(path)[0] if path.is_file() else np.eye(4)
