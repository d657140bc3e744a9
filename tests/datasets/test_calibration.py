"""Where intrinsics come from, and what is said when they cannot be right."""

import json
from pathlib import Path

import pytest
from recordings import CAMERA

from slamcli.datasets.calibration import find_camera
from slamcli.datasets.cameras import FREIBURG, freiburg_number
from slamcli.errors import SlamError

OWN = json.loads(CAMERA)


@pytest.mark.parametrize(
    ("name", "number"),
    [("rgbd_dataset_freiburg1_xyz", 1), ("freiburg2_desk", 2), ("fr3_office", 3), ("fr4_x", None), ("xfr1_y", None), ("freiburg1", None)],
)
def test_freiburg_number(name: str, number: int | None) -> None:
    assert freiburg_number(name) == number


def test_freiburg_by_folder_name(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg2_desk"
    folder.mkdir()
    assert find_camera(folder, None, (640, 480)) == FREIBURG[2]
    assert FREIBURG[2].depth_scale == 5208.0


def test_a_camera_file_counts_more_than_the_name(tmp_path: Path) -> None:
    folder = tmp_path / "fr1_mine"
    folder.mkdir()
    (folder / "camera.json").write_text(CAMERA)
    assert find_camera(folder, None, None).fx == 60.0


@pytest.mark.parametrize("head", ["", "[camera]\n"])
def test_toml_with_and_without_table(tmp_path: Path, head: str) -> None:
    (tmp_path / "camera.toml").write_text(head + "\n".join(f"{key} = {value}" for key, value in OWN.items()))
    assert find_camera(tmp_path, None, None).to_dict() == find_camera(tmp_path, OWN, None).to_dict()


def test_override_changes_single_keys_or_stands_alone(tmp_path: Path) -> None:
    folder = tmp_path / "fr1_x"
    folder.mkdir()
    assert find_camera(folder, {"depth_scale": 1000}, None).depth_scale == 1000
    assert find_camera(folder, {"depth_scale": 1000}, None).fx == FREIBURG[1].fx
    alone = {key: value for key, value in OWN.items() if key not in ("width", "height")}
    assert find_camera(tmp_path, alone, (64, 48)).width == 64  # the image says its size


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "cannot be parsed"),
        ("[1, 2]", "must be a table"),
        ("{}", "must be a table"),
        ('{"width": 64}', "missing"),
        (CAMERA.replace('"fx"', '"focal"'), "'focal' is not known"),
        (CAMERA.replace("60.0", '"sixty"'), "finite number"),
        (CAMERA.replace("60.0", "NaN"), "finite number"),
        (CAMERA.replace("31.5", "900"), "principal point"),
        (CAMERA.replace("5000", "0"), "depth_scale"),
        (CAMERA.replace("60.0", "0.001"), "focal length"),
    ],
)
def test_errors_name_the_file(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(SlamError, match=r"camera\.json") as caught:
        find_camera(tmp_path, None, None)
    assert said in str(caught.value)


def test_no_calibration_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match=r"camera\.toml"):
        find_camera(tmp_path, None, (64, 48))


def test_whole_numbers_written_as_floats_are_sizes(tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(CAMERA.replace("64", "64.0"))
    assert isinstance(find_camera(tmp_path, None, None).width, int)
