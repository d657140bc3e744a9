"""The layouts that open. A reader is one module here and one row of READERS.

A reader's module has ``recognises(path) -> bool``, which looks at names and first bytes, and ``read(path) -> Recorded``, which
finds images, stamps and calibration; everything after that is the same for all and is done in `slamcli.datasets.assembly`.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from slamcli.datasets.recorded import Recorded


class Layout(Protocol):
    """What a reader's module offers."""

    def recognises(self, path: Path) -> bool:
        """Say whether a path looks like this layout; names and first bytes are looked at, no more."""

    def read(self, path: Path) -> Recorded:
        """Find images, stamps and calibration; SlamError where a part that is needed is not there."""


@dataclass(frozen=True)
class Reader:
    """One layout."""

    name: str  # of its module here
    title: str
    told_by: str
    extra: str = ""  # what of slamcli[...] it needs beside a plain install

    @property
    def layout(self) -> Layout:
        """Import its module, which happens when a path is looked at: a run's results depend on its own reader alone."""
        return cast(Layout, import_module(f"slamcli.datasets.readers.{self.name}"))


# The more telling first: a recording is read by the first that recognises it.
READERS = (
    Reader("r3d", "Record3D's own file", "suffix .r3d", "phone"),
    Reader("sens", "ScanNet's .sens", "suffix .sens"),
    Reader("rtabmap_db", "RTAB-Map's database", "suffix .db, SQLite"),
    Reader("realsense", "librealsense's recorder", ".bag or .db3 with topics /device_0/sensor_*"),
    Reader("rosbag", "ROS 1 bag, ROS 2 bag, MCAP", ".bag, .mcap, .db3, or a folder with metadata.yaml"),
    Reader("azure_mkv", "Azure Kinect's recorder", "suffix .mkv", "video"),
    Reader("tum", "TUM RGB-D, ETH3D-SLAM, Bonn", "rgb.txt and depth.txt"),
    Reader("record3d", "Record3D's export", "metadata.json, rgb/ and depth/", "phone"),
    Reader("strayscanner", "StrayScanner", "odometry.csv, rgb.mp4 and depth/", "video"),
    Reader("transforms", "nerfstudio, Polycam, NeRFCapture", "transforms.json with depth"),
    Reader("open3d", "Open3D's recorder", "camera_intrinsic.json, color/ and depth/"),
    Reader("scannet", "ScanNet, extracted", "intrinsic/intrinsic_color.txt, color/ and depth/"),
    Reader("replica", "Replica as NICE-SLAM has it", "results/frame*.jpg and results/depth*.png"),
    Reader("seven_scenes", "7-Scenes, tsdf-fusion", "frame-*.color.png or .jpg, frame-*.depth.png"),
    Reader("icl_nuim", "ICL-NUIM", "*.gt.freiburg beside lists or folders of images"),
    Reader("rtabmap", "RTAB-Map's export", "calib/, rgb/ and depth/"),
    Reader("associations", "pairs in one list", "associations.txt, associate.txt, assoc.txt ..."),
    Reader("numbered", "numbered images", "rgb/, color/ or image/ and depth/ with equal numbers or stamps for names"),
)


def reader_of(path: Path) -> Reader | None:
    """Return the reader that recognises a path."""
    return next((reader for reader in READERS if reader.layout.recognises(path)), None)
