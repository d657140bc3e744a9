"""librealsense's recorder: ROS 1 .bag, and SQLite .db3 from version 2.57 on, with topics of its own and the streams' extrinsics."""

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamcli.datasets.bags import Bag, Topic, open_bag
from slamcli.datasets.readers import rosbag
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.ros_images import TopicImages
from slamcli.datasets.sqlite import query
from slamcli.errors import SlamError
from slamcli.formats.ros_messages import Cursor, matrix
from slamcli.geometry.algebra import inverse, product

MARK = "/device_0/sensor_"
SEARCHED = 1 << 16  # bytes of a bag's list of topics
UNITS = re.compile(r"/option/Depth[ _]Units/value$")
METADATA_STAMP = re.compile(r"(?:^|;)timestamp=([0-9.]+)")


def recognises(path: Path) -> bool:
    """Look for the recorder's topics in the list that a bag has."""
    if not path.is_file() or path.suffix.lower() not in (".bag", ".db3"):
        return False
    if path.suffix.lower() == ".db3":
        try:
            return any(MARK in str(row[0]) for row in query(path, "SELECT name FROM topics LIMIT 1000", what="a bag"))
        except SlamError:
            return False
    with open(path, "rb") as file:
        head = file.read(4096)
        at = head.find(b"index_pos=")
        if at < 0 or at + 18 > len(head):
            return False
        place = struct.unpack_from("<Q", head, at + 10)[0]
        file.seek(min(place, path.stat().st_size))
        return MARK.encode() in file.read(SEARCHED)


def read(path: Path) -> Recorded:
    """Read the streams of colour and depth; depth is in its own camera, and registered on reading by the streams' extrinsics."""
    bag = open_bag(path)
    found = rosbag.of_bag(bag, path, reader="realsense")
    colour, depth = found.colour.images, found.depth.images
    assert isinstance(colour, TopicImages) and isinstance(depth, TopicImages)
    calibration, said = found.calibration, [w for w in found.warnings if "tf does not say" not in w]
    if calibration.depth_values is not None:
        T_cr, T_dr = _extrinsics(bag, colour.topic), _extrinsics(bag, depth.topic)
        if T_cr is None or T_dr is None:
            said.append(f"{path}: holds no extrinsics of its streams; the depth camera is taken to be where colour is")
        else:
            calibration = replace(calibration, T_cd=product(T_cr, inverse(T_dr)))
    return replace(
        found,
        calibration=calibration,
        colour=_stamped(bag, found.colour, colour),
        depth=_stamped(bag, found.depth, depth),
        depth_scale=_depth_scale(bag) or found.depth_scale,
        warnings=said,
    )


def _extrinsics(bag: Bag, topic: Topic) -> np.ndarray | None:
    """Read where the device's reference is in a stream's axes, (4, 4): x_stream = T @ x_reference."""
    stream = topic.name.split("/image/")[0]
    for other in bag.topics.values():
        if not other.name.startswith(f"{stream}/tf/") or not other.messages:
            continue
        data = bag.read(other.messages[0][1])
        try:
            if not other.kind.endswith("String"):
                return matrix(Cursor(data, is_cdr=bag.is_cdr).numbers(7))
            text = Cursor(data, is_cdr=bag.is_cdr).text()
            rotation, translation = (_floats(re.search(rf"{key}=([^;]*)", text)) for key in ("rotation", "translation"))
        except (struct.error, ValueError) as error:
            raise SlamError(f"{other.name}: is damaged ({error})") from error
        if len(rotation) == 9 and len(translation) == 3:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = np.array(rotation).reshape(3, 3).T, translation  # librealsense writes rotations by columns
            return T
    return None


def _floats(found: re.Match | None) -> list[float]:
    return [float(value) for value in found.group(1).split(",")] if found else []


def _depth_scale(bag: Bag) -> float | None:
    """Read the unit of depth [m] that the sensor was set to, as units per metre."""
    for topic in bag.topics.values():
        if UNITS.search(topic.name) and topic.messages:
            data = bag.read(topic.messages[0][1])
            try:
                cursor = Cursor(data, is_cdr=bag.is_cdr)
                unit = float(cursor.text()) if topic.kind.endswith("String") else float(cursor.number("f"))
            except (struct.error, ValueError):
                continue
            if 0 < unit < 1:
                return float(np.round(1.0 / unit, 3))
    return None


def _stamped(bag: Bag, stream: Stream, source: TopicImages) -> Stream:
    """Take the sensor's own stamps [ms], which the newer format keeps beside the images: headers have the time since the start there."""
    name = f"{source.topic.name.split('/image/')[0]}/image/metadata"
    topic = bag.topics.get(name)
    if topic is None or not topic.kind.endswith("String"):
        return stream
    of_time: dict[int, float] = {}
    for time, place in topic.messages:
        try:
            found = METADATA_STAMP.search(Cursor(bag.read(place), is_cdr=bag.is_cdr).text())
        except (SlamError, struct.error):
            continue
        if found:
            of_time[time] = float(found.group(1)) / 1000.0
    stamp = np.array([of_time.get(time, np.nan) for time, _ in source.topic.messages])
    return replace(stream, stamp=stamp) if np.isfinite(stamp).all() else stream
