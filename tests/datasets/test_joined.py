"""Recordings joined: one time line, frames numbered through, each picture that of its own recording."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import CAMERA, write_recording

from slamcli.datasets import open_dataset
from slamcli.datasets.joined import APART, JoinedDataset, check_different, in_order, unique_names
from slamcli.datasets.recording import Recording
from slamcli.errors import SlamError
from slamcli.formats.trajectory import write_tum
from slamcli.schema import Trajectory


def recording(folder: Path, *, start: float = 0.0, frames: int = 4, truth: bool = False, camera: str = CAMERA) -> Recording:
    write_recording(folder, frames=frames, camera=camera)
    if truth:
        stamp = np.arange(-3.0, 3.0, 0.01)
        T_wc = np.tile(np.eye(4), (len(stamp), 1, 1))
        T_wc[:, 0, 3] = stamp
        write_tum(folder / "groundtruth.txt", Trajectory(stamp=stamp, T_wc=T_wc))
    dataset = open_dataset(str(folder))
    assert isinstance(dataset, Recording)
    return replace(dataset, stamp=dataset.stamp + start, depth_stamp=dataset.depth_stamp + start)


@pytest.fixture
def three(tmp_path: Path) -> list[Recording]:
    return [recording(tmp_path / name, frames=n) for name, n in (("walk2", 3), ("walk10", 4), ("attic", 5))]


def test_clocks_decide_the_order_where_no_two_overlap_else_names(three: list[Recording], tmp_path: Path) -> None:
    for given in itertools.permutations(three):
        assert [given[i].name for i in in_order(given)] == ["attic", "walk2", "walk10"]
    days = [replace(one, stamp=one.stamp + day) for one, day in zip(three, (2e5, 1e5, 3e5), strict=True)]
    for given in itertools.permutations(days):
        assert [given[i].name for i in in_order(given)] == ["walk10", "walk2", "attic"]


def test_a_figure_that_is_no_number_stands_in_names_as_a_letter(three: list[Recording]) -> None:
    first, second, _ = three
    given = [replace(first, name="\u00b2"), replace(second, name="2")]
    assert [given[i].name for i in in_order(given)] == ["2", "\u00b2"]


def test_the_time_line_increases_and_moves_only_what_it_must(three: list[Recording]) -> None:
    later = replace(three[2], stamp=three[2].stamp + 5e5, depth_stamp=three[2].depth_stamp + 5e5)
    joined = JoinedDataset([three[0], three[1], later], ["a", "b", "c"])
    assert np.all(np.diff(joined.stamp) > 0)
    starts = joined.offset[1:-1]
    assert (joined.stamp[starts] - joined.stamp[starts - 1] >= APART).all()
    shift = joined.stamp - joined.recordings().own_stamp
    assert set(shift[:3]) == {0.0} and set(shift[7:]) == {0.0}
    assert len(np.unique(np.round(shift[3:7], 6))) == 1 and shift[3] == pytest.approx(np.ceil(shift[3]))
    np.testing.assert_allclose(joined.depth_stamp - joined.stamp, 0.004, atol=1e-9)


def test_each_frame_is_that_of_its_recording(three: list[Recording]) -> None:
    joined = JoinedDataset(three, ["a", "b", "c"])
    assert len(joined) == 12 and joined.camera == three[0].camera
    for i, (part, frame) in enumerate((one, frame) for one in three for frame in range(len(one))):
        np.testing.assert_array_equal(joined.rgb(i), part.rgb(frame))
        np.testing.assert_array_equal(joined.grey(i), part.grey(frame))
        np.testing.assert_array_equal(joined.depth(i), part.depth(frame))
        assert joined.mask(i) is None
    assert joined.colour_name[3] == "b/rgb/0.png" and joined.depth_name[11] == "c/depth/4.png"
    assert joined.place(0) == (0, 0) and joined.place(2) == (0, 2) and joined.place(3) == (1, 0) and joined.place(11) == (2, 4)


def test_pictures_of_another_camera_are_told_in_the_common_ones_pixels(tmp_path: Path, three: list[Recording]) -> None:
    other = recording(tmp_path / "other", camera=CAMERA.replace('"fx": 60.0, "fy": 60.0', '"fx": 90.0, "fy": 90.0'))
    joined = JoinedDataset([three[0], other], ["a", "b"])
    assert joined.camera.fx == 90.0 and joined.camera.width > 64
    assert joined.rgb(0).shape == joined.rgb(4).shape == (joined.camera.height, joined.camera.width, 3)
    assert joined.depth(4).shape == joined.grey(4).shape == (joined.camera.height, joined.camera.width)
    assert any("cameras differ" in warning for warning in joined.warnings)
    middle = joined.rgb(4)[joined.camera.height // 2, joined.camera.width // 2].astype(float)
    assert middle.sum() > 0 and joined.rgb(4)[0, 0].sum() == 0  # beyond what the narrower camera saw


def test_truth_is_told_on_the_time_line_and_only_around_each_recording(tmp_path: Path) -> None:
    parts = [recording(tmp_path / "a", truth=True), recording(tmp_path / "b"), recording(tmp_path / "c", truth=True)]
    joined = JoinedDataset(parts, ["a", "b", "c"])
    truth = joined.ground_truth()
    assert truth is not None and np.all(np.diff(truth.stamp) > 0)
    shift = joined.stamp[8] - joined.recordings().own_stamp[8]
    near = np.abs(truth.stamp[:, None] - joined.stamp[[0, 8]]).min(axis=1)
    assert near.max() < 1.3 and set(np.round(truth.stamp - truth.T_wc[:, 0, 3], 6)) == {0.0, round(float(shift), 6)}
    assert JoinedDataset(parts[1:2], ["b"]).ground_truth() is None


def test_names_are_unique_whatever_is_taken() -> None:
    assert unique_names(["tum/fr1_xyz", "fr1_xyz", "x/fr1_xyz", "room"]) == ["fr1_xyz", "fr1_xyz-2", "fr1_xyz-3", "room"]
    assert unique_names(["room"], taken=["room", "room-2"]) == ["room-3"]


def test_the_same_recording_twice_is_refused(three: list[Recording]) -> None:
    check_different(three)
    with pytest.raises(SlamError, match="the same recording as"):
        check_different([*three, three[1]])


def test_the_digest_tells_recordings_and_their_order_but_no_names(three: list[Recording]) -> None:
    digest = JoinedDataset(three, ["a", "b", "c"]).digest()
    assert digest == JoinedDataset(three, ["x", "y", "z"]).digest()
    assert digest != JoinedDataset(three[::-1], ["a", "b", "c"]).digest()
    assert digest != JoinedDataset(three[:2], ["a", "b"]).digest()
