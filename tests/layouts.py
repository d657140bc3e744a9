"""Write one short recording into every layout, as other programs do; each writer is independent of the readers.

The colour images keep their bytes where the layout allows it, depth keeps its readings, stamps are kept where the layout has them.
"""

import io
import json
import shutil
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

SENSOR_IMAGE, SENSOR_COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


@dataclass(frozen=True)
class Content:
    """What is written: F frames."""

    stamp: list[int]  # ns
    depth_stamp: list[int]  # ns
    colour: list[bytes]  # encoded
    suffix: str  # of the colour images
    raw: list[np.ndarray]  # (H, W) uint16
    camera: dict[str, float]  # keys of Camera
    T_wc: np.ndarray  # (F, 4, 4)

    @property
    def size(self) -> tuple[int, int]:
        return int(self.camera["width"]), int(self.camera["height"])

    @property
    def scale(self) -> float:
        return float(self.camera["depth_scale"])

    def bgr(self, i: int) -> np.ndarray:
        return cv2.imdecode(np.frombuffer(self.colour[i], np.uint8), cv2.IMREAD_COLOR)

    def metres(self, i: int) -> np.ndarray:
        return (self.raw[i].astype(np.float32) / np.float32(self.scale)).astype(np.float32)


def seconds(ns: int) -> str:
    return f"{ns // 10**9}.{ns % 10**9:09d}"


def png16(raw: np.ndarray) -> bytes:
    return cv2.imencode(".png", raw)[1].tobytes()


def camera_toml(content: Content, **depth: object) -> str:
    lines = [f"{key} = {value!r}" for key, value in content.camera.items()]
    if depth:
        lines += ["[depth]", *(f"{key} = {json.dumps(value)}" for key, value in depth.items())]
    return "\n".join(lines) + "\n"


def matrix_text(T: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in T) + "\n"


def k_rows(camera: dict[str, float]) -> list[float]:
    return [camera["fx"], 0.0, camera["cx"], 0.0, camera["fy"], camera["cy"], 0.0, 0.0, 1.0]


def k_columns(camera: dict[str, float]) -> list[float]:
    return [camera["fx"], 0.0, 0.0, 0.0, camera["fy"], 0.0, camera["cx"], camera["cy"], 1.0]


def write_images(content: Content, out: Path, colour: str, depth: str, *, first: int = 0, pad: int = 0) -> None:
    """Write numbered images below two patterns such as "rgb/{}"."""
    for i, (picture, raw) in enumerate(zip(content.colour, content.raw, strict=True), start=first):
        for pattern, data, suffix in ((colour, picture, content.suffix), (depth, png16(raw), ".png")):
            path = out / (pattern.format(f"{i:0{pad}d}") + suffix)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


# --- folders


def tum(content: Content, out: Path) -> Path:
    write_images(content, out, "rgb/{}", "depth/{}")
    for name, stamps, suffix in (("rgb", content.stamp, content.suffix), ("depth", content.depth_stamp, ".png")):
        lines = [f"{seconds(stamp)} {name}/{i}{suffix}" for i, stamp in enumerate(stamps)]
        (out / f"{name}.txt").write_text("# stamp file\n" + "\n".join(lines) + "\n")
    (out / "camera.toml").write_text(camera_toml(content))
    return out


def associations(content: Content, out: Path) -> Path:
    write_images(content, out, "rgb/{}", "depth/{}")
    lines = [
        f"{seconds(d)} depth/{i}.png {seconds(c)} rgb/{i}{content.suffix}"
        for i, (c, d) in enumerate(zip(content.stamp, content.depth_stamp, strict=True))
    ]
    (out / "associate.txt").write_text("\n".join(lines) + "\n")
    (out / "camera.toml").write_text(camera_toml(content))
    return out


def numbered(content: Content, out: Path) -> Path:
    write_images(content, out, "image/{}", "depth/{}", first=7)
    (out / "K.txt").write_text(" ".join(map(repr, k_rows(content.camera))))
    return out


def stamped_names(content: Content, out: Path) -> Path:
    for name, stamps, images, suffix in (
        ("color", content.stamp, content.colour, content.suffix),
        ("depth", content.depth_stamp, [png16(raw) for raw in content.raw], ".png"),
    ):
        (out / name).mkdir(parents=True)
        for stamp, data in zip(stamps, images, strict=True):
            (out / name / f"{seconds(stamp)}{suffix}").write_bytes(data)
    (out / "camera.toml").write_text(camera_toml(content))
    return out


def open3d(content: Content, out: Path) -> Path:
    write_images(content, out, "color/{}", "depth/{}", pad=6)
    values = {"width": content.size[0], "height": content.size[1], "intrinsic_matrix": k_columns(content.camera)}
    (out / "camera_intrinsic.json").write_text(json.dumps(values, indent=4))
    return out


def icl_nuim(content: Content, out: Path) -> Path:
    write_images(content, out, "rgb/{}", "depth/{}")
    lines = [f"{i} depth/{i}.png {i} rgb/{i}{content.suffix}" for i in range(len(content.stamp))]
    (out / "associations.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{i} " + " ".join(f"{v:.6f}" for v in content.T_wc[i][:3, 3]) + " 0 0 0 1" for i in range(1, len(content.stamp))]
    (out / "livingRoom0.gt.freiburg").write_text("\n".join(rows) + "\n")
    (out / "camera.toml").write_text(camera_toml(content))
    return out


def seven_scenes(content: Content, out: Path) -> Path:
    write_images(content, out, "frame-{}.color", "frame-{}.depth", pad=6)
    for i, T_wc in enumerate(content.T_wc):
        (out / f"frame-{i:06d}.pose.txt").write_text(matrix_text(T_wc))
    (out / "camera-intrinsics.txt").write_text(matrix_text(np.array(k_rows(content.camera)).reshape(3, 3)))
    return out


def replica(content: Content, out: Path) -> Path:
    write_images(content, out, "results/frame{}", "results/depth{}", pad=6)
    (out / "traj.txt").write_text("\n".join(" ".join(f"{v:.9e}" for v in T.ravel()) for T in content.T_wc) + "\n")
    camera = {key: content.camera[key] for key in ("fx", "fy", "cx", "cy")}
    camera |= {"w": content.size[0], "h": content.size[1], "scale": content.scale}
    (out / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return out


def scannet(content: Content, out: Path) -> Path:
    write_images(content, out, "color/{}", "depth/{}")
    (out / "pose").mkdir()
    (out / "intrinsic").mkdir()
    for i, T_wc in enumerate(content.T_wc):
        (out / "pose" / f"{i}.txt").write_text(matrix_text(T_wc) if i != 1 else "-inf " * 16)
    k = np.eye(4)
    k[:3, :3] = np.array(k_rows(content.camera)).reshape(3, 3)
    for name, matrix in (("intrinsic_color", k), ("intrinsic_depth", k), ("extrinsic_color", np.eye(4)), ("extrinsic_depth", np.eye(4))):
        (out / "intrinsic" / f"{name}.txt").write_text(matrix_text(matrix))
    return out


def record3d(content: Content, out: Path) -> Path:
    """As the app exports with depth in another lossless format: float32 metres as numpy arrays, portrait or not."""
    write_images(content, out, "rgb/{}", "depth/{}")
    for i in range(len(content.stamp)):
        (out / "depth" / f"{i}.png").unlink()
        np.save(out / "depth" / f"{i}.npy", content.metres(i))
    (out / "metadata.json").write_text(json.dumps(record3d_metadata(content)))
    return out


def record3d_metadata(content: Content) -> dict:
    width, height = content.size
    stamps = [stamp / 10**9 for stamp in content.stamp]
    return {"w": width, "h": height, "dw": width, "dh": height, "fps": 30, "K": k_columns(content.camera), "frameTimestamps": stamps}


def rtabmap(content: Content, out: Path) -> Path:
    write_images(content, out, "rgb/{}", "depth/{}", first=1)
    (out / "calib").mkdir()
    for i, _ in enumerate(content.stamp, start=1):
        (out / "calib" / f"{i}.yaml").write_text(opencv_yaml(content))
    rows = [f"{seconds(stamp)} 0 0 0 0 0 0 1 {i}" for i, stamp in enumerate(content.stamp, start=1)]
    (out / "poses.txt").write_text("#timestamp x y z qx qy qz qw id\n" + "\n".join(rows) + "\n")
    return out


def opencv_yaml(content: Content) -> str:
    width, height = content.size
    rows = ", ".join(map(repr, k_rows(content.camera)))
    return (
        f'%YAML:1.0\n---\ncamera_name: "1"\nimage_width: {width}\nimage_height: {height}\n'
        f"camera_matrix:\n   rows: 3\n   cols: 3\n   data: [ {rows} ]\n"
        "distortion_coefficients:\n   rows: 1\n   cols: 5\n   data: [ 0., 0., 0., 0., 0. ]\ndistortion_model: plumb_bob\n"
    )


def transforms(content: Content, out: Path) -> Path:
    write_images(content, out, "images/frame_{}", "depth/frame_{}", pad=5)
    frames = [
        {
            "file_path": f"./images/frame_{i:05d}{content.suffix}",
            "depth_file_path": f"depth/frame_{i:05d}.png",
            "timestamp": content.stamp[i] / 10**9,
            "transform_matrix": (content.T_wc[i] @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        for i in range(len(content.stamp))
    ]
    camera = {"fl_x": content.camera["fx"], "fl_y": content.camera["fy"], "cx": content.camera["cx"], "cy": content.camera["cy"]}
    about = {**camera, "w": content.size[0], "h": content.size[1], "depth_unit_scale_factor": 1.0 / content.scale, "frames": frames}
    (out / "transforms.json").write_text(json.dumps(about))
    return out


def phone(content: Content, out: Path) -> Path:
    """StrayScanner's layout, which loses: colour as H.264, depth of 256 x 192 in millimetres, one stamp for both."""
    import av

    (out / "depth").mkdir(parents=True)
    with av.open(str(out / "rgb.mp4"), "w") as container:
        stream = container.add_stream("h264", rate=30)
        (stream.width, stream.height), stream.pix_fmt, stream.options = content.size, "yuv420p", {"crf": "18", "preset": "veryfast"}
        for i in range(len(content.stamp)):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(content.bgr(i), format="bgr24")))
        container.mux(stream.encode())
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, stamp in enumerate(content.stamp):
        small = cv2.resize(content.raw[i], (256, 192), interpolation=cv2.INTER_NEAREST)
        (out / "depth" / f"{i:06d}.png").write_bytes(png16(np.rint(small * (1000.0 / content.scale)).astype(np.uint16)))
        rows.append(f"{seconds(stamp)}, {i:06d}, 0, 0, 0, 0, 0, 0, 1")
    (out / "odometry.csv").write_text("\n".join(rows))
    (out / "camera.toml").write_text(camera_toml(content).replace(f"depth_scale = {content.scale!r}", "depth_scale = 1000.0"))
    return out


# --- single files


def r3d(content: Content, out: Path) -> Path:
    import liblzfse

    out.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(out / "scan.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(record3d_metadata(content)))
        for i, picture in enumerate(content.colour):
            archive.writestr(f"rgbd/{i}.jpg", picture)
            archive.writestr(f"rgbd/{i}.depth", liblzfse.compress(content.metres(i).tobytes()))
            archive.writestr(f"rgbd/{i}.conf", liblzfse.compress(np.full(content.raw[i].shape, 2, np.uint8).tobytes()))
    return out / "scan.r3d"


def sens(content: Content, out: Path) -> Path:
    out.mkdir(parents=True, exist_ok=True)
    (width, height), name = content.size, b"StructureSensor"
    k = np.eye(4, dtype="<f4")
    k[:3, :3] = np.array(k_rows(content.camera)).reshape(3, 3)
    head = struct.pack("<IQ", 4, len(name)) + name
    head += b"".join(m.tobytes() for m in (k, np.eye(4, dtype="<f4"), k, np.eye(4, dtype="<f4")))
    kind = 2 if content.suffix == ".jpg" else 1
    head += struct.pack("<2i4IfQ", kind, 1, width, height, width, height, content.scale, len(content.stamp))
    body = b""
    for i, picture in enumerate(content.colour):
        depth = zlib.compress(content.raw[i].astype("<u2").tobytes())
        body += content.T_wc[i].astype("<f4").tobytes()
        body += struct.pack("<4Q", content.stamp[i] // 1000, content.depth_stamp[i] // 1000, len(picture), len(depth)) + picture + depth
    (out / "scene.sens").write_bytes(head + body + struct.pack("<Q", 0))
    return out / "scene.sens"


def rtabmap_db(content: Content, out: Path, *, use_rvl: bool = False) -> Path:
    out.mkdir(parents=True, exist_ok=True)
    (width, height), k = content.size, struct.pack("<9d", *k_rows(content.camera))
    calibration = struct.pack("<11i", 0, 21, 0, 0, width, height, 9, 5, 0, 0, 12) + k + struct.pack("<5d", *[0.0] * 5)
    calibration += np.eye(4, dtype="<f4")[:3].tobytes()
    with sqlite3.connect(out / "map.db") as db:
        db.execute("CREATE TABLE Node (id INTEGER, map_id INTEGER, weight INTEGER, stamp FLOAT, pose BLOB, ground_truth_pose BLOB)")
        db.execute("CREATE TABLE Data (id INTEGER, image BLOB, depth BLOB, calibration BLOB)")
        for i, picture in enumerate(content.colour, start=1):
            raw = content.raw[i - 1]
            depth = b"DEPTHRVL" + struct.pack("<II", width, height) + rvl(raw) if use_rvl else png16(raw)
            db.execute("INSERT INTO Node VALUES (?, 0, 0, ?, NULL, NULL)", (i, content.stamp[i - 1] / 10**9))
            db.execute("INSERT INTO Data VALUES (?, ?, ?, ?)", (i, picture, depth, calibration))
    db.close()
    return out / "map.db"


def rvl(raw: np.ndarray) -> bytes:
    """The encoder of the paper, over whole arrays."""
    values = raw.ravel().astype(np.int64)
    is_value = np.concatenate([[False], values > 0, [False]])
    starts, ends = np.flatnonzero(~is_value[:-1] & is_value[1:]), np.flatnonzero(is_value[:-1] & ~is_value[1:])
    delta = np.diff(values[values > 0], prepend=0)
    code, at, done, tokens = (delta << 1) ^ (delta >> 63), 0, 0, []
    for start, end in zip(starts, ends, strict=True):
        tokens += [np.array([start - at, end - start]), code[done : done + end - start]]
        at, done = end, done + end - start
    if at < len(values):
        tokens.append(np.array([len(values) - at, 0]))
    numbers = np.concatenate(tokens)
    n_nibbles = np.maximum(np.ceil(np.log2(numbers + 1.0) / 3 - 1e-12), 1).astype(np.int64)
    place = np.arange(n_nibbles.sum()) - np.repeat(np.cumsum(n_nibbles) - n_nibbles, n_nibbles)
    nibbles = (np.repeat(numbers, n_nibbles) >> (3 * place)) & 7
    nibbles += 8 * (place < np.repeat(n_nibbles, n_nibbles) - 1)
    words = np.concatenate([nibbles, np.zeros(-len(nibbles) % 8, np.int64)]).reshape(-1, 8).astype(np.uint64)
    packed = sum(words[:, k] << np.uint64(4 * (7 - k)) for k in range(8))
    return np.asarray(packed).astype("<u4").tobytes()


# --- ROS


def ros1(content: Content, out: Path, **how: object) -> Path:
    from rosbags.rosbag1 import Writer

    out.mkdir(parents=True, exist_ok=True)
    writer = Writer(out / "walk.bag")
    if how.pop("packed", False):
        writer.set_compression(Writer.CompressionFormat.LZ4)
    with writer:
        write_ros(writer, content, RosMessages(**how), is_cdr=False)
    return out / "walk.bag"


def ros2(content: Content, out: Path, *, storage: str = "sqlite3", packed: str = "", **how: object) -> Path:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    out.parent.mkdir(parents=True, exist_ok=True)
    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    writer = Writer(out, version=9, storage_plugin=plugin)
    if packed:
        writer.set_compression(CompressionMode[packed.upper()], CompressionFormat.ZSTD)
    with writer:
        write_ros(writer, content, RosMessages(**how), is_cdr=True)
    return out


def mcap(content: Content, out: Path, **how: object) -> Path:
    folder = ros2(content, out / "bag", storage="mcap", **how)
    file = next(folder.glob("*.mcap"))
    shutil.move(file, out / "walk.mcap")
    shutil.rmtree(folder)
    return out / "walk.mcap"


@dataclass(frozen=True)
class RosMessages:
    """Which messages a bag holds, and how."""

    colour: str = "jpeg"
    colour_topic: str = "/camera/color/image_raw"
    projection: dict[str, float] | None = None  # P of colour's CameraInfo; zeros without
    is_raw_told: bool = True  # K and D of colour's CameraInfo; zeros if not
    depth: str = "32FC1"
    depth_frame: str = "color_optical"
    depth_topic: str = "/camera/depth_registered/image_raw"
    depth_camera: dict[str, float] | None = None
    T_cd: np.ndarray | None = None
    infrared: bool = False
    shuffled: bool = False
    skip: tuple[str, ...] = ()


def write_ros(writer: object, content: Content, how: RosMessages, *, is_cdr: bool) -> None:
    """Write colour, depth, CameraInfo and tf by the definitions that rosbags ships: not by the reader's own parser."""
    depth, depth_frame, depth_topic = how.depth, how.depth_frame, how.depth_topic
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if is_cdr else Stores.ROS1_NOETIC)
    if "tf2_msgs/msg/TFMessage" not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    types = store.types
    serialize = store.serialize_cdr if is_cdr else store.serialize_ros1

    def header(stamp: int, frame: str) -> object:
        when = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        extra = {} if is_cdr else {"seq": 0}
        return types["std_msgs/msg/Header"](stamp=when, frame_id=frame, **extra)

    def info(camera: dict[str, float], stamp: int, frame: str, projection: dict[str, float] | None = None) -> object:
        upper = (lambda name: name) if is_cdr else str.upper
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        d = np.array([camera.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
        model = "rational_polynomial" if d[5:].any() else "plumb_bob"
        p = np.zeros(12)
        if projection is not None:
            p.reshape(3, 4)[:, :3] = np.reshape(k_rows(projection), (3, 3))
        return types["sensor_msgs/msg/CameraInfo"](
            header=header(stamp, frame), height=int(camera["height"]), width=int(camera["width"]), distortion_model=model,
            binning_x=0, binning_y=0, roi=region,
            **{upper("d"): d if d[5:].any() else d[:5], upper("k"): np.array(k_rows(camera) if camera["fx"] else [0.0] * 9), upper("r"): np.eye(3).ravel(), upper("p"): p},
        )  # fmt: skip

    def raw(image: np.ndarray, encoding: str, stamp: int, frame: str) -> object:
        data = np.ascontiguousarray(image).view(np.uint8).ravel()
        return types[SENSOR_IMAGE](
            header=header(stamp, frame), height=image.shape[0], width=image.shape[1], encoding=encoding, is_bigendian=0,
            step=len(data) // image.shape[0], data=data,
        )  # fmt: skip

    def compressed(data: bytes, kind: str, stamp: int, frame: str) -> object:
        return types[SENSOR_COMPRESSED](header=header(stamp, frame), format=kind, data=np.frombuffer(data, np.uint8))

    def depth_message(i: int) -> tuple[str, str, object]:
        stamp, image = content.depth_stamp[i], content.raw[i]
        if depth == "32FC1":
            return depth_topic, SENSOR_IMAGE, raw(content.metres(i), "32FC1", stamp, depth_frame)
        if depth == "16UC1":
            return depth_topic, SENSOR_IMAGE, raw(image, "16UC1", stamp, depth_frame)
        if id(image) not in encoded:  # the images of a content live as long as this call
            encoded[id(image)] = compressed_depth(image)
        return f"{depth_topic}/compressedDepth", SENSOR_COMPRESSED, compressed(encoded[id(image)], kind_of_depth, stamp, depth_frame)

    encoded: dict[int, bytes] = {}  # a long recording may repeat its images
    kind_of_depth = f"16UC1; compressedDepth {depth}"

    def compressed_depth(image: np.ndarray) -> bytes:
        config = struct.pack("<iff", 0, 0.0, 0.0)
        if depth == "png":
            return config + png16(image)
        if depth == "rvl":
            return config + struct.pack("<II", image.shape[1], image.shape[0]) + rvl(image)
        raise ValueError(depth)

    def colour_message(i: int) -> tuple[str, str, object]:
        stamp, name = content.stamp[i], how.colour_topic
        if how.colour == "jpeg":
            kind = "rgb8; jpeg compressed bgr8" if content.suffix == ".jpg" else "rgb8; png compressed bgr8"
            return f"{name}/compressed", SENSOR_COMPRESSED, compressed(content.colour[i], kind, stamp, "color_optical")
        image = content.bgr(i) if how.colour == "bgr8" else cv2.cvtColor(content.bgr(i), cv2.COLOR_BGR2RGB)
        return name, SENSOR_IMAGE, raw(image, how.colour, stamp, "color_optical")

    messages: list[tuple[int, str, str, object]] = []
    colour_space, depth_space = (topic.rsplit("/", 1)[0] for topic in (how.colour_topic, depth_topic))
    colour_camera = (
        content.camera if how.is_raw_told else dict.fromkeys(content.camera, 0.0) | {k: content.camera[k] for k in ("width", "height")}
    )
    for i in range(len(content.stamp)):
        at = max(content.stamp[i], content.depth_stamp[i]) + 5_000_000
        if "colour" not in how.skip:
            messages.append((at, *colour_message(i)))
        if "depth" not in how.skip:
            messages.append((at + 1, *depth_message(i)))
        if how.infrared:
            grey = cv2.cvtColor(content.bgr(i), cv2.COLOR_BGR2GRAY)
            messages.append((at + 2, "/camera/infra1/image_raw", SENSOR_IMAGE, raw(grey, "mono8", content.stamp[i], "infra")))
            unregistered = raw(content.raw[i] // 2, "16UC1", content.depth_stamp[i], "depth_optical")
            messages.append((at + 3, "/camera/depth/image_rect_raw", SENSOR_IMAGE, unregistered))
        if "info" not in how.skip:
            kind = "sensor_msgs/msg/CameraInfo"
            messages.append(
                (at, f"{colour_space}/camera_info", kind, info(colour_camera, content.stamp[i], "color_optical", how.projection))
            )
            messages.append(
                (at, f"{depth_space}/camera_info", kind, info(how.depth_camera or content.camera, content.stamp[i], depth_frame))
            )
    if how.T_cd is not None:
        messages.insert(
            0, (content.stamp[0], "/tf_static", "tf2_msgs/msg/TFMessage", _tf(types, header, how.T_cd, content.stamp[0], depth_frame))
        )
    if how.shuffled:
        messages = messages[::-1]
    connections: dict[str, object] = {}
    for at, topic, kind, message in messages:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], at, serialize(message, kind))


def _tf(types: dict, header: Callable, T_cd: np.ndarray, stamp: int, child: str) -> object:
    """Both cameras hang on a body: colour turned and aside, depth where T_cd puts it."""
    T_bc = np.eye(4)
    T_bc[:3, :3], T_bc[:3, 3] = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0], [0.01, 0.02, 0.03]
    made = []
    for frame, T in (("color_optical", T_bc), (child, T_bc @ T_cd)):
        w, x, y, z = quaternion(T[:3, :3])
        translation = types["geometry_msgs/msg/Vector3"](x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
        transform = types["geometry_msgs/msg/Transform"](
            translation=translation, rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
        )
        made.append(types["geometry_msgs/msg/TransformStamped"](header=header(stamp, "body"), child_frame_id=frame, transform=transform))
    return types["tf2_msgs/msg/TFMessage"](transforms=made)


def quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """w x y z of a small turn."""
    w = float(np.sqrt(1.0 + np.trace(R)) / 2)
    return w, *(float(v) for v in np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))


@dataclass(frozen=True)
class Layout:
    """One way to write a recording, and what of it is kept."""

    name: str
    write: Callable[[Content, Path], Path]
    reader: str
    keeps_stamps: bool = True
    keeps_depth_stamps: bool = True
    override: tuple[str, ...] = ("depth_scale",)  # of the camera, where the layout has another unit by custom
    needs: tuple[str, ...] = ()  # modules


def _ros(write: Callable, **how: object) -> Callable[[Content, Path], Path]:
    return lambda content, out: write(content, out, **how)


UNIT_KEPT: tuple[str, ...] = ()
LAYOUTS = (
    Layout("tum", tum, "tum", override=UNIT_KEPT),
    Layout("associations", associations, "associations", override=UNIT_KEPT),
    Layout("numbered", numbered, "numbered", keeps_stamps=False),
    Layout("stamped_names", stamped_names, "numbered", override=UNIT_KEPT),
    Layout("open3d", open3d, "open3d", keeps_stamps=False),
    Layout("icl_nuim", icl_nuim, "icl_nuim", keeps_stamps=False, override=UNIT_KEPT),
    Layout("seven_scenes", seven_scenes, "seven_scenes", keeps_stamps=False),
    Layout("replica", replica, "replica", keeps_stamps=False, override=UNIT_KEPT),
    Layout("scannet", scannet, "scannet", keeps_stamps=False),
    Layout("record3d", record3d, "record3d", keeps_depth_stamps=False, override=UNIT_KEPT),
    Layout("rtabmap", rtabmap, "rtabmap", keeps_depth_stamps=False),
    Layout("transforms", transforms, "transforms", keeps_depth_stamps=False, override=UNIT_KEPT),
    Layout("r3d", r3d, "r3d", keeps_depth_stamps=False, override=UNIT_KEPT, needs=("liblzfse",)),
    Layout("sens", sens, "sens", override=UNIT_KEPT),
    Layout("rtabmap_db", rtabmap_db, "rtabmap_db", keeps_depth_stamps=False),
    Layout("rtabmap_db_rvl", _ros(rtabmap_db, use_rvl=True), "rtabmap_db", keeps_depth_stamps=False),
    Layout("ros1_compressed", ros1, "rosbag", override=UNIT_KEPT),
    Layout("ros1_raw", _ros(ros1, colour="bgr8", depth="16UC1"), "rosbag"),
    Layout("ros1_lz4", _ros(ros1, packed=True, colour="rgb8", depth="png"), "rosbag"),
    Layout("ros1_rvl", _ros(ros1, colour="rgb8", depth="rvl"), "rosbag"),
    Layout("ros2_raw", _ros(ros2, colour="bgr8", depth="16UC1"), "rosbag"),
    Layout("ros2_sqlite", _ros(ros2, colour="jpeg", depth="rvl"), "rosbag"),
    Layout("ros2_zstd", _ros(ros2, packed="message", colour="rgb8"), "rosbag", override=UNIT_KEPT),
    Layout("ros2_mcap", _ros(ros2, storage="mcap", depth="png"), "rosbag"),
    Layout("mcap_raw", _ros(mcap, colour="bgr8", depth="16UC1"), "rosbag"),
    Layout("mcap", _ros(mcap, colour="rgb8", depth="rvl"), "rosbag"),
)

# Of which colour is pixels, whose luma is computed: as of a PNG, not as a JPEG has it stored.
RAW_COLOUR = ("ros1_raw", "ros1_lz4", "ros1_rvl", "ros2_raw", "ros2_zstd", "mcap_raw", "mcap")


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()
