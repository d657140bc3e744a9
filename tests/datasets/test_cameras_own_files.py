"""Files of the cameras' own recorders, written by the makers' libraries where these run: RealSense, Azure Kinect, phones."""

import json
import time
from pathlib import Path

import cv2
import layouts
import numpy as np
import pytest

from slamcli.datasets import open_dataset
from slamcli.errors import SlamError

SIZE = (160, 120)
TURN = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0]
OFFSET = [0.015, 0.001, -0.002]  # [m] depth camera to colour camera


def intrinsics(focal: float) -> dict[str, float]:
    return {"width": SIZE[0], "height": SIZE[1], "fx": focal, "fy": focal + 1, "cx": 80.5, "cy": 61.0}


def pictures(n: int) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    return [cv2.GaussianBlur(rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8), (0, 0), 2.0) for _ in range(n)]


def depths(n: int) -> list[np.ndarray]:
    return [(1500 + 10 * i + np.arange(SIZE[0])[None] + np.zeros((SIZE[1], 1))).astype(np.uint16) for i in range(n)]


@pytest.fixture(scope="module")
def realsense_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Written by librealsense: a software device and its recorder."""
    rs = pytest.importorskip("pyrealsense2", reason="librealsense is not installed")
    path = tmp_path_factory.mktemp("realsense") / "walk.db3"
    device = rs.software_device()
    sensors = [device.add_sensor("Stereo Module"), device.add_sensor("RGB Camera")]
    streams = []
    for sensor, kind, form, n_bytes, focal, uid in (
        (sensors[0], rs.stream.depth, rs.format.z16, 2, 96.0, 1),
        (sensors[1], rs.stream.color, rs.format.rgb8, 3, 154.0, 2),
    ):
        lens = rs.intrinsics()
        for name, key in (("width", "width"), ("height", "height"), ("fx", "fx"), ("fy", "fy"), ("ppx", "cx"), ("ppy", "cy")):
            setattr(lens, name, intrinsics(focal)[key])
        lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
        stream = rs.video_stream()
        stream.type, stream.uid, stream.fmt, stream.bpp, stream.fps, stream.intrinsics = kind, uid, form, n_bytes, 30, lens
        stream.width, stream.height = SIZE
        streams.append(sensor.add_video_stream(stream))
    sensors[0].add_read_only_option(rs.option.depth_units, 0.001)
    extrinsics = rs.extrinsics()
    extrinsics.rotation, extrinsics.translation = TURN.T.ravel().tolist(), OFFSET
    streams[0].register_extrinsics_to(streams[1], extrinsics)
    try:
        recorder = rs.recorder(str(path), device)
    except RuntimeError as error:
        pytest.skip(f"this librealsense records in another format: {error}")
    recorded, queue = recorder.query_sensors(), rs.frame_queue(50)
    for sensor, stream in zip(recorded, streams, strict=True):
        sensor.open(stream)
        sensor.start(queue)
    for i, (depth, picture) in enumerate(zip(depths(4), pictures(4), strict=True)):
        for sensor, stream, image, late in ((sensors[0], streams[0], depth, 0.0), (sensors[1], streams[1], picture, 4.0)):
            frame = rs.software_video_frame()
            frame.bpp = image.itemsize * (3 if image.ndim == 3 else 1)
            frame.stride, frame.frame_number, frame.domain = SIZE[0] * frame.bpp, i, rs.timestamp_domain.system_time
            frame.timestamp, frame.profile, frame.pixels = 1000.0 * (1600000000 + i / 30) + late, stream.as_video_stream_profile(), image
            sensor.on_video_frame(frame)
        time.sleep(0.05)  # the recorder writes in a thread of its own
    time.sleep(0.2)
    for sensor in recorded:
        sensor.stop()
        sensor.close()
    del recorder, recorded
    return path


def test_realsense_file_of_librealsense_itself(realsense_file: Path) -> None:
    dataset = open_dataset(str(realsense_file))
    assert (dataset.reader, len(dataset)) == ("realsense", 4)
    np.testing.assert_allclose(np.diff(dataset.stamp), 1 / 30, atol=1e-4)
    np.testing.assert_allclose(dataset.depth_stamp - dataset.stamp, -0.004, atol=1e-4)
    assert (dataset.camera.fx, dataset.camera.depth_scale) == (154.0, 1000.0)
    assert (dataset.depth_camera.fx, dataset.depth_camera.fy) == (96.0, 97.0)
    np.testing.assert_allclose(dataset.registration.T_cd[:3, :3], TURN, atol=1e-6)
    np.testing.assert_allclose(dataset.registration.T_cd[:3, 3], OFFSET, atol=1e-6)
    assert np.array_equal(dataset.rgb(2), pictures(4)[2])
    assert np.nanmedian(dataset.depth(1)) == pytest.approx(1.59, abs=0.02)


def test_old_realsense_bag(tmp_path: Path) -> None:
    """The layout of librealsense before 2.57, by its ros_writer: no library of today writes it."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with Writer(tmp_path / "old.bag") as writer:
        connections = {}

        def put(at: int, topic: str, kind: str, message: object) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], at, store.serialize_ros1(message, kind))

        def header(ns: int) -> object:
            return types["std_msgs/msg/Header"](
                seq=0, stamp=types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9), frame_id="0"
            )

        vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
        w, x, y, z = layouts.quaternion(TURN)
        for name, T in (
            (
                "0/Depth_0",
                types["geometry_msgs/msg/Transform"](translation=vector(x=0.0, y=0.0, z=0.0), rotation=turn(x=0.0, y=0.0, z=0.0, w=1.0)),
            ),
            (
                "1/Color_0",
                types["geometry_msgs/msg/Transform"](
                    translation=vector(x=OFFSET[0], y=OFFSET[1], z=OFFSET[2]), rotation=turn(x=x, y=y, z=z, w=w)
                ),
            ),
        ):
            put(1, f"/device_0/sensor_{name}/tf/0", "geometry_msgs/msg/Transform", T)
        put(1, "/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", types["std_msgs/msg/Float32"](data=np.float32(0.001)))
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        for name, focal in (("0/Depth_0", 96.0), ("1/Color_0", 154.0)):
            info = types["sensor_msgs/msg/CameraInfo"](
                header=header(1), height=SIZE[1], width=SIZE[0], distortion_model="Brown Conrady", D=np.zeros(5),
                K=np.array(layouts.k_rows(intrinsics(focal))), R=np.eye(3).ravel(), P=np.zeros(12), binning_x=0, binning_y=0, roi=region,
            )  # fmt: skip
            put(1, f"/device_0/sensor_{name}/info/camera_info", "sensor_msgs/msg/CameraInfo", info)
        for i, (depth, picture) in enumerate(zip(depths(4), pictures(4), strict=True)):
            ns = 1600000000_000000000 + i * 33_333_333
            for name, image, encoding in (("0/Depth_0", depth, "mono16"), ("1/Color_0", picture, "rgb8")):
                data = np.ascontiguousarray(image).view(np.uint8).ravel()
                message = types["sensor_msgs/msg/Image"](
                    header=header(ns),
                    height=SIZE[1],
                    width=SIZE[0],
                    encoding=encoding,
                    is_bigendian=0,
                    step=len(data) // SIZE[1],
                    data=data,
                )
                put(100 + i, f"/device_0/sensor_{name}/image/data", "sensor_msgs/msg/Image", message)
    dataset = open_dataset(str(tmp_path / "old.bag"))
    assert (dataset.reader, len(dataset), dataset.depth_camera.fx) == ("realsense", 4, 96.0)
    np.testing.assert_allclose(dataset.registration.T_cd[:3, :3], TURN, atol=1e-6)
    np.testing.assert_allclose(dataset.registration.T_cd[:3, 3], OFFSET, atol=1e-6)
    np.testing.assert_allclose(np.diff(dataset.stamp), 1 / 30, atol=1e-6)


AZURE = {  # ModelParameters: cx cy fx fy k1 .. k6, two unused, p2 p1
    "CalibrationInformation": {
        "Cameras": [
            {
                "Purpose": "CALIBRATION_CameraPurposeDepth",
                "Intrinsics": {"ModelParameters": [0.5, 0.5, 0.49, 0.49, 0.5, 0.1, 0.01, 0.8, 0.2, 0.02, 0, 0, -1e-4, 1e-4]},
                "Rt": {"Rotation": np.eye(3).ravel().tolist(), "Translation": [0, 0, 0]},
            },
            {
                "Purpose": "CALIBRATION_CameraPurposePhotoVideo",
                "Intrinsics": {"ModelParameters": [0.5, 0.5, 0.475, 0.6333, 0.58, -2.49, 1.36, 0.46, -2.33, 1.3, 0, 0, -1e-4, 6e-4]},
                "Rt": {"Rotation": TURN.ravel().tolist(), "Translation": OFFSET},
            },
        ]
    }
}


def write_azure(path: Path, *, calibration: dict | None = AZURE) -> Path:
    av = pytest.importorskip("av", reason="PyAV is not installed")
    with av.open(str(path), "w") as container:
        colour, depth = container.add_stream("mjpeg", rate=30), container.add_stream("ffv1", rate=30)
        (colour.width, colour.height, colour.pix_fmt), (depth.width, depth.height, depth.pix_fmt) = (
            (1280, 720, "yuvj420p"),
            (320, 288, "gray16le"),
        )
        colour.metadata["title"], depth.metadata["title"] = "COLOR", "DEPTH"
        if calibration is not None:
            container.add_attachment("calibration.json", "application/octet-stream", json.dumps(calibration).encode())
        for i in range(4):
            picture = np.full((720, 1280, 3), (40 + 30 * i, 90, 160), np.uint8)
            frames = (
                av.VideoFrame.from_ndarray(picture, format="rgb24"),
                av.VideoFrame.from_ndarray(np.full((288, 320), 2000 + i, np.uint16), format="gray16le"),
            )
            for stream, frame in zip((colour, depth), frames, strict=True):
                frame.pts = i
                container.mux(stream.encode(frame))
        for stream in (colour, depth):
            container.mux(stream.encode())
    return path


def test_azure_kinect_file(tmp_path: Path) -> None:
    dataset = open_dataset(str(write_azure(tmp_path / "walk.mkv")))
    assert (dataset.reader, len(dataset)) == ("azure_mkv", 4)
    camera, depth_camera = dataset.camera, dataset.depth_camera
    assert (camera.fx, camera.cx, camera.cy) == pytest.approx((0.475 * 1280, 639.5, 359.5))
    assert (camera.k6, camera.p2, camera.is_rational) == (1.3, -1e-4, True)
    assert (depth_camera.fx, depth_camera.cx, depth_camera.cy) == pytest.approx((0.49 * 512, 256 - 96 - 0.5, 256 - 90 - 0.5))
    np.testing.assert_allclose(dataset.registration.T_cd[:3, :3], TURN, atol=1e-6)
    np.testing.assert_allclose(np.diff(dataset.stamp), 1 / 30, atol=1e-3)
    assert np.nanmedian(dataset.depth(2)) == pytest.approx(2.002, abs=0.1)
    assert np.abs(dataset.rgb(3)[300, 600].astype(int) - [130, 90, 160]).max() <= 4


@pytest.mark.parametrize(
    ("calibration", "said"),
    [
        (None, "no calibration: fx"),
        ({"CalibrationInformation": {}}, "cannot be used"),
        ({"CalibrationInformation": {"Cameras": [{"Purpose": "PurposeDepth"}, {"Purpose": "PurposePhotoVideo"}]}}, "cannot be used"),
    ],
)
def test_azure_files_without_a_calibration_are_told(tmp_path: Path, calibration: dict | None, said: str) -> None:
    path = write_azure(tmp_path / "walk.mkv", calibration=calibration)
    with pytest.raises(SlamError, match=said) as caught:
        open_dataset(str(path))
    assert str(path) in str(caught.value)


def write_stray(folder: Path, *, frames: int = 6, newer: bool = False) -> Path:
    """As the phone writes it, with the video's own compression."""
    av = pytest.importorskip("av", reason="PyAV is not installed")
    for name in ("depth", "confidence"):
        (folder / name).mkdir(parents=True)
    with av.open(str(folder / "rgb.mp4"), "w") as container:
        stream = container.add_stream("h264", rate=60)
        stream.width, stream.height, stream.pix_fmt, stream.options = 640, 480, "yuv420p", {"crf": "10", "bf": "2"}
        for i in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((480, 640, 3), 30 + 30 * i, np.uint8), format="rgb24")))
        container.mux(stream.encode())
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + (", fx, fy, cx, cy" if newer else "")]
    for i in range(frames):
        depth = np.full((48, 64), 2000 + i, np.uint16)
        confidence = np.full((48, 64), 2, np.uint8)
        confidence[:, :10] = 1
        cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), depth)
        cv2.imwrite(str(folder / "confidence" / f"{i:06d}.png"), confidence)
        rows.append(f"{258528.330141 + i / 60:.6f}, {i:06d}, 0, 0, 0, 0, 0, 0, 1" + (", 455.0, 455.0, 321.0, 241.0" if newer else ""))
    (folder / "odometry.csv").write_text("\n".join(rows))
    (folder / "camera_matrix.csv").write_text("450.0, 0.0, 320.0\n0.0, 450.0, 240.0\n0.0, 0.0, 1.0")
    return folder


@pytest.mark.parametrize(("newer", "focal"), [(False, 450.0), (True, 455.0)])
def test_strayscanner(tmp_path: Path, newer: bool, focal: float) -> None:
    dataset = open_dataset(str(write_stray(tmp_path / "scan", newer=newer)))
    assert (dataset.reader, len(dataset), dataset.camera.fx) == ("strayscanner", 6, focal)
    np.testing.assert_allclose(np.diff(dataset.stamp), 1 / 60, atol=2e-6)
    for i in (4, 0, 5, 2):
        assert np.abs(dataset.grey(i).astype(int) - (30 + 30 * i)).max() <= 4
        depth = dataset.depth(i)
        assert depth.shape == (480, 640) and np.isnan(depth[:, :90]).all()
        np.testing.assert_allclose(depth[:, 110:], (2000 + i) / 1000, rtol=1e-6)


def test_strayscanner_with_damage(tmp_path: Path) -> None:
    folder = write_stray(tmp_path / "scan")
    data = (folder / "rgb.mp4").read_bytes()
    (folder / "rgb.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(SlamError, match=r"rgb\.mp4"):
        open_dataset(str(folder))
    (folder / "rgb.mp4").unlink()
    with pytest.raises(SlamError, match="no colour"):
        open_dataset(str(folder))
