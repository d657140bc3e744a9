"""Recordings as people spoil them: lists, stamps, depth and calibration, each a few lines, with what must come of it."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import CAMERA, SIZE, depth, png, write_recording

from slamcli.config.options import RecordingConfig
from slamcli.datasets import Dataset, open_dataset
from slamcli.errors import SlamError

N = 40
STEP = 1 / 30
EPOCH = 1305031102.0


@dataclass(frozen=True)
class Case:
    """What is done to a sound recording of 40 frames at 30 Hz, and what must be said and hold."""

    change: Callable[[Path], None]
    said: str = ""  # in one of the warnings; with `refused`, in the error
    refused: bool = False
    frames: int = N
    in_order: bool = True  # frame i shows picture i
    step: float | None = STEP  # [s] median
    with_depth: int | None = None  # None = all frames
    holds: Callable[[Dataset], bool] = lambda dataset: True
    options: RecordingConfig = RecordingConfig()


def rows(folder: Path, name: str) -> list[tuple[float, str]]:
    lines = (folder / f"{name}.txt").read_text().splitlines()
    return [(float(line.split()[0]), line.split()[1]) for line in lines if not line.startswith("#")]


def rewrite(
    line: Callable[[float, str], str], *, names: tuple[str, ...] = ("rgb", "depth"), encoding: str = "utf-8"
) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in names:
            text = "\n".join(line(stamp, file) for stamp, file in rows(folder, name))
            (folder / f"{name}.txt").write_bytes(text.encode(encoding))

    return change


def restamp(stamps: Callable[[np.ndarray], np.ndarray | list[str]], *, names: tuple[str, ...] = ("rgb", "depth")) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in names:
            table = rows(folder, name)
            new = stamps(np.array([stamp for stamp, _ in table]))
            texts = [value if isinstance(value, str) else repr(float(value)) for value in new]
            (folder / f"{name}.txt").write_text("\n".join(f"{text} {file}" for text, (_, file) in zip(texts, table, strict=True)))

    return change


def reorder(order: Callable[[int], list[int]]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in ("rgb", "depth"):
            table = rows(folder, name)
            (folder / f"{name}.txt").write_text("\n".join(f"{table[i][0]:.6f} {table[i][1]}" for i in order(len(table))))

    return change


def pairs(line: Callable[[int, float], str], *, name: str = "associations.txt") -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        stamps = [stamp for stamp, _ in rows(folder, "rgb")]
        (folder / name).write_text("\n".join(line(i, stamp) for i, stamp in enumerate(stamps)))
        (folder / "rgb.txt").unlink()
        (folder / "depth.txt").unlink()

    return change


def repaint(draw: Callable[[int, np.ndarray], bytes], *, suffix: str = ".png") -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for i in range(N):
            (folder / "depth" / f"{i}.png").unlink()
            (folder / "depth" / f"{i}{suffix}").write_bytes(draw(i, depth(i)))
        text = (folder / "depth.txt").read_text()
        (folder / "depth.txt").write_text(text.replace(".png", suffix))

    return change


def recalibrate(*files: tuple[str, str]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / "camera.json").unlink()
        for name, text in files:
            (folder / name).write_text(text)

    return change


def then(*changes: Callable[[Path], None]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for one in changes:
            one(folder)

    return change


def rename_all(folder: Path, name: str, new: Callable[[str], str]) -> None:
    for file in list((folder / name).iterdir()):
        file.rename(file.with_name(new(file.name)))


def smooth(i: int) -> np.ndarray:
    """A slanted wall in 1/5000 m: neighbouring readings differ little."""
    return (7000 + 20 * np.arange(SIZE[0])[None] + 15 * np.arange(SIZE[1])[:, None] + i).astype(np.uint16)


def far_away(i: int) -> np.ndarray:
    """A wall 4 m off in a sensor's own steps: half of the neighbours are equal, and some are 256 units apart, which is 1 with bytes swapped."""
    steps = np.tile([0, 0, 0, 0, 0, 256, 100, 100, 100, 100, 100], SIZE[0])[: SIZE[0]]
    return np.tile(19000 + i + np.cumsum(steps), (SIZE[1], 1)).astype(np.uint16)


def npy(array: np.ndarray) -> bytes:
    import io

    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


RNG = np.random.default_rng(4)
PROCESSING = np.concatenate([RNG.uniform(0.005, 0.03, N)])
SHUFFLED = RNG.permutation(N).tolist()
MATRIX = "60.0 0 31.5\n0 60.0 23.5\n0 0 1\n"
FLOAT_TIFF = (cv2.IMWRITE_TIFF_COMPRESSION, 1)


def two_sessions(folder: Path) -> None:
    restamp(lambda t: np.concatenate([t[:25], t[:15]]))(folder)


def no_files(folder: Path, share: float) -> None:
    for i in range(int(share * N)):
        (folder / "rgb" / f"{i}.png").unlink()


def camera_with(**changes: object) -> tuple[str, str]:
    return "camera.json", json.dumps({**json.loads(CAMERA), **changes})


def doubled(folder: Path) -> None:
    """Write every image a second time, with the same stamp."""
    for name in ("rgb", "depth"):
        lines = [line for line in (folder / f"{name}.txt").read_text().splitlines() if not line.startswith("#")]
        for line in lines:
            file = folder / line.split()[1]
            file.with_name(f"{file.stem}b{file.suffix}").write_bytes(file.read_bytes())
        (folder / f"{name}.txt").write_text("".join(f"{line}\n{line.replace('.png', 'b.png')}\n" for line in lines))


CASES = {
    # lists
    "semicolons": Case(rewrite(lambda t, f: f"{t:.6f};{f}")),
    "tabs": Case(rewrite(lambda t, f: f"{t:.6f}\t{f}")),
    "commas": Case(rewrite(lambda t, f: f"{t:.6f},{f}")),
    "decimal commas": Case(rewrite(lambda t, f: f"{t:.6f} {f}".replace(".", ",", 1))),
    "decimal commas and semicolons": Case(rewrite(lambda t, f: f"{t:.6f}; {f}".replace(".", ",", 1))),
    "quotes": Case(rewrite(lambda t, f: f'"{t:.6f}", "{f}"')),
    "backslashes": Case(rewrite(lambda t, f: f"{t:.6f} " + f.replace("/", "\\"))),
    "a dot before": Case(rewrite(lambda t, f: f"{t:.6f} ./{f}")),
    "utf-16 with a mark": Case(rewrite(lambda t, f: f"{t:.6f} {f}", encoding="utf-16")),
    "utf-16 without": Case(rewrite(lambda t, f: f"{t:.6f} {f}", encoding="utf-16-le")),
    "utf-8 with a mark": Case(rewrite(lambda t, f: f"{t:.6f} {f}", encoding="utf-8-sig")),
    "old macintosh line ends": Case(lambda d: [(d / n).write_bytes((d / n).read_bytes().replace(b"\n", b"\r")) for n in ("rgb.txt", "depth.txt")]),
    "columns swapped": Case(rewrite(lambda t, f: f"{f} {t:.6f}")),
    "an index before": Case(rewrite(lambda t, f: f"{round(t * 30)}, {t:.6f}, {f}")),
    "an index before that no number holds": Case(rewrite(lambda t, f: f"{'9' * 400}, {t:.6f}, {f}")),
    "seconds and nanoseconds": Case(rewrite(lambda t, f: f"{int(EPOCH + t)},{round((t % 1) * 1e9)},{f}")),
    "a heading": Case(rewrite(lambda t, f: f"{t:.6f} {f}" if t else f"timestamp filename\n{t:.6f} {f}")),
    "every line twice": Case(rewrite(lambda t, f: f"{t:.6f} {f}\n{t:.6f} {f}"), said="repeated lines left out"),
    "absolute paths of another machine": Case(rewrite(lambda t, f: f"{t:.6f} /home/me/data/walk/{f}")),
    "absolute paths of windows": Case(rewrite(lambda t, f: f"{t:.6f} D:\\walk\\" + f.replace("/", "\\"))),
    "names without their folder": Case(rewrite(lambda t, f: f"{t:.6f} {f.split('/')[1]}")),
    "names without their suffix": Case(rewrite(lambda t, f: f"{t:.6f} {f.split('.')[0]}")),
    "another case": Case(rewrite(lambda t, f: f"{t:.6f} {f.upper()}")),
    "colour recompressed, the list not": Case(
        lambda d: [(d / "rgb" / f"{i}.png").rename(d / "rgb" / f"{i}.jpg") for i in range(N)], holds=lambda s: s.colour_name[0] == "rgb/0.jpg"
    ),
    "folder called RGB": Case(lambda d: (d / "rgb").rename(d / "RGB")),
    "a tenth of the files missing": Case(lambda d: no_files(d, 0.1), said="4 of 40 colour images are not there"),
    "most files missing": Case(lambda d: no_files(d, 0.7), said="28 of 40 colour images are not there", refused=True),
    "a path out of the folder": Case(rewrite(lambda t, f: f"{t:.6f} ../{f}"), said="leads out", refused=True),
    # stamps
    "milliseconds": Case(restamp(lambda t: 1e3 * (EPOCH + t)), said="stamps are in ms"),
    "microseconds": Case(restamp(lambda t: [str(round(1e6 * (EPOCH + x))) for x in t]), said="stamps are in us"),
    "nanoseconds": Case(restamp(lambda t: [str(round(1e9 * x) + 1305031102000000000) for x in t]), said="stamps are in ns"),
    "milliseconds since the start": Case(restamp(lambda t: np.rint(1e3 * t)), said="stamps are in ms", step=0.033),
    "nanoseconds since the start": Case(restamp(lambda t: np.rint(1e9 * t)), said="stamps are in ns"),
    "milliseconds in one list alone": Case(restamp(lambda t: 1e3 * t, names=("depth",)), said="stamps are in ms"),
    "frame numbers": Case(restamp(lambda t: np.rint(30 * t)), said="frame numbers; 30 Hz assumed"),
    "frame numbers and a rate": Case(restamp(lambda t: np.rint(30 * t)), said="10 Hz as recording.fps says", step=0.1, options=RecordingConfig(fps=10.0)),
    "frame numbers of every third frame": Case(restamp(lambda t: 3 * np.rint(30 * t)), said="frame numbers", step=0.1),
    "a rate beside a clock": Case(lambda d: None, said="recording.fps 10 is not used", options=RecordingConfig(fps=10.0)),
    "processing times": Case(restamp(lambda t: PROCESSING), said="no clock (processing times?)"),
    "a constant": Case(restamp(lambda t: 0 * t + EPOCH), said="repeat the one before"),
    "whole seconds": Case(restamp(lambda t: np.floor(EPOCH + 4 * t)), said="whole seconds", step=None),
    "zeros": Case(restamp(lambda t: 0 * t), said="no clock"),
    "lines shuffled": Case(reorder(lambda n: SHUFFLED), said="not sorted by time"),
    "lines reversed": Case(reorder(lambda n: list(range(n))[::-1]), said="not sorted by time"),
    "second half first": Case(reorder(lambda n: [*range(20, n), *range(20)]), said="not sorted by time"),
    "two lines swapped": Case(reorder(lambda n: [0, 1, 3, 2, *range(4, n)]), said="not sorted by time (1 steps back)"),
    "two sessions joined": Case(two_sessions, said="sessions that were joined"),
    "a counter of 32 bits of microseconds": Case(restamp(lambda t: (1e6 * t + 2**32 - 5e5) % 2**32), said="rolled over"),
    "seconds of the hour": Case(restamp(lambda t: (t + 3599.5) % 3600), said="rolled over"),
    "some stamps nan": Case(restamp(lambda t: np.where(np.arange(len(t)) % 10 == 3, np.nan, t)), said="4 unusable lines", frames=36, in_order=False),
    "a gap of a minute": Case(restamp(lambda t: t + 60.0 * (t > 0.51))),
    "one stamp twice": Case(restamp(lambda t: np.where(np.arange(len(t)) == 7, t[6], t)), said="1 repeated stamps", frames=39, in_order=False),
    "each image twice, under another name": Case(doubled, said="40 images repeat the one before, stamp and content; left out"),
    "stamps of a tenth of a second": Case(restamp(lambda t: np.floor(10 * t + 1e-9) / 10), said="no clock; 30 Hz assumed"),
    "depth of another epoch": Case(restamp(lambda t: t + EPOCH, names=("depth",)), said="no depth image lies within", refused=True),
    "depth at half the rate": Case(lambda d: reorder(lambda n: list(range(0, n, 2)))(d) or restore_rgb(d), with_depth=20),
    # pairs in one list
    "colour first": Case(pairs(lambda i, t: f"{t:.6f} rgb/{i}.png {t:.6f} depth/{i}.png")),
    "depth first": Case(pairs(lambda i, t: f"{t:.6f} depth/{i}.png {t:.6f} rgb/{i}.png", name="associate.txt")),
    "pairs with the truth before": Case(pairs(lambda i, t: f"{t:.6f} {i} 0 0 0 0 0 1 {t:.6f} rgb/{i}.png {t:.6f} depth/{i}.png"), holds=lambda s: truth_moves(s)),
    "pairs with the truth behind": Case(pairs(lambda i, t: f"{t:.6f} rgb/{i}.png {t:.6f} depth/{i}.png {t:.6f} {i} 0 0 0 0 0 1"), holds=lambda s: truth_moves(s)),
    "pairs with one stamp": Case(pairs(lambda i, t: f"{t:.6f} rgb/{i}.png depth/{i}.png")),
    "pairs without stamps": Case(pairs(lambda i, t: f"rgb/{i}.png depth/{i}.png"), said="in the order of the list"),
    "pairs with frame numbers": Case(pairs(lambda i, t: f"{i} depth/{i}.png {i} rgb/{i}.png", name="assoc.txt"), said="frame numbers"),
    "pairs in csv": Case(pairs(lambda i, t: f"{t:.6f},rgb/{i}.png,{t:.6f},depth/{i}.png", name="associations.csv")),
    "pairs under another name": Case(pairs(lambda i, t: f"{t:.6f} rgb/{i}.png {t:.6f} depth/{i}.png", name="my_assoc_list.txt")),
    "no list at all": Case(lambda d: [(d / f"{n}.txt").unlink() for n in ("rgb", "depth")], said="in the order of their numbers"),
    # depth
    "readings at the type's maximum": Case(repaint(lambda i, raw: png(np.where(raw == 0, 65535, raw).astype(np.uint16))), holds=lambda s: np.isnan(s.depth(0)[0, :5]).all()),
    "16-bit tiff": Case(repaint(lambda i, raw: png(raw, ".tiff"), suffix=".tiff")),
    "16-bit pgm": Case(repaint(lambda i, raw: png(raw, ".pgm"), suffix=".pgm")),
    "numpy in metres": Case(
        then(recalibrate(("K.txt", MATRIX)), repaint(lambda i, raw: npy((raw / 5000).astype(np.float32)), suffix=".npy")),
        holds=lambda s: np.nanmax(np.abs(s.depth(1) - depth(1) / 5000)) < 4.0 and s.camera.depth_scale == 1.0,
    ),
    "numpy of whole numbers": Case(repaint(lambda i, raw: npy(raw), suffix=".npy")),
    "floats in millimetres": Case(
        then(recalibrate(("K.txt", MATRIX)), repaint(lambda i, raw: npy((raw / 5).astype(np.float64)), suffix=".npy")),
        said="in millimetres",
        holds=lambda s: 0.5 < np.nanmedian(s.depth(0)) < 3.0,
    ),
    "32-bit whole numbers": Case(repaint(lambda i, raw: npy(raw.astype(np.int32)), suffix=".npy")),
    "an object in numpy's format": Case(repaint(lambda i, raw: npy(np.array([{}], dtype=object)), suffix=".npy"), said="no array of numbers", refused=True),
    "bytes swapped": Case(repaint(lambda i, raw: png(smooth(i).byteswap())), said="bytes of each reading are swapped", refused=True),
    "large steps far away": Case(repaint(lambda i, raw: png(far_away(i))), holds=lambda s: np.nanmin(s.depth(0)) > 3.0),
    "8 bits": Case(repaint(lambda i, raw: png((raw >> 8).astype(np.uint8))), said="8 bits", refused=True),
    "8 bits stretched": Case(repaint(lambda i, raw: png(((smooth(i) >> 6) * 257).astype(np.uint16))), said="stretched to 16", refused=True),
    "three channels": Case(repaint(lambda i, raw: png(np.repeat((raw >> 8).astype(np.uint8)[..., None], 3, axis=2))), said="3 channels", refused=True),
    "half the size": Case(repaint(lambda i, raw: png(smooth(i)[::2, ::2].copy())), holds=lambda s: s.depth(0).shape == (48, 64) and not np.isnan(s.depth(0)).any()),
    "twice the size": Case(repaint(lambda i, raw: png(cv2.resize(smooth(i), None, fx=2, fy=2))), holds=lambda s: s.depth(0).shape == (48, 64)),
    "another shape": Case(repaint(lambda i, raw: png(raw[:24].copy())), said="not the shape", refused=True),
    "no reading": Case(repaint(lambda i, raw: png(0 * raw)), said="hold no reading"),
    "millimetres under 5000": Case(repaint(lambda i, raw: png((raw / 5).astype(np.uint16))), said="camera.depth_scale = 1000 (millimetres)"),
    # calibration
    "K in a text file": Case(recalibrate(("K.txt", MATRIX)), said="assumed", holds=lambda s: s.camera.cx == 31.5),
    "K as 4 x 4": Case(recalibrate(("intrinsics.txt", "60 0 31.5 0\n0 60 23.5 0\n0 0 1 0\n0 0 0 1\n")), holds=lambda s: s.camera.cy == 23.5),
    "K by columns": Case(recalibrate(("intrinsics.json", '{"K": [60, 0, 0, 0, 60, 0, 31.5, 23.5, 1]}')), holds=lambda s: s.camera.cx == 31.5),
    "K as nested rows": Case(recalibrate(("intrinsics.json", "[[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]")), holds=lambda s: s.camera.cx == 31.5),
    "four numbers": Case(recalibrate(("calibration.txt", "60.0 60.0 31.5 23.5\n")), holds=lambda s: (s.camera.fx, s.camera.depth_scale) == (60.0, 5000.0)),
    "fx = ...": Case(recalibrate(("calib.txt", "fx = 60.0\nfy = 60.0\ncx = 31.5\ncy = 23.5\nscale: 5000\n")), holds=lambda s: s.camera.depth_scale == 5000.0),
    "ORB-SLAM's yaml": Case(
        recalibrate(("camera.yaml", "%YAML:1.0\nCamera.fx: 60.0\nCamera.fy: 60.0\nCamera.cx: 31.5\nCamera.cy: 23.5\nCamera.k1: 0.1\nDepthMapFactor: 5000.0\n")),
        holds=lambda s: (s.camera.k1, s.camera.depth_scale) == (0.1, 5000.0),
    ),
    "ROS's yaml": Case(
        recalibrate(("camera_info.yaml", "image_width: 64\nimage_height: 48\ndistortion_model: rational_polynomial\ncamera_matrix: {rows: 3, cols: 3, data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}\ndistortion_coefficients: {rows: 1, cols: 8, data: [0.1, 0, 0, 0, 0, 0.2, 0, 0]}\n")),
        holds=lambda s: s.camera.k4 == 0.2 and s.camera.is_rational,
    ),
    "fisheye": Case(
        recalibrate(("camera_info.yaml", "image_width: 64\nimage_height: 48\ndistortion_model: equidistant\ncamera_matrix: {data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}\ndistortion_coefficients: {data: [0.1, 0.01, 0.0, 0.0]}\n")),
        holds=lambda s: s.camera.lens == "equidistant" and s.camera.k2 == 0.01,
    ),
    "a lens nobody knows": Case(recalibrate(("camera_info.yaml", "distortion_model: dandelion\ncamera_matrix: {data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}\ndistortion_coefficients: {data: [0.1]}\n")), said="'dandelion' is not known", refused=True),
    "negative fy": Case(recalibrate(("intrinsics.json", '{"fx": 60.0, "fy": -60.0, "cx": 31.5, "cy": 23.5}')), holds=lambda s: s.camera.fy == 60.0),
    "calibrated at twice the size": Case(recalibrate(camera_with(width=128, height=96, fx=120.0, fy=120.0, cx=63.5, cy=47.5)), holds=lambda s: (s.camera.fx, s.camera.cx) == (60.0, 31.5)),
    "calibrated at half the size": Case(recalibrate(camera_with(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)), holds=lambda s: s.camera.fx == 60.0),
    "K of twice the size without a size": Case(recalibrate(("K.txt", "120 0 63.5\n0 120 47.5\n0 0 1\n")), holds=lambda s: s.camera.fx == 60.0),
    "calibrated upright": Case(recalibrate(camera_with(width=48, height=64, cx=23.5, cy=31.5)), holds=lambda s: (s.camera.width, s.camera.cx) == (64, 31.5)),
    "of another shape": Case(recalibrate(camera_with(width=65)), said="but the calibration is for 65 x 48", refused=True),
    "the unit in a file of its own": Case(
        recalibrate(("K.txt", MATRIX), ("camera.toml", "depth_scale = 5000\n")), holds=lambda s: (s.camera.fx, s.camera.depth_scale) == (60.0, 5000.0)
    ),
    "one number missing": Case(recalibrate(("camera.json", '{"fx": 60.0, "fy": 60.0, "cx": 31.5}')), said="cy is missing", refused=True),
    "none": Case(recalibrate(), said="fx, fy, cx, cy are missing; put them into a camera.toml in the folder", refused=True),
    "none, but a name": Case(recalibrate(), holds=lambda s: s.camera.fx == pytest.approx(52.5), options=RecordingConfig(known_camera="kinect1")),
    "a name that nobody knows": Case(recalibrate(), said="known are kinect1", refused=True, options=RecordingConfig(known_camera="kinect9")),
    "a depth camera of its own": Case(
        recalibrate(camera_with(depth={"fx": 66.0, "fy": 66.0, "cx": 31.5, "cy": 23.5, "translation": [0.02, 0, 0]})),
        said="registered to colour on reading (focal length 66.0 px, 20 mm aside)",
        holds=lambda s: s.depth_camera.fx == 66.0,
    ),
    "a depth camera turned about nothing": Case(recalibrate(camera_with(depth={"fx": 66.0, "fy": 66.0, "cx": 31.5, "cy": 23.5, "rotation": [1, 0, 0, 0, 1, 0, 0, 0, -1]})), said="rotation of the depth camera", refused=True),
    # as further programs write them
    "pipes between the columns": Case(rewrite(lambda t, f: f"{t:.6f} | {f}")),
    "comments behind the names": Case(rewrite(lambda t, f: f"{t:.6f} {f} # frame {round(t * 30)}"), said="a comment a line of its own", refused=True),
    "comments of another language": Case(rewrite(lambda t, f: f"{t:.6f} {f}" if t else f"// stamp name\n% stamp name\n{t:.6f} {f}")),
    "brackets around lines": Case(rewrite(lambda t, f: f"({t:.6f}, '{f}')")),
    "file addresses": Case(rewrite(lambda t, f: f"{t:.6f} file:///home/me/walk/{f}")),
    "blank lines between": Case(rewrite(lambda t, f: f"{t:.6f} {f}\n\n  ")),
    "stamps in quotes": Case(rewrite(lambda t, f: f"'{t:.6f}' {f}")),
    "exponents": Case(rewrite(lambda t, f: f"{t:.9e} {f}")),
    "hard spaces": Case(rewrite(lambda t, f: f"{t:.6f}\u00a0{f}")),
    "a size and a checksum behind": Case(rewrite(lambda t, f: f"{t:.6f} {f} 3072 d41d8cd98f00b204e9800998ecf8427e"), said="follows the file name", refused=True),
    "dates of the calendar": Case(rewrite(lambda t, f: f"2024-03-05T10:00:{t:09.6f}Z {f}")),
    "nanoseconds with a decimal point": Case(restamp(lambda t: [f"{1e9 * (EPOCH + x):.1f}" for x in t]), said="stamps are in ns"),
    "a counter of 16 bits of milliseconds": Case(restamp(lambda t: np.rint((1e3 * t + 65036) % 65536)), said="rolled over"),
    "negative seconds before a trigger": Case(restamp(lambda t: t - 0.7)),
    "ticks of 90 kHz": Case(restamp(lambda t: np.rint(9e4 * t)), step=None),
    "depth in another folder": Case(lambda d: [(d / "depth").rename(d / "depths"), (d / "depth.txt").write_text((d / "depth.txt").read_text().replace("depth/", "depths/"))]),
    "negative readings": Case(repaint(lambda i, raw: npy(np.where(raw == 0, -1, raw.astype(np.int32))), suffix=".npy"), holds=lambda s: not np.nanmin(s.depth(0)) < 0.0),
    "float16 in metres": Case(then(recalibrate(("K.txt", MATRIX)), repaint(lambda i, raw: npy((raw / 5000).astype(np.float16)), suffix=".npy")), holds=lambda s: 0.5 < np.nanmedian(s.depth(0)) < 3.0),
    "infinite floats": Case(then(recalibrate(("K.txt", MATRIX)), repaint(lambda i, raw: npy(np.where(raw == 0, np.inf, raw / 5000).astype(np.float32)), suffix=".npy")), holds=lambda s: not np.isinf(s.depth(0)).any()),
    "a third axis of one": Case(repaint(lambda i, raw: npy(raw[..., None]), suffix=".npy")),
    "focal length and optical centre": Case(recalibrate(("intrinsics.json", '{"focal_length": [60, 60], "principal_point": [31.5, 23.5]}')), holds=lambda s: s.camera.cx == 31.5),
    "capital names": Case(recalibrate(("intrinsics.json", '{"FX": 60.0, "FY": 60.0, "CX": 31.5, "CY": 23.5}')), holds=lambda s: s.camera.cx == 31.5),
    "librealsense's names": Case(recalibrate(("intrinsics.json", '{"width": 64, "height": 48, "ppx": 31.5, "ppy": 23.5, "fx": 60.0, "fy": 60.0, "model": "distortion.brown_conrady", "coeffs": [0, 0, 0, 0, 0]}')), holds=lambda s: s.camera.cx == 31.5),
    "numbers as words": Case(recalibrate(("camera.json", '{"fx": "60.0", "fy": "60.0", "cx": "31.5", "cy": "23.5"}')), said="camera.fx = '60.0': must be a finite number", refused=True),
    "K with commas": Case(recalibrate(("K.txt", "60.0, 0, 31.5\n0, 60.0, 23.5\n0, 0, 1\n")), holds=lambda s: s.camera.cx == 31.5),
    "K in brackets": Case(recalibrate(("K.txt", "[[60.0 0 31.5]\n [0 60.0 23.5]\n [0 0 1]]\n")), holds=lambda s: s.camera.cx == 31.5),
    "an infinite focal length": Case(recalibrate(("camera.json", '{"fx": Infinity, "fy": 60.0, "cx": 31.5, "cy": 23.5}')), said="fx", refused=True),
    "a focal length of zero": Case(recalibrate(camera_with(fx=0.0)), said="fx", refused=True),
    "a depth camera that is mirrored": Case(recalibrate(camera_with(depth={"fx": 66.0, "fy": -66.0, "cx": 31.5, "cy": 23.5})), said="camera.fy = -66: not a focal length", refused=True),
    "an offset in millimetres": Case(recalibrate(camera_with(depth={"fx": 66.0, "fy": 66.0, "cx": 31.5, "cy": 23.5, "translation": [20.0, 0, 0]})), said="not in millimetres", refused=True),
    # parts of a recording
    "from the middle": Case(lambda d: None, frames=20, in_order=False, options=RecordingConfig(start=0.66)),
    "to the middle": Case(lambda d: None, frames=21, options=RecordingConfig(end=0.67)),
    "every fourth frame": Case(lambda d: None, frames=10, in_order=False, step=4 * STEP, options=RecordingConfig(every=4)),
    "nothing of it": Case(lambda d: None, said="lasts 1.30 s", refused=True, options=RecordingConfig(start=7.0)),
}  # fmt: skip


def restore_rgb(folder: Path) -> None:
    (folder / "rgb.txt").write_text("\n".join(f"{i / 30:.6f} rgb/{i}.png" for i in range(N)))


def truth_moves(dataset: Dataset) -> bool:
    truth = dataset.ground_truth()
    return truth is not None and np.array_equal(truth.stamp, dataset.stamp) and truth.T_wc[:, 0, 3].tolist() == list(range(N))


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each picture holds its number, so that its place tells the order."""
    folder = write_recording(tmp_path_factory.mktemp("deformed") / "walk", frames=N)
    for i in range(N):
        (folder / "rgb" / f"{i}.png").write_bytes(png(np.full((SIZE[1], SIZE[0], 3), 2 * i, np.uint8)))
    return folder


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_deformed_recording(case: Case, pristine: Path, tmp_path: Path) -> None:
    import shutil

    folder = tmp_path / "walk"
    shutil.copytree(pristine, folder)
    case.change(folder)
    if case.refused:
        with pytest.raises(SlamError) as caught:
            open_dataset(str(folder), options=case.options)
        assert case.said in str(caught.value) and "\n" not in str(caught.value)
        return
    dataset = open_dataset(str(folder), options=case.options)
    assert case.said in "; ".join(dataset.warnings)
    assert len(dataset) == case.frames and (np.diff(dataset.stamp) > 0).all()
    if case.step is not None:
        assert np.median(np.diff(dataset.stamp)) == pytest.approx(case.step, rel=0.02)
    if case.in_order and "missing" not in case.said and "not there" not in case.said:
        assert [int(dataset.grey(i)[0, 0]) // 2 for i in range(0, case.frames, 7)] == list(range(0, case.frames, 7))
    assert np.isfinite(dataset.depth_stamp).sum() == (case.with_depth if case.with_depth is not None else case.frames)
    assert dataset.depth(case.frames - 1 if case.with_depth is None else 0).shape == (SIZE[1], SIZE[0])
    assert case.holds(dataset)


def test_there_are_enough_of_each_kind() -> None:
    assert len(CASES) >= 80 and sum(case.refused for case in CASES.values()) >= 15
