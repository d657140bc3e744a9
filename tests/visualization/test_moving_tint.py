"""What moves is tinted in images, and nothing else."""

import base64
from types import SimpleNamespace

import cv2
import numpy as np
from boxroom import KINECT

from slamcli.report import pictures
from slamcli.schema import Moving
from slamcli.slam import depth_views
from slamcli.visualization import moving_tint

SHAPE = KINECT.height, KINECT.width


def masks() -> Moving:
    """Three frames: nothing moves in the first, a block in the second, a larger one in the third."""
    moving = np.zeros((3, *depth_views.shape(KINECT)), dtype=bool)
    moving[1, 4:6, 4:8] = moving[2, 2:12, 2:20] = True
    return Moving(moving)


def test_the_places_of_the_mask_are_tinted_and_the_rest_is_as_it_was() -> None:
    rgb = np.full((*SHAPE, 3), 100, np.uint8)
    assert moving_tint.tinted(rgb, Moving(), 1, KINECT) is rgb and moving_tint.tinted(rgb, masks(), 0, KINECT) is rgb
    changed = (moving_tint.tinted(rgb, masks(), 1, KINECT) != rgb).any(axis=2)
    side = SHAPE[1] // depth_views.shape(KINECT)[1]
    expected = np.zeros(SHAPE, dtype=bool)
    expected[4 * side : 6 * side, 4 * side : 8 * side] = True
    np.testing.assert_array_equal(changed, expected)


def test_the_report_shows_the_frame_in_which_most_moves_and_no_picture_where_nothing_does() -> None:
    dataset = SimpleNamespace(rgb=lambda i: np.full((*SHAPE, 3), 40 * i, np.uint8), camera=KINECT)

    def picture(moving: Moving) -> pictures.Picture | None:
        run = SimpleNamespace(load=lambda record, stage: moving, dataset=lambda: dataset)
        return pictures._moving(run, "What moves", np.zeros((0, 3)))  # type: ignore[arg-type]

    assert picture(Moving()) is None
    shown = picture(masks())
    assert (
        shown is not None and "frame 2" in shown.caption and "in 1 of 3 frames" in shown.caption
    )  # the block of the other is too small to count
    image = cv2.imdecode(np.frombuffer(base64.b64decode(shown.url.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[:2] == SHAPE and abs(int(image[-1, -1, 0]) - 80) < 4
