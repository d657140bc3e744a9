"""What people do to recordings of phones and other programs: file names, tables, descriptions, and what must come of it."""

import importlib.util
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import layouts
import numpy as np
import pytest
from layouts import Content
from recordings import png

from slamcli.datasets import Dataset, open_dataset
from slamcli.errors import SlamError

N, SIZE, START = 12, (64, 48), 1305031102_175304000  # frames, pixels, ns
CAMERA = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "depth_scale": 5000.0}
Change = Callable[[Path], object]


@pytest.fixture(scope="module")
def content() -> Content:
    """A wall that comes nearer by 2 cm a frame, so that a depth image tells which it is."""
    rng = np.random.default_rng(5)
    pictures = [png(rng.integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8), ".jpg") for _ in range(N)]
    raw = [np.full((SIZE[1], SIZE[0]), round(5000 * wall(i)), np.uint16) for i in range(N)]
    stamp = [START + 33_333_000 * i for i in range(N)]
    return Content(stamp, stamp, pictures, ".jpg", raw, dict(CAMERA), np.tile(np.eye(4), (N, 1, 1)))


def wall(i: int) -> float:
    """Return the distance [m] of the wall in frame i."""
    return 2.0 - 0.02 * i


@dataclass(frozen=True)
class Case:
    """What is done to a recording of 12 frames, and what must be said and hold."""

    change: Change
    said: str = ""  # in a warning, or in the refusal
    frames: tuple[int, ...] = tuple(range(N))  # that are left
    with_depth: tuple[int, ...] | None = None  # of these, all where not given
    refused: bool = False
    has_clock: bool = True


def described(name: str, change: Callable[[dict], object]) -> Change:
    """Change the description that a folder holds as JSON."""

    def go(folder: Path) -> None:
        about = json.loads((folder / name).read_text())
        change(about)
        (folder / name).write_text(json.dumps(about))

    return go


def each_frame(change: Callable[[int, dict], object]) -> Change:
    return described("transforms.json", lambda about: [change(i, frame) for i, frame in enumerate(about["frames"])])


def moved_into_frames(about: dict) -> None:
    own = {key: about.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    for frame in about["frames"]:
        frame.update(own)


def angle_instead(about: dict) -> None:
    for key in ("fl_x", "fl_y", "cx", "cy"):
        del about[key]
    about["camera_angle_x"] = 2.0 * np.arctan(32.0 / 60.0)


def reversed_without_stamps(about: dict) -> None:
    about["frames"].reverse()
    for frame in about["frames"]:
        del frame["timestamp"]


TRANSFORMS = {
    "untouched": Case(lambda d: None),
    "names without their suffix": Case(each_frame(lambda i, f: f.update(file_path=f["file_path"][:-4]))),
    "paths of another machine": Case(each_frame(lambda i, f: f.update(file_path=f"/home/me/{f['file_path'][2:]}"))),
    "intrinsics of each frame": Case(described("transforms.json", moved_into_frames)),
    "an angle of view": Case(described("transforms.json", angle_instead)),
    "an angle of view without a size": Case(
        described("transforms.json", lambda about: (angle_instead(about), about.pop("w"))), said="fx, fy, cx, cy are missing", refused=True
    ),
    "calibrated at twice the size": Case(
        described("transforms.json", lambda about: about.update(w=128, h=96, fl_x=120.0, fl_y=120.0, cx=63.5, cy=47.5))
    ),
    "depth of every other frame": Case(
        each_frame(lambda i, f: f.pop("depth_file_path") if i % 2 else None), with_depth=tuple(range(0, N, 2))
    ),
    "reversed, without stamps": Case(
        described("transforms.json", reversed_without_stamps), said="not in the order of their numbers", has_clock=False
    ),
    "stamps in quotes": Case(each_frame(lambda i, f: f.update(timestamp=str(f["timestamp"])))),
    "stamps that are words": Case(each_frame(lambda i, f: f.update(timestamp="noon")), said="has no time stamps", has_clock=False),
    "stamps in milliseconds": Case(each_frame(lambda i, f: f.update(timestamp=1e3 * f["timestamp"])), said="stamps are in ms"),
    "the unit in quotes": Case(described("transforms.json", lambda about: about.update(depth_unit_scale_factor="0.0002"))),
    "a byte order mark": Case(lambda d: (d / "transforms.json").write_bytes(b"\xef\xbb\xbf" + (d / "transforms.json").read_bytes())),
    "no depth": Case(each_frame(lambda i, f: f.pop("depth_file_path")), said="have no depth", refused=True),
}


def table(change: Callable[[list[str]], list[str]]) -> Change:
    """Change the lines of StrayScanner's table, the heading first."""
    return lambda d: (d / "odometry.csv").write_text("\n".join(change((d / "odometry.csv").read_text().splitlines())))


def renamed(source: str, to: str) -> Change:
    return lambda d: (d / source).rename(d / to)


def renumbered(shift: int) -> Change:
    def go(folder: Path) -> None:
        for file in sorted((folder / "depth").iterdir(), reverse=shift > 0):
            file.rename(file.with_name(f"{int(file.stem) + shift:06d}{file.suffix}"))

    return go


def calibrated(text: str | None) -> Change:
    """Put K into StrayScanner's own file, or nowhere."""

    def go(folder: Path) -> None:
        (folder / "camera.toml").unlink()
        if text is not None:
            (folder / "camera_matrix.csv").write_text(text)

    return go


STRAYSCANNER = {
    "untouched": Case(lambda d: None),
    "no blanks in the table": Case(table(lambda lines: [line.replace(" ", "") for line in lines])),
    "semicolons in the table": Case(table(lambda lines: [line.replace(", ", ";") for line in lines])),
    "the end of the table missing": Case(table(lambda lines: lines[:9]), said="4 frames without a time stamp", frames=tuple(range(8))),
    "the middle of the table missing": Case(
        table(lambda lines: lines[:4] + lines[7:]), said="3 frames without a time stamp", frames=(0, 1, 2, *range(6, N))
    ),
    "rows that do not say their frame": Case(table(lambda lines: [line.replace(" 0000", " x") for line in lines])),
    "rows all of one frame": Case(table(lambda lines: [lines[0], *(f"{line.split(',')[0]}, 7, 0, 0, 0, 0, 0, 0, 1" for line in lines[1:])])),
    "depth numbered from 1": Case(renumbered(1), said="paired in their order"),
    "three depth images missing": Case(
        lambda d: [(d / "depth" / f"{i:06d}.png").unlink() for i in (3, 4, 9)], with_depth=tuple(i for i in range(N) if i not in (3, 4, 9))
    ),
    "the first depth image missing": Case(lambda d: (d / "depth" / "000000.png").unlink(), with_depth=tuple(range(1, N))),
    "K in its own file": Case(calibrated("60.0, 0.0, 31.5\n0.0, 60.0, 23.5\n0.0, 0.0, 1.0\n")),
    "K by columns": Case(calibrated("60.0, 0.0, 0.0\n0.0, 60.0, 0.0\n31.5, 23.5, 1.0\n")),
    "no calibration": Case(calibrated(None), said="fx, fy, cx, cy are missing; put them into a camera.toml", refused=True),
    "a video in capitals": Case(renamed("rgb.mp4", "RGB.MP4")),
    "a video of another name": Case(renamed("rgb.mp4", "video.mov")),
    "two videos, neither the phone's": Case(
        lambda d: (renamed("rgb.mp4", "a.mp4")(d), shutil.copy(d / "a.mp4", d / "b.mp4")), said="rgb.mp4: is not there", refused=True
    ),
    "a video cut off": Case(lambda d: (d / "rgb.mp4").write_bytes((d / "rgb.mp4").read_bytes()[:900]), said="no video that can be read", refused=True),
}  # fmt: skip


RECORD3D = {
    "untouched": Case(lambda d: None),
    "a rate in place of stamps": Case(described("metadata.json", lambda about: (about.pop("frameTimestamps", 0), about.update(fps=30)))),
    "K as nested rows": Case(described("metadata.json", lambda about: about.update(K=np.reshape(about["K"], (3, 3)).tolist()))),
    "K of too few numbers": Case(described("metadata.json", lambda about: about.update(K=about["K"][:3])), said="K", refused=True),
    "a byte order mark": Case(lambda d: (d / "metadata.json").write_bytes(b"\xef\xbb\xbf" + (d / "metadata.json").read_bytes())),
}
NUMBERED = {"depth numbered from 1": Case(renumbered(1), said="paired in their order", has_clock=False)}
WRITERS: dict[str, tuple[Callable[[Content, Path], Path], str, dict[str, Case]]] = {
    "transforms": (layouts.transforms, "json", TRANSFORMS),
    "strayscanner": (layouts.phone, "av", STRAYSCANNER),
    "record3d": (layouts.record3d, "OpenEXR", RECORD3D),
    "numbered": (layouts.numbered, "json", NUMBERED),
}


@pytest.mark.parametrize(("layout", "what"), [(layout, what) for layout, (_, _, cases) in WRITERS.items() for what in cases])
def test_deformed_layout(layout: str, what: str, content: Content, tmp_path: Path) -> None:
    write, module, cases = WRITERS[layout]
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    case, folder = cases[what], write(content, tmp_path / "walk")
    case.change(folder)
    if case.refused:
        with pytest.raises(SlamError) as caught:
            open_dataset(str(folder))
        assert case.said in str(caught.value) and "\n" not in str(caught.value)
        return
    dataset = open_dataset(str(folder), camera=None if layout != "numbered" else {"depth_scale": 5000.0})
    assert dataset.reader == layout and case.said in "; ".join(dataset.warnings)
    if case.has_clock and layout != "record3d":
        np.testing.assert_allclose(dataset.stamp, [(START + 33_333_000 * i) / 1e9 for i in case.frames], atol=2e-6)
    assert frames_by_depth(dataset) == [i if case.with_depth is None or i in case.with_depth else None for i in case.frames]
    assert (dataset.camera.fx, dataset.camera.cx) == pytest.approx((60.0, 31.5))


def frames_by_depth(dataset: Dataset) -> list[int | None]:
    """Return which frame each depth image is of; None where a frame has none."""
    images = (dataset.depth(i) for i in range(len(dataset)))
    return [None if image is None else round((wall(0) - float(np.median(image))) / 0.02) for image in images]
