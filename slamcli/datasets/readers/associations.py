"""One file that pairs colour and depth images: associations.txt and its like."""

from pathlib import Path

from slamcli.datasets.calibration import find_calibration
from slamcli.datasets.folder import Folder
from slamcli.datasets.lists import PairList, read_pairs
from slamcli.datasets.recorded import LISTED, Recorded, Stream, Truth, truth_file, truth_of_columns
from slamcli.datasets.sources import ImageFiles

NAMES = (
    "associations.txt", "association.txt", "associate.txt", "associated.txt", "assoc.txt", "associations.csv", "rgbd_assoc.txt",
    "rgb_depth.txt", "rgbd.txt", "pairs.txt", "match.txt",
)  # fmt: skip


def recognises(path: Path) -> bool:
    """Look for the file under its usual names."""
    return association_file(path) is not None


def read(path: Path) -> Recorded:
    """Read the pairs in the order of the file."""
    source = association_file(path)
    assert source is not None, "recognises() holds"
    pairs = read_pairs(source, Folder(path))
    return of_pairs(pairs, path, reader="associations", truth=_truth(path, pairs))


def of_pairs(pairs: PairList, path: Path, *, reader: str, truth: Truth | None, depth_scale: float | None = None) -> Recorded:
    """Return what a list of pairs says."""
    return Recorded(
        reader=reader,
        root=path,
        colour=Stream(ImageFiles(path, pairs.colour), pairs.stamp, str(pairs.path), LISTED),
        depth=Stream(ImageFiles(path, pairs.depth), pairs.depth_stamp, str(pairs.path), LISTED),
        calibration=find_calibration(path),
        is_paired=True,
        depth_scale=depth_scale,
        truth=truth,
        warnings=pairs.warnings,
    )


def association_file(path: Path) -> Path | None:
    """Return the file that pairs the images; one of another name where it is the only text file that says so."""
    for name in NAMES:
        if (path / name).is_file():
            return path / name
    found = sorted(file for file in path.glob("*assoc*.txt") if file.is_file()) if path.is_dir() else []
    return found[0] if found else None


def _truth(path: Path, pairs: PairList) -> Truth | None:
    if pairs.poses is not None:
        return truth_of_columns(pairs.poses)
    return truth_file(path / "groundtruth.txt")
