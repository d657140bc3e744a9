"""What only bags have: topics to choose from, transforms, messages out of order, and files that are none."""

import json
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import layouts
import numpy as np
import pytest
from layouts import Content
from recordings import png

from slamcli.datasets import Dataset, open_dataset
from slamcli.datasets.readers import r3d
from slamcli.errors import SlamError
from slamcli.formats import ros_messages

SIZE = (64, 48)
CAMERA = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 24.0, "depth_scale": 1000.0}
DEPTH_CAMERA = {**CAMERA, "fx": 45.0, "fy": 45.0}
KINDS = {"ros1": layouts.ros1, "ros2": layouts.ros2, "mcap": layouts.mcap}


@pytest.fixture(scope="module")
def content() -> Content:
    rng = np.random.default_rng(7)
    pictures = [png(cv2.GaussianBlur(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8), (0, 0), 2.0)) for _ in range(6)]
    raw = [np.full((48, 64), 1500 + 10 * i, np.uint16) for i in range(6)]
    stamp = [1700000000_000000000 + 33_333_333 * i for i in range(6)]
    return Content(stamp, stamp, pictures, ".png", raw, CAMERA, np.tile(np.eye(4), (6, 1, 1)))


def opened(content: Content, folder: Path, kind: str, **how: object) -> Dataset:
    return open_dataset(str(KINDS[kind](content, folder / "walk", **how)))


@pytest.mark.parametrize("kind", KINDS)
def test_of_two_depth_topics_the_registered_one_is_taken_and_said(content: Content, tmp_path: Path, kind: str) -> None:
    dataset = opened(
        content, tmp_path, kind, infrared=True, colour="rgb8", depth="16UC1", depth_topic="/camera/aligned_depth_to_color/image_raw"
    )
    assert np.nanmedian(dataset.depth(0)) == pytest.approx(1.5)  # the other one has half of it
    said = "; ".join(dataset.warnings)
    assert "depth is taken from /camera/aligned_depth_to_color/image_raw; not used: /camera/depth/image_rect_raw" in said
    assert "colour is taken from /camera/color/image_raw; not used: /camera/infra1/image_raw" in said
    assert dataset.depth_camera is None


@pytest.mark.parametrize("kind", KINDS)
def test_depth_of_its_own_camera_is_registered_by_tf(content: Content, tmp_path: Path, kind: str) -> None:
    T_cd = np.eye(4)
    T_cd[:3, :3], T_cd[:3, 3] = cv2.Rodrigues(np.array([0.01, 0.02, -0.03]))[0], [0.025, 0.001, -0.002]
    how = {"depth": "16UC1", "depth_topic": "/camera/depth/image_rect_raw", "depth_frame": "depth_optical", "depth_camera": DEPTH_CAMERA}
    dataset = opened(content, tmp_path / "tf", kind, T_cd=T_cd, **how)
    np.testing.assert_allclose(dataset.registration.T_cd, T_cd, atol=1e-9)
    assert dataset.depth_camera.fx == 45.0 and any("registered to colour on reading" in warning for warning in dataset.warnings)
    without = opened(content, tmp_path / "none", kind, **how)
    assert np.array_equal(without.registration.T_cd, np.eye(4))
    assert any("tf does not say" in warning for warning in without.warnings)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("missing", ["colour", "depth"])
def test_a_missing_topic_is_told_with_those_that_are_there(content: Content, tmp_path: Path, kind: str, missing: str) -> None:
    with pytest.raises(SlamError, match=f"no topic with {missing} images; its topics are: .*/camera_info") as caught:
        opened(content, tmp_path, kind, skip=(missing,))
    assert "walk" in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_without_camera_info_the_numbers_are_asked_for(content: Content, tmp_path: Path, kind: str) -> None:
    with pytest.raises(SlamError, match="no calibration: fx, fy, cx, cy are missing"):
        opened(content, tmp_path, kind, skip=("info",))


STRAIGHT = {"fx": 50.0, "fy": 51.0, "cx": 30.0, "cy": 22.0}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("topic", "projection", "is_raw_told", "is_rectified"),
    [
        ("/camera/rgb/image_rect_color", STRAIGHT, True, True),
        ("/camera/rgb/image_raw", STRAIGHT, True, False),  # P is there, and the images are as the lens made them
        ("/camera/rgb/image_raw", STRAIGHT, False, True),  # nothing else is known
        ("/camera/rgb/image_rect_color", None, True, False),  # P was never set
        ("/camera/direct/image_raw", STRAIGHT, True, False),  # no word of its own
    ],
)
def test_rectified_images_have_the_intrinsics_of_p_and_no_distortion(
    content: Content, tmp_path: Path, kind: str, topic: str, projection: dict | None, is_raw_told: bool, is_rectified: bool
) -> None:
    bent = replace(content, camera={**content.camera, "k1": 0.2, "k2": -0.1})
    dataset = opened(bent, tmp_path, kind, colour_topic=topic, projection=projection, is_raw_told=is_raw_told)
    camera = dataset.camera
    assert camera.is_distorted != is_rectified
    assert [camera.fx, camera.fy, camera.cx, camera.cy] == [(STRAIGHT if is_rectified else bent.camera)[key] for key in STRAIGHT]


@pytest.mark.parametrize("kind", KINDS)
def test_messages_out_of_order_are_sorted(content: Content, tmp_path: Path, kind: str) -> None:
    dataset = opened(content, tmp_path, kind, shuffled=True)
    assert len(dataset) == 6 and (np.diff(dataset.stamp) > 0).all()
    assert np.array_equal(dataset.rgb(0), content.bgr(0)[..., ::-1])


def test_stamps_are_those_of_the_images_and_not_of_their_recording(content: Content, tmp_path: Path) -> None:
    """The writer puts messages 5 ms after their images."""
    dataset = opened(content, tmp_path, "ros2")
    assert np.array_equal(dataset.stamp, np.array([float(layouts.seconds(stamp)) for stamp in content.stamp]))


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("walk.bag", b""),
        ("walk.bag", b"#ROSBAG V1.2\n" + bytes(5000)),
        ("walk.bag", b"#ROSBAG V2.0\n" + bytes(5000)),
        ("walk.bag", b"PK\x03\x04" + bytes(500)),
        ("walk.mcap", b""),
        ("walk.mcap", b"\x89MCAP0\r\n" + bytes(300)),
        ("walk.db3", b"SQLite format 3\0" + bytes(300)),
        ("walk.db3", b"no database"),
    ],
)
def test_files_that_are_no_bag(tmp_path: Path, name: str, data: bytes) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SlamError, match="cannot be read as a bag") as caught:
        open_dataset(str(tmp_path / name))
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_a_bag_without_images(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / "scan.bag") as writer:
        topic = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        writer.write(topic, 1, store.serialize_ros1(store.types["std_msgs/msg/String"](data="hello"), "std_msgs/msg/String"))
    with pytest.raises(SlamError, match=r"its topics are: /chatter \(String, 1\)"):
        open_dataset(str(tmp_path / "scan.bag"))


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scan.r3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", b" " * (65 << 20))
        archive.writestr("rgbd/0.jpg", b"")
    assert (tmp_path / "scan.r3d").stat().st_size < 1 << 20
    with pytest.raises(SlamError, match=r"scan\.r3d: its metadata are too large"):
        open_dataset(str(tmp_path / "scan.r3d"))


def test_members_whose_numbers_are_none_are_no_pictures(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scan.r3d", "w") as archive:
        archive.writestr("metadata", b"{}")
        for name in ("\u00b2", "9" * 5000, "a/7", ""):
            archive.writestr(f"rgbd/{name}.jpg", b"")
    with pytest.raises(SlamError, match=r"holds no picture rgbd/N\.jpg"):
        open_dataset(str(tmp_path / "scan.r3d"))


def test_frames_of_a_long_recording_are_listed_in_a_time_that_grows_with_them(content: Content, tmp_path: Path) -> None:
    n_frames = 20_000
    with zipfile.ZipFile(tmp_path / "scan.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(layouts.record3d_metadata(content)))
        for i in range(n_frames):
            archive.writestr(f"rgbd/{i}.jpg", b"")
            archive.writestr(f"rgbd/{i}.depth", b"")
    start = time.process_time()
    assert len(r3d.read(tmp_path / "scan.r3d").depth.images.names) == n_frames
    assert time.process_time() - start < 5.0


def test_metadata_packed_in_a_way_that_is_not_known_are_told(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scan.r3d", "w") as archive:
        archive.writestr("metadata", b"{}")
        archive.writestr("rgbd/0.jpg", b"")
    data = (tmp_path / "scan.r3d").read_bytes()
    for at, value in ((data.index(b"PK\1\2") + 10, 77), (data.index(b"PK\1\2") + 8, 1)):  # the method, and that it is encrypted
        (tmp_path / "scan.r3d").write_bytes(data[:at] + bytes([value]) + data[at + 1 :])
        with pytest.raises(SlamError, match="its metadata cannot be parsed"):
            open_dataset(str(tmp_path / "scan.r3d"))


@pytest.mark.parametrize("is_cdr", [False, True])
def test_messages_cut_anywhere_are_told(content: Content, is_cdr: bool) -> None:
    """The parser meets every prefix of a real message."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if is_cdr else Stores.ROS1_NOETIC)
    types = store.types
    extra = {} if is_cdr else {"seq": 0}
    header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=7, nanosec=9), frame_id="optical", **extra)
    kind = "sensor_msgs/msg/Image"
    message = types[kind](header=header, height=2, width=3, encoding="mono8", is_bigendian=0, step=3, data=np.arange(6, dtype=np.uint8))
    data = bytes(store.serialize_cdr(message, kind) if is_cdr else store.serialize_ros1(message, kind))
    whole = ros_messages.image(data, is_cdr=is_cdr, is_compressed=False)
    assert (whole.frame_id, whole.encoding, whole.width, whole.height, whole.data) == ("optical", "mono8", 3, 2, bytes(range(6)))
    assert ros_messages.stamp(data, is_cdr=is_cdr) == 7_000_000_009
    for n in range(whole.data.__len__() and len(data.rstrip(b"\0"))):
        with pytest.raises(SlamError, match="cut off"):
            ros_messages.image(data[:n], is_cdr=is_cdr, is_compressed=False)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_depth_as_inverse_floats_of_the_image_transport(content: Content, encoding: str) -> None:
    """compressed_depth_image_transport of 32FC1: depth = a / (code - b)."""
    import struct

    from slamcli.datasets.ros_images import compressed_depth

    depth = np.linspace(0.5, 5.0, 48 * 64).reshape(48, 64)
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    code = np.rint(a / depth + b).astype(np.uint16)
    found = compressed_depth(struct.pack("<iff", 0, a, b) + layouts.png16(code), "32FC1; compressedDepth png", "here")
    assert np.abs(found - depth).max() < 0.01 and found.dtype == np.float32
