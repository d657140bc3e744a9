"""Known cameras: the calibrated ones of the TUM data set, and what others are by their data sheets."""

import re
from dataclasses import dataclass
from typing import Any

from slamcli.errors import SlamError
from slamcli.geometry.camera import Camera

# J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012, calibration page of the data set. The depth images are
# already scaled, so the correction factors on that page must not be applied again; ORB-SLAM2 found another 4 % on freiburg2 (5208).
_VGA: Any = {"width": 640, "height": 480}
FREIBURG = {
    1: Camera(**_VGA, fx=517.306408, fy=516.469215, cx=318.643040, cy=255.313989, k1=0.262383, k2=-0.953104, p1=-0.005358, p2=0.002628,
              k3=1.163314, depth_scale=5000.0),
    2: Camera(**_VGA, fx=520.908620, fy=521.007327, cx=325.141442, cy=249.701764, k1=0.231222, k2=-0.784899, p1=-0.003257, p2=-0.000105,
              k3=0.917205, depth_scale=5208.0),
    3: Camera(**_VGA, fx=535.4, fy=539.2, cx=320.1, cy=247.6, depth_scale=5000.0),
}  # fmt: skip
ICL = {"width": 640, "height": 480, "fx": 481.2, "fy": 480.0, "cx": 319.5, "cy": 239.5, "depth_scale": 5000.0}  # A. Handa et al., ICRA 2014


@dataclass(frozen=True)
class Nominal:
    """A camera as its maker describes it: good to some per cent, so that intrinsics are worth finding from the recording."""

    what: str
    focal_by_height: float  # focal length of colour over the height of the picture, 4 : 3 and 16 : 9 cut from one sensor height


# Focal lengths over heights from the fields of view in the makers' data sheets, and from calibrations in public recordings.
NOMINAL = {
    "kinect1": Nominal("Kinect for Xbox 360", 525.0 / 480),
    "xtion": Nominal("Asus Xtion, PrimeSense", 525.0 / 480),
    "kinect2": Nominal("Kinect for Xbox One, colour 1920 x 1080", 1060.0 / 1080),
    "azure": Nominal("Azure Kinect, colour 16 : 9", 608.0 / 720),
    "orbbec": Nominal("Orbbec Astra", 525.0 / 480),
    "d415": Nominal("RealSense D415", 920.0 / 720),
    "d435": Nominal("RealSense D435, D435i", 615.0 / 480),
    "d455": Nominal("RealSense D455", 640.0 / 720),
    "l515": Nominal("RealSense L515", 910.0 / 720),
    "iphone": Nominal("iPhone, iPad with LiDAR", 1352.0 / 1440),
}


def freiburg_number(name: str) -> int | None:
    """Return n for names such as ``rgbd_dataset_freiburgN_desk``, ``freiburgN_desk`` and ``frN_desk``."""
    found = re.match(r"(?:rgbd_dataset_)?(?:freiburg|fr)([123])_", name)
    return int(found.group(1)) if found else None


def nominal(name: str, width: int, height: int) -> dict[str, float]:
    """Return the intrinsics of a camera by its name for pictures of a size; upright pictures of a camera that was turned, too."""
    if name not in NOMINAL:
        raise SlamError(f"camera {name!r} is not known by name; known are {', '.join(NOMINAL)}")
    focal = NOMINAL[name].focal_by_height * min(width, height)
    return {"width": width, "height": height, "fx": focal, "fy": focal, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
