"""A folder that does not open is told what was seen in it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from slamcli.datasets import open_dataset
from slamcli.errors import SlamError


def fill(folder: Path, n: int, dtype: type) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    image = np.zeros((4, 6, 3) if dtype is np.uint8 else (4, 6), dtype=dtype)
    for i in range(n):
        cv2.imwrite(str(folder / f"{i}.png"), image)


def refusal(folder: Path) -> str:
    with pytest.raises(SlamError) as told:
        open_dataset(str(folder))
    assert "\n" not in str(told.value)
    return str(told.value)


def test_colour_alone_is_told_to_lack_depth(tmp_path: Path) -> None:
    fill(tmp_path / "rgb", 5, np.uint8)
    assert "not a recording; 5 colour images in rgb/, no depth images (PNG of 16 bits); see" in refusal(tmp_path)


def test_depth_alone_is_told_to_lack_colour(tmp_path: Path) -> None:
    fill(tmp_path / "depth", 1, np.uint16)
    assert "; 1 16-bit image in depth/, no colour images; see" in refusal(tmp_path)
    (tmp_path / "my film.MP4").write_bytes(b"")
    assert "no colour images but the video my film.MP4: write its pictures into rgb/, as ffmpeg does" in refusal(tmp_path)


def test_both_kinds_under_other_names_are_told_which_names_open(tmp_path: Path) -> None:
    fill(tmp_path / "cam0", 5, np.uint8)
    fill(tmp_path / "cam1", 4, np.uint16)
    told = refusal(tmp_path)
    assert "5 colour images in cam0/, 4 16-bit images in cam1/: name the folders rgb and depth, or list the pairs" in told


def test_recordings_that_are_files_in_it_are_named(tmp_path: Path) -> None:
    (tmp_path / "walk.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "notes.txt").touch()
    assert "not a recording; recordings are in it: old.bag, walk.mcap; see" in refusal(tmp_path)


def test_a_folder_of_other_things_is_told_nothing_of_images(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").touch()
    assert "not a recording; see what opens" in refusal(tmp_path)
