"""TUM and KITTI trajectory files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.errors import SlamError
from slamcli.formats import TRAJECTORY_FORMATS
from slamcli.formats.trajectory import read_tum, write_kitti, write_tum, writer
from slamcli.geometry import se3
from slamcli.schema import Trajectory

POSE = "1.0 2.0 3.0 0 0 0 1"


def random_trajectory(n: int, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamp = np.round(1.3e9 + np.cumsum(rng.uniform(0.001, 0.1, n)), 6)
    return Trajectory(stamp=stamp, T_wc=se3.exp(rng.uniform(-3, 3, (n, 6))))


@settings(deadline=None)
@given(n=st.integers(1, 20), seed=st.integers(0, 1000))
def test_read_returns_what_was_written(n: int, seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("trajectory") / "t.txt"
    written = random_trajectory(n, seed)
    write_tum(path, written)
    again = read_tum(path)
    np.testing.assert_allclose(again.stamp, written.stamp, atol=5e-7)
    np.testing.assert_allclose(again.T_wc, written.T_wc, atol=1e-8)


def test_comments_separators_and_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text(f"\ufeff# head\n\n  # indented\n2.5,1,2,3,0,0,0,2\n1.5\t{POSE}\n")
    trajectory = read_tum(path)
    assert trajectory.stamp.tolist() == [1.5, 2.5]  # sorted
    np.testing.assert_allclose(trajectory.T_wc[:, :3, 3], [[1, 2, 3], [1, 2, 3]])
    np.testing.assert_allclose(trajectory.T_wc[1, :3, :3], np.eye(3))  # the quaternion is normalized


def test_the_first_of_equal_stamps_counts(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("1 5 0 0 0 0 0 1\n1 6 0 0 0 0 0 1\n")
    assert read_tum(path).T_wc[:, 0, 3].tolist() == [5.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no pose"),
        ("# only comments\n", "holds no pose"),
        ("1 2 3\n", ":1: 3 columns"),
        (f"1 {POSE} 9\n", ":1: 9 columns"),
        (f"1 {POSE}\n2 a 2 3 0 0 0 1\n", ":2: not a number"),
        (f"1 {POSE}\nnan {POSE}\n", ":2: NaN"),
        ("1 1 2 inf 0 0 0 1\n", ":1: NaN"),
        ("1 1 2 3 0 0 0 0\n", "length 0"),
        ("\x00\x01\x02", "columns"),
    ],
)
def test_errors_name_file_and_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(SlamError, match="bad.txt") as caught:
        read_tum(path)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_missing_file_and_folder_are_told(tmp_path: Path) -> None:
    for path in (tmp_path / "none.txt", tmp_path):
        with pytest.raises(SlamError, match="cannot be read"):
            read_tum(path)
    with pytest.raises(SlamError, match="cannot be written"):
        write_tum(tmp_path / "no" / "folder.txt", random_trajectory(2, 0))


def test_kitti_rows_are_the_upper_matrix(tmp_path: Path) -> None:
    path = tmp_path / "k.txt"
    trajectory = random_trajectory(5, 1)
    write_kitti(path, trajectory)
    np.testing.assert_allclose(np.loadtxt(path).reshape(5, 3, 4), trajectory.T_wc[:, :3], atol=1e-8)


def test_evo_reads_the_same_poses(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    trajectory = random_trajectory(7, 2)
    write_tum(tmp_path / "t.txt", trajectory)
    write_kitti(tmp_path / "k.txt", trajectory)
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "t.txt"))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "k.txt"))
    np.testing.assert_allclose(np.array(tum.poses_se3), trajectory.T_wc, atol=1e-8)
    np.testing.assert_allclose(np.array(kitti.poses_se3), trajectory.T_wc, atol=1e-8)


@pytest.mark.parametrize("layout", TRAJECTORY_FORMATS)
def test_every_format_of_the_table_has_its_writer_and_its_own_endings(layout: str, tmp_path: Path) -> None:
    writer(layout)(tmp_path / "t", random_trajectory(4, 0))
    lines = (tmp_path / "t").read_text().splitlines()
    assert 4 <= len(lines) <= 5  # a line of names at most
    others = [ending for name, endings in TRAJECTORY_FORMATS.items() if name != layout for ending in endings]
    assert TRAJECTORY_FORMATS[layout] and not set(TRAJECTORY_FORMATS[layout]) & {*others, ".g2o"}
