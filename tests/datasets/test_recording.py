"""A recording as it is delivered: large pictures made smaller with their camera, masks, and frames that cannot be read."""

import json
import os
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from recordings import png, write_recording

from slamcli.config.options import RecordingConfig
from slamcli.datasets import open_dataset, sources
from slamcli.datasets.assembly import reduction_of


@pytest.mark.parametrize(
    ("size", "reduction"),
    [
        ((640, 480), 1),
        ((1280, 720), 1),
        ((1280, 800), 1),
        ((1296, 968), 2),
        ((1920, 1080), 3),
        ((1920, 1440), 3),
        ((1440, 1920), 3),
        ((3840, 2160), 5),
    ],
)
def test_pictures_of_more_than_a_megapixel_come_down_to_about_that_of_vga(size: tuple[int, int], reduction: int) -> None:
    assert reduction_of(*size) == reduction
    if reduction > 1:
        assert 0.5 * 640 * 480 < size[0] // reduction * (size[1] // reduction) <= 1.5 * 640 * 480


def write_large(folder: Path, size: tuple[int, int] = (1920, 1440)) -> Path:
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    target = np.zeros((size[1], size[0], 3), np.uint8)
    cv2.circle(target, (1200, 300), 60, (255, 255, 255), -1)
    for i in range(3):
        (folder / "rgb" / f"{i}.jpg").write_bytes(png(target, ".jpg"))
        (folder / "depth" / f"{i}.png").write_bytes(png(np.full((192, 256), 1500 + i, np.uint16)))
    camera = {"width": size[0], "height": size[1], "fx": 1350.0, "fy": 1350.0, "cx": 962.0, "cy": 722.0, "depth_scale": 1000}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


@pytest.mark.shows("recording.full_size")
def test_large_pictures_keep_their_rays(tmp_path: Path) -> None:
    folder = write_large(tmp_path / "phone")
    small, large = open_dataset(str(folder)), open_dataset(str(folder), options=RecordingConfig(full_size=True))
    assert small.rgb(0).shape == (480, 640, 3) and large.rgb(0).shape == (1440, 1920, 3)
    assert small.depth(1).shape == (480, 640) and large.depth(1).shape == (1440, 1920)
    assert any("1920 x 1440 px are used at 640 x 480" in warning for warning in small.warnings)
    assert small.digest() != large.digest()
    centres = []
    for dataset in (small, large):
        v, u = np.nonzero(dataset.grey(0) > 128)
        centres.append(dataset.camera.normalize(np.array([u.mean(), v.mean()])))
    np.testing.assert_allclose(centres[0], centres[1], atol=0.1 / 450)


def test_masks_go_with_their_pictures(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "walk")
    (folder / "masks").mkdir()
    mask = np.zeros((48, 64), np.uint8)
    mask[10:20, 30:40] = 255
    (folder / "masks" / "2.png").write_bytes(png(mask))
    dataset = open_dataset(str(folder))
    assert [dataset.mask(i) is not None for i in range(4)] == [False, False, True, False]
    assert np.array_equal(dataset.mask(2), mask > 0)


def test_seven_scenes_without_intrinsics_has_depth_of_a_camera_of_its_own(tmp_path: Path) -> None:
    for i in range(3):
        for kind, image in (("color", np.full((480, 640, 3), 90, np.uint8)), ("depth", np.full((480, 640), 2000, np.uint16))):
            (tmp_path / f"frame-{i:06d}.{kind}.png").write_bytes(png(image))
    dataset = open_dataset(str(tmp_path))
    assert (dataset.reader, dataset.camera.fx, dataset.depth_camera.fx) == ("seven_scenes", 525.0, 585.0)
    assert np.isfinite(dataset.depth(0)).mean() > 0.75  # a Kinect's depth covers less than its colour picture
    assert any("registered to colour on reading (focal length 585.0 px, 25 mm aside)" in warning for warning in dataset.warnings)


def test_the_file_system_is_asked_for_each_image_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, asked = write_large(tmp_path / "phone"), Counter()
    stat = SimpleNamespace(stat=lambda path: (asked.update([str(path)]), os.stat(path))[1], path=os.path)
    monkeypatch.setattr(sources, "os", stat)
    dataset = open_dataset(str(folder))
    identity = dataset.digest()
    assert set(asked.values()) == {1} and len(asked) >= 6
    assert identity == open_dataset(str(folder)).digest() and set(asked.values()) == {2}
    (folder / "rgb" / "1.jpg").write_bytes((folder / "rgb" / "1.jpg").read_bytes() + b" ")
    assert open_dataset(str(folder)).digest() != identity
