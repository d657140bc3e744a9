"""E57 clouds: the same points and colours in the library that others read them with."""

from pathlib import Path

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.formats import cloud


def test_pye57_reads_the_same_points(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    rng = np.random.default_rng(0)
    xyz, rgb = rng.uniform(-5, 5, (100, 3)).astype(np.float32), rng.integers(0, 256, (100, 3)).astype(np.uint8)
    cloud.write(tmp_path / "c.e57", xyz, rgb)
    file = pye57.E57(str(tmp_path / "c.e57"))
    found = file.read_scan(0, ignore_missing_fields=True, colors=True)
    np.testing.assert_allclose(np.stack([found[f"cartesian{axis}"] for axis in "XYZ"], axis=1), xyz, atol=1e-6)
    np.testing.assert_array_equal(np.stack([found[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=1), rgb)
    assert [path.name for path in tmp_path.iterdir()] == ["c.e57"]


def test_an_empty_cloud_is_refused_in_words(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    with pytest.raises(SlamError, match="at least one point"):
        cloud.write(tmp_path / "c.e57", np.zeros((0, 3), np.float32))
    assert list(tmp_path.iterdir()) == []
