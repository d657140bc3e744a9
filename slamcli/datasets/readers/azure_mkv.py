"""Azure Kinect's .mkv: tracks of colour and depth, and the calibration of both cameras as an attachment."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.datasets.calibration import Calibration
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.video import VideoDepth, VideoFrames, load_av
from slamcli.errors import SlamError
from slamcli.geometry.algebra import inverse, product

DEPTH_SCALE = 1000.0
MAX_ATTACHMENT = 16 << 20  # bytes
COLOUR, DEPTH = "COLOR", "DEPTH"  # titles of the tracks
# Azure Kinect Sensor SDK, mode_specific_calibration.c: intrinsics are given for a whole sensor of this size, from which a mode's pictures
# are cut at an offset.
COLOUR_MODES = {
    (1280, 720): ((1280, 960), (0, 120)), (1920, 1080): ((1920, 1440), (0, 180)), (2560, 1440): ((2560, 1920), (0, 240)),
    (2048, 1536): ((2048, 1536), (0, 0)), (3840, 2160): ((3840, 2880), (0, 360)), (4096, 3072): ((4096, 3072), (0, 0)),
}  # fmt: skip
DEPTH_MODES = {
    (640, 576): ((1024, 1024), (192, 180)), (320, 288): ((512, 512), (96, 90)),
    (1024, 1024): ((1024, 1024), (0, 0)), (512, 512): ((512, 512), (0, 0)),
}  # fmt: skip


def recognises(path: Path) -> bool:
    """Look for the suffix."""
    return path.is_file() and path.suffix.lower() == ".mkv"


def read(path: Path) -> Recorded:
    """Index both tracks and read the attachment."""
    tracks, sizes, about = _look(path)
    if COLOUR not in tracks or DEPTH not in tracks:
        raise SlamError(
            f"{path}: has no tracks of colour and depth; is it of an Azure Kinect? its tracks are: {', '.join(tracks) or 'none'}"
        )
    colour = VideoFrames(path, track=tracks[COLOUR], encoding="rgb8")
    depth = VideoDepth(path, track=tracks[DEPTH])
    return Recorded(
        reader="azure_mkv",
        root=path,
        colour=Stream(colour, colour.seconds, str(path)),
        depth=Stream(depth, depth.seconds, str(path)),
        calibration=_calibration(about, sizes[COLOUR], sizes[DEPTH], path) if about else Calibration({}),
        depth_scale=DEPTH_SCALE,
    )


def _look(path: Path) -> tuple[dict[str, int], dict[str, tuple[int, int]], dict[str, Any] | None]:
    """Find the tracks by their titles, else by their order, the sizes of their pictures, and the calibration."""
    av = load_av(path)
    try:
        with av.open(str(path)) as container:
            video = list(container.streams.video)
            titles = [str(stream.metadata.get("title", "")).upper() for stream in video]
            if not any(title == DEPTH for title in titles) and len(video) >= 2:
                titles = [COLOUR, DEPTH, "IR"][: len(video)]
            tracks = {title: number for number, title in enumerate(titles)}
            sizes = {title: (int(stream.width), int(stream.height)) for title, stream in zip(titles, video, strict=False)}
            attached = [bytes(stream.data)[: MAX_ATTACHMENT + 1] for stream in container.streams if stream.type == "attachment"]
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise SlamError(f"{path}: is no video that can be read ({error})") from error
    return tracks, sizes, next((about for data in attached if (about := _parsed(data)) is not None), None)


def _parsed(data: bytes) -> dict[str, Any] | None:
    try:
        about = json.loads(data.rstrip(b"\0")) if len(data) <= MAX_ATTACHMENT else None
    except (ValueError, RecursionError):
        return None
    return about if isinstance(about, dict) and "CalibrationInformation" in about else None


def _calibration(about: dict[str, Any], size: tuple[int, int], depth_size: tuple[int, int], path: Path) -> Calibration:
    try:
        cameras = {str(camera["Purpose"]).rsplit("Purpose", 1)[-1]: camera for camera in about["CalibrationInformation"]["Cameras"]}
        colour, depth = cameras["PhotoVideo"], cameras["Depth"]
        values, depth_values = _intrinsics(colour, size, COLOUR_MODES), _intrinsics(depth, depth_size, DEPTH_MODES)
        T_cd = product(_pose(colour), inverse(_pose(depth)))
    except (KeyError, TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise SlamError(f"{path}: its calibration cannot be used ({type(error).__name__}: {error})") from error
    return Calibration(values, f"{path}: its calibration", depth_values, T_cd)


def _intrinsics(camera: dict[str, Any], size: tuple[int, int], modes: dict) -> dict[str, Any]:
    """Bring a camera's intrinsics, shares of the sensor's sides measured from its corner, to the pixels of a mode."""
    if size not in modes:
        raise ValueError(f"{size[0]} x {size[1]} px is no mode of the camera")
    (width, height), (left, top) = modes[size]
    p = [float(value) for value in camera["Intrinsics"]["ModelParameters"]]
    return {
        "width": size[0], "height": size[1], "fx": p[2] * width, "fy": p[3] * height,
        "cx": p[0] * width - left - 0.5, "cy": p[1] * height - top - 0.5,
        "k1": p[4], "k2": p[5], "k3": p[6], "k4": p[7], "k5": p[8], "k6": p[9], "p2": p[12], "p1": p[13],
    }  # fmt: skip


def _pose(camera: dict[str, Any]) -> np.ndarray:
    """Read (4, 4) from the device's reference to a camera."""
    T = np.eye(4)
    T[:3, :3] = np.array(camera["Rt"]["Rotation"], dtype=np.float64).reshape(3, 3)
    T[:3, 3] = np.array(camera["Rt"]["Translation"], dtype=np.float64).reshape(3)
    return T
