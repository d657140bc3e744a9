"""Optical flow: points of a shifted picture are followed, what is lost is said to be, and matches are one to one."""

import cv2
import numpy as np
import pytest

from slamcli.vision import optical_flow


def picture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.integers(0, 256, (240, 320), dtype=np.uint8), (0, 0), 2.0)


def shifted(grey: np.ndarray, dx: float, dy: float) -> np.ndarray:
    return cv2.warpAffine(grey, np.float32([[1, 0, dx], [0, 1, dy]]), grey.shape[::-1], borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (3.5, -2.25), (12.0, 7.0)])
def test_points_of_a_shifted_picture_are_followed(dx, dy):
    xy = np.random.default_rng(1).uniform(40, 200, (50, 2)).astype(np.float32)
    there = optical_flow.follow(picture(), shifted(picture(), dx, dy), xy)
    found = np.isfinite(there[:, 0])
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(there[found] - xy[found] - [dx, dy], axis=1)) < 0.1


def test_another_picture_loses_most_points_and_no_point_is_not_an_error():
    xy = np.random.default_rng(1).uniform(20, 220, (50, 2)).astype(np.float32)
    assert np.isnan(optical_flow.follow(picture(), picture(7), xy)[:, 0]).mean() > 0.5
    assert np.isnan(optical_flow.follow(picture(), np.zeros((240, 320), np.uint8), xy)).all()
    assert optical_flow.follow(picture(), picture(), np.zeros((0, 2), np.float32)).shape == (0, 2)


def test_matches_are_mutual_free_and_near():
    xy_i = np.array([[10.0, 10.0], [20.0, 10.0], [30.0, 10.0], [40.0, 10.0]])
    flowed_j = np.array([[20.5, 10.0], [10.2, 10.1], [20.1, 10.0], [np.nan, np.nan], [30.0, 13.0], [40.0, 10.0]])
    free_i, free_j = np.ones(4, bool), np.ones(6, bool)
    assert optical_flow.match(xy_i, flowed_j, is_free_i=free_i, is_free_j=free_j, radius=2.0).tolist() == [[0, 1], [1, 2], [3, 5]]
    free_i[0] = free_j[2] = False
    assert optical_flow.match(xy_i, flowed_j, is_free_i=free_i, is_free_j=free_j, radius=2.0).tolist() == [[1, 0], [3, 5]]
    assert optical_flow.match(xy_i, flowed_j, is_free_i=~np.ones(4, bool), is_free_j=free_j, radius=2.0).shape == (0, 2)
