"""LAS and LAZ files against laspy."""

from pathlib import Path

import numpy as np
import pytest

from slamcli.formats import cloud

laspy = pytest.importorskip("laspy")


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_laspy_reads_the_same_points_and_colours(ending: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-40.0, 60.0, (500, 3)).astype(np.float32)
    rgb = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    path = tmp_path / f"cloud.{ending}"
    cloud.write(path, xyz, rgb)
    read = laspy.read(path)
    assert (read.header.version.major, read.header.version.minor, read.header.point_format.id) == (1, 4, 7)
    np.testing.assert_allclose(read.xyz, xyz, atol=0.0006)
    assert np.array_equal(np.column_stack([read.red, read.green, read.blue]) >> 8, rgb)
    first = path.read_bytes()
    cloud.write(path, xyz, rgb)
    assert path.read_bytes() == first


def test_a_cloud_without_points_or_colours_is_a_file_too(tmp_path: Path) -> None:
    cloud.write(tmp_path / "none.las", np.zeros((0, 3), np.float32))
    assert len(laspy.read(tmp_path / "none.las").points) == 0
    cloud.write(tmp_path / "grey.las", np.ones((3, 3), np.float32))
    assert laspy.read(tmp_path / "grey.las").red.tolist() == [0, 0, 0]
