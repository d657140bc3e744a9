"""What the camera truly saw of a simulated room, with people before it."""

from pathlib import Path

import cv2
import numpy as np

from slamcli.evaluation import map_error


def test_people_hide_what_is_behind_them_in_their_frame_alone(tmp_path: Path) -> None:
    depth, owner = np.full((12, 16), 2.0, dtype=np.float32), np.zeros((12, 16), dtype=np.uint8)
    owner[2:5, 3:9], owner[8:10, 0:4] = 1, 3
    (tmp_path / "moving").mkdir()
    assert cv2.imwrite(str(tmp_path / "moving" / "4.133333.png"), owner)
    still = map_error.without_people(depth, tmp_path, 4.1333333)
    np.testing.assert_array_equal(np.isnan(still), owner > 0)
    np.testing.assert_array_equal(map_error.without_people(depth, tmp_path, 4.2), depth)
