"""Cost maps, read back as nav2's map_io does in mode `scale`."""

import cv2
import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.formats import cost_map


def as_nav2_reads(path):
    """Follow map_io.cpp: transparent is unknown, else the shade between the two thresholds gives 0 to 100."""
    page = dict(line.split(": ", 1) for line in path.with_suffix(".yaml").read_text().splitlines())
    assert page["mode"] == "scale" and page["negate"] == "0"
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    shade, opacity = (picture[..., 0], picture[..., 3]) if picture.ndim == 3 else (picture, np.full(picture.shape, 255))
    occupied = 1.0 - shade / 255.0
    low, high = float(page["free_thresh"]), float(page["occupied_thresh"])
    value = np.where(occupied >= high, 100, np.where(occupied <= low, 0, np.rint((occupied - low) / (high - low) * 100.0)))
    return np.where(opacity < 255, -1, value)[::-1]


def test_every_cost_is_read_as_it_was_written(tmp_path):
    cost = np.concatenate([np.arange(101), [-1, -1, 0]]).reshape(8, 13).astype(np.int8)
    cost_map.write(tmp_path / "c.png", cost, origin=(-1.0, 2.5), resolution=0.05)
    assert np.array_equal(as_nav2_reads(tmp_path / "c.png"), cost)
    cost_map.write(tmp_path / "c.pgm", cost, origin=(-1.0, 2.5), resolution=0.05)
    assert np.array_equal(as_nav2_reads(tmp_path / "c.pgm"), np.where(cost < 0, 100, cost))
    assert "origin: [-1.0, 2.5, 0.0]" in (tmp_path / "c.yaml").read_text()


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(SlamError, match=r"\.pgm or \.png"):
        cost_map.write(tmp_path / "c.tif", np.zeros((2, 2), np.int8), origin=(0.0, 0.0), resolution=0.05)
