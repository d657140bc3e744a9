"""Images of a topic, as the readers of bags find them."""

import struct
from functools import cached_property
from pathlib import Path

import numpy as np

from slamcli.datasets import images, png
from slamcli.datasets.bags import HEAD, Bag, Topic
from slamcli.datasets.images import Picture, Pixels, check_whole
from slamcli.errors import BadFrame, SlamError
from slamcli.formats import ros_messages, rvl
from slamcli.formats.ros_messages import Image

DEPTH_TYPES: dict[str, np.dtype] = {
    "16uc1": np.dtype("u2"),
    "mono16": np.dtype("u2"),
    "z16": np.dtype("u2"),
    "32fc1": np.dtype("f4"),
    "64fc1": np.dtype("f8"),
}
CHANNELS = {"rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono8": 1, "8uc1": 1,
            "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2, "yuv422_uyvy": 2,
            "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1}  # fmt: skip
ALSO = {"8uc3": "bgr8", "8uc4": "bgra8", "8uc1": "mono8", "yuv422_uyvy": "uyvy"}
CONFIG_HEADER = struct.Struct("<iff")  # of compressed_depth_image_transport
COMPRESSED = "CompressedImage"


class TopicImages:
    """Images of one topic by number."""

    def __init__(self, bag: Bag, path: Path, topic: Topic) -> None:
        self.bag, self.path, self.topic = bag, path, topic
        self.is_compressed = topic.kind.endswith(COMPRESSED)
        self._sizes: dict[int, int] = {}

    @cached_property
    def names(self) -> list[str]:
        """Name images by topic and number."""
        return [f"{self.topic.name}#{i}" for i in range(len(self.topic.messages))]

    def where(self, i: int) -> str:
        """Name the file, the topic and the number."""
        return f"{self.path}:{self.names[i]}"

    def n_bytes(self, i: int) -> int:
        """Return the time of recording in the place of a size: both tell one message from another, and this is known without reading."""
        return self.topic.messages[i][0]

    def read(self, i: int) -> Picture | np.ndarray:
        """Read one image: a picture, or depth as pixels."""
        message, where = self.message(i), self.where(i)
        if self.is_compressed:
            return _compressed(message, where)
        return _raw(message, where)

    def message(self, i: int) -> Image:
        """Read and take apart one message."""
        try:
            data = self.bag.read(self.topic.messages[i][1])
            return ros_messages.image(data, is_cdr=self.bag.is_cdr, is_compressed=self.is_compressed)
        except SlamError as error:
            raise BadFrame(f"{self.where(i)}: {error}") from error

    def stamps(self) -> tuple[np.ndarray, str]:
        """Read the stamp of each message's header, (N,) [s]; the times of recording where headers tell none or cost too much."""
        recorded = np.array([time / 1_000_000_000 for time, _ in self.topic.messages])
        if self.bag.is_slow:
            return recorded, "stamps are the times of recording, as the bag is packed and too long to unpack for those of the images"
        found = []
        for _, place in self.topic.messages:
            try:
                found.append(ros_messages.stamp(self.bag.read(place, HEAD), is_cdr=self.bag.is_cdr) / 1_000_000_000)
            except SlamError:
                found.append(np.nan)
        stamps = np.array(found)
        if not (stamps[np.isfinite(stamps)] > 0).any():
            return recorded, "stamps are the times of recording, as the images have none"
        return stamps, ""


def is_depth(message: Image, *, is_compressed: bool) -> bool:
    """Tell depth from a picture."""
    encoding = message.encoding.lower()
    if is_compressed:
        return "compresseddepth" in encoding or encoding.startswith(("16uc1", "32fc1"))
    return encoding in DEPTH_TYPES


def is_picture(message: Image, *, is_compressed: bool) -> bool:
    """Tell a picture that can be read."""
    return not is_depth(message, is_compressed=is_compressed) and (is_compressed or message.encoding.lower() in CHANNELS)


def _raw(message: Image, where: str) -> Pixels | np.ndarray:
    encoding, width, height = message.encoding.lower(), message.width, message.height
    dtype = DEPTH_TYPES.get(encoding, np.dtype("u1"))
    channels = 1 if encoding in DEPTH_TYPES else CHANNELS.get(encoding, 0)
    if channels == 0:
        raise BadFrame(f"{where}: pixels of kind {message.encoding!r} are not known")
    row = width * channels * dtype.itemsize
    if not (width > 0 and height > 0 and width * height <= images.MAX_PIXELS and row <= message.step) or message.step * height > len(
        message.data
    ):
        raise BadFrame(f"{where}: {len(message.data)} bytes are no {message.encoding} image of {width} x {height} px")
    rows = np.frombuffer(message.data, np.uint8, message.step * height).reshape(height, message.step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(dtype.newbyteorder(">" if message.is_bigendian else "<"))
    if encoding in DEPTH_TYPES:
        return pixels.astype(dtype)
    shape = (height, width, channels) if channels > 1 else (height, width)
    return Pixels(pixels.reshape(shape), ALSO.get(encoding, encoding))


def _compressed(message: Image, where: str) -> bytes | np.ndarray:
    if not is_depth(message, is_compressed=True):
        check_whole(message.data, where)
        return message.data
    if "compresseddepth" not in message.encoding.lower() and message.data.startswith(png.MAGIC):
        return message.data
    return compressed_depth(message.data, message.encoding, where)


def compressed_depth(data: bytes, encoding: str, where: str) -> bytes | np.ndarray:
    """Decode compressed_depth_image_transport: 12 bytes of its own, then PNG, or width, height and RVL; floats as inverse depth."""
    if len(data) <= CONFIG_HEADER.size:
        raise BadFrame(f"{where}: is cut off")
    _, a, b = CONFIG_HEADER.unpack_from(data)
    inner = data[CONFIG_HEADER.size :]
    if "rvl" in encoding.lower():
        try:
            code: bytes | np.ndarray = rvl.decode(inner[8:], *struct.unpack_from("<II", inner))
        except (SlamError, struct.error) as error:
            raise BadFrame(f"{where}: {error}") from error
    else:
        check_whole(inner, where)
        code = inner
    if not encoding.lower().startswith("32fc1"):
        return code
    if isinstance(code, bytes):
        code = images.decode_depth(code, name=where)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(code > 0, np.float32(a) / (code.astype(np.float32) - np.float32(b)), np.float32(0)).astype(np.float32)


def first_message(bag: Bag, path: Path, topic: Topic, *, tried: int = 5) -> Image | None:
    """Read the first message of a topic that can be read."""
    source = TopicImages(bag, path, topic)
    for i in range(min(tried, len(topic.messages))):
        try:
            return source.message(i)
        except BadFrame:
            continue
    return None
