"""ROS 1 .bag, ROS 2 folder and bare .mcap or .db3: a topic of colour, one of depth, their CameraInfo and tf."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from slamcli.datasets.bags import Bag, Topic, open_bag
from slamcli.datasets.calibration import Calibration
from slamcli.datasets.intrinsics import distortion
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.ros_images import COMPRESSED, TopicImages, first_message, is_depth, is_picture
from slamcli.errors import SlamError
from slamcli.formats import ros_messages
from slamcli.formats.ros_messages import CameraInfo, Image
from slamcli.geometry.algebra import inverse, product

IMAGE = "sensor_msgs/msg/Image"
KINDS = (IMAGE, f"sensor_msgs/msg/{COMPRESSED}")
INFO = "sensor_msgs/msg/CameraInfo"
TF_KINDS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
MILLIMETRES = 1000.0
REGISTERED = ("aligned", "registered")
RECTIFIED = {"rect", "rectified"}
NOT_COLOUR = ("infra", "/ir/", "fisheye", "left", "right", "gray", "mono", "thermal", "confidence", "label", "mask", "debug")
COLOUR_WORDS = ("color", "colour", "rgb")
MOST_TF_MESSAGES = 2000  # read in search of where the cameras sit
SAME = 1e-3  # relative difference up to which focal lengths are the same


def recognises(path: Path) -> bool:
    """Look for the suffix, or for a ROS 2 bag's description."""
    if path.is_file():
        return path.suffix.lower() in (".bag", ".mcap", ".db3")
    return (path / "metadata.yaml").is_file() and (any(path.glob("*.db3*")) or any(path.glob("*.mcap*")))


def read(path: Path) -> Recorded:
    """Choose the topics and index their messages."""
    return of_bag(open_bag(path), path, reader="rosbag")


def of_bag(bag: Bag, path: Path, *, reader: str) -> Recorded:
    """Find the two topics of images, their stamps, intrinsics and transform."""
    said: list[str] = []
    colour, picture = _choose(bag, path, "colour", said)
    depth, depth_image = _choose(bag, path, "depth", said)
    info, depth_info = _info(bag, colour.name, picture), _info(bag, depth.name, depth_image)
    colour_images, depth_images = TopicImages(bag, path, colour), TopicImages(bag, path, depth)
    (stamp, note), (depth_stamp, depth_note) = colour_images.stamps(), depth_images.stamps()
    said += [f"{path}: {text}" for text in dict.fromkeys((note, depth_note)) if text]
    calibration = Calibration(intrinsics(info, colour.name), f"{path}: CameraInfo of {colour.name}") if info else Calibration({})
    depth_values = intrinsics(depth_info, depth.name) if depth_info else {}
    if info and depth_info and not _is_registered(depth.name, depth_image, picture, calibration.values, depth_values):
        T_cd = _pose(bag, picture.frame_id or info.frame_id, depth_image.frame_id or depth_info.frame_id)
        if T_cd is None:
            said.append(f"{path}: tf does not say where the depth camera sits; it is taken to be where colour is")
        calibration = Calibration(calibration.values, calibration.source, depth_values, T_cd)
    is_float = depth_image.encoding.lower().startswith(("32fc1", "64fc1"))
    return Recorded(
        reader=reader,
        root=path,
        colour=Stream(colour_images, stamp, f"{path}:{colour.name}"),
        depth=Stream(depth_images, depth_stamp, f"{path}:{depth.name}"),
        calibration=calibration,
        depth_scale=1.0 if is_float else MILLIMETRES,
        warnings=said,
    )


def intrinsics(info: CameraInfo, topic: str) -> dict:
    """Return a CameraInfo as keys of Camera, for the images of a topic.

    Rectified ones (``image_rect``, ``image_rect_color``) are free of distortion and belong to P; K and D are of the image before. Where
    one of K and P is not set, the other holds.
    """
    k, p = info.k, info.p
    size = {"width": info.width, "height": info.height} if info.width and info.height else {}
    if p[0] > 0.0 and (k[0] <= 0.0 or is_rectified(topic)):
        return {**size, "fx": p[0], "fy": p[5], "cx": p[2], "cy": p[6]}
    return {**size, "fx": k[0], "fy": k[4], "cx": k[2], "cy": k[5], **distortion(info.d, info.model)}


def is_rectified(topic: str) -> bool:
    """Say whether a topic's name, in the convention of ROS' image pipeline, promises images without distortion."""
    return not RECTIFIED.isdisjoint(re.split(r"[/_]", topic.lower()))


def _choose(bag: Bag, path: Path, what: str, said: list[str]) -> tuple[Topic, Image]:
    """Choose a topic of colour or depth, the best first; say which, where there are several."""
    found: list[tuple[tuple, Topic, Image]] = []
    for topic in bag.topics.values():
        if topic.kind not in KINDS or not topic.messages:
            continue
        message = first_message(bag, path, topic)
        fits = is_depth if what == "depth" else is_picture
        if message is not None and fits(message, is_compressed=topic.kind.endswith(COMPRESSED)):
            found.append((_rank(topic, message, what), topic, message))
    if not found:
        there = ", ".join(f"{t.name} ({t.kind.rsplit('/', 1)[-1]}, {len(t.messages)})" for t in list(bag.topics.values())[:20])
        raise SlamError(f"{path}: has no topic with {what} images; its topics are: {there or 'none'}")
    found.sort(key=lambda entry: entry[0])
    _, topic, message = found[0]
    if len(found) > 1:
        others = ", ".join(entry[1].name for entry in found[1:])
        said.append(f"{path}: {what} is taken from {topic.name}; not used: {others}")
    return topic, message


def _rank(topic: Topic, message: Image, what: str) -> tuple:
    """Order topics of one kind: what is registered, what is coloured, what has more messages, what is raw."""
    name = topic.name.lower()
    if what == "depth":
        is_worse = [not any(word in name for word in REGISTERED), "confidence" in name]
    else:
        is_grey = message.encoding.lower() in ("mono8", "8uc1")
        is_worse = [is_grey or any(word in name for word in NOT_COLOUR), not any(word in name for word in COLOUR_WORDS)]
    return (*is_worse, -(len(topic.messages) // 10), topic.kind.endswith(COMPRESSED), name)


def _info(bag: Bag, name: str, message: Image) -> CameraInfo | None:
    """Find the CameraInfo that belongs to a topic: in its namespace, else of its frame, else the only one there is."""
    topics = [topic for topic in bag.topics.values() if topic.kind == INFO and topic.messages]
    spaces = [name.rsplit("/", depth)[0] for depth in (1, 2, 3) if name.count("/") > depth]
    near = [t for space in spaces for t in topics if t.name in (f"{space}/camera_info", f"{space}/info/camera_info")]
    known = [info for topic in [*near, *topics] if (info := _read_info(bag, topic)) is not None]
    if near and known:
        return known[0]
    of_frame = [info for info in known if info.frame_id and info.frame_id == message.frame_id]
    return of_frame[0] if of_frame else known[0] if len(known) == 1 else None


def _read_info(bag: Bag, topic: Topic) -> CameraInfo | None:
    for _, place in topic.messages[:3]:
        try:
            info = ros_messages.camera_info(bag.read(place), is_cdr=bag.is_cdr)
        except SlamError:
            continue
        if info.k[0] > 0.0 or info.p[0] > 0.0:
            return info
    return None


def _is_registered(name: str, depth: Image, colour: Image, of_colour: Mapping, of_depth: Mapping) -> bool:
    """Say whether depth lies on colour already: by its name, its frame, or equal intrinsics."""
    if any(word in name.lower() for word in REGISTERED):
        return True
    view, colour_view = (values["fx"] / values.get("width", 1) for values in (of_depth, of_colour))
    pinhole, colour_pinhole = ([values[key] for key in ("fx", "fy", "cx", "cy")] for values in (of_depth, of_colour))
    is_same_view = abs(view / colour_view - 1.0) < SAME
    return is_same_view and (depth.frame_id == colour.frame_id or np.allclose(pinhole, colour_pinhole, rtol=SAME))


def _pose(bag: Bag, frame: str, depth_frame: str) -> np.ndarray | None:
    """Find T_cd from tf: both frames are followed up to one that they share."""
    up: dict[str, tuple[str, np.ndarray]] = {}
    for topic in sorted((t for t in bag.topics.values() if t.kind in TF_KINDS), key=lambda t: "static" not in t.name):
        for _, place in topic.messages[:MOST_TF_MESSAGES]:
            try:
                for found in ros_messages.transforms(bag.read(place), is_cdr=bag.is_cdr):
                    up.setdefault(found.child, (found.parent, found.T))
            except SlamError:
                continue
    colour_chain, depth_chain = _chain(up, frame.strip("/")), _chain(up, depth_frame.strip("/"))
    shared = next((name for name in colour_chain if name in depth_chain), None)
    return None if shared is None else product(inverse(colour_chain[shared]), depth_chain[shared])


def _chain(up: dict[str, tuple[str, np.ndarray]], frame: str) -> dict[str, np.ndarray]:
    """Return the transform from a frame to each of those above it."""
    chain = {frame: np.eye(4)}
    while frame in up and up[frame][0] not in chain:
        parent, T = up[frame]
        chain[parent] = product(T, chain[frame])
        frame = parent
    return chain
